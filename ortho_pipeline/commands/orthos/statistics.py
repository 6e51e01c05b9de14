"""How accurate an ortho is: bias, RMSE and CE90 with 95 % intervals, from its displacement field or from points.

The field is drawn many times, conditioned on the matches (`estimation.spatial.displacement_field`). Each statistic is
computed from each draw. So intervals include errors that neighbouring matches share, and places between matches. The
accuracy of the ortho does not include the noise of single matches. CE90 is the 90th percentile of the length of the
displacement over the tested area.

Points are few, so errors are assumed to be normal: mean and covariance are drawn from their posterior.

Source: ASPRS 2023, Positional Accuracy Standards for Digital Geospatial Data, edition 2; Gelman et al. 2013, section
3.6 (normal data, both parameters unknown).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import spatial

from ortho_pipeline.commands.orthos.measuring import CELLS, MeasuredOrtho
from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField
from ortho_pipeline.models.base import Array

#: A cell is tested if a match is nearer than so many spacings of tried places.
_REACH = 2.0
_LEVELS = 0.025, 0.975
#: Minimum number of points for a covariance.
FEWEST_POINTS = 4
#: Draws of means and covariances of points, and of errors for each.
_DRAWS, _ERRORS = 2000, 500
NAMES = ("bias_east", "bias_north", "bias", "rmse", "ce90")


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, draws: Array, value: float | None = None) -> Estimate:
        """Return the estimate of draws ``(k,)``: their median, or a value."""
        low, high = np.quantile(draws, _LEVELS)
        middle = float(np.median(draws)) if value is None else value
        return cls(middle, float(low), float(high))

    def scaled(self, factor: float) -> Estimate:
        """Return it in other units."""
        return Estimate(self.value * factor, self.low * factor, self.high * factor)

    def to_json(self) -> dict[str, float]:
        """Return value, low and high."""
        return {"value": self.value, "low": self.low, "high": self.high}


@dataclass(frozen=True)
class Accuracy:
    """Bias, RMSE and CE90 in metres; `bias` is the length of the mean displacement."""

    bias_east: Estimate
    bias_north: Estimate
    bias: Estimate
    rmse: Estimate
    ce90: Estimate

    @classmethod
    def of_fields(cls, draws: Array) -> Accuracy:
        """Return the accuracy of fields ``(k, m, 2)``."""
        mean, length = draws.mean(axis=1), np.hypot(draws[..., 0], draws[..., 1])
        return cls(
            Estimate.of(mean[:, 0]),
            Estimate.of(mean[:, 1]),
            Estimate.of(np.hypot(*mean.T), float(np.hypot(*np.median(mean, axis=0)))),
            Estimate.of(np.sqrt((length**2).mean(axis=1))),
            Estimate.of(np.quantile(length, 0.9, axis=1)),
        )

    @classmethod
    def of_points(cls, errors: Array, seed: int = 0) -> Accuracy:
        """Return the accuracy from the errors ``(n, 2)`` of independent points."""
        from scipy.stats import invwishart  # importing it would take most of the start-up of what uses no points

        count = len(errors)
        random = np.random.default_rng(seed)
        mean, about = errors.mean(axis=0), errors - errors.mean(axis=0)
        scatter = about.T @ about + 1e-12 * np.eye(2)
        covariances = invwishart.rvs(count - 1, scatter, size=_DRAWS, random_state=random)
        roots = np.linalg.cholesky(covariances)
        means = mean + np.einsum("kij,kj->ki", roots, random.standard_normal((_DRAWS, 2))) / np.sqrt(count)
        drawn = means[:, None] + np.einsum("kij,knj->kni", roots, random.standard_normal((_DRAWS, _ERRORS, 2)))
        length = np.hypot(drawn[..., 0], drawn[..., 1])
        rmse = np.sqrt((means**2).sum(axis=1) + np.trace(covariances, axis1=1, axis2=2))
        return cls(
            Estimate.of(means[:, 0], float(mean[0])),
            Estimate.of(means[:, 1], float(mean[1])),
            Estimate.of(np.hypot(*means.T), float(np.hypot(*mean))),
            Estimate.of(rmse, float(np.sqrt((errors**2).sum(axis=1).mean()))),
            Estimate.of(np.quantile(length, 0.9, axis=1)),
        )

    def in_pixels(self, pixel: float) -> Accuracy:
        """Return it in pixels of so many metres."""
        return replace(self, **{name: getattr(self, name).scaled(1.0 / pixel) for name in NAMES})

    def to_json(self, pixel: float) -> dict[str, Any]:
        """Return all in metres and in pixels."""
        pixels = self.in_pixels(pixel)
        return {f"{name}_m": getattr(self, name).to_json() for name in NAMES} | {
            f"{name}_px": getattr(pixels, name).to_json() for name in NAMES
        }


@dataclass(frozen=True, eq=False)
class Verified:
    """The displacement field of an ortho where it is tested.

    Parameters
    ----------
    field : DisplacementField
        In metres, over the image (px), without parts that are displaced.
    cells : (m, 2)
        Middles of the tested cells, px.
    draws : (k, m, 2)
        Fields there, metres to east and north.
    tested : float
        Part of the image with values that is tested.
    """

    measured: MeasuredOrtho
    field: DisplacementField
    cells: Array
    draws: Array
    tested: float

    @classmethod
    def of(cls, measured: MeasuredOrtho, seed: int = 0) -> Verified:
        """Return the displacement field of an ortho from its matches."""
        field = measured.field
        cells = tested_cells(measured)
        draws = field.draws(cells, seed)
        if measured.apart.any():
            draws = _with_parts(draws, measured, cells, seed)
        # Residuals cannot show an error that all matches share.
        alike = measured.pixel * measured.alike(field.noise / measured.pixel)
        common = np.random.default_rng([seed, 1]).normal(0.0, alike, (len(draws), 1, 2))
        return cls(measured, field, cells, draws + common, len(cells) / measured.shown.sum())

    @property
    def mean(self) -> Array:
        """The likeliest displacement ``(m, 2)`` of the cells, metres."""
        return np.asarray(self.draws.mean(axis=0))

    def relative(self) -> Accuracy:
        """Return the accuracy relative to the references."""
        return Accuracy.of_fields(self.draws)

    def absolute(self, reference_sigma: float, seed: int = 0) -> Accuracy:
        """Return the accuracy on the ground, where the references as a whole are displaced by an unknown shift."""
        random = np.random.default_rng([seed, 2])
        shifts = random.normal(0.0, reference_sigma, (len(self.draws), 1, 2))
        return Accuracy.of_fields(self.draws + shifts)


def _with_parts(draws: Array, measured: MeasuredOrtho, cells: Array, seed: int) -> Array:
    """Return fields ``(k, m, 2)`` at cells with the displaced parts, which have edges that no smooth field follows.

    An edge is anywhere between the matches on both sides.
    """
    part, rest = measured.apart, ~(measured.apart | measured.local)
    inner, near = spatial.cKDTree(measured.image[part]).query(cells)
    outer, _ = spatial.cKDTree(measured.image[rest]).query(cells)
    edge = np.random.default_rng([seed, 3]).uniform(-_spacing(measured), _spacing(measured), (len(draws), 1))
    moved = draws - draws.mean(axis=0) + measured.displacement[part][near]
    return np.where((outer - inner > edge)[..., None], moved, draws)


def _spacing(measured: MeasuredOrtho) -> float:
    """Return the mean distance (px) between tried places."""
    return math.sqrt(math.prod(measured.size) / max(len(measured.searched.matches.image), 1))


def tested_cells(measured: MeasuredOrtho) -> Array:
    """Return the middles ``(m, 2)`` px of the cells of an image that have values, and matches near them."""
    size = np.array(measured.size, dtype=float)
    steps = (np.arange(CELLS) + 0.5) / CELLS
    cells = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * size
    reach = _REACH * max(_spacing(measured), float(size.max()) / CELLS)
    near, _ = spatial.cKDTree(measured.image).query(cells)
    return np.asarray(cells[(near <= reach) & measured.shown.ravel()])


def slopes_of(verified: Verified) -> tuple[Array, Array]:
    """Return how the displacement changes ``(2, 2)`` per metre of the columns and rows, and its sigmas.

    Rows are east and north, columns metres along the columns and along the rows.
    """
    step = np.linalg.norm(verified.measured.metres, axis=0)
    about = (verified.cells - verified.cells.mean(axis=0)) * step
    design = np.column_stack([np.ones(len(about)), about])
    found = np.einsum("pm,kma->kap", np.linalg.pinv(design), verified.draws)[:, :, 1:]
    return found.mean(axis=0), found.std(axis=0)


def profile(verified: Verified, axis: int, bins: int = 12) -> list[dict[str, Any]]:
    """Return the mean displacement in strips of columns (axis 0) or rows (1), with 95 % intervals, metres."""
    edges = np.linspace(0.0, verified.measured.size[axis], bins + 1)
    place: NDArray[np.int_] = np.clip(np.digitize(verified.cells[:, axis], edges) - 1, 0, bins - 1)
    found = []
    for number in np.unique(place).tolist():
        east, north = verified.draws[:, place == number].mean(axis=1).T
        found.append(
            {
                "from": float(edges[number]),
                "to": float(edges[number + 1]),
                "east_m": Estimate.of(east).to_json(),
                "north_m": Estimate.of(north).to_json(),
            }
        )
    return found
