"""Separate search of each chip: along the line of sight, or for a part of the scene that is displaced.

Height errors may differ from place to place.

A wrong height moves a match in one direction of the image, along the line of sight (for two scenes, the epipolar line).
If it moves by more than the size of a chip, no common shift is clear: chips agree only across the line of sight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.imaging.matching.agreement import ACCIDENT, FEWEST_PART, by_chance
from ortho_pipeline.imaging.matching.candidates import candidates, cells_of
from ortho_pipeline.imaging.matching.chip_search import FEWEST, MEASURED, SIDE, doubts, found_again, in_batches, seen
from ortho_pipeline.imaging.matching.chips import Renderer, scene_chips
from ortho_pipeline.imaging.matching.least_squares import measure
from ortho_pipeline.imaging.matching.search import Level
from ortho_pipeline.imaging.matching.targets import SceneView, Target
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.rays import meet_surface

#: Largest displacement by heights (chip px, standard deviation) for a common search of chips.
BLURRED = 1.5
#: Heights are searched and accepted within this many sigmas.
HEIGHTS = 3.0
#: Radii (chip px) of the search of a chip: least at the coarsest level, and at the following levels.
_FIRST, _NEXT = 6, 4
#: Number of chips to search.
_ASKED = 100
#: Least visible part of a chip in a coarse search.
_GLIMPSED = 0.3
#: Least displacement (chip px) of a part, and the largest distance within which its chips agree.
_LEAST = 0.5
_TOGETHER = 2.5
#: Number of chips around a chip, itself included, of which most agree with it in the middle of a part.
_AROUND = 9
#: Distance (chip px) across the line of sight within which chips agree.
_ACROSS = 1.5


class Chips:
    """Chips of a scene, and the state of each; offsets in pixels of the scene, NaN for lost chips.

    Parameters
    ----------
    view : SceneView
        With the corrected model.
    centres : (n, 2) of int
    factor : int
        Pixels of the scene in a chip pixel.
    reach : float
        Search radius (px) of each chip.
    """

    def __init__(
        self,
        view: SceneView,
        targets: Sequence[Target],
        centres: NDArray[np.int_],
        factor: int,
        reach: float,
        threads: int,
    ) -> None:
        self.view, self.targets, self.centres, self.factor = view, targets, centres, factor
        self.reach, self.threads = reach, threads
        count = len(centres)
        self.offset = np.zeros((count, 2))
        self.covariance = np.full((count, 2, 2), np.nan)
        self.score = np.zeros(count)
        #: Why a chip is lost, keys of `matcher.REASONS`.
        self.reason: NDArray[Any] = np.full(count, "", dtype="<U12")

    def search(self) -> None:
        """Find each chip separately to a chip px, coarse to fine."""
        factor = self._coarsest()
        self._search(factor, max(_NEXT, math.ceil(self.reach / factor)))

    def search_small(self) -> None:
        """Find each chip from every level, and keep the best position: coarse chips are larger than small parts."""
        factor = self._coarsest()
        best, score = np.full(self.offset.shape, np.nan), np.full(len(self.offset), -np.inf)
        radius = max(_NEXT, math.ceil(self.reach / factor))
        while True:
            self.offset, self.score = np.zeros_like(best), np.zeros_like(score)
            self.reason[:] = ""
            self._search(factor, radius)
            better = np.isfinite(self.offset).all(axis=1) & (self.score > score)
            best[better], score[better] = self.offset[better], self.score[better]
            if factor == self.factor:
                break
            factor = max(self.factor, factor // 2)
            radius = min(math.ceil(self.reach / factor), SIDE // 2)
        self.offset, self.score = best, score

    def _coarsest(self) -> int:
        factor = self.factor
        while self.reach / factor > _FIRST and SIDE * factor * 4 <= min(self.view.size):
            factor *= 2
        return factor

    def _search(self, factor: int, radius: int) -> None:
        while True:
            self._in_batches(self._level(factor, radius, finest=factor == self.factor))
            if factor == self.factor:
                return
            factor, radius = max(self.factor, factor // 2), _NEXT

    def _level(self, factor: int, radius: int, *, finest: bool) -> Callable[[NDArray[np.int_]], None]:
        def work(index: NDArray[np.int_]) -> None:
            origins = self.centres[index] - SIDE // 2 * factor
            start = np.round(self.offset[index]).astype(int)
            wide = self._rendered(origins + start - 2 * radius * factor, SIDE + 4 * radius, factor)
            peak = found_again(scene_chips(self.view, origins, SIDE, factor), wide, radius)
            self.offset[index], self.score[index] = start + peak.shift * factor, peak.score
            if finest:
                around = scene_chips(self.view, origins - radius * factor, SIDE + 2 * radius, factor)
                self.reason[index] = doubts(peak, wide, around, radius)
            else:
                self.reason[index[seen(wide, radius) <= _GLIMPSED]] = "hidden"
            self.offset[index[self.reason[index] != ""]] = np.nan

        return work

    def measure(self) -> None:
        """Measure each found chip to a fraction of a pixel."""
        factor = self.factor

        def work(index: NDArray[np.int_]) -> None:
            origins = self.centres[index] - SIDE // 2 * factor
            start = np.round(self.offset[index]).astype(int)
            wide = self._rendered(origins + start - MEASURED * factor, SIDE + 2 * MEASURED, factor)
            scene = scene_chips(self.view, origins, SIDE, factor)
            measured = measure(scene, wide, (self.offset[index] - start) / factor)
            self.offset[index] = start + measured.shift * factor
            self.covariance[index] = measured.covariance * factor**2
            self.score[index] = measured.correlation

        self._in_batches(work)

    def _rendered(self, origins: NDArray[np.int_], size: int, factor: int) -> NDArray[np.float32]:
        return Renderer(self.view, self.targets, origins, size, factor).render(np.arange(len(origins)))

    def _in_batches(self, work: Callable[[NDArray[np.int_]], None]) -> None:
        in_batches(work, np.flatnonzero(np.isfinite(self.offset).all(axis=1)), self.threads)


def displaced_parts(
    view: SceneView,
    targets: Sequence[Target],
    centres: Array,
    reason: NDArray[np.str_],
    factor: int,
    reach: float,
    threads: int,
) -> tuple[NDArray[np.int_], Array, Array]:
    """Return which rejected chips of a scene are in parts that match at other positions than the rest, and where.

    Parameters
    ----------
    view : SceneView
        With the corrected model.
    centres : (n, 2)
    reason : (n,) of str
        Why the chip there was rejected, a key of `matcher.REASONS`; empty if it was kept.
    factor : int
        Pixels of the scene in a chip pixel.
    reach : float
        Largest displacement (px).

    Returns
    -------
    index : (k,) of int
        Chips of which more agree than do by chance.
    offset : (k, 2)
        Where the corrected model projects the same ground, minus the centre (px).
    covariance : (k, 2, 2)
        Of the offset.
    """
    lost = np.flatnonzero((reason != "hidden") & (reason != ""))
    chips = Chips(view, targets, centres[lost].astype(int), factor, reach, threads)
    if len(lost) >= FEWEST_PART:
        chips.search_small()
        chips.measure()
        found = np.flatnonzero(np.isfinite(chips.offset).all(axis=1))
        offset = chips.offset[found] / factor
        length = np.hypot(*offset.T)
        # Errors of matches are mostly small, so many of them agree on a small displacement.
        agree, radius = np.minimum(_TOGETHER, length / 2), np.minimum(reach / factor, 2 * length)
        agreeing = cKDTree(offset).query_ball_point(offset, agree, return_length=True) if len(found) else agree
        chance = by_chance(agreeing, len(lost), agree, radius) * (2 * reach / factor + 1) ** 2
        common = (length >= _LEAST) & (agreeing >= FEWEST_PART) & (chance <= ACCIDENT)
        inside = _in_areas(centres[lost[found]], offset, agree, common, centres[reason == ""])
        chips.offset[found[~(common & inside)]] = np.nan
    good = np.isfinite(chips.covariance).all(axis=(1, 2)) & np.isfinite(chips.offset).all(axis=1)
    return lost[good], chips.offset[good], chips.covariance[good]


def _in_areas(centres: Array, offset: Array, agree: Array, common: NDArray[np.bool_], kept: Array) -> NDArray[np.bool_]:
    """Return which chips ``(n,)`` are in areas of chips that agree: edges may change alike all over a scene.

    In the middle of an area, most of the chips around a chip agree with it. At its edge, one in the middle does.

    Parameters
    ----------
    offset : (n, 2)
    agree : (n,)
        Distance of offsets within which others agree with each.
    common : (n,) of bool
        Which chips agree with more than do by chance.
    kept : (k, 2)
        Centres of other chips, which agree with none.
    """
    places = np.concatenate([centres, kept])
    near = cKDTree(places).query(centres, np.arange(1, min(_AROUND, len(places)) + 1))[1]
    # The last one is for all that were kept.
    near = np.minimum(near, len(centres))
    apart = np.concatenate([offset, [(np.nan, np.nan)]])[near] - offset[:, None]
    around = np.hypot(*apart.transpose(2, 0, 1)) <= agree[:, None]
    middle = common & (around.mean(axis=1) >= 0.5)
    return np.asarray((around & np.append(middle, False)[near]).any(axis=1))


def along_sight(
    view: SceneView,
    targets: Sequence[Target],
    factor: int,
    search: float,
    window: tuple[int, int, int, int],
    displaced: float,
    threads: int,
) -> tuple[ImageCorrection, int, int] | None:
    """Return the shift of the model on which most chips, each found separately, agree across the line of sight.

    This places a scene if height errors displace chips by more than their size.

    Parameters
    ----------
    search : float
        Largest error of the model (px).
    displaced : float
        Standard deviation (px) of the displacement by wrong heights.

    Returns
    -------
    correction : ImageCorrection
    chips, agreeing : int
        None if as many could agree by chance.
    """
    start = ImageCorrection.identity(view.model, "affine", ((window[0] + window[2]) / 2, (window[1] + window[3]) / 2))
    columns, rows = cells_of(window[2] - window[0], window[3] - window[1], _ASKED)
    origins, _ = candidates(view, window, (columns, rows), SIDE, factor, np.ones((rows, columns), dtype=bool))
    corrected = SceneView(view.intensity, start, view.surface)
    chips = Chips(corrected, targets, origins + SIDE // 2 * factor, factor, search + HEIGHTS * displaced, threads)
    chips.search()
    good = np.isfinite(chips.offset).all(axis=1)
    ground = meet_surface(start, chips.centres + np.nan_to_num(chips.offset), view.surface)
    along, _ = displacements(view, targets[0], start.ground_partials(ground), ground)
    good &= np.isfinite(along).all(axis=1)
    offset = chips.offset[good]
    if len(offset) < FEWEST:
        return None
    most = _agreeing(offset, along[good], displaced, chips)
    if not most.any():
        return None
    step = np.zeros(6)
    step[[0, 3]] = -np.median(offset[most], axis=0)
    return replace(start, coefficients=step), len(offset), int(most.sum())


def displacement(view: SceneView, shown: Array, dem_sigma: float, factor: int) -> float:
    """Return the standard deviation (px) of the displacement by wrong heights; 0 if a common search can bear it."""
    ground = meet_surface(view.model, shown, view.surface)
    along = view.model.ground_partials(ground[np.isfinite(ground).all(axis=1)])[:, :, 2]
    displaced = dem_sigma * float(np.median(np.hypot(*along.T))) if len(along) else 0.0
    return displaced if displaced > BLURRED * factor else 0.0


def placed_along_sight(
    view: SceneView,
    targets: Sequence[Target],
    level: tuple[int, float],
    region: tuple[int, int, int, int],
    displaced: float,
    threads: int,
    refused: InputError,
) -> tuple[ImageCorrection, list[Level]]:
    """Return the correction on which chips agree across the line of sight, if heights may have caused a refusal.

    Raises
    ------
    InputError
        If they do not agree, or heights are not the cause.
    """
    factor, reach = level
    if not displaced:
        raise refused
    fit = along_sight(view, targets, factor, reach, region, displaced, threads)
    if fit is None:
        raise InputError(
            f"{refused.message}. Wrong heights (up to {displaced:.0f} px along the line of sight) do not explain this: "
            "chips also disagree across it",
            file=refused.file,
            field=refused.field,
            remedy=Text("give a better DEM, or ", refused.remedy or ""),
        ) from None
    correction, chips, agreeing = fit
    shift = correction.coefficients[[0, 3]]
    radius = math.ceil((reach + HEIGHTS * displaced) / factor)
    return correction, [Level(factor, radius, chips, agreeing, (float(shift[0]), float(shift[1])))]


def _agreeing(offset: Array, along: Array, displaced: float, chips: Chips) -> NDArray[np.bool_]:
    """Return the majority of offsets ``(n, 2)`` (px) that agrees across the line of sight; none if it may be chance.

    Parameters
    ----------
    along : (n, 2)
        The line of sight at each.
    displaced : float
        Standard deviation (px) of the displacement by wrong heights.
    chips : Chips
        The searched chips.
    """
    unit = _unit(np.median(along, axis=0))
    place = offset @ np.stack([unit, (-unit[1], unit[0])], axis=1)
    wide = max(2 * HEIGHTS * displaced, 2 * _ACROSS * chips.factor), _ACROSS * chips.factor
    near = (np.abs(place[:, None] - place) <= wide).all(axis=2)
    most = near[int(near.sum(axis=1).argmax())]
    chance = min(1.0, float(np.prod([half / chips.reach for half in np.minimum(wide, chips.reach)])))
    count = len(offset)
    accident = bdtrc(int(most.sum()) - 2, count - 1, chance) * count > ACCIDENT
    return np.zeros(count, dtype=bool) if accident else most


def across(residuals: Array, along: Array) -> Array:
    """Return the parts of residuals ``(n, 2)`` across a line of sight ``(2,)``."""
    unit = _unit(along)
    return residuals - np.outer(residuals @ unit, unit)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def displacements(view: SceneView, target: Target, partials: Array, ground: Array) -> tuple[Array, Array]:
    """Return the displacement of matches by a metre of height ``(n, 2)``, and d(target)/d(image) ``(n, 2, 2)``.

    Parameters
    ----------
    partials : (n, 2, 3)
        d(image)/d(ground) of the model of the view.
    """
    per_metre = map_from_enu(parse_crs(view.model.crs), ground)
    second = np.stack(
        [
            (target.project(ground + step, view.model.crs) - target.project(ground - step, view.model.crs)) / 2
            for step in np.moveaxis(per_metre, 2, 0)
        ],
        axis=-1,
    )
    first = partials @ per_metre
    # Along a ray of another scene the horizontal position changes with height; in an orthoimage it does not.
    with np.errstate(invalid="ignore"):
        plan = -solved(second[:, :, :2], second[:, :, 2:])
        along = (first[:, :, 2:] + first[:, :, :2] @ plan)[:, :, 0]
        turned = solved(first[:, :, :2].swapaxes(1, 2), second[:, :, :2].swapaxes(1, 2)).swapaxes(1, 2)
    return along, turned


def solved(matrix: Array, right: Array) -> Array:
    """Solve stacks of linear systems; NaN where unknown or singular."""
    solution = np.full(right.shape, np.nan)
    known = np.flatnonzero(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2)))
    good = known[np.linalg.det(matrix[known]) != 0]
    solution[good] = np.linalg.solve(matrix[good], right[good])
    return solution
