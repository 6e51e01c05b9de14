"""Chips that are searched along the line of sight, each by itself, because heights are wrong from place to place.

A height that is wrong moves a match along one direction of the image, the line of sight (of two scenes the epipolar
one). Where that is farther than chips are large, no shift of the whole stands out: chips agree across it alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.imaging.matching.candidates import candidates, cells_of
from ortho_pipeline.imaging.matching.chip_search import FEWEST, MEASURED, SIDE, doubts, found_again, in_batches, seen
from ortho_pipeline.imaging.matching.chips import Renderer, scene_chips
from ortho_pipeline.imaging.matching.least_squares import measure
from ortho_pipeline.imaging.matching.search import Level
from ortho_pipeline.imaging.matching.targets import SceneView, Target
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.rays import meet_surface

#: Chips bear heights that displace them by so many chip px (standard deviation).
BLURRED = 1.5
#: Heights are searched and believed within so many of their sigmas.
HEIGHTS = 3.0
#: Radii (chip px) of the search of a chip: of the coarsest level at least, and of those after it.
_FIRST, _NEXT = 6, 4
#: Places that are asked.
_ASKED = 100
#: Part of a chip that is seen at least where it is searched coarsely.
_GLIMPSED = 0.3
#: Chips that agree lie within so many chip px across the line of sight; the chance that so many do by accident.
_ACROSS, _ACCIDENT = 1.5, 1e-6


class Chips:
    """Chips of a scene, and how far each has come; offsets in its pixels, NaN for what is lost.

    Parameters
    ----------
    view : SceneView
        With the model as it is corrected.
    centres : (n, 2) of int
    factor : int
        Pixels of the scene in a chip pixel.
    reach : float
        How far (px) each is searched.
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
        #: Why it is lost, keys of `matcher.REASONS`.
        self.reason: NDArray[Any] = np.full(count, "", dtype="<U12")

    def search(self) -> None:
        """Find each chip to a chip px, coarse to fine, each by itself: heights are wrong from place to place."""
        factor = self.factor
        while self.reach / factor > _FIRST and SIDE * factor * 4 <= min(self.view.size):
            factor *= 2
        radius = max(_NEXT, math.ceil(self.reach / factor))
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
            found = found_again(scene_chips(self.view, origins, SIDE, factor), wide, radius)
            self.offset[index], self.score[index] = start + found.shift * factor, found.score
            if finest:
                around = scene_chips(self.view, origins - radius * factor, SIDE + 2 * radius, factor)
                self.reason[index] = doubts(found, wide, around, radius)
            else:
                self.reason[index[seen(wide, radius) <= _GLIMPSED]] = "hidden"
            self.offset[index[self.reason[index] != ""]] = np.nan

        return work

    def measure(self) -> None:
        """Measure each chip that was found to a part of a pixel."""
        factor = self.factor

        def work(index: NDArray[np.int_]) -> None:
            origins = self.centres[index] - SIDE // 2 * factor
            start = np.round(self.offset[index]).astype(int)
            wide = self._rendered(origins + start - MEASURED * factor, SIDE + 2 * MEASURED, factor)
            scene = scene_chips(self.view, origins, SIDE, factor)
            found = measure(scene, wide, (self.offset[index] - start) / factor)
            self.offset[index] = start + found.shift * factor
            self.covariance[index] = found.covariance * factor**2
            self.score[index] = found.correlation

        self._in_batches(work)

    def _rendered(self, origins: NDArray[np.int_], size: int, factor: int) -> NDArray[np.float32]:
        return Renderer(self.view, self.targets, origins, size, factor).render(np.arange(len(origins)))

    def _in_batches(self, work: Callable[[NDArray[np.int_]], None]) -> None:
        in_batches(work, np.flatnonzero(np.isfinite(self.offset).all(axis=1)), self.threads)


def along_sight(
    view: SceneView,
    targets: Sequence[Target],
    factor: int,
    search: float,
    window: tuple[int, int, int, int],
    displaced: float,
    threads: int,
) -> tuple[ImageCorrection, int, int] | None:
    """Return the shift of the model on which most chips agree across the line of sight, each found by itself.

    That is how a scene is placed where heights are wrong by more than chips are large, from chip to chip.

    Parameters
    ----------
    search : float
        How far (px) the model may be off.
    displaced : float
        Standard deviation (px) of what wrong heights displace chips by.

    Returns
    -------
    correction : ImageCorrection
    chips, agreeing : int
        Or None, where so many could as well agree by accident.
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
    """Return the standard deviation (px) of what wrong heights displace matches by; 0 where chips bear it."""
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
    """Return the correction on which chips agree across the line of sight, where heights may be the cause of a refusal.

    Raises
    ------
    InputError
        If they do not agree, or heights are no cause.
    """
    factor, reach = level
    if not displaced:
        raise refused
    found = along_sight(view, targets, factor, reach, region, displaced, threads)
    if found is None:
        raise InputError(
            f"{refused.message}; nor do chips agree across the line of sight, along which wrong heights displace them "
            f"by {displaced:.0f} px",
            file=refused.file,
            field=refused.field,
            remedy=Text("give better heights, or: ", refused.remedy or ""),
        ) from None
    correction, chips, agreeing = found
    shift = correction.coefficients[[0, 3]]
    radius = math.ceil((reach + HEIGHTS * displaced) / factor)
    return correction, [Level(factor, radius, chips, agreeing, (float(shift[0]), float(shift[1])))]


def _agreeing(offset: Array, along: Array, displaced: float, chips: Chips) -> NDArray[np.bool_]:
    """Return the most of offsets ``(n, 2)`` (px) that agree across the line of sight; none if it may be an accident.

    Parameters
    ----------
    along : (n, 2)
        The line of sight at each.
    displaced : float
        Standard deviation (px) of what wrong heights displace them by.
    chips : Chips
        As they were searched.
    """
    unit = _unit(np.median(along, axis=0))
    place = offset @ np.stack([unit, (-unit[1], unit[0])], axis=1)
    wide = max(2 * HEIGHTS * displaced, 2 * _ACROSS * chips.factor), _ACROSS * chips.factor
    near = (np.abs(place[:, None] - place) <= wide).all(axis=2)
    most = near[int(near.sum(axis=1).argmax())]
    chance = min(1.0, float(np.prod([one / chips.reach for one in np.minimum(wide, chips.reach)])))
    count = len(offset)
    accident = stats.binom.sf(int(most.sum()) - 2, count - 1, chance) * count > _ACCIDENT
    return np.zeros(count, dtype=bool) if accident else most


def across(residuals: Array, along: Array) -> Array:
    """Return what residuals ``(n, 2)`` are across a line of sight ``(2,)``."""
    unit = _unit(along)
    return residuals - np.outer(residuals @ unit, unit)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def displacements(view: SceneView, target: Target, partials: Array, ground: Array) -> tuple[Array, Array]:
    """Return how a metre of height displaces matches ``(n, 2)``, and d(target)/d(image) ``(n, 2, 2)``.

    Parameters
    ----------
    partials : (n, 2, 3)
        Of the model of the view.
    """
    per_metre = map_from_enu(parse_crs(view.model.crs), ground)
    second = np.stack(
        [
            (target.project(ground + one, view.model.crs) - target.project(ground - one, view.model.crs)) / 2
            for one in np.moveaxis(per_metre, 2, 0)
        ],
        axis=-1,
    )
    first = partials @ per_metre
    # Along a ray of another scene plan follows height; in an orthoimage it does not.
    with np.errstate(invalid="ignore"):
        plan = -solved(second[:, :, :2], second[:, :, 2:])
        along = (first[:, :, 2:] + first[:, :, :2] @ plan)[:, :, 0]
        turned = solved(first[:, :, :2].swapaxes(1, 2), second[:, :, :2].swapaxes(1, 2)).swapaxes(1, 2)
    return along, turned


def solved(matrix: Array, right: Array) -> Array:
    """Solve stacks of linear systems; NaN where they are not known or singular."""
    found = np.full(right.shape, np.nan)
    known = np.flatnonzero(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2)))
    good = known[np.linalg.det(matrix[known]) != 0]
    found[good] = np.linalg.solve(matrix[good], right[good])
    return found
