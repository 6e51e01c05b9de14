r"""Centres of roundabouts, tanks and other circles on the ground: an ellipse fitted to their edge in an image.

The edge is found along rays from a rough centre, an ellipse through most of these places by random sampling, and then
the edge is located again in sectors of the circumference: a step between two levels, seen through a Gaussian and the
square pixel (`edge.edge_response`), is fitted to the pixels themselves over their distance from the ellipse. No pixel
is interpolated and none counts twice, so the noise of the pixels becomes that of the centre. Sectors that show no such
step, or show it elsewhere (trees, cars, shadows, roads that join), have no weight.

The centre of the ellipse is not exactly the image of the circle's centre. In a perspective view from the distance D at
the incidence i, a circle of the radius R is off by :math:`r (R/D) \sin i \cos i \le r R / 2D`, where r is its radius in
pixels: 0.008 px for a roundabout of 50 m at 0.3 m per pixel from 500 km, but 25 px for one of 10 m at 2 cm from 100 m.

Source: Halir and Flusser 1998 for what an ellipse through points is; the location of edges as in ISO 12233.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging.edge import APERTURE, edge_response

Array = NDArray[np.float64]

#: Smallest radius (px): below, the two sides of the edge are not seen apart.
SMALLEST = 5.0
#: Least share of the circumference that has to be seen.
LEAST_SEEN = 0.5
#: The edge is looked for within this part of the radius to both sides of the rough circle.
_SEARCH = 0.4
#: Pixels to each side of the edge that are looked at, and length (px) of a sector along it.
_REACH, _SECTOR = 3.5, 2.5
#: Least step at the edge, in its own standard deviations, for a sector to show it.
_CONTRAST = 4.0
#: Sectors whose edge is farther off (px) see something else.
_FAR = 1.5
#: Edges of the first search within this distance (px) of an ellipse lie on it; flatter ellipses are none.
_NEAR, _FLATTEST = 0.4, 0.4
#: Sectors beyond this many robust standard deviations, and this distance (px), see something else.
_REJECT_SIGMAS, _REJECT_FLOOR = 3.5, 0.1
#: An edge that is off its ellipse by more (px, root mean square) is not an ellipse.
_ROUND = 0.25
#: Gaussian blur (px) of the edge to start with.
_START_BLUR = 0.6
#: Draws of the random sampling (with half of the places wrong, five are right together in 10), and ellipses kept.
_DRAWS, _CANDIDATES = 300, 4
_REMEDY = "give the middle and the radius of a round edge between two even areas, to a fifth of the radius"


@dataclass(frozen=True, eq=False)
class Ellipse:
    """An ellipse in an image; lengths in pixels, `centre` (column, row) from the outer corner of the first pixel.

    `covariance` (2, 2) is that of the centre, from how the edges scatter about the ellipse: pixels that were resampled
    before make it too small by what they share. So does an image of a small circle with hardly any noise: for half-axes
    of 8 and 7 px the error is 1.1 sigma with noise of 5 % of the contrast (error 0.03 px), 1.4 with 0.6 % (0.005 px)
    and 1.5 with 0.1 % (0.003 px; forty centres each). `axes` are the half-axes, the longer first, and `angle_deg` turns
    from the direction of the columns to the longer one, towards growing rows, within -90 to 90. `seen` is the share of
    the circumference that shows the edge, in `edges` places which scatter by `scatter` about the ellipse. `contrast` is
    the brightness inside minus that outside, `psf_sigma` the Gaussian blur of the edge beside the pixel's aperture.
    """

    centre: Array
    covariance: Array
    axes: tuple[float, float]
    angle_deg: float
    seen: float
    edges: int
    scatter: float
    contrast: float
    psf_sigma: float

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the centre ``(2,)``."""
        return np.sqrt(np.diag(self.covariance))

    def outline(self, count: int = 180) -> Array:
        """Return points ``(count, 2)`` along the ellipse."""
        shape = _Shape(float(self.centre[0]), float(self.centre[1]), *self.axes, math.radians(self.angle_deg))
        return shape.at(np.linspace(0, 2 * np.pi, count, endpoint=False))

    def to_json(self) -> dict[str, Any]:
        """Return the ellipse as JSON values."""
        return {
            "centre": self.centre.tolist(),
            "covariance": self.covariance.tolist(),
            "axes": list(self.axes),
            "angle_deg": self.angle_deg,
            "seen": self.seen,
            "edges": self.edges,
            "scatter": self.scatter,
            "contrast": self.contrast,
            "psf_sigma": self.psf_sigma,
        }


def fit_ellipse(pixels: ArrayLike, centre: tuple[float, float], radius: float) -> Ellipse:
    """Find the ellipse around a rough centre.

    Parameters
    ----------
    pixels : (H, W)
        NaN where there is no value.
    centre : (float, float)
        Rough (column, row), to a fifth of the radius; the outer corner of the first pixel is (0, 0).
    radius : float
        Rough radius in pixels, to a fifth as well: of some rings it says which is meant.

    Returns
    -------
    Ellipse

    Raises
    ------
    InputError
        If these numbers do not lie in the pixels, or there is no ellipse: no edge, one of another shape, or one that is
        seen on less than half of its circumference.
    """
    values = np.asarray(pixels, dtype=np.float64)
    if values.ndim != 2:
        raise InputError("pixels are an array of rows and columns", field="pixels", remedy="give one band")
    height, width = values.shape
    x, y = (float(value) for value in centre)
    if not (0 <= x <= width and 0 <= y <= height):
        raise InputError(f"the centre {x:g}, {y:g} lies outside of the {width} x {height} pixels", field="centre",
                         remedy="give a column and a row within the image")  # fmt: skip
    if not SMALLEST <= radius <= max(width, height):
        raise InputError(f"a radius of {radius:g} px cannot be measured in {width} x {height} pixels", field="radius",
                         remedy=f"give a radius from {SMALLEST:g} px to the size of the image")  # fmt: skip
    candidates = [(_settled(values, shape, sign, rounds=3), sign) for shape, sign in _first(values, x, y, radius)]
    best = max(candidates, key=lambda one: one[0].score if one[0] else -1.0, default=(None, 0))
    if best[0] is None:
        raise _none(f"no round edge about {x:.6g}, {y:.6g}")
    settled = _settled(values, best[0].shape, best[1], rounds=12)
    if settled is None:
        raise _none("the edge is seen in too few places")
    return _checked(settled, (x, y), radius)


# -- the ellipse -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shape:
    """Centre, half-axes along and across the direction `turn` (rad)."""

    x: float
    y: float
    a: float
    b: float
    turn: float

    def at(self, t: Array) -> Array:
        """Return the points ``(N, 2)`` at eccentric anomalies."""
        own = np.stack([self.a * np.cos(t), self.b * np.sin(t)], axis=1)
        return np.asarray(self._out(own) + np.array([self.x, self.y]))

    def _out(self, own: Array) -> Array:
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        return own @ np.array([[cos, sin], [-sin, cos]])

    def normals(self, t: Array) -> Array:
        """Return the outward unit normals ``(N, 2)``."""
        own = np.stack([self.b * np.cos(t), self.a * np.sin(t)], axis=1)
        return self._out(own / np.linalg.norm(own, axis=1)[:, None])

    def curvature(self, t: Array) -> Array:
        """Return the curvature ``(N,)``, 1/px."""
        return np.asarray(self.a * self.b / np.hypot(self.a * np.sin(t), self.b * np.cos(t)) ** 3)

    def beside(self, points: Array) -> Array:
        """Return about how far outside points lie, along the ray from the centre ``(N,)``."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        own = (points - (self.x, self.y)) @ np.array([[cos, -sin], [sin, cos]])
        return np.hypot(*own.T) * (1.0 - 1.0 / np.maximum(np.hypot(*(own / (self.a, self.b)).T), 1e-9))

    def foot(self, points: Array) -> tuple[Array, Array]:
        """Return the anomaly of the nearest point of the ellipse and the distance (positive outside) ``(N,)`` each."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        u, v = ((points - (self.x, self.y)) @ np.array([[cos, -sin], [sin, cos]])).T
        t = np.arctan2(v * self.a, u * self.b)
        for _ in range(5):
            c, s = np.cos(t), np.sin(t)
            away = (self.a * c - u) * -self.a * s + (self.b * s - v) * self.b * c
            bend = (self.a * s) ** 2 + (self.b * c) ** 2 - (self.a * c - u) * self.a * c - (self.b * s - v) * self.b * s
            t = t - away / np.maximum(bend, 0.1 * self.a * self.b)
        return t, ((points - self.at(t)) * self.normals(t)).sum(axis=1)

    def partials(self, t: Array) -> Array:
        """Return how far the ellipse moves outwards per unit of x, y, a, b and turn ``(N, 5)``."""
        normal = self.normals(t)
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        along, across = normal @ [cos, sin], normal @ [-sin, cos]
        x, y = self.a * np.cos(t), self.b * np.sin(t)
        return np.stack([*normal.T, along * np.cos(t), across * np.sin(t), across * x - along * y], axis=1)

    def moved(self, step: Array) -> _Shape:
        x, y, a, b, turn = step.tolist()
        return _Shape(self.x + x, self.y + y, self.a + a, self.b + b, self.turn + turn)


def _conics(points: Array, draws: Array) -> list[_Shape]:
    """Return the ellipses through five places each ``(K, 5, 2)``, about the mean of all places."""
    middle, scale = points.mean(axis=0), float(np.abs(points - points.mean(axis=0)).max())
    u, v = np.moveaxis((draws - middle) / scale, 2, 0)
    design = np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)], axis=2)
    found = []
    for a, b, c, d, e, f in np.linalg.svd(design)[2][:, -1]:
        matrix = np.array([[a, b / 2], [b / 2, c]])
        if not 4 * a * c - b * b > 1e-9:
            continue
        centre = np.linalg.solve(matrix, [-d / 2, -e / 2])
        rest = centre @ matrix @ centre - f
        sizes, vectors = np.linalg.eigh(matrix / rest if rest else matrix)
        if sizes[0] > 0 and sizes[0] >= _FLATTEST**2 * sizes[1]:
            x, y = centre * scale + middle
            turn = math.atan2(vectors[1, 0], vectors[0, 0])
            found.append(_Shape(x, y, scale / math.sqrt(sizes[0]), scale / math.sqrt(sizes[1]), turn))
    return found


# -- the first search ------------------------------------------------------------------------------------------------


def _first(values: Array, x: float, y: float, radius: float) -> list[tuple[_Shape, int]]:
    """Return ellipses through many of the steepest places on rays, each with 1 if it is brighter inside, or -1."""
    from scipy.ndimage import gaussian_filter1d, map_coordinates

    angles = np.linspace(0, 2 * np.pi, max(36, round(2 * np.pi * radius / 1.5)), endpoint=False)
    away = np.arange(max(1.0, (1 - _SEARCH) * radius - 2), (1 + _SEARCH) * radius + 2.25, 0.25)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = (x, y) + away[None, :, None] * rays[:, None, :]
    seen = map_coordinates(values, [places[..., 1] - 0.5, places[..., 0] - 0.5], order=1, cval=np.nan)
    slope = np.diff(gaussian_filter1d(seen, 3.0, axis=1, mode="nearest"), axis=1)
    middle = (away[1:] + away[:-1]) / 2
    found = []
    for sign in (1, -1):
        falling = np.where(np.isfinite(slope), -sign * slope, -np.inf)
        peak = falling.argmax(axis=1)
        there = falling[np.arange(len(peak)), peak] > 0
        points = (x, y) + middle[peak][there, None] * rays[there]
        found += [(shape, sign) for shape in _through(points, (x, y), radius)]
    return found


def _through(points: Array, centre: tuple[float, float], radius: float) -> list[_Shape]:
    """Return the ellipses near the rough one that pass by most points, the best first, none twice."""
    if len(points) < 10:
        return []
    random = np.random.default_rng(0)
    draws = points[random.permuted(np.tile(np.arange(len(points)), (_DRAWS, 1)), axis=1)[:, :5]]

    def score(shape: _Shape) -> float:
        return float(np.maximum(1 - (shape.beside(points) / _NEAR) ** 2, 0.0).sum())

    def plausible(shape: _Shape) -> bool:
        size = math.sqrt(abs(shape.a * shape.b))
        return abs(size - radius) <= _SEARCH * radius >= math.dist((shape.x, shape.y), centre)

    def distinct(shapes: list[_Shape], apart: float) -> list[_Shape]:
        found: list[_Shape] = []
        for shape in sorted(shapes, key=lambda shape: -score(shape)):
            if all(math.dist((shape.x, shape.y), (other.x, other.y)) > apart for other in found):
                found.append(shape)
        return found

    # Five places say little of where the others are: the best ellipses are fitted to what is near them.
    rough = distinct([shape for shape in _conics(points, draws) if plausible(shape)], 0.5)
    fine = [shape for shape in (_refined(shape, points) for shape in rough[:24]) if plausible(shape)]
    least = LEAST_SEEN / 3 * len(points)
    return [shape for shape in distinct(fine, _NEAR)[:_CANDIDATES] if score(shape) > least]


def _refined(shape: _Shape, points: Array) -> _Shape:
    """Return the ellipse through the points near one, by least squares."""
    for near in (1.0, 0.7, 0.4):
        t, distance = shape.foot(points)
        close = np.abs(distance) < near
        if close.sum() < 8:
            break
        partials = shape.partials(t[close])
        normal = partials.T @ partials + np.diag([0.0, 0.0, 0.0, 0.0, 1e-3 * len(points)])
        shape = shape.moved(np.asarray(np.linalg.solve(normal, partials.T @ distance[close]), dtype=np.float64))
    return shape


# -- sectors ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Sectors:
    """Pixels near an ellipse, by sectors of its circumference, and where each sector ``(S,)`` sees the edge.

    `offset` is by how much farther outside than the ellipse, and `error` its standard deviation; `step` is the
    brightness inside minus outside. NaN where a sector has too few pixels.
    """

    t: Array
    sigma: float
    distance: Array
    values: Array
    wide: Array
    tall: Array
    which: NDArray[np.intp]
    offset: Array
    error: Array
    step: Array
    step_error: Array
    squares: Array

    @classmethod
    def around(cls, pixels: Array, shape: _Shape, sigma: float) -> _Sectors:
        rows, columns = np.indices(pixels.shape)
        reach = min(_REACH, 0.6 * min(shape.a, shape.b))
        points = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
        off = np.hypot(*(points - (shape.x, shape.y)).T)
        close = (off > min(shape.a, shape.b) - reach) & (off < max(shape.a, shape.b) + reach)
        close &= np.isfinite(pixels.ravel())
        points, values = points[close], pixels.ravel()[close]
        t, distance = shape.foot(points)
        inside = np.abs(distance) <= reach
        t, distance, values = t[inside], distance[inside], values[inside]
        count = max(16, round(np.pi * (shape.a + shape.b) / _SECTOR))
        which = np.floor(t % (2 * np.pi) / (2 * np.pi) * count).astype(np.intp) % count
        normal = np.abs(shape.normals(t))
        empty = np.full(count, np.nan)
        middle = (np.arange(count) + 0.5) * 2 * np.pi / count
        found = cls(
            middle, sigma, distance, values, normal[:, 0], normal[:, 1], which, empty, empty, empty, empty, empty
        ).located(sigma)
        # A blurred disc has its half level a little inside: the edge's own spread, and its bend.
        shift = (found.sigma**2 + APERTURE**2) * shape.curvature(middle) / 2
        return replace(found, offset=found.offset + shift)

    def located(self, sigma: float) -> _Sectors:
        """Fit the levels and the place of the step in every sector, to first order in the place."""
        count = len(self.t)
        inner = 1.0 - edge_response(self.distance, sigma, self.wide, self.tall)
        ahead, behind = (edge_response(self.distance + h, sigma, self.wide, self.tall) for h in (0.05, -0.05))
        design = np.stack([np.ones_like(inner), inner, (ahead - behind) / 0.1], axis=1)

        def sums(of: Array) -> Array:
            return np.asarray(np.bincount(self.which, of, minlength=count), dtype=np.float64)

        normal = np.empty((count, 3, 3))
        for j in range(3):
            for k in range(3):
                normal[:, j, k] = sums(design[:, j] * design[:, k])
        right = np.stack([sums(column * self.values) for column in design.T], axis=1)
        pixels = sums(np.ones_like(inner))
        both = np.minimum(sums((self.distance < -1).astype(float)), sums((self.distance > 1).astype(float)))
        able = (pixels >= 6) & (both >= 2) & (np.linalg.det(normal) > 1e-6)
        cofactor = np.full((count, 3, 3), np.nan)
        cofactor[able] = np.linalg.inv(normal[able])
        solved = np.einsum("sij,sj->si", cofactor, right)
        left = self.values - (design * solved[self.which]).sum(axis=1)
        squares = sums(np.where(np.isfinite(left), left**2, 0.0))
        # Of a few pixels the scatter is known badly: that of all sectors helps.
        freedom = np.maximum(pixels - 3, 1)
        common = float(np.median(squares[able] / freedom[able])) if able.any() else np.nan
        variance = (squares + 8 * common) / (freedom + 8)
        with np.errstate(invalid="ignore", divide="ignore"):
            offset = solved[:, 2] / solved[:, 1]
            spread = np.sqrt(variance * cofactor[:, 2, 2]) / np.abs(solved[:, 1])
            doubt = np.sqrt(variance * cofactor[:, 1, 1])
        return replace(
            self, sigma=sigma, offset=offset, error=spread, step=solved[:, 1], step_error=doubt, squares=squares
        )

    def weights(self, sign: int) -> Array:
        """Return the weights ``(S,)`` of the offsets, 1/px²: zero for sectors that see something else, or nothing."""
        with np.errstate(invalid="ignore"):
            clear = (sign * self.step > _CONTRAST * self.step_error) & (np.abs(self.offset) < _FAR)
        if not clear.any():
            return np.zeros(len(self.t))
        floor = max(float(np.median(self.error[clear])), 1e-4)
        spread = max(1.4826 * float(np.median(np.abs(self.offset[clear]))), floor)
        clear &= np.abs(self.offset) <= max(_REJECT_SIGMAS * spread, _REJECT_FLOOR)
        weights: Array = np.where(clear, 1 / np.clip(np.nan_to_num(self.error, nan=1.0), floor, 1e3) ** 2, 0.0)
        return weights


def _blur(sectors: _Sectors, seeing: NDArray[np.bool_]) -> float:
    """Return the Gaussian blur (px) with which the sectors that see the edge follow their pixels best."""
    from scipy.optimize import minimize_scalar

    def misfit(sigma: float) -> float:
        return float(sectors.located(sigma).squares[seeing].sum())

    return float(minimize_scalar(misfit, bounds=(0.05, _REACH / 1.5), method="bounded", options={"xatol": 0.02}).x)


@dataclass(frozen=True, eq=False)
class _Settled:
    """An ellipse adjusted to the edge: its covariance (x, y, a, b, turn), and the scatter of the edges about it."""

    shape: _Shape
    sectors: _Sectors
    used: NDArray[np.bool_]
    covariance: Array
    scatter: float

    @property
    def score(self) -> float:
        """Share of the sectors that see the edge just there: an ellipse that many sectors are a little off is none."""
        limit = max(_REJECT_FLOOR, _REJECT_SIGMAS * float(np.median(self.sectors.error[self.used])))
        return float(np.maximum(1 - (self.sectors.offset[self.used] / limit) ** 2, 0.0).sum() / len(self.used))


def _settled(pixels: Array, shape: _Shape, sign: int, *, rounds: int) -> _Settled | None:
    """Adjust an ellipse to the edge that sectors along it see; None where too few see one."""
    sigma, result = _START_BLUR, None
    for turn in range(rounds):
        sectors = _Sectors.around(pixels, shape, sigma)
        weights = sectors.weights(sign)
        used = weights > 0
        if used.sum() < 10:
            return None
        partials, offset, weight = shape.partials(sectors.t[used]), sectors.offset[used], weights[used]
        # A circle has no direction: it is held where it is, by an observation that is worth nothing beside the others.
        hold = np.diag([0.0, 0.0, 0.0, 0.0, 1e-4 * float(weight.sum())])
        cofactor = np.linalg.inv((partials.T * weight) @ partials + hold)
        step = cofactor @ (partials.T @ (weight * offset))
        squares = float((weight * (offset - partials @ step) ** 2).sum())
        shape = shape.moved(np.clip(step, -2.0, 2.0))
        if not (np.isfinite(step).all() and min(shape.a, shape.b) > _REACH / 2):
            return None
        covariance = cofactor * squares / (len(offset) - 5)
        result = _Settled(shape, sectors, used, covariance, math.sqrt(squares / float(weight.sum())))
        if turn in (2, 4):
            sigma = _blur(sectors, used)
        elif turn > 4 and np.abs(step[:4]).max() < 1e-4:
            break
    return result


def _checked(settled: _Settled, rough: tuple[float, float], radius: float) -> Ellipse:
    """Return the result, or refuse what is not an ellipse."""
    shape, sectors, used = settled.shape, settled.sectors, settled.used
    arc = np.hypot(shape.a * np.sin(sectors.t), shape.b * np.cos(sectors.t))
    seen = float(arc[used].sum() / arc.sum())
    if seen < LEAST_SEEN:
        raise _none(f"an ellipse fits {100 * seen:.0f} % of its circumference only")
    if settled.scatter > _ROUND:
        raise _none(f"the edge is off an ellipse by {settled.scatter:.2f} px")
    long, short = max(shape.a, shape.b), min(shape.a, shape.b)
    away = math.dist((shape.x, shape.y), rough)
    if not (short >= _FLATTEST * long and abs(math.sqrt(long * short) - radius) <= _SEARCH * radius >= away):
        raise _none(f"no round edge of about {radius:g} px around {rough[0]:.6g}, {rough[1]:.6g}")
    turn = math.degrees(shape.turn) + (0.0 if shape.a >= shape.b else 90.0)
    return Ellipse(
        centre=np.array([shape.x, shape.y]),
        covariance=settled.covariance[:2, :2],
        axes=(long, short),
        angle_deg=(turn + 90.0) % 180.0 - 90.0,
        seen=seen,
        edges=int(used.sum()),
        scatter=settled.scatter,
        contrast=float(np.median(sectors.step[used])),
        psf_sigma=sectors.sigma,
    )


def _none(what: str) -> InputError:
    return InputError(f"there is no ellipse: {what}", field="centre", remedy=_REMEDY)
