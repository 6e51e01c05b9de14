r"""The displacement field of an image, from displacements that matches measured: its most likely value at every place.

Along each of two axes, :math:`d(x) = F(x) b + s(x) + n`: an affine trend, a smooth field with
:math:`\mathrm{cov}(s_i, s_j) = \sigma_s^2 k(d_{ij} / c)`, and noise of matching with the variances
:math:`\sigma_n^2 w_i`. Chips that overlap share noise: a shift is a mean over the pixels of a chip, so the correlation
is the part of its pixels that one shares with the other. Errors of drawn pairs whose truth is known have this
correlation. A match measures the mean displacement of its chip. So no field has a shorter range than its side, and the
covariance of two means is that at the root mean square distance of their points, :math:`d^2 + a^2 / 3` for chips of
side :math:`a`. Without it a rough field explains the noise that chips share, and too little noise remains.

Smoothness, range and strength of the field are unknown. So all functions of `shared_errors` have the same prior weight
and are weighted by their restricted likelihood. A trend without slopes (a mere shift) is as likely beforehand as one
with slopes. Fields are drawn from all of them (conditional simulation by universal
kriging). A statistic of the field (its mean, its RMSE, a percentile of its length) is computed from each draw. Its
spread includes the errors that neighbours share, places without matches, and the unknown function.

Source: Cressie 1993, sections 3.4 (universal kriging) and 3.6.2 (conditional simulation); Handcock and Stein 1993;
Kass and Raftery 1995, section 4.1 (Schwarz criterion).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, spatial, special

from ortho_pipeline.errors import TooFewPoints
from ortho_pipeline.estimation.spatial.shared_errors import FAMILIES
from ortho_pipeline.models.base import Array

#: Minimum number of displacements for a field.
FEWEST_POINTS = 12
#: Maximum numbers of displacements: for the field, and to weight the functions. More cost time and change little.
_MOST_POINTS, _TRIED = 500, 200
#: Ranges and ratios of variances, field over noise, that are tried.
_RANGES, _RATIOS, _LARGEST = 8, 16, 1e4
#: Functions that are drawn for one set of fields, and the fields of each.
_FUNCTIONS, _OF_EACH = 50, 20
#: A displacement is local if it differs by so many sigmas from the prediction of its neighbours.
_LOCAL = 4.5
#: Part of the noise that chips share at one place; the rest is of each alone.
_OF_PIXELS = 0.98
#: Variance that is added to a field that is drawn, over that of field and noise: a thousandth of their size.
_SMALL = 1e-6
#: Rounds of leaving local displacements out.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class _Axis:
    """The likely functions of one axis, with noise in units of the axis."""

    kernels: tuple[tuple[int, float], ...]  # family and range
    ratios: Array
    chance: Array  # (kernels, ratios)
    squares: Array  # (kernels, ratios): weighted sum of squares of what is left
    freedom: int

    @property
    def best(self) -> tuple[int, int]:
        """The likeliest function."""
        kernel, ratio = np.unravel_index(int(self.chance.argmax()), self.chance.shape)
        return int(kernel), int(ratio)


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """What the displacement of an image is likely to be at each place.

    Parameters
    ----------
    place, value : (n, 2)
        Where displacements were measured, in units of the extent, and the displacements.
    weight : (n,)
        Variances of the noise, relative to each other.
    side : float
        Of chips, in units of the extent.
    scale : float
        Units of `place` in the extent.
    origin : (2,)
    local : (N,) of bool
        Which of all given displacements contradict their neighbours; they are not among the n.
    """

    place: Array
    value: Array
    weight: Array
    side: float
    scale: float
    origin: Array
    local: NDArray[np.bool_]
    axes: tuple[_Axis, _Axis]

    @classmethod
    def of(cls, place: Array, value: Array, sigma: Array | None = None, side: float = 0.0) -> DisplacementField:
        """Return the field of displacements.

        Parameters
        ----------
        place, value : (N, 2)
            In any units.
        sigma : (N,), optional
            Standard deviations of the displacements, relative to each other.
        side : float
            Side of the compared part of chips, in units of places: those that overlap share noise.

        Raises
        ------
        TooFewPoints
            If there are fewer than 12, or they are all on one line.
        """
        if len(place) < FEWEST_POINTS:
            raise TooFewPoints(f"{len(place)} displacements do not determine a field", remedy="give more matches")
        if _on_a_line(place):
            raise TooFewPoints(
                "displacements on one line do not determine a field", remedy="give matches away from this line"
            )
        weight = np.ones(len(place)) if sigma is None else (sigma / np.median(sigma)) ** 2
        weight = np.clip(weight, 0.25, 16.0)
        origin, scale = place.mean(axis=0), float(np.ptp(place, axis=0).max())
        inside, local = (place - origin) / scale, np.zeros(len(place), dtype=bool)
        for turn in range(_ROUNDS):
            index = np.flatnonzero(~local)
            if len(index) > _MOST_POINTS:
                index = np.sort(np.random.default_rng(0).permutation(index)[:_MOST_POINTS])
            axes = _likely(inside[index], value[index], weight[index], side / scale)
            found = cls(inside[index], value[index], weight[index], side / scale, scale, origin, local, axes)
            if turn == _ROUNDS - 1:
                break
            apart = found._apart()
            if not (apart > _LOCAL**2).any():
                break
            again = local.copy()
            again[index[apart > _LOCAL**2]] = True
            if len(place) - again.sum() < max(FEWEST_POINTS, len(place) / 2):
                break
            local = again
        return found

    @property
    def noise(self) -> Array:
        """Standard deviation ``(2,)`` of single matches of weight one."""
        return np.array([np.sqrt(one.squares[one.best] / one.freedom) for one in self.axes])

    @property
    def shared(self) -> Array:
        """Standard deviation ``(2,)`` of the field about its trend, by the likeliest function."""
        return self.noise * np.sqrt([one.ratios[one.best[1]] for one in self.axes])

    @property
    def range(self) -> Array:
        """Distance ``(2,)`` over which the field keeps 1/e of its correlation, in the units of places."""
        return np.array([one.kernels[one.best[0]][1] for one in self.axes]) * self.scale

    def mean(self, place: Array) -> Array:
        """Return the likeliest field ``(m, 2)`` at places ``(m, 2)``."""
        inside = (place - self.origin) / self.scale
        found = np.empty((len(place), 2))
        for axis, one in enumerate(self.axes):
            kernel, ratio = one.best
            found[:, axis] = self._kriged(axis, one.kernels[kernel], one.ratios[ratio], inside)[0]
        return found

    def trend(self) -> Array:
        """Return the affine trend ``(3, 2)`` of the likeliest function: at the origin, per unit of x and of y."""
        found = np.empty((3, 2))
        for axis, one in enumerate(self.axes):
            kernel, ratio = one.best
            inverse = self._whitened(one.kernels[kernel], one.ratios[ratio])
            found[:, axis] = np.linalg.lstsq(inverse(_design(self.place)), inverse(self.value[:, axis]), rcond=None)[0]
        return found / np.array([1.0, self.scale, self.scale])[:, None]

    def draws(self, place: Array, seed: int = 0) -> Array:
        """Return fields ``(draws, m, 2)`` at places ``(m, 2)``, each as likely as any other."""
        random = np.random.default_rng(seed)
        inside = (place - self.origin) / self.scale
        found = np.empty((_FUNCTIONS * _OF_EACH, len(place), 2))
        for axis, one in enumerate(self.axes):
            chosen = random.choice(one.chance.size, _FUNCTIONS, p=one.chance.ravel())
            slopes = random.random(_FUNCTIONS) >= self._constant(axis)
            rows = random.permutation(len(found)).reshape(_FUNCTIONS, _OF_EACH)
            kriged: dict[tuple[int, bool], tuple[Array, Array]] = {}
            for number, sloping, part in zip(chosen.tolist(), slopes.tolist(), rows, strict=True):
                kernel, ratio = divmod(number, len(one.ratios))
                if (number, sloping) not in kriged:
                    kriged[number, sloping] = self._kriged(
                        axis, one.kernels[kernel], one.ratios[ratio], inside, root=True, slopes=sloping
                    )
                middle, root = kriged[number, sloping]
                variance = one.squares[kernel, ratio] / random.chisquare(one.freedom, _OF_EACH)
                noise = random.standard_normal((_OF_EACH, len(place)))
                found[part, :, axis] = middle + np.sqrt(variance)[:, None] * (noise @ root.T)
        return found

    def regressed(self, place: Array, value: Array, along: Array) -> tuple[Array, Array, Array]:
        """Return how values ``(n, 2)`` change with a quantity ``(n,)`` besides their trend, and the sigmas, ``(2,)``.

        Errors are correlated as the likeliest function of this field says. The third is the level of the values at the
        middle of their places where the quantity is 0.
        """
        inside = (place - self.origin) / self.scale
        rates, sigmas, level = np.zeros(2), np.zeros(2), np.zeros(2)
        for axis, one in enumerate(self.axes):
            kernel, ratio = one.best
            noise = _noise(inside, np.ones(len(inside)), self.side)
            variance = noise + one.ratios[ratio] * _covariance(one.kernels[kernel], self._distance(inside, inside))
            root = linalg.cholesky(variance, lower=True)
            columns = np.column_stack([_design(inside), along, value[:, axis]])
            white = linalg.solve_triangular(root, columns, lower=True)
            inverse = np.linalg.pinv(white[:, :-1])
            found = inverse @ white[:, -1]
            left = white[:, -1] - white[:, :-1] @ found
            rates[axis], level[axis] = found[3], found[0]
            sigmas[axis] = np.linalg.norm(left) / np.sqrt(len(left) - 4) * np.linalg.norm(inverse[3])
        return rates, sigmas, level

    def held_out(self, groups: NDArray[np.int_]) -> tuple[Array, Array]:
        """Return squared errors ``(groups,)`` of the field and of the trend where each group takes no part."""
        found = []
        for group in np.unique(groups):
            out = groups == group
            errors = np.zeros(2)
            for axis, one in enumerate(self.axes):
                kernel, ratio = one.best
                rest = DisplacementField(
                    self.place[~out],
                    self.value[~out],
                    self.weight[~out],
                    self.side,
                    self.scale,
                    self.origin,
                    self.local,
                    self.axes,
                )
                here = rest._kriged(axis, one.kernels[kernel], one.ratios[ratio], self.place[out])[0]
                plain = np.linalg.lstsq(_design(rest.place), rest.value[:, axis], rcond=None)[0]
                errors += [
                    ((self.value[out, axis] - here) ** 2).mean(),
                    ((self.value[out, axis] - _design(self.place[out]) @ plain) ** 2).mean(),
                ]
            found.append(errors)
        both = np.array(found)
        return both[:, 0], both[:, 1]

    def _distance(self, one: Array, other: Array) -> Array:
        return _between_chips(spatial.distance.cdist(one, other), self.side)

    @functools.cached_property
    def _own_noise(self) -> Array:
        return _noise(self.place, self.weight, self.side)

    @functools.cached_property
    def _own_distance(self) -> Array:
        return self._distance(self.place, self.place)

    def _whitened(self, kernel: tuple[int, float], ratio: float) -> Callable[[Array], Array]:
        """Return the function that whitens columns."""
        root = linalg.cholesky(self._own_noise + ratio * _covariance(kernel, self._own_distance), lower=True)
        return lambda columns: np.asarray(linalg.solve_triangular(root, columns, lower=True))

    def _kriged(
        self,
        axis: int,
        kernel: tuple[int, float],
        ratio: float,
        place: Array,
        *,
        root: bool = False,
        slopes: bool = True,
    ) -> tuple[Array, Array]:
        """Return the mean ``(m,)`` of the field of an axis at places, and a root of its covariance over the noise's."""
        white, terms = self._whitened(kernel, ratio), 3 if slopes else 1
        design, value = white(_design(self.place)[:, :terms]), white(self.value[:, axis])
        across = white(ratio * _covariance(kernel, self._distance(self.place, place)))
        normal = linalg.cho_factor(design.T @ design)
        trend = linalg.cho_solve(normal, design.T @ value)
        left = _design(place)[:, :terms] - across.T @ design
        mean = across.T @ value + left @ trend
        if not root:
            return mean, np.zeros((0, 0))
        covariance = ratio * _covariance(kernel, self._distance(place, place)) - across.T @ across
        covariance += left @ linalg.cho_solve(normal, left.T)
        # The field is known at places of matches: without this part of its variance the matrix is singular.
        covariance += _SMALL * (1.0 + ratio) * np.eye(len(place))
        return mean, linalg.cholesky(covariance, lower=True)

    def _constant(self, axis: int) -> float:
        """Return the chance that the trend of an axis has no slopes, by the information criterion of Schwarz.

        The number of displacements is that of independent ones with the same information on the mean.
        """
        one = self.axes[axis]
        kernel, ratio = one.best
        white = self._whitened(one.kernels[kernel], one.ratios[ratio])
        design, value = white(_design(self.place)), white(self.value[:, axis])
        squares = []
        for terms in (1, 3):
            part = design[:, :terms]
            squares.append(((value - part @ np.linalg.lstsq(part, value, rcond=None)[0]) ** 2).sum())
        gain = len(value) * math.log(max(squares[0], 1e-300) / max(squares[1], 1e-300))
        return float(special.expit(math.log(max((design[:, 0] ** 2).sum(), 1.0)) - gain / 2))

    def _apart(self) -> Array:
        """Return squared distances ``(n,)`` of displacements from what the others say, in sigmas."""
        found = np.zeros(len(self.place))
        for axis, one in enumerate(self.axes):
            kernel, ratio = one.best
            white = self._whitened(one.kernels[kernel], one.ratios[ratio])
            inverse = white(np.eye(len(self.place)))
            design = np.linalg.qr(white(_design(self.place)))[0]
            inverse = inverse - design @ (design.T @ inverse)
            precision = (inverse**2).sum(axis=0)
            alone = inverse.T @ (inverse @ self.value[:, axis]) / precision
            found += alone**2 * precision / max(one.squares[one.best] / one.freedom, 1e-300)
        return found


def _on_a_line(place: Array) -> bool:
    """Return whether places are on one line, up to a millionth of their extent: they determine no slopes."""
    spread = np.cov(place.T)
    return not np.linalg.det(spread) > 1e-12 * np.trace(spread) ** 2


def _design(place: Array) -> Array:
    return np.column_stack([np.ones(len(place)), place])


def _covariance(kernel: tuple[int, float], distance: Array) -> Array:
    family, length = kernel
    return np.asarray(FAMILIES[family](distance / length))


def _between_chips(distance: Array, side: float) -> Array:
    """Return root mean square distances of points of chips from distances of their centres."""
    return np.asarray(np.sqrt(distance**2 + side**2 / 3.0))


def _noise(place: Array, weight: Array, side: float) -> Array:
    """Return the covariance ``(n, n)`` of the noise: chips that overlap share a part of it."""
    root = np.sqrt(weight)
    if not side > 0:
        return np.diag(weight)
    apart = np.abs(place[:, None] - place) / side
    shared = np.maximum(1.0 - apart, 0.0).prod(axis=2)
    return np.asarray((_OF_PIXELS * shared + (1.0 - _OF_PIXELS) * np.eye(len(place))) * root[:, None] * root)


def _likely(place: Array, value: Array, weight: Array, side: float) -> tuple[_Axis, _Axis]:
    """Return how likely each function is along both axes, by restricted likelihood."""
    count = len(place)
    if count > _TRIED:
        some = np.sort(np.random.default_rng(0).permutation(count)[:_TRIED])
        place, value, weight = place[some], value[some], weight[some]
    inverse = linalg.solve_triangular(
        linalg.cholesky(_noise(place, weight, side), lower=True), np.eye(len(place)), lower=True
    )
    design, seen = inverse @ _design(place), inverse @ value
    basis = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    left, freedom, inverse = basis.T @ seen, len(seen) - design.shape[1], basis.T @ inverse
    whole = np.maximum((left**2).sum(axis=0) / freedom, 1e-300)
    distance = spatial.distance.cdist(place, place)
    near = float(np.median(np.partition(distance, 1, axis=1)[:, 1]))
    ranges = np.geomspace(np.clip(max(near, side), 0.01, 0.5), 1.0, _RANGES)
    ratios = np.concatenate([[0.0], np.geomspace(1.0 / count, _LARGEST, _RATIOS)])
    between = _between_chips(distance, side)
    kernels = tuple((family, float(length)) for family in range(len(FAMILIES)) for length in ranges)
    logs, squares = (np.empty((2, len(kernels), len(ratios))) for _ in range(2))
    for number, (family, length) in enumerate(kernels):
        values, vectors = np.linalg.eigh(inverse @ FAMILIES[family](between / length) @ inverse.T)
        each = 1.0 + ratios[:, None] * np.maximum(values, 0.0)
        squares[:, number] = ((vectors.T @ left) ** 2).T @ (1.0 / each).T
        logs[:, number] = -0.5 * (np.log(each).sum(axis=1) + freedom * np.log(np.maximum(squares[:, number], 1e-300)))
    # As in `shared_errors`: the part of the variance that residuals show is as likely to be any from none to all.
    logs -= np.log(np.maximum(squares / freedom * (1.0 + ratios) / whole[:, None, None], 1.0))
    # Beforehand there is as likely no field as one of any strength.
    logs[:, :, 0] += np.log(_RATIOS)
    chance = np.exp(logs - logs.max(axis=(1, 2), keepdims=True))
    chance /= chance.sum(axis=(1, 2), keepdims=True)
    first, second = (_Axis(kernels, ratios, chance[axis], squares[axis], freedom) for axis in (0, 1))
    return first, second
