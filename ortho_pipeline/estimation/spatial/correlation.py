r"""Covariance analysis of residuals: do neighbouring points have similar errors, and what is their relative accuracy?

Pairs of points are sorted into classes of distance. For each class and axis, with residuals :math:`r` of variance
:math:`s^2` and mean :math:`m`:

- correlation :math:`\overline{(r_i - m)(r_j - m)} / s^2`,
- relative standard deviation :math:`\sqrt{\sum (r_i - r_j)^2 / (2 n)}`: below the RMSE of single points if neighbours
  have similar errors. Its square is the semivariance. The covariance function :math:`C(d) = \sigma_s^2 e^{-d / c}` of
  shared errors, with independent noise :math:`\sigma_n^2`, is fitted to it:
  :math:`\gamma(d) = \sigma_n^2 + \sigma_s^2 (1 - e^{-d / c})`.

Moran's I over the nearest neighbours of each point tests whether residuals are more similar than by chance, against
permutations of the residuals. Residuals of an adjustment are never independent (at least, they sum to zero), so each
permutation is adjusted again.

Source: section 3.3 and figure 7 of Bueyueksalih et al. (OrbView-3; the program BLAN); Moran 1950, Notes on continuous
stochastic phenomena (I); Cliff and Ord 1981, Spatial processes, chapter 8 (residuals of an adjustment); Cressie 1993,
Statistics for spatial data, section 2.6.2 (weighted fit to the semivariance).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import in_metres, metre_partials, with_reference_height
from ortho_pipeline.estimation.statistics import basis_of, student_of
from ortho_pipeline.files.json.records import Count, Pair, Record
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import enu_from_geodetic
from ortho_pipeline.models.base import Array

#: Chance that random residuals are called systematic.
SIGNIFICANCE = 0.05
#: With fewer points or fewer degrees of freedom nothing is tested.
FEWEST_POINTS = 8
#: Neighbours of each point in Moran's I.
NEIGHBOURS = 4
#: With fewer points the statement says that only strong systematic errors would show.
_SHARP = 30
#: More points cost time without benefit: a sample of this size is used.
MOST_POINTS = 1000
#: Least number of pairs in a class of distance, and largest number of classes.
_PAIRS_PER_CLASS, _MOST_CLASSES = 30, 12


Verdict = Literal["systematic", "none found", "too few points"]


class DistanceClass(Record):
    """Pairs of points whose distance is in a range, metres."""

    from_m: float
    to_m: float
    distance_m: float
    pairs: Annotated[int, pydantic.Field(ge=1)]
    correlation: Pair
    relative: Pair


class CovarianceFunction(Record):
    """Standard deviations of noise and of shared errors, and the distance at which 1/e of their covariance is left."""

    noise: float
    systematic: float
    range_m: float

    def covariance(self, distance: ArrayLike) -> Array:
        """Return the covariance of residuals at distances, without noise."""
        return np.asarray(self.systematic**2 * np.exp(-np.asarray(distance, dtype=np.float64) / self.range_m))

    def relative(self, distance: ArrayLike) -> Array:
        """Return the relative standard deviation at distances."""
        return np.sqrt(self.noise**2 + self.systematic**2 - self.covariance(distance))


class Covariance(Record):
    """Covariance analysis of residuals on the ground, per axis (x, y); see docs/engineering/accuracy.md."""

    # Pairs of numbers are per axis, in the unit of the residuals. `relative` and `correlation` are of pairs closer than
    # `near_m`, None without such pairs. A function is None if the covariance of its axis does not decrease with
    # distance. `moran`, `p` (per axis), `p_joint` (of the larger one) and `critical` (exceeded by chance in 1 of 20
    # cases) are of each point with its nearest neighbours; they are None for too few points.
    unit: str
    n: Count
    near_m: float | None
    pairs_near: Count
    mean: Pair
    mean_p: Pair | None
    absolute: Pair
    relative: Pair | None
    correlation: Pair | None
    classes: tuple[DistanceClass, ...]
    functions: tuple[CovarianceFunction | None, CovarianceFunction | None]
    moran: Pair | None
    p: Pair | None
    p_joint: float | None
    critical: float | None
    verdict: Verdict
    statement: str

    @property
    def is_tested(self) -> bool:
        """Whether there were enough points for a test and for classes of distance."""
        return self.p_joint is not None and len(self.classes) > 1


class Covariances(Record):
    """Covariance analysis of control and of check points, never of both together."""

    control: Covariance | None = None
    check: Covariance | None = None

    @property
    def drawn(self) -> tuple[Literal["control", "check"], Covariance] | None:
        """The role and the analysis to draw: check points if they could be tested, otherwise control points."""
        if self.check is not None and self.check.is_tested:
            return "check", self.check
        return None if self.control is None or not self.control.is_tested else ("control", self.control)


def analyse(
    xy: ArrayLike,
    residuals: ArrayLike,
    *,
    near: float | None = None,
    classes: Sequence[float] | None = None,
    design: ArrayLike | None = None,
    draws: int = 999,
    unit: str = "m",
) -> Covariance:
    """Analyse the residuals ``(N, 2)`` of points at ``xy (N, 2)`` metres; rows with NaN are ignored.

    Parameters
    ----------
    near : float, optional
        Distance (m) below which points are neighbours; default: a distance with as many pairs as points.
    classes : sequence of float, optional
        Edges (m) of the classes of distance; default: 0, `near`, and further classes with equal numbers of pairs.
    design : array (N, 2, P), optional
        Partials of the residuals by the adjusted parameters; default: a mean per axis.
    unit : str
        Unit of the residuals, for the statement.

    Raises
    ------
    InputError
        If the shapes do not match, or a distance is not positive.
    """
    where, values, partials = _usable(xy, residuals, design)
    mean, absolute = np.zeros(2), np.zeros(2)
    if len(values):
        mean, absolute = values.mean(axis=0), np.sqrt((values**2).mean(axis=0))
    i, j = np.triu_indices(len(values), 1)
    distance = np.hypot(*(where[i] - where[j]).T)
    near = _default_near(distance, len(values)) if near is None else _positive(near)
    edges = _edges(distance, near) if classes is None else _checked_edges(classes)
    products, halves = _pair_values(values, i, j)
    variance = ((values - mean) ** 2).mean(axis=0) if len(values) else np.ones(2)
    close = distance <= near if near is not None else np.zeros(len(distance), dtype=bool)
    some = bool(close.any())
    tested = _test(where, values, partials, draws)
    verdict: Verdict = "too few points"
    if tested is not None:
        verdict = "systematic" if tested[2] < SIGNIFICANCE else "none found"
    analysis = Covariance(
        unit=unit,
        n=len(values),
        near_m=near,
        pairs_near=int(close.sum()),
        mean=_pair(mean),
        mean_p=_mean_p(values),
        absolute=_pair(absolute),
        relative=_pair(np.sqrt(halves[close].mean(axis=0))) if some else None,
        correlation=_pair(_ratio(products[close].mean(axis=0), variance)) if some else None,
        classes=_classes(distance, products, halves, variance, edges),
        functions=(_function(distance, halves[:, 0]), _function(distance, halves[:, 1])),
        moran=tested and tested[0],
        p=tested and tested[1],
        p_joint=tested and tested[2],
        critical=tested and tested[3],
        verdict=verdict,
        statement="",
    )
    return analysis.replaced(statement=" ".join(_sentences(analysis)))


def analyse_fit(fit: Fit, *, near: float | None = None) -> Covariances:
    """Analyse the residuals of a fit on the ground (m, true east and north), for control and check points separately.

    Parameters
    ----------
    near : float, optional
        As for `analyse`.

    Examples
    --------
    >>> scene, points = op.open_scene("sample_data/scene.tif"), op.read_points("sample_data/gcps.geojson")
    >>> analyse_fit(scene.fit(points, "shift")).control.n
    12
    """
    points = fit.points
    if not len(points):
        return Covariances()
    shifts, where, control, check = in_metres(fit, fit.residuals), _on_the_ground(fit), None, None
    if fit.used.any():
        control = analyse(where[fit.used], shifts[fit.used], near=near, design=_design(fit)[fit.used])
    if points.check.any():
        check = analyse(where[points.tests], shifts[points.tests], near=near)
    return Covariances(control=control, check=check)


def _on_the_ground(fit: Fit) -> Array:
    """Return east and north (m) of the points in the local ENU frame of the first."""
    ground = with_reference_height(fit.model, fit.points.ground)
    geographic = ground_transform(fit.points.crs, "EPSG:4979")(ground)
    known = np.isfinite(geographic).all(axis=1)
    where = np.full((len(ground), 2), np.nan)
    if known.any():
        # Origin at the first point, because longitudes have no mean across the antimeridian.
        where[known] = enu_from_geodetic(geographic[known], geographic[known][0])[0][:, :2]
    return where


def _design(fit: Fit) -> Array:
    """Return the partials of residuals on the ground (m) by the parameters ``(N, 2, P)``."""
    plan, _ = metre_partials(fit.model, fit.points.ground)
    partials = fit.model.param_partials(with_reference_height(fit.model, fit.points.ground))
    solved = np.full(partials.shape, np.nan)
    regular = np.isfinite(plan).all(axis=(1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(plan))) > 0)
    solved[regular] = np.linalg.solve(plan[regular], partials[regular])
    return solved


def _usable(xy: ArrayLike, residuals: ArrayLike, design: ArrayLike | None) -> tuple[Array, Array, Array]:
    """Return positions, residuals and design of the points that have all three, at most `MOST_POINTS`."""
    where, values = np.asarray(xy, dtype=np.float64), np.asarray(residuals, dtype=np.float64)
    if where.ndim != 2 or where.shape[1:] != (2,) or where.shape != values.shape:
        raise InputError(f"positions and residuals must both be (N, 2), not {where.shape} and {values.shape}")
    mean = np.broadcast_to(np.eye(2), (len(values), 2, 2))
    partials = mean if design is None else np.asarray(design, dtype=np.float64)
    if partials.ndim != 3 or partials.shape[:2] != values.shape:
        raise InputError(f"the design of {counted(len(values), 'point')} must be (N, 2, P), not {partials.shape}")
    finite = np.isfinite(where).all(axis=1) & np.isfinite(values).all(axis=1) & np.isfinite(partials).all(axis=(1, 2))
    rows = np.flatnonzero(finite)
    if len(rows) > MOST_POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST_POINTS, replace=False))
    return where[rows], values[rows], partials[rows]


def _positive(near: float) -> float:
    if not (math.isfinite(near) and near > 0):
        raise InputError(f"near must be a positive distance, not {near!r}", field="near")
    return float(near)


def _checked_edges(classes: Sequence[float]) -> Array:
    edges = np.asarray(classes, dtype=np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.isfinite(edges).all() or (np.diff(edges) <= 0).any() or edges[0] < 0:
        raise InputError("the edges of classes must be ascending distances, not negative", field="classes")
    return edges


# -- pairs -----------------------------------------------------------------------------------------------------------


def _pair_values(values: Array, i: NDArray[Any], j: NDArray[Any]) -> tuple[Array, Array]:
    """Return the product about the mean and half the squared difference of each pair, both ``(pairs, 2)``."""
    about = values - values.mean(axis=0) if len(values) else values
    return about[i] * about[j], (values[i] - values[j]) ** 2 / 2


def _default_near(distance: Array, count: int) -> float | None:
    """Return the distance (rounded up to two digits) below which there are as many pairs as points, at least ten."""
    wanted = max(count, 10)
    if len(distance) < wanted:
        return None
    reach = float(np.partition(distance, wanted - 1)[wanted - 1])
    if reach <= 0:
        return None
    step = 10.0 ** (math.floor(math.log10(reach)) - 1)
    # Rounded to avoid values such as 0.30000000000000004.
    return float(f"{math.ceil(reach / step - 1e-9) * step:.6g}")


def _edges(distance: Array, near: float | None) -> Array:
    if near is None or not len(distance):
        return np.zeros(0)
    beyond = np.sort(distance[distance > near])
    count = min(_MOST_CLASSES - 1, len(beyond) // _PAIRS_PER_CLASS)
    cuts = beyond[np.linspace(0, len(beyond) - 1, count + 1).round().astype(int)[1:]] if count else beyond[-1:]
    return np.unique(np.concatenate([[0.0, near], cuts]))


def _classes(
    distance: Array, products: Array, halves: Array, variance: Array, edges: Array
) -> tuple[DistanceClass, ...]:
    classes: list[DistanceClass] = []
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        # The first class includes its lower edge, because two points may have the same position.
        within = (distance <= high) & ((distance > low) if classes or low > 0 else (distance >= low))
        if within.any():
            classes.append(
                DistanceClass(
                    from_m=low,
                    to_m=high,
                    distance_m=float(distance[within].mean()),
                    pairs=int(within.sum()),
                    correlation=_pair(_ratio(products[within].mean(axis=0), variance)),
                    relative=_pair(np.sqrt(halves[within].mean(axis=0))),
                )
            )
    return tuple(classes)


def _ratio(products: Array, variance: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance > 0, products / variance, 0.0)


def _pair(values: Array) -> Pair:
    return float(values[0]), float(values[1])


def _mean_p(values: Array) -> Pair | None:
    """Return the chance per axis of such a mean for independent errors with mean zero (t test)."""
    count = len(values)
    if count < FEWEST_POINTS:
        return None
    _, p = student_of(values.mean(axis=0), np.diag(values.var(axis=0, ddof=1) / count), count - 1)
    return _pair(np.nan_to_num(p, nan=1.0))


# -- the covariance function -----------------------------------------------------------------------------------------


def _function(distance: Array, halves: Array) -> CovarianceFunction | None:
    """Fit noise, shared part and range to the semivariances of classes of pairs, up to 3/4 of the longest distance.

    Weights are the number of pairs over the squared semivariance (Cressie). For a given range the model is linear in
    both variances, so only the range is searched. Returns None if the covariance does not decrease with distance.
    """
    if len(distance) < 3 * _PAIRS_PER_CLASS or not halves.any():
        return None
    reach = 0.75 * float(distance.max())
    order = np.argsort(distance)
    order = order[distance[order] <= reach]
    parts = np.array_split(order, min(30, max(len(order) // _PAIRS_PER_CLASS, 3)))
    at, seen = (np.array([values[part].mean() for part in parts]) for values in (distance, halves))
    pairs = np.array([len(part) for part in parts], dtype=np.float64)
    weight = pairs / np.maximum(seen, 1e-12 * seen.max()) ** 2
    for _ in range(4):
        noise, shared, length = _best_range(at, seen, weight, reach)
        model = noise + shared * -np.expm1(-at / length)
        weight = pairs / np.maximum(model, 1e-9 * seen.max()) ** 2
    if shared <= 0:
        return None
    return CovarianceFunction(noise=math.sqrt(noise), systematic=math.sqrt(shared), range_m=length)


def _best_range(at: Array, seen: Array, weight: Array, reach: float) -> tuple[float, float, float]:
    """Search the range on successively finer grids of its logarithm; return both variances and the range."""
    low, high = math.log(max(0.2 * at[0], 1e-4 * reach)), math.log(reach)
    for _ in range(5):
        grid = np.linspace(low, high, 25)
        rise = -np.expm1(-at / np.exp(grid)[:, None])
        noise, shared = _two_variances(rise, seen, weight)
        misfit = (weight * (seen - noise[:, None] - shared[:, None] * rise) ** 2).sum(axis=1)
        best = int(np.argmin(misfit))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    return float(noise[best]), float(shared[best]), math.exp(grid[best])


def _two_variances(rise: Array, seen: Array, weight: Array) -> tuple[Array, Array]:
    """Solve ``seen = noise + shared * rise`` for rows of `rise`, by weighted least squares with both not negative."""
    share = weight / weight.sum()
    mean_rise, mean_seen = rise @ share, float(seen @ share)
    about = rise - mean_rise[:, None]
    spread = (about**2) @ share
    shared = np.maximum(_ratio((about * (seen - mean_seen)) @ share, spread), 0.0)
    noise = mean_seen - shared * mean_rise
    alone = _ratio((rise * seen) @ share, (rise**2) @ share)
    return np.maximum(noise, 0.0), np.where(noise < 0, alone, shared)


# -- the test --------------------------------------------------------------------------------------------------------


def _test(where: Array, values: Array, design: Array, draws: int) -> tuple[Pair, Pair, float, float] | None:
    """Return Moran's I, its p per axis and of the larger one, and the critical value; None for too few points."""
    count = len(values)
    basis = _basis(design)
    if count < FEWEST_POINTS or 2 * count - basis.shape[1] < FEWEST_POINTS:
        return None
    pairs = _nearest(where)
    seen = _moran(_projected(values[None], basis), *pairs)[0]
    random = np.random.default_rng(0)
    drawn = [
        _moran(_projected(values[random.permuted(np.tile(np.arange(count), (size, 1)), axis=1)], basis), *pairs)
        for size in [len(part) for part in np.array_split(np.arange(draws), max(1, draws * count // 200_000))]
    ]
    null = np.concatenate(drawn)
    hair = 1e-12
    p = (1 + (null >= seen - hair).sum(axis=0)) / (1 + draws)
    largest = null.max(axis=1)
    joint = (1 + (largest >= seen.max() - hair).sum()) / (1 + draws)
    # Exactly the values above this one have a p below the limit.
    rank = max(1, math.ceil(SIGNIFICANCE * (1 + draws)) - 1)
    return _pair(seen), _pair(p), float(joint), float(np.sort(largest)[-rank])


def _basis(design: Array) -> Array:
    """Return orthonormal columns ``(2 N, rank)`` that span what the adjustment removes from residuals."""
    if not design.size:
        return np.zeros((2 * len(design), 0))
    rows = design.reshape(-1, design.shape[2])
    scale = np.linalg.norm(rows, axis=0)
    return basis_of(rows / np.where(scale > 0, scale, 1.0))


def _projected(values: Array, basis: Array) -> Array:
    """Return residuals ``(K, N, 2)`` after an adjustment."""
    rows = values.reshape(len(values), -1)
    return np.asarray((rows - (rows @ basis) @ basis.T).reshape(values.shape))


def _nearest(where: Array) -> tuple[NDArray[Any], NDArray[Any]]:
    from scipy.spatial import cKDTree

    # If several points have the same position, the nearest is not always the point itself.
    _, nearest = cKDTree(where).query(where, k=NEIGHBOURS + 1)
    first = np.repeat(np.arange(len(where)), NEIGHBOURS + 1)
    second = np.asarray(nearest).ravel()
    other = first != second
    return first[other], second[other]


def _moran(values: Array, first: NDArray[Any], second: NDArray[Any]) -> Array:
    """Return Moran's I per axis ``(K, 2)`` of K sets of residuals ``(K, N, 2)``."""
    about = values - values.mean(axis=1, keepdims=True)
    return _ratio((about[:, first] * about[:, second]).mean(axis=1), (about**2).mean(axis=1))


# -- the statement ---------------------------------------------------------------------------------------------------


def _sentences(analysis: Covariance) -> list[str]:
    if analysis.moran is None or analysis.critical is None:
        return [
            f"{counted(analysis.n, 'point')}: too few to distinguish systematic errors from chance. The test needs "
            f"{FEWEST_POINTS} points, and {FEWEST_POINTS} observations more than parameters."
        ]
    alike = "{:+.2f} in x and {:+.2f} in y".format(*analysis.moran)
    many = round(1 / SIGNIFICANCE)
    limit = f"{analysis.critical:+.2f} in {many - 1} scenes of {many}"
    chance = f"Without systematic errors, the larger one (with its sign) is below {limit}"
    if analysis.critical < 0:
        chance += " (residuals of a fit to few points are negatively correlated)"
    result, here = "No systematic error was found", "Here it is below that"
    if analysis.verdict == "systematic":
        result, here = "Systematic errors remain", "Here it is above that"
    sentences = [
        f"{result}. The residuals of neighbours (the {NEIGHBOURS} nearest points) have a correlation of {alike}. "
        f"{chance}. {here}."
    ]
    if analysis.verdict == "systematic":
        sizes = [
            f"{function.systematic:.2f} {analysis.unit} in {axis}"
            for axis, function, p in zip("xy", analysis.functions, analysis.p or (1.0, 1.0), strict=True)
            if function is not None and p < SIGNIFICANCE
        ]
        if sizes:
            sentences.append(f"The systematic errors have a standard deviation of about {' and '.join(sizes)}.")
        sentences.append("The accuracy at check points includes them: if it suffices, nothing is to be done.")
        sentences.append("They can come from the DEM, the model, the points, or the reference of matches.")
    if analysis.verdict != "systematic" and analysis.n < _SHARP:
        sentences.append(f"With {analysis.n} points, only a strong systematic error would show.")
    if analysis.relative is not None:
        near, single = (
            f"{x:.2f} {analysis.unit} in x and {y:.2f} {analysis.unit} in y"
            for x, y in (analysis.relative, analysis.absolute)
        )
        sentences.append(
            f"Between points closer than {analysis.near_m:g} m ({counted(analysis.pairs_near, 'pair')}) the relative "
            f"error is {near}. The error of a single point is {single}."
        )
    if analysis.mean_p and min(analysis.mean_p) < SIGNIFICANCE / 2:
        off = "{:+.2f} and {:+.2f}".format(*analysis.mean)
        sentences.append(f"The mean residual is {off} {analysis.unit}, more than chance explains.")
    return [text.replace(" -", " −") for text in sentences]
