"""Edges of known truth: displacements of dates, errors of dates and edges, moving ground, wrong edges.

Nothing here knows of the adjustment. Fields are smoothed white noise on a finer grid than the places.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import spatial
from scipy.ndimage import gaussian_filter, map_coordinates

from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.graph import pairs_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """A stack of edges.

    Parameters
    ----------
    error : float
        Largest shift of a date, px, uniform along each axis.
    noise : float
        Sigma (px) of a single match.
    of_date, of_edge : float
        Sigma (px) of smooth errors that all edges of a date share, and of an edge.
    of_season : float
        Sigma (px) of smooth errors that all dates of a quarter of the year share.
    length : float
        Of smooth errors, in parts of the area.
    sharp : bool
        Whether the correlation of these errors is exponential; else it is Gaussian.
    moving : float
        Part of the places that move, at up to `rate` px a year.
    wrong : float
        Part of the edges that are wrong by some px.
    hidden : float
        Part of the values that clouds hide.
    step : float
        px by which dates of the second half are displaced.
    sloped : int
        Number of dates with slopes, of up to `slope` px at the rim.
    """

    seed: int = 0
    dates: int = 40
    interval: float = 16.0
    error: float = 20.0
    scatter: float | None = None
    noise: float = 0.15
    of_date: float = 0.05
    of_edge: float = 0.05
    of_season: float = 0.0
    length: float = 0.12
    sharp: bool = False
    moving: float = 0.0
    rate: float = 1.0
    wrong: float = 0.0
    hidden: float = 0.2
    step: float = 0.0
    sloped: int = 0
    slope: float = 0.5
    cells: Cells = field(default_factory=lambda: Cells.over(np.zeros(2), np.full(2, 1000.0)))

    def made(self) -> Made:
        """Return the edges and the truth."""
        random = np.random.default_rng(self.seed)
        place, count = self.cells.place, len(self.cells.place)
        days = np.cumsum(random.uniform(0.5, 1.5, self.dates)) * self.interval
        shift = random.uniform(-self.error, self.error, (self.dates, 2))
        if self.scatter is not None:
            shift = random.normal(0.0, self.scatter, (self.dates, 2))
        shift[self.dates // 2 :, 0] += self.step
        slopes = np.zeros((self.dates, 2, 2))
        some = random.permutation(self.dates)[: self.sloped]
        slopes[some] = random.choice([-1.0, 1.0], (self.sloped, 2, 2)) * random.uniform(0.5, 1, (self.sloped, 2, 2))
        slopes *= self.slope
        rate = self._motion(random)
        pairs = np.array(pairs_of(days.tolist()))
        smooth = [self._field(random) * self.of_date for _ in range(self.dates)]
        own = random.normal(0.0, self.noise / 2, (self.dates, count, 2))
        if self.of_season:
            looks = [self._field(random) * self.of_season for _ in range(4)]
            smooth = [one + looks[int(day / 365.25 % 1.0 * 4)] for one, day in zip(smooth, days, strict=True)]
        value = np.empty((len(pairs), count, 2))
        for number, (one, other) in enumerate(pairs):
            value[number] = shift[one] - shift[other] + place @ (slopes[one] - slopes[other])
            value[number] += rate * (days[one] - days[other]) / 365.25
            value[number] += smooth[one] - smooth[other] + own[one] - own[other]
            value[number] += self._field(random) * self.of_edge + random.normal(0.0, self.noise / 2, (count, 2))
        bad = random.random(len(pairs)) < self.wrong
        value[bad] += random.uniform(2, 15, (bad.sum(), 1, 2)) * random.choice([-1, 1], (bad.sum(), 1, 2))
        value[random.random((len(pairs), count)) < self.hidden] = np.nan
        edges = Edges(pairs[:, 0], pairs[:, 1], value, np.full(value.shape[:2], self.noise**2), np.zeros(len(pairs)))
        return Made(self, edges, days / 365.25, shift, slopes, np.hypot(*rate.T) > 0, rate, bad)

    @functools.cached_property
    def _root(self) -> Array:
        """Root of exponential correlations that fall to 1/e where the Gaussian ones do."""
        distance = spatial.distance.cdist(self.cells.place, self.cells.place)
        return np.asarray(np.linalg.cholesky(np.exp(-distance / (4.0 * self.length)) + 1e-9 * np.eye(len(distance))))

    def _motion(self, random: np.random.Generator) -> Array:
        """Return rates ``(K, 2)`` of a connected part of the places."""
        place = self.cells.place
        rate = np.zeros(place.shape)
        if self.moving:
            far = np.hypot(*(place - random.uniform(-0.7, 0.7, 2)).T)
            inside = far <= np.quantile(far, self.moving)
            turn = random.uniform(0, 2 * np.pi)
            rate[inside] = self.rate * random.uniform(0.7, 1.3, (inside.sum(), 1)) * [np.cos(turn), np.sin(turn)]
        return rate

    def _field(self, random: np.random.Generator) -> Array:
        if self.sharp:
            return np.asarray(self._root @ random.standard_normal((len(self.cells.place), 2)))
        size = 96
        found = []
        where = (self.cells.place + 1) / 2 * 47 + 24
        for _ in range(2):
            smooth = gaussian_filter(random.standard_normal((size, size)), self.length * 48, mode="wrap")
            found.append(map_coordinates(smooth / smooth.std(), where.T[::-1], order=1))
        return np.column_stack(found)


@dataclass(frozen=True, eq=False)
class Made:
    """Edges and what is true of them."""

    truth: Truth
    edges: Edges
    years: Array
    shift: Array
    slopes: Array
    moving: NDArray[np.bool_]
    rate: Array
    wrong: NDArray[np.bool_]
