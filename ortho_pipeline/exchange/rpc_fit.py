"""An RPC fitted to another model over its box: iterated, regularised ratios of cubics."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import longitudes_near
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.models.polynomials import terms_of
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.models.rpc_box import RPC_TERMS, has_pole

#: Errors (px) of a fitted RPC: above the first it is reported, above the second refused.
WARN_ERROR, REFUSE_ERROR = 0.02, 0.1
#: Weight of the penalty on the size of the normalised coefficients in `fit_rpc`, relative to one observation.
TIKHONOV = 1e-7
#: Iterations of the weights of a ratio; the best one counts.
_ITERATIONS = 5


@dataclass(frozen=True)
class RpcExport:
    """An RPC that represents another model.

    Parameters
    ----------
    rpc : RPC
    exact : bool
        Whether both are the same function of the ground, up to rounding.
    max_error_px : float
        Largest difference on an independent grid; 0 if exact.
    warnings : tuple of Notice
    """

    rpc: RPC
    exact: bool
    max_error_px: float
    warnings: tuple[Notice, ...] = ()


def fit_rpc(
    model: SensorModel,
    box: tuple[float, float, float, float],
    height_range: tuple[float, float],
    *,
    grid: tuple[int, int, int] = (15, 15, 7),
    force: bool = False,
) -> RpcExport:
    """Fit the 80 coefficients of an RPC to any model, on a grid of ground points at several heights.

    The linearised equations ``num - v den = 0`` are iterated with the weight ``1 / den`` (Sanathanan and Koerner 1963)
    and a small penalty, then verified on a grid of other points.

    Parameters
    ----------
    model : SensorModel
    box : (xmin, ymin, xmax, ymax)
        Longitudes and latitudes in degrees; xmax beyond 180 for a scene across the antimeridian.
    height_range : (lo, hi)
        Ellipsoidal metres.
    grid : (int, int, int)
        Points along longitude, latitude and height.
    force : bool
        Accept an error of more than 0.1 px.

    Raises
    ------
    InputError
        If the box is empty or mostly outside of the model, no sound RPC fits, or the fit is off by more than 0.1 px
        without `force`.
    """
    centre, half = _centre_and_half(box, height_range)
    ground, image = _samples(model, box, height_range, grid)
    middle = (image.min(axis=0) + image.max(axis=0)) / 2
    scale = np.maximum((image.max(axis=0) - image.min(axis=0)) / 2, 1.0)
    terms = terms_of(RPC_TERMS, (ground - centre) / half).T
    names = ("col_off", "row_off", "lon_off", "lat_off", "h_off", "col_scale", "row_scale", "lon_scale", "lat_scale")
    numbers = dict(zip((*names, "h_scale"), map(float, (*middle, *centre, *scale, *half)), strict=True))
    # A box across the antimeridian may extend beyond 180 degrees; readers of RPCs need an offset within.
    numbers["lon_off"] = math.remainder(numbers["lon_off"], 360.0)
    (col_num, col_den), (row_num, row_den) = (_fit_ratio(terms, (image - middle)[:, k] / scale[k]) for k in (0, 1))
    try:
        rpc = RPC(**numbers, col_num=col_num, col_den=col_den, row_num=row_num, row_den=row_den)
    except InputError as error:
        raise InputError(
            f"an RPC cannot represent this model ({error.message.replace('this RPC', 'the fitted RPC')})",
            remedy="fit it over a smaller box or height range, or export control points or geolocation arrays",
        ) from error
    nx, ny, nh = grid
    ground, image = _samples(model, box, height_range, (nx + 1, ny + 1, nh + 1))
    worst = float(np.abs(rpc.ground_to_image(ground) - image).max())
    if not worst <= REFUSE_ERROR and not force:
        fault = f"an RPC represents this model only to {significant(worst, 3)} px"
        raise InputError(
            fault if math.isfinite(worst) else "an RPC cannot represent this model over its heights",
            remedy="fit it over a smaller box or height range, or accept the error (force)",
        )
    text = f"the RPC represents the model only to {significant(worst, 3)} px"
    notices = (Notice("rpc-approximate", text, max_error_px=worst),) if worst > WARN_ERROR else ()
    return RpcExport(rpc, False, worst, notices)


def _fit_ratio(terms: Array, values: Array) -> tuple[Array, Array]:
    """Fit numerator and denominator ``(20,)`` of ``values (N,)`` on ``terms (N, 20)``.

    If the denominator gets a pole within the points, its coefficients are penalised more; the last resort is a plain
    polynomial.
    """
    for damping in (TIKHONOV, 1e-4, 1e-2):
        fitted = _iterate_ratio(terms, values, damping)
        if fitted is not None:
            return fitted
    num = np.asarray(np.linalg.lstsq(terms, values, rcond=None)[0], dtype=np.float64)
    den: Array = np.eye(20)[0]
    return num, den


def _iterate_ratio(terms: Array, values: Array, damping: float) -> tuple[Array, Array] | None:
    """Return the best of some iterations; None if the first one has a pole in the box of the terms."""
    system = np.column_stack([terms, -values[:, None] * terms[:, 1:], values])
    penalty = np.sqrt(len(terms)) * np.repeat([TIKHONOV, damping], [20, 19])
    denominator = np.ones(len(terms))
    best: tuple[float, Array, Array] | None = None
    for _ in range(_ITERATIONS):
        # The right side is the last column, so R is enough. The penalty is applied to the singular values of R: as
        # further rows of the system it would fill the reflections with denormal numbers.
        r: Array = np.asarray(np.linalg.qr(system / denominator[:, None], mode="r"))
        u, size, vt = np.linalg.svd(r[:39, :39] / penalty)
        solution: Array = vt.T @ (size / (size**2 + 1.0) * (u.T @ r[:39, 39])) / penalty
        num, den = solution[:20], np.concatenate([[1.0], solution[20:]])
        denominator = terms @ den
        if has_pole(den):
            break
        worst = float(np.abs(terms @ num / denominator - values).max())
        if best is None or worst < best[0]:
            best = worst, num, den
    return None if best is None else (best[1], best[2])


def _samples(
    model: SensorModel,
    box: tuple[float, float, float, float],
    height_range: tuple[float, float],
    grid: tuple[int, int, int],
) -> tuple[Array, Array]:
    ground = box_grid(box, height_range, grid)
    with np.errstate(all="ignore"):
        image = model.ground_to_image(ground_transform("EPSG:4979", model.crs)(ground))
    good = np.isfinite(image).all(axis=1)
    if good.mean() < 0.5:
        raise InputError(
            f"the model maps only {good.mean():.0%} of the box into the image",
            field="box",
            remedy="give a box within the scene",
        )
    return ground[good], image[good]


def _centre_and_half(box: tuple[float, float, float, float], height_range: tuple[float, float]) -> tuple[Array, Array]:
    low = np.array([box[0], box[1], height_range[0]], dtype=np.float64)
    high = np.array([box[2], box[3], height_range[1]], dtype=np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (high >= low).all() and (high > low)[:2].all()):
        raise InputError(f"the box {box} with heights {height_range} is empty", field="box")
    # A flat box would leave the terms in height undetermined.
    return (low + high) / 2, np.maximum((high - low) / 2, [0.0, 0.0, 1.0])


def box_grid(
    box: tuple[float, float, float, float], height_range: tuple[float, float], grid: tuple[int, int, int]
) -> Array:
    centre, half = _centre_and_half(box, height_range)
    axes = [middle + reach * np.linspace(-1.0, 1.0, n) for middle, reach, n in zip(centre, half, grid, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def domain_box(model: SensorModel) -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    """Return the domain of a model as a box in longitude and latitude, and its heights."""
    centre, half = model.domain
    signs = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    ground = ground_transform(model.crs, "EPSG:4979")(centre + signs * half)
    # Unwrapped about the middle: a scene across the antimeridian is one box.
    lon = longitudes_near(ground[:, 0], ground[13, 0])
    lat = ground[:, 1]
    return (float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())), model.height_range
