"""The search for the error of a model, coarse to fine, and tests of the result.

Coarse chips all over the scene are compared with wide windows of the target. The error of a model is nearly constant
over a scene, so the mean of all correlation surfaces has a much clearer peak than a single chip. Its highest positions
are hypotheses. For each the target is rendered again and compared, because relief is in the right place only with the
right model. The best hypothesis is accepted if

- it is *unique*: its mean correlation is clearly higher than that of any other (`_CLEARLY`), also by a paired t-test
  over the chips, and also where each position is at its best part of a pixel (`_REPEATED`); stripes, chessboards and
  rows of equal roofs fail this test;
- its chips *agree* on a smooth correction, at each finer level better than by chance (binomial test);
- it is *no accident*: the probability that as many chips of the last search (the matcher's) agree by chance, at any
  searched position, is less than one in a million.

Source: Moisan and Stival 2004 (a-contrario consensus).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.statistics import chance_of_mean
from ortho_pipeline.imaging.matching.agreement import (
    NEXT,
    affine_step,
    agreed,
    divided_between,
    followed_by,
    refuse_accident,
    shifted,
)
from ortho_pipeline.imaging.matching.chips import Renderer, scene_chips
from ortho_pipeline.imaging.matching.correlation import Peaks, orientation, peaks, surfaces
from ortho_pipeline.imaging.matching.targets import SceneView, Target, metres_per_pixel
from ortho_pipeline.imaging.turns import Turn, margin, renderings, votes
from ortho_pipeline.models import ImageCorrection, MapGrid
from ortho_pipeline.models.base import Array

#: Left, top, right and bottom, px.
Region = tuple[int, int, int, int]
#: Usual and least side of a coarse chip (chip px).
_SIDE, _LEAST_SIDE = 48, 24
#: Least number of coarse chips.
_FEWEST = 5
#: Radii of the coarsest search (chip px).
_COMFORTABLE, _LARGEST_RADIUS = 100, 160
#: Blur (chip px) of the mean surface, because corrections are not the same everywhere.
_SMEAR = 1.5
#: Largest number of hypotheses, and their least part of the highest mean correlation.
_HYPOTHESES, _WORTH = 5, 0.4
#: Positions nearer than this (chip px) are the same peak.
_APART = 6
#: Largest number of steps to refine a rotated hypothesis, and the step (chip px) that ends them.
_SETTLING, _STANDS = 4, 0.3
#: Significance level of the best position over the second best.
_UNIQUE = 1e-3
#: Largest ratio of the second to the first mean correlation. In a repetitive pattern it is nearly 1, and sub-pixel
#: positions decide which one is higher.
_CLEARLY = 0.8
#: The same of correlations at the best parts of a pixel: 0.78 to 0.97 in patterns, and less than this in 94 scenes of
#: other ground.
_REPEATED = 0.6
#: Chips agree within this distance (chip px).
_AGREE = 1.5


@dataclass(frozen=True, eq=False)
class Level:
    """Result of one level of the search.

    Parameters
    ----------
    factor : int
        Pixels of the scene in one of its chips.
    radius : int
        Radius of the search (chip px).
    chips, agreeing : int
        Numbers of compared chips, and of chips that agree with the correction.
    shift : (float, float)
        Mean error of the model: column and row (px of the scene).
    """

    factor: int
    radius: int
    chips: int
    agreeing: int
    shift: tuple[float, float]


def place(
    view: SceneView, targets: Sequence[Target], reach: float, base: int, region: Region, rotation_deg: float = 0.0
) -> tuple[ImageCorrection, list[Level]]:
    """Return the model of a view with the correction for which the targets agree with it, to a few chip px.

    Parameters
    ----------
    reach : float
        Largest error of the model (px of the scene).
    base : int
        Pixels of the scene in a chip pixel at the finest level.
    region : (left, top, right, bottom)
        The part of the scene (px) that the targets show.
    rotation_deg : float
        Largest rotation of the model. If no shift alone fits, rotations and scales are also searched.

    Raises
    ------
    InputError
        If there is no clear best position within reach. The message has the reason.
    """
    middle = (region[0] + region[2]) / 2, (region[1] + region[3]) / 2
    start = ImageCorrection.identity(view.model, "affine", middle)
    factor, radius = _coarsest(region, reach, base)
    alone = _shifts_alone(view, targets, region, start, (factor, radius))
    try:
        return _refined(view, targets, reach, base, region, (factor, radius), alone)
    except InputError as error:
        # Under clouds, or in another season, few coarse chips may decide nothing; fine ones are more.
        finest = base, max(NEXT, math.ceil(reach / base) + 2)
        if factor > base and finest[1] <= _COMFORTABLE:
            with contextlib.suppress(InputError):
                fine = _shifts_alone(view, targets, region, start, finest)
                return _refined(view, targets, reach, base, region, finest, fine)
        if rotation_deg:
            turned = _turned(view, targets, region, start, (factor, radius), rotation_deg)
            refined = (_settled(view, targets, region, correction, factor) for correction in turned)
            corrections = _distinct(refined, region, factor)
            # The best one must also be clear among shifts alone: in a repetitive pattern no rotation is unique.
            corrections = _distinct([*corrections, *alone], region, factor)
            with contextlib.suppress(InputError):
                return _refined(view, targets, reach, base, region, (factor, radius), corrections)
        raise error from None


def _shifts_alone(
    view: SceneView, targets: Sequence[Target], region: Region, start: ImageCorrection, level: tuple[int, int]
) -> list[ImageCorrection]:
    """Return the corrections of the highest peaks over shifts, the highest first."""
    factor, radius = level
    side = _chip_side(region, factor, 3)
    shifts = _hypotheses(_correlated(view, targets, region, side, factor, radius), targets)
    return [shifted(start, -shift * factor) for shift in shifts]


def _turned(
    view: SceneView,
    targets: Sequence[Target],
    region: Region,
    start: ImageCorrection,
    level: tuple[int, int],
    rotation_deg: float,
) -> list[ImageCorrection]:
    """Return the corrections of the highest peaks over shifts, rotations and scales, the highest first."""
    factor, radius = level
    side = _chip_side(region, factor, 3)
    origin = np.array(start.origin)
    wide = radius + margin((_spread(region, side, factor, view.spots) + side * factor / 2 - origin) / factor)
    turns: list[Turn] = []
    for matrix in renderings(rotation_deg):
        model = followed_by(start, affine_step(matrix, np.zeros(2)))
        shown = _correlated(replace(view, model=model), targets, region, side, factor, wide)
        if len(shown.centres) >= _FEWEST:
            turns += votes(shown.smooth(), (shown.centres - origin) / factor, radius, matrix, factor)
    turns.sort(key=lambda turn: -turn.value)
    likely = (
        followed_by(start, affine_step(turn.matrix, turn.shift))
        for turn in turns
        if turn.value > _WORTH * turns[0].value
    )
    return _distinct(likely, region, factor)


def _settled(
    view: SceneView, targets: Sequence[Target], region: Region, correction: ImageCorrection, factor: int
) -> ImageCorrection:
    """Return a correction refined step by step, as its chips agree on a better one.

    Rotation and scale are only known to their steps, and a rotated oblique image is also sheared. So several
    neighbouring positions may lead to one correction.
    """
    # Small chips, because a fit of slopes needs many.
    side = min(_LEAST_SIDE, _chip_side(region, factor, 3))
    for _ in range(_SETTLING):
        shown = _correlated(replace(view, model=correction), targets, region, side, factor, NEXT)
        if len(shown.centres) < _FEWEST:
            break
        peak = peaks(shown.surface, 2)
        before = correction
        correction, _ = agreed(correction, shown.centres, peak.shift * factor, peak.score, _AGREE * factor)
        if _apart(before, correction, region) < _STANDS * factor:
            break
    return correction


def _distinct(corrections: Iterable[ImageCorrection], region: Region, factor: int) -> list[ImageCorrection]:
    """Return the first corrections that differ from all earlier ones."""
    distinct: list[ImageCorrection] = []
    for correction in corrections:
        if all(_apart(correction, other, region) > _APART * factor for other in distinct):
            distinct.append(correction)
        if len(distinct) == _HYPOTHESES:
            break
    return distinct


def _apart(first: ImageCorrection, second: ImageCorrection, region: Region) -> float:
    """Return the mean distance (px) over a region between two corrections of one model."""
    across, down = (np.linspace(-extent / 2, extent / 2, 4) for extent in _extent(region))
    places = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    shift = (first.coefficients - second.coefficients)[[0, 3]]
    return float(np.hypot(*(places @ (first.matrix - second.matrix).T + shift).T).mean())


def _refined(
    view: SceneView,
    targets: Sequence[Target],
    reach: float,
    base: int,
    region: Region,
    level: tuple[int, int],
    corrections: Sequence[ImageCorrection],
) -> tuple[ImageCorrection, list[Level]]:
    """Return the clear best correction among hypotheses, refined level by level.

    Raises
    ------
    InputError
        If none is clearly best, or its chips agree no better than by chance.
    """
    factor, radius = level
    side = _chip_side(region, factor, 3)
    compared = [_correlated(replace(view, model=model), targets, region, side, factor, NEXT) for model in corrections]
    best = _standing_out(compared, corrections, targets, reach, metres_per_pixel(view))
    correction, shown = corrections[best], compared[best]
    _refuse_repeated(view, targets, reach, region, level, shifted(correction, -shown.peak.shift[0] * factor))
    levels: list[Level] = []
    while True:
        peak = peaks(shown.surface, 2)
        correction, agreeing = agreed(correction, shown.centres, peak.shift * factor, peak.score, _AGREE * factor)
        # The many chips of the last search test later whether it is the right position among all.
        refuse_accident(int(agreeing.sum()), len(agreeing), _AGREE, 1.0, targets, reach)
        mean = correction.coefficients[[0, 3]]
        levels.append(Level(factor, radius, len(agreeing), int(agreeing.sum()), (float(mean[0]), float(mean[1]))))
        if factor <= base:
            return correction, levels
        factor, radius = max(base, factor // 2), NEXT
        side = _chip_side(region, factor, 1)
        shown = _correlated(replace(view, model=correction), targets, region, side, factor, radius)
        if len(shown.centres) < 3:
            raise _no_overlap(targets, len(shown.centres))


def _refuse_repeated(
    view: SceneView,
    targets: Sequence[Target],
    reach: float,
    region: Region,
    level: tuple[int, int],
    best: ImageCorrection,
) -> None:
    """Refuse a position, at its best part of a pixel, if another one around it is nearly as good.

    A pattern repeats itself at more positions than there are hypotheses. Between whole pixels they fit less well, and
    blurred surfaces do not show them.

    Raises
    ------
    InputError
        If another position fits nearly as well.
    """
    factor, radius = level
    side = _chip_side(region, factor, 3)

    def near(model: ImageCorrection, within: int) -> _Shown:
        return _correlated(replace(view, model=model), targets, region, side, factor, within)

    around = near(best, radius)
    highest = float(around.mean.max())
    for shift in _highest(around.mean, NEXT - 1):
        if np.hypot(*shift) <= NEXT // 2:
            continue
        # Half as far, so that the peak of the best position stays outside.
        rival = shifted(best, -shift * factor)
        peak = near(rival, NEXT // 2).peak
        if peak.inside[0]:
            peak = near(shifted(rival, -peak.shift[0] * factor), NEXT // 2).peak
            if peak.score[0] > _REPEATED * highest:
                raise _not_clear(len(around.centres), (highest, float(peak.score[0])), best, targets, reach)


@dataclass(frozen=True, eq=False)
class _Shown:
    """Correlation surfaces ``(n, k, k)`` of chips with `centres` ``(n, 2)`` (px of the scene)."""

    centres: Array
    surface: NDArray[np.float32]

    def smooth(self) -> NDArray[np.float32]:
        """Return the surfaces, blurred by the variation of the shift over a scene."""
        return np.asarray(ndimage.gaussian_filter(self.surface, (0, _SMEAR, _SMEAR), mode="nearest"))

    @property
    def mean(self) -> NDArray[np.float32]:
        """The mean surface, ``(k, k)``; zeros without chips."""
        return np.asarray(self.surface.mean(axis=0) if len(self.surface) else np.zeros(self.surface.shape[1:], "f4"))

    @property
    def peak(self) -> Peaks:
        """The peak of the mean surface."""
        return peaks(self.mean[None])


def _extent(region: Region) -> tuple[int, int]:
    return region[2] - region[0], region[3] - region[1]


def _chip_side(region: Region, factor: int, beside: int) -> int:
    """Return the side (chip px) of chips so that `beside` of them fit side by side, if they are not too small."""
    shortest = min(_extent(region)) // factor
    return min(max(_LEAST_SIDE, min(_SIDE, shortest // beside)), shortest)


def _coarsest(region: Region, reach: float, base: int) -> tuple[int, int]:
    """Return factor and radius of the coarsest level: the largest pixels that still give several chips."""
    smaller, larger = sorted(_extent(region))
    factor = base
    while reach / factor > _COMFORTABLE or factor == base:
        next_factor = factor * 2
        across, along = smaller // next_factor, larger // next_factor
        if (across // _LEAST_SIDE) * (along // _LEAST_SIDE) < _FEWEST + 4 or factor >= reach:
            break
        factor = next_factor
    radius = max(NEXT, math.ceil(reach / factor) + 2)
    if radius > _LARGEST_RADIUS:
        raise InputError(
            f"a search within {reach:.0f} px is too wide for an image of {larger} x {smaller} px",
            field="match.search",
            remedy="reduce the search distance, or measure points by hand",
        )
    return factor, radius


def _spread(region: Region, side: int, factor: int, most: int) -> NDArray[np.int_]:
    """Return first pixels ``(n, 2)`` of chips, at most so many per side, spread over a region without overlap."""
    places = []
    for first, extent in zip(region, _extent(region), strict=False):
        count = max(1, min(most, extent // (side * factor)))
        cell = extent / count
        places.append([first + int(cell * (k + 0.5) - side * factor / 2) for k in range(count)])
    columns, rows = np.meshgrid(*places)
    return np.column_stack([columns.ravel(), rows.ravel()])


def _correlated(
    view: SceneView, targets: Sequence[Target], region: Region, side: int, factor: int, radius: int
) -> _Shown:
    """Correlate chips, spread over a region, with the first target that shows enough of each."""
    origins = _spread(region, side, factor, view.spots)
    wide = side + 2 * radius
    scene = scene_chips(view, origins, side, factor)
    shown = Renderer(view, targets, origins - radius * factor, wide, factor).render(np.arange(len(origins)))
    surface = surfaces(orientation(scene), orientation(shown))
    known = (surface != 0).mean(axis=(1, 2)) > 0.2
    centres = origins + side * factor / 2
    return _Shown(centres[known], surface[known])


def _hypotheses(shown: _Shown, targets: Sequence[Target]) -> list[Array]:
    """Return the shifts (chip px) of the highest peaks of the mean surface, the highest first."""
    if len(shown.centres) < _FEWEST:
        raise _no_overlap(targets, len(shown.centres))
    return _highest(shown.smooth().mean(axis=0), _APART)


def _highest(mean: NDArray[np.float32], apart: int) -> list[Array]:
    """Return the shifts (chip px) of the highest peaks of a surface ``(k, k)``, more than `apart` from each other."""
    radius = (mean.shape[0] - 1) // 2
    highest = float(mean.max())
    shifts: list[Array] = []
    left = mean.copy()
    rows, columns = np.indices(mean.shape)
    while len(shifts) < _HYPOTHESES:
        row, column = np.unravel_index(int(left.argmax()), left.shape)
        if shifts and not left[row, column] > _WORTH * highest:
            break
        shifts.append(np.array([column - radius, row - radius], dtype=float))
        left[np.maximum(np.abs(rows - row), np.abs(columns - column)) <= apart] = -2.0
    return shifts


def _remedy(correction: ImageCorrection, target: Target) -> Text:
    """Return what to do if no position stands out; heights have no effect on a finished ortho."""
    raw: tuple[str | Setting, ...] = (
        " Flat ground in mountains causes this: give a DEM, and its accuracy if it is coarse (",
        Setting("surface.sigma", "20"),
        ").",
    )
    return Text(
        f"check that {target.called} shows this place.",
        *(() if isinstance(correction.model, MapGrid) else raw),
        " If the image may be farther off, search farther (",
        Setting("match.search"),
        "); if it may be rotated, add ",
        Setting("match.search_rotation", "5"),
        ". On uniform or repetitive ground, measure points by hand",
    )


def _standing_out(
    compared: Sequence[_Shown],
    corrections: Sequence[ImageCorrection],
    targets: Sequence[Target],
    reach: float,
    pixel: float,
) -> int:
    """Return the index of the hypothesis that is clearly better than the others.

    Raises
    ------
    InputError
        If none is.
    """
    values: list[dict[tuple[float, ...], float]] = []
    for shown in compared:
        if len(shown.centres) < _FEWEST:
            values.append({})
            continue
        smooth = shown.smooth()
        row, column = np.unravel_index(int(smooth.mean(axis=0).argmax()), smooth.shape[1:])
        values.append({tuple(c): float(v) for c, v in zip(shown.centres, smooth[:, row, column], strict=True)})
    means = [float(np.mean(list(scores.values()))) if scores else -1.0 for scores in values]
    order = np.argsort(means)[::-1]
    best = int(order[0])
    for other in order[1:].tolist():
        common = [place for place in values[best] if place in values[other]]
        difference = np.array([values[best][place] - values[other][place] for place in common])
        chance = 1.0
        if len(difference) >= _FEWEST:
            chance = chance_of_mean(difference)
        if chance < _UNIQUE and means[other] < _CLEARLY * means[best]:
            continue
        far = float(np.hypot(*(corrections[best].coefficients - corrections[other].coefficients)[[0, 3]])) * pixel
        divided = divided_between(values[best], values[other], far)
        if divided:
            raise InputError(
                f"{targets[0].called} is inconsistent: {divided}",
                file=targets[0].path,
                field=targets[0].field,
                remedy="give another reference, or only the correct part of this one",
            )
        raise _not_clear(len(common), (means[best], means[other]), corrections[best], targets, reach)
    return best


def _not_clear(
    chips: int, means: tuple[float, float], correction: ImageCorrection, targets: Sequence[Target], reach: float
) -> InputError:
    return InputError(
        f"cannot match the scene with {targets[0].called}: no clear best position within {reach:.0f} px "
        f"(mean correlation of {counted(chips, 'chip')}: best {means[0]:.2f}, second best {means[1]:.2f})",
        file=targets[0].path,
        field=targets[0].field,
        remedy=_remedy(correction, targets[0]),
    )


def _no_overlap(targets: Sequence[Target], count: int) -> InputError:
    why = f"only {counted(count, 'chip')} in common with the scene; {_FEWEST} are needed"
    if not count:
        why = "it has no pixel values there, or heights are missing"
    return InputError(
        f"{targets[0].called} shows too little of the scene: {why}",
        file=targets[0].path,
        field=targets[0].field,
        remedy=Text(
            "give images that overlap more, choose bands that have values with ",
            Setting("match.reference_bands"),
            ", or give a DEM that covers the overlap",
        ),
    )
