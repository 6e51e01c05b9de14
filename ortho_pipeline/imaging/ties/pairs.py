r"""Two scenes: where chips of one are in the other one, whatever the heights of the DEM.

A chip of the first scene is compared with the second one, rendered into its geometry through the DEM. A match d of the
chip about p says that the second scene shows at :math:`B(G(p + d))` what the first one shows at p, G being where the
ray of the (corrected) first model meets the DEM. That is true whatever the DEM's height there, because the same G has
rendered the chip: a height that is wrong by :math:`\delta` moves d by :math:`\delta\,u` along the epipolar direction
:math:`u = A_h - A_{xy} B_{xy}^{-1} B_h` (px per metre), and the tie not at all. So matches are searched as far along it
as heights may be wrong, and judged against each other across it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.imaging.matching.candidates import candidates, cells_of
from ortho_pipeline.imaging.matching.chip_search import (
    FEWEST,
    MEASURED,
    SIDE,
    SIGMAS,
    doubts,
    found_again,
    in_batches,
    seen,
)
from ortho_pipeline.imaging.matching.chips import rendered_chips, scene_chips
from ortho_pipeline.imaging.matching.least_squares import measure
from ortho_pipeline.imaging.matching.search import place
from ortho_pipeline.imaging.matching.targets import OtherScene, View, chip_factor, shown_by, spread_over
from ortho_pipeline.imaging.matching.weights import Components, components
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.rays import meet_surface

#: Radii (chip px) of the search of a chip: of the coarsest level at least, and of those after it.
_FIRST, _NEXT = 6, 4
#: Part of a chip that is seen at least where it is searched coarsely.
_GLIMPSED = 0.3
#: Heights are searched and believed within so many of their sigmas.
_HEIGHTS = 3.0
#: Rounds of judging.
_JUDGED = 8
#: Chip pixels that the heights displace by more than this are too fine for the first search.
_BLURRED = 1.5
#: Places that are asked where no correction stands out, and the chance that so many agree by accident.
_ASKED, _ACCIDENT = 100, 1e-6
#: Standard deviation (px) that any match has at least.
_FLOOR = 0.02


@dataclass(frozen=True)
class TieSettings:
    """Choices of a user.

    Parameters
    ----------
    search : float
        How far (m on the ground) the models may be off against each other.
    points : int
        About how many ties are wanted of a pair.
    dem_sigma : float
        Standard deviation (m) of the DEM's heights.
    threads : int
    memory : int
        Bytes that are meant for all of the work, of which GDAL's cache has a part.
    """

    search: float
    points: int = 500
    dem_sigma: float = 10.0
    threads: int = 1
    memory: int = 512_000_000


@dataclass(frozen=True)
class PairSummary:
    """Result of a pair of scenes.

    Parameters
    ----------
    images : (int, int)
    ties, tried : int
    shift : (float, float)
        Column and row (px of the first scene) by which its model was off against the second one's.
    components : Components or None
        What the residuals are made of.
    reason : str
        Why there are no ties; empty if there are.
    """

    images: tuple[int, int]
    ties: int
    tried: int
    shift: tuple[float, float] = (math.nan, math.nan)
    components: Components | None = None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Matched:
    """Places of one scene found in the other one; NaN where nothing was found.

    Parameters
    ----------
    first, second : (n, 2)
        Pixel positions in both scenes.
    first_covariance, second_covariance : (n, 2, 2)
        px²; the error of a match is that of both chips, half and half.
    height, height_sigma : (n,)
        How much higher (m) than the DEM the match puts the ground, up to what a correction of the model takes up.
    score : (n,)
        Correlation of the chips.
    """

    first: Array
    second: Array
    first_covariance: Array
    second_covariance: Array
    height: Array
    height_sigma: Array
    score: Array
    components: Components

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which were found."""
        return np.isfinite(self.second[:, 0])


@dataclass(frozen=True, eq=False)
class Pair:
    """A scene, another one, and the correction of the first model under which they agree.

    Parameters
    ----------
    view : View
    target : OtherScene
    correction : ImageCorrection
    factor : int
        Pixels of the first scene in a chip pixel.
    reach : float
        How far (px) heights may displace a match.
    settings : TieSettings
    """

    view: View
    target: OtherScene
    correction: ImageCorrection
    factor: int
    reach: float
    settings: TieSettings

    @classmethod
    def place(cls, view: View, target: OtherScene, shown: Array, search: float, settings: TieSettings) -> Pair:
        """Find the correction, by what both show.

        Parameters
        ----------
        shown : (n, 2)
            Points of the first scene that the second one shows.
        search : float
            How far (px) the model may be off.

        Raises
        ------
        InputError
            If resolutions are too different, or no place stands out.
        """
        base = chip_factor(view, [target], shown)
        ground = meet_surface(view.model, shown, view.surface)
        ground = ground[np.isfinite(ground).all(axis=1)]
        parallax = np.hypot(*_sight(view, target, view.model.ground_partials(ground), ground)[0].T)
        sigma = settings.dem_sigma * float(np.nanmedian(parallax)) if len(ground) else 0.0
        low, high = shown.min(axis=0), shown.max(axis=0)
        window = int(low[0]), int(low[1]), math.ceil(high[0]), math.ceil(high[1])
        finest = base
        while sigma / finest > _BLURRED and min(high - low) / (2 * finest) >= 3 * 24:
            finest *= 2
        while True:
            try:
                correction, _ = place(view, [target], max(search, 2.0 * finest), finest, window)
            except InputError as error:
                # The heights may be better than stated, and some grounds show nothing in large pixels.
                if finest > base:
                    finest = max(base, finest // 2)
                    continue
                found = cls(view, target, _uncorrected(view, window), base, search + _HEIGHTS * sigma, settings)
                return found._agreed(window, sigma, error)
            else:
                return cls(view, target, correction, base, _HEIGHTS * sigma + 2 * finest, settings)

    def _agreed(self, window: tuple[int, int, int, int], sigma: float, error: InputError) -> Pair:
        """Return the pair shifted to where most chips agree across the epipolar direction, each found by itself.

        That is how places are found where heights are wrong by more than chips are large, from chip to chip.
        """
        columns, rows = cells_of(window[2] - window[0], window[3] - window[1], _ASKED)
        inside = np.ones((rows, columns), dtype=bool)
        origins, _ = candidates(self.view, window, (columns, rows), SIDE, self.factor, inside)
        chips = _Chips(self, origins + SIDE // 2 * self.factor)
        chips.search()
        good = np.isfinite(chips.offset).all(axis=1)
        ground = meet_surface(self.correction, chips.centres + np.nan_to_num(chips.offset), self.view.surface)
        along, _ = _sight(self.view, self.target, self.correction.ground_partials(ground), ground)
        good &= np.isfinite(along).all(axis=1)
        offset, count = chips.offset[good], int(good.sum())
        if count < FEWEST:
            raise error
        unit = np.median(along[good], axis=0)
        unit /= np.linalg.norm(unit)
        place = offset @ np.stack([unit, (-unit[1], unit[0])], axis=1)
        wide = max(2 * _HEIGHTS * sigma, 3.0 * self.factor), 1.5 * self.factor
        apart = np.abs(place[:, None] - place)
        near = (apart <= wide).all(axis=2)
        most = near[int(near.sum(axis=1).argmax())]
        chance = min(1.0, float(np.prod([2 * one / (2 * self.reach) for one in np.minimum(wide, self.reach)])))
        if stats.binom.sf(int(most.sum()) - 2, count - 1, chance) * count > _ACCIDENT:
            raise error
        shift = np.zeros(6)
        shift[[0, 3]] = -np.median(offset[most], axis=0)
        correction = ImageCorrection(self.view.model, "affine", self.correction.origin, shift)
        return replace(self, correction=correction, reach=2 * _HEIGHTS * sigma + 2 * self.factor)

    @property
    def shift(self) -> tuple[float, float]:
        """Column and row (px) by which the model was off in the mean."""
        shift = self.correction.coefficients[[0, 3]]
        return float(shift[0]), float(shift[1])

    def match(self, places: Array) -> Matched:
        """Find places ``(n, 2)`` of the first scene in the second one.

        Chips are of whole pixels: what the chip about the nearest of their corners says is taken for the place itself.
        """
        chips = _Chips(self, np.round(places).astype(int))
        chips.search()
        chips.measure()
        return self._judged(places, chips)

    def _judged(self, places: Array, chips: _Chips) -> Matched:
        """Leave out what contradicts the others across the epipolar direction, or heights by more than they may."""
        count = len(places)
        ground = np.full((count, 3), np.nan)
        good = np.isfinite(chips.offset).all(axis=1)
        ground[good] = meet_surface(self.correction, places[good] + chips.offset[good], self.view.surface)
        good &= np.isfinite(ground).all(axis=1)
        partials = np.full((count, 2, 3), np.nan)
        partials[good] = self.correction.ground_partials(ground[good])
        along, turned = _sight(self.view, self.target, partials, ground)
        good &= np.isfinite(along).all(axis=1)
        parts, residuals = Components(1.0, 0.0, _FLOOR), np.full((count, 2), np.nan)
        for _ in range(_JUDGED):
            index = np.flatnonzero(good)
            if len(index) < FEWEST:
                good[:] = False
                break
            origin, extent = places[index].mean(axis=0), max(float(np.ptp(places[index], axis=0).max()), 1.0)
            design = np.column_stack([np.ones(len(index)), (places[index] - origin) / extent])
            residuals[index], parts = _fitted(design, chips.offset[index], chips.covariance[index], along[index])
            parts = replace(parts, other=max(parts.other, _FLOOR))
            total = replace(parts, height=max(parts.height, self.settings.dem_sigma)).covariance(
                chips.covariance[index], along[index]
            )
            apart = residuals[index]
            distance = squared_distances(apart, total)
            bad = distance > SIGMAS**2
            if not bad.any():
                break
            good[index[bad]] = False
        second = np.full((count, 2), np.nan)
        second[good] = self.target.project(ground[good], self.view.model.crs)
        covariance = replace(parts, height=0.0).covariance(chips.covariance, along)
        height, sigma = _heights(residuals, covariance, along)
        return Matched(
            places, second, covariance / 2, turned @ covariance @ turned.swapaxes(1, 2) / 2, height, sigma,
            chips.score, parts,
        )  # fmt: skip


def _uncorrected(view: View, window: tuple[int, ...]) -> ImageCorrection:
    return ImageCorrection.identity(view.model, "affine", ((window[0] + window[2]) / 2, (window[1] + window[3]) / 2))


def shared(view: View, target: OtherScene) -> Array:
    """Return those of points ``(n, 2)`` spread over a scene that another one shows, as the models have it."""
    image = spread_over(view)
    return image[shows(view, target, image)]


def shows(view: View, target: OtherScene, image: Array) -> NDArray[np.bool_]:
    """Tell which image points ``(n,)`` of a scene another one shows, as the models have it."""
    return shown_by([target], meet_surface(view.model, image, view.surface), view.model.crs)


def _sight(view: View, target: OtherScene, partials: Array, ground: Array) -> tuple[Array, Array]:
    """Return how a metre of height displaces matches ``(n, 2)``, and d(second image)/d(first image) ``(n, 2, 2)``.

    Parameters
    ----------
    partials : (n, 2, 3)
        Of the first model.
    """
    per_metre = map_from_enu(parse_crs(view.model.crs), ground)
    second = np.stack(
        [(target.project(ground + one, view.model.crs) - target.project(ground - one, view.model.crs)) / 2
         for one in np.moveaxis(per_metre, 2, 0)], axis=-1,
    )  # fmt: skip
    first = partials @ per_metre
    # Along a ray of the second scene, plan follows height.
    with np.errstate(invalid="ignore"):
        plan = -_solve(second[:, :, :2], second[:, :, 2:])
        along = (first[:, :, 2:] + first[:, :, :2] @ plan)[:, :, 0]
        turned = _solve(first[:, :, :2].swapaxes(1, 2), second[:, :, :2].swapaxes(1, 2)).swapaxes(1, 2)
    return along, turned


def _solve(matrix: Array, right: Array) -> Array:
    """Solve stacks of linear systems; NaN where they are not known or singular."""
    found = np.full(right.shape, np.nan)
    known = np.flatnonzero(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2)))
    good = known[np.linalg.det(matrix[known]) != 0]
    found[good] = np.linalg.solve(matrix[good], right[good])
    return found


def _fitted(design: Array, offset: Array, matched: Array, along: Array) -> tuple[Array, Components]:
    """Return what an affine correction leaves of the offsets ``(n, 2)``, weighted by what the parts are found to be."""
    residuals = offset - np.median(offset, axis=0)
    parts = components(residuals, matched, along)
    for _ in range(3):
        total = replace(parts, other=max(parts.other, _FLOOR)).covariance(matched, along)
        distance = squared_distances(residuals, total)
        weight = np.linalg.inv(total) / np.maximum(1.0, np.sqrt(distance) / 2.0)[:, None, None]
        rows = np.einsum("nk,ij->nijk", design, np.eye(2)).reshape(len(design), 2, 2 * design.shape[1])
        normal = np.einsum("nip,nij,njq->pq", rows, weight, rows)
        right = np.einsum("nip,nij,nj->p", rows, weight, offset)
        residuals = offset - rows @ np.linalg.lstsq(normal, right, rcond=None)[0]
        parts = components(residuals, matched, along)
    return residuals, parts


def _heights(residuals: Array, covariance: Array, along: Array) -> tuple[Array, Array]:
    """Return the heights ``(n,)`` in metres that residuals are, and their sigmas."""
    weighted = _solve(covariance, along[:, :, None])[:, :, 0]
    square = np.einsum("ni,ni->n", weighted, along)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.einsum("ni,ni->n", weighted, residuals) / square, 1.0 / np.sqrt(square)


class _Chips:
    """Chips of the first scene, and how far each has come; offsets in its pixels, NaN for what is lost."""

    def __init__(self, pair: Pair, centres: NDArray[np.int_]) -> None:
        self.pair, self.centres = pair, centres
        self.seen = View(pair.view.intensity, pair.correction, pair.view.surface)
        count = len(centres)
        self.offset = np.zeros((count, 2))
        self.covariance = np.full((count, 2, 2), np.nan)
        self.score = np.zeros(count)

    def search(self) -> None:
        """Find each chip to a chip px, coarse to fine, each by itself: heights are wrong from place to place."""
        base, reach = self.pair.factor, self.pair.reach
        factor = base
        while reach / factor > _FIRST and SIDE * factor * 4 <= min(self.pair.view.size):
            factor *= 2
        radius = max(_NEXT, math.ceil(reach / factor))
        while True:
            self._in_batches(self._level(factor, radius, finest=factor == base))
            if factor == base:
                return
            factor, radius = max(base, factor // 2), _NEXT

    def _level(self, factor: int, radius: int, *, finest: bool) -> Callable[[NDArray[np.int_]], None]:
        def work(index: NDArray[np.int_]) -> None:
            origins = self.centres[index] - SIDE // 2 * factor
            start = np.round(self.offset[index]).astype(int)
            wide = self._rendered(origins + start - 2 * radius * factor, SIDE + 4 * radius, factor)
            found = found_again(scene_chips(self.pair.view, origins, SIDE, factor), wide, radius)
            self.offset[index] = start + found.shift * factor
            if finest:
                around = scene_chips(self.pair.view, origins - radius * factor, SIDE + 2 * radius, factor)
                lost = doubts(found, wide, around, radius) != ""
            else:
                lost = seen(wide, radius) <= _GLIMPSED
            self.offset[index[lost]] = np.nan

        return work

    def measure(self) -> None:
        """Measure each chip that was found to a part of a pixel."""
        factor = self.pair.factor

        def work(index: NDArray[np.int_]) -> None:
            origins = self.centres[index] - SIDE // 2 * factor
            start = np.round(self.offset[index]).astype(int)
            wide = self._rendered(origins + start - MEASURED * factor, SIDE + 2 * MEASURED, factor)
            scene = scene_chips(self.pair.view, origins, SIDE, factor)
            found = measure(scene, wide, (self.offset[index] - start) / factor)
            self.offset[index] = start + found.shift * factor
            self.covariance[index] = found.covariance * factor**2
            self.score[index] = found.correlation

        self._in_batches(work)

    def _rendered(self, origins: NDArray[np.int_], size: int, factor: int) -> NDArray[np.float32]:
        return rendered_chips(self.seen, self.pair.target, origins, size, factor)

    def _in_batches(self, work: Callable[[NDArray[np.int_]], None]) -> None:
        in_batches(work, np.flatnonzero(np.isfinite(self.offset).all(axis=1)), self.pair.settings.threads)
