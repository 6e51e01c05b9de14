"""Results as matplotlib's axes, for notebooks and papers; the plots of reports are drawings (`drawing`)."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import installing
from ortho_pipeline.estimation.choice.comparison import ComparisonRecord
from ortho_pipeline.estimation.fit import Fit

#: Kind of point or figure -> mark and colour.
_MARKS = {
    "control": ("o", "tab:blue"),
    "check": ("s", "tab:orange"),
    "out": ("x", "tab:gray"),
    "loo": ("v", "tab:green"),
}
_NAMES = {"control": "control", "check": "check", "out": "left out", "loo": "each left out in turn"}


@functools.singledispatch
def plot(result: object, axes: Any = None) -> Any:
    """Draw a fit (its residual vectors) or a comparison (the RMSE of all models) with matplotlib; return the axes.

    Parameters
    ----------
    axes : matplotlib axes, optional
        Drawn on; new ones without.

    Raises
    ------
    InputError
        If matplotlib is not installed, or the result is neither.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> scene, points = op.open_scene("sample_data/scene.tif"), op.read_points("sample_data/gcps.geojson")
    >>> op.plot(scene.fit(points, "shift")).get_ylabel()
    'row, px'
    """
    raise InputError(
        f"there is no plot of a {type(result).__name__}", field="result", remedy="give a fit or a comparison"
    )


@plot.register
def _(fit: Fit, axes: Any = None) -> Any:
    kinds = np.where(fit.points.control & ~fit.used, "out", fit.points.roles)
    return residual_axes(fit.points.image, fit.residuals, kinds.tolist(), repr(fit)[1:-1], axes)


@plot.register
def _(comparison: ComparisonRecord, axes: Any = None) -> Any:
    rmses = {
        row.model: {kind: found.total for kind, found in row.rmse if found} for row in comparison.rows if not row.error
    }
    return rmse_axes(rmses, comparison.recommended, axes)


def residual_axes(
    image: NDArray[np.float64], residuals: NDArray[np.float64], kinds: Sequence[str], title: str, axes: Any
) -> Any:
    """Draw residual vectors (px, drawn longer) at their places in the image; return the axes.

    Parameters
    ----------
    image, residuals : ndarray (N, 2)
        Column, row; what is not finite is left out.
    kinds : sequence of str
        ``control``, ``check`` or ``out`` of each point; those have a mark and no arrow.

    Raises
    ------
    InputError
        If matplotlib is not installed.
    """
    axes = axes if axes is not None else _new()
    kind = np.array(kinds)
    known = np.isfinite(image).all(axis=1) & np.isfinite(residuals).all(axis=1)
    for name, (mark, colour) in _MARKS.items():
        some = known & (kind == name)
        if not some.any():
            continue
        axes.plot(*image[some].T, mark, color=colour, markersize=4, label=_NAMES[name])
        if name != "out":
            axes.quiver(
                *image[some].T,
                *residuals[some].T,
                color=colour,
                angles="xy",
                width=0.004,
                scale=_scale(image[known], residuals[known & (kind != "out")]),
                scale_units="xy",
            )
    axes.set_title(title)
    axes.set_xlabel("column, px")
    axes.set_ylabel("row, px")
    axes.set_aspect("equal")
    if not axes.yaxis_inverted():
        axes.invert_yaxis()
    if known.any():
        axes.legend()
    return axes


def rmse_axes(rows: Mapping[str, Mapping[str, float]], chosen: str | None, axes: Any) -> Any:
    """Draw the RMSE (px) of models by what they are of (``control``, ``check``, ``loo``); return the axes.

    Raises
    ------
    InputError
        If matplotlib is not installed.
    """
    axes = axes if axes is not None else _new()
    names = list(rows)
    for kind in ("control", "loo", "check"):
        found = [(rows[name][kind], k) for k, name in enumerate(names) if rows[name].get(kind)]
        if found:
            mark, colour = _MARKS[kind]
            axes.plot(*zip(*found, strict=True), mark, color=colour, label=_NAMES[kind])
    axes.set_yticks(range(len(names)), [f"{name} (recommended)" if name == chosen else name for name in names])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("RMSE, px")
    axes.legend()
    return axes


def _scale(image: NDArray[np.float64], residuals: NDArray[np.float64]) -> float:
    """Return pixels of residual per pixel drawn: the longest arrow is a tenth of what the points span."""
    longest = float(np.hypot(*residuals.T).max(initial=0.0))
    span = float(np.ptp(image, axis=0).max(initial=0.0))
    return 10.0 * longest / span if longest > 0 and span > 0 else 1.0


def _new() -> Any:
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise InputError(
            "plots need matplotlib, which is not installed",
            field="axes",
            remedy=installing("plots"),
        ) from error
    return pyplot.subplots(layout="constrained")[1]
