"""Where chips are found again in larger ones, and whether to believe it: alike, unique, back again, in all bands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.imaging.band_shifts import BandShift
from ortho_pipeline.imaging.matching.chips import Renderer
from ortho_pipeline.imaging.matching.correlation import Peaks, orientation, peaks, surfaces
from ortho_pipeline.imaging.matching.least_squares import measure
from ortho_pipeline.imaging.matching.targets import Reference, SceneView, Target
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.runtime.process_limits import side_by_side

#: Side of a chip (chip px); it is even, so that a chip of any factor has its centre between the same pixels.
SIDE = 40
#: Radius (chip px) of what is rendered to measure in.
MEASURED = 4
#: Fewer matches than this cannot be judged by each other.
FEWEST = 12
#: A match that is farther from the others than so many of its sigmas contradicts them.
SIGMAS = 3.5
#: Correlation of orientations below which a match could as well be noise.
_LEAST_SCORE = 0.25
#: A second peak of more than this part of the first: the place is not unique.
_UNIQUE = 0.85
#: Forward and backward match differ by less than this (chip px).
_BACK = 0.7
#: Part of a chip that the target shows at least.
_SEEN = 0.8
#: At most so many chips are measured in single bands, at most so many of these, within so many chip px.
_CHIPS, _BANDS, _AROUND = 48, 6, 6
#: Chips that are worked on together: as many for any number of threads, so that results do not depend on them.
_BATCH = 32

Chips = NDArray[np.float32]
_T = TypeVar("_T", bound=np.generic)


def found_again(scene: Chips, wide: Chips, radius: int) -> Peaks:
    """Find chips ``(n, s, s)`` within `radius` about the centres of larger ones ``(n, s + 4 radius, ...)``.

    These are so large that the way back can be tried from any place that is found.
    """
    return peaks(surfaces(orientation(scene), _inner(orientation(wide), radius)))


def seen(wide: Chips, radius: int) -> Array:
    """Return the part ``(n,)`` of where `found_again` looks that is valid."""
    return np.asarray(np.isfinite(_inner(wide, radius)).mean(axis=(1, 2)))


def doubts(found: Peaks, wide: Chips, around: Chips, radius: int) -> NDArray[np.str_]:
    """Return why places that were found again are not believed ``(n,)``, keys of `matcher.REASONS`; empty if they are.

    Parameters
    ----------
    wide : (n, s + 4 radius, s + 4 radius)
        What was looked in.
    around : (n, s + 2 radius, s + 2 radius)
        The scene about its chips, for the way back.
    """
    reason = np.full(len(wide), "", dtype="<U12")
    for name, passed in (
        ("backward", _way_back(found.shift, wide, around, radius) <= _BACK),
        ("ambiguous", found.inside & (found.ratio <= _UNIQUE)),
        ("weak", found.score >= _LEAST_SCORE),
        ("hidden", seen(wide, radius) >= _SEEN),
    ):
        reason[~passed] = name
    return reason


def in_batches(work: Callable[[NDArray[np.int_]], None], index: NDArray[np.int_], threads: int) -> None:
    """Do a work on numbers ``(n,)``, some at a time."""
    parts = [(first, first + _BATCH) for first in range(0, len(index), _BATCH)]
    side_by_side(lambda _, begin, end: work(index[begin:end]), parts, threads)


def in_each_band(
    view: SceneView,
    targets: Sequence[Target],
    origins: NDArray[np.int_],
    scene: Chips,
    start: Array,
    factor: int,
    threads: int,
) -> tuple[BandShift, ...]:
    """Return where single bands of references put chips; none where fewer than two bands can be compared.

    Parameters
    ----------
    view : SceneView
        With the model as the matches corrected it.
    origins : (n, 2)
        First pixels of chips that were matched.
    scene : (n, s, s)
    start : (n, 2)
        Where they were found in the targets, chip px.
    """
    references = [target for target in targets if isinstance(target, Reference)]
    numbers = _compared_bands(references)
    if len(numbers) < 2 or len(origins) < FEWEST:
        return ()
    some = np.unique(np.linspace(0, len(origins) - 1, _CHIPS).round().astype(int))
    side = SIDE + 2 * _AROUND
    renderer = Renderer(view, references, origins[some] - _AROUND * factor, side, factor)
    fields, bands = orientation(scene[some]), []
    for number in numbers:
        single = [replace(one, intensity=Intensity(one.intensity.source, (number,))) for one in references]
        wide = _rendered(renderer.of(single), len(some), side, threads)
        # Least squares finds what is near: the band as a whole may be some pixels away.
        coarse = peaks(surfaces(fields, orientation(wide)))
        moved = (coarse.shift - start[some])[coarse.inside]
        whole = np.round(np.median(moved, axis=0)) if len(moved) else np.zeros(2)
        found = measure(scene[some], wide, start[some] + whole).shift
        # Where a band shows the scene farther on, the model moves back.
        moves = (start[some] - found)[np.isfinite(found).all(axis=1)] * factor
        if len(moves) >= FEWEST:
            bands.append(BandShift.of(number, moves))
    return tuple(bands) if len(bands) > 1 else ()


def _compared_bands(references: Sequence[Reference]) -> tuple[int, ...]:
    """Return the numbers of the bands that are compared: several that a user chose, else all with content."""
    if not references:
        return ()
    first = references[0].intensity
    numbers = first.averaged
    if len(first.bands) < 2:
        numbers = (*numbers, *(one for one in first.best(_BANDS) if one not in numbers))
    fewest = min(one.intensity.source.count for one in references)
    return tuple(sorted(one for one in numbers[:_BANDS] if one <= fewest))


def _rendered(renderer: Renderer, count: int, side: int, threads: int) -> Chips:
    wide = np.empty((count, side, side), dtype=np.float32)

    def render(index: NDArray[np.int_]) -> None:
        wide[index] = renderer.render(index)

    in_batches(render, np.arange(count), threads)
    return wide


def _inner(wide: NDArray[_T], radius: int) -> NDArray[_T]:
    return wide[:, radius:-radius, radius:-radius]


def _way_back(shift: Array, wide: Chips, around: Chips, radius: int) -> Array:
    """Return how far (chip px) from where it began the way back ends ``(n,)``."""
    whole = np.clip(np.round(shift), -radius, radius).astype(int)
    side = wide.shape[1] - 4 * radius
    there = np.stack(
        [
            chip[row : row + side, column : column + side]
            for chip, (column, row) in zip(wide, 2 * radius + whole, strict=True)
        ]
    )
    back = peaks(surfaces(orientation(there), orientation(around)))
    return np.asarray(np.hypot(*(back.shift + (shift - whole)).T))
