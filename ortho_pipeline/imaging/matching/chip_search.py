"""Search of chips in larger ones, and tests of the result: similarity, uniqueness, matching back, all bands."""

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

#: Side of a chip (chip px). It is even, so that the centre is between the same pixels for any factor.
SIDE = 40
#: Radius (chip px) of the measurement around a chip.
MEASURED = 4
#: Least number of matches that can be tested against each other.
FEWEST = 12
#: A match contradicts the others if it is farther away than this many sigmas.
SIGMAS = 3.5
#: Least correlation of orientations; below, a match can be noise.
_LEAST_SCORE = 0.25
#: Largest ratio of the second to the first peak of a unique match.
_UNIQUE = 0.85
#: Largest difference (chip px) between forward and backward match.
_BACK = 0.7
#: Least part of a chip that the target must show.
_SEEN = 0.8
#: Largest numbers of chips and of single bands to measure, and the search radius (chip px).
_CHIPS, _BANDS, _AROUND = 48, 6, 6
#: Chips in a batch; the same for any number of threads, so that results do not depend on it.
_BATCH = 32

Chips = NDArray[np.float32]
_T = TypeVar("_T", bound=np.generic)


def found_again(scene: Chips, wide: Chips, radius: int) -> Peaks:
    """Find chips ``(n, s, s)`` within `radius` of the centres of larger ones ``(n, s + 4 radius, ...)``.

    The larger chips leave enough room to match back from any position.
    """
    return peaks(surfaces(orientation(scene), _inner(orientation(wide), radius)))


def seen(wide: Chips, radius: int) -> Array:
    """Return the valid part ``(n,)`` of the area that `found_again` searches."""
    return np.asarray(np.isfinite(_inner(wide, radius)).mean(axis=(1, 2)))


def doubts(peak: Peaks, wide: Chips, around: Chips, radius: int) -> NDArray[np.str_]:
    """Return why matches are rejected ``(n,)``, keys of `matcher.REASONS`; empty if they are not.

    Parameters
    ----------
    wide : (n, s + 4 radius, s + 4 radius)
        The searched chips.
    around : (n, s + 2 radius, s + 2 radius)
        The scene around its chips, to match back.
    """
    reason = np.full(len(wide), "", dtype="<U12")
    for name, passed in (
        ("backward", _way_back(peak.shift, wide, around, radius) <= _BACK),
        ("ambiguous", peak.inside & (peak.ratio <= _UNIQUE)),
        ("weak", peak.score >= _LEAST_SCORE),
        ("hidden", seen(wide, radius) >= _SEEN),
    ):
        reason[~passed] = name
    return reason


def in_batches(work: Callable[[NDArray[np.int_]], None], index: NDArray[np.int_], threads: int) -> None:
    """Call `work` with batches of numbers ``(n,)``."""
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
    """Return the shifts of single bands of references; none if fewer than two bands can be compared.

    Parameters
    ----------
    view : SceneView
        With the corrected model.
    origins : (n, 2)
        First pixels of matched chips.
    scene : (n, s, s)
    start : (n, 2)
        Their positions in the targets (chip px).
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
        single = [replace(image, intensity=Intensity(image.intensity.source, (number,))) for image in references]
        wide = _rendered(renderer.of(single), len(some), side, threads)
        # Least squares needs a near start, and the whole band may be some pixels away.
        coarse = peaks(surfaces(fields, orientation(wide)))
        moved = (coarse.shift - start[some])[coarse.inside]
        band_shift = np.round(np.median(moved, axis=0)) if len(moved) else np.zeros(2)
        shift = measure(scene[some], wide, start[some] + band_shift).shift
        # The model moves opposite to the shift of a band.
        moves = (start[some] - shift)[np.isfinite(shift).all(axis=1)] * factor
        if len(moves) >= FEWEST:
            bands.append(BandShift.of(number, moves))
    return tuple(bands) if len(bands) > 1 else ()


def _compared_bands(references: Sequence[Reference]) -> tuple[int, ...]:
    """Return the numbers of the bands to compare: the chosen ones if there are several, else all with content."""
    if not references:
        return ()
    first = references[0].intensity
    numbers = first.averaged
    if len(first.bands) < 2:
        numbers = (*numbers, *(number for number in first.best(_BANDS) if number not in numbers))
    fewest = min(image.intensity.source.count for image in references)
    return tuple(sorted(number for number in numbers[:_BANDS] if number <= fewest))


def _rendered(renderer: Renderer, count: int, side: int, threads: int) -> Chips:
    wide = np.empty((count, side, side), dtype=np.float32)

    def render(index: NDArray[np.int_]) -> None:
        wide[index] = renderer.render(index)

    in_batches(render, np.arange(count), threads)
    return wide


def _inner(wide: NDArray[_T], radius: int) -> NDArray[_T]:
    return wide[:, radius:-radius, radius:-radius]


def _way_back(shift: Array, wide: Chips, around: Chips, radius: int) -> Array:
    """Return the distance (chip px) between a chip and the result of matching back ``(n,)``."""
    rounded = np.clip(np.round(shift), -radius, radius).astype(int)
    side = wide.shape[1] - 4 * radius
    there = np.stack(
        [
            chip[row : row + side, column : column + side]
            for chip, (column, row) in zip(wide, 2 * radius + rounded, strict=True)
        ]
    )
    back = peaks(surfaces(orientation(there), orientation(around)))
    return np.asarray(np.hypot(*(back.shift + (shift - rounded)).T))
