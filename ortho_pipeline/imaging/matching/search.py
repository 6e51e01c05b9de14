"""The search: how far a model is off, coarse to fine, and whether what was found can be believed.

Coarse chips all over the scene are compared with wide windows of the target. A model is off by much the same
everywhere, so the mean of all correlation surfaces has a peak far above what any single chip shows. Its highest places
are hypotheses: under each the target is rendered anew and compared again, because relief lies where it belongs only
where the model is right. The best of them is believed if

- it is *unique*: its mean correlation is clearly higher than that of any other (`_CLEARLY`), and over the chips so by a
  paired t-test, which stripes, chessboards and rows of equal roofs do not pass;
- its chips *agree* on a smooth correction, at each finer level better than chance would have it (binomial test);
- it is *no accident*: as many of the chips of the last search, which is the matcher's, would agree by chance at any of
  all places searched once in a million times.

Source: Moisan and Stival 2004 (a-contrario consensus).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.imaging.matching.agreement import affine_step, agreed, followed_by, shifted
from ortho_pipeline.imaging.matching.chips import Renderer, scene_chips
from ortho_pipeline.imaging.matching.correlation import orientation, peaks, surfaces
from ortho_pipeline.imaging.matching.targets import SceneView, Target, metres_per_pixel
from ortho_pipeline.imaging.turns import Turn, margin, renderings, votes
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array

#: Left, top, right and bottom, px.
Region = tuple[int, int, int, int]
#: Side of a coarse chip (chip px), and the least that is worth a try.
_SIDE, _LEAST_SIDE = 48, 24
#: Coarse chips per side of the scene, at most; and at least so many in all.
_PER_SIDE, _FEWEST = 6, 5
#: Radii of the coarsest search (chip px).
_COMFORTABLE, _LARGEST_RADIUS = 100, 160
#: Radius (chip px) of the searches after the first.
_NEXT = 4
#: The mean surface is blurred by so much (chip px): corrections are not the same everywhere.
_SMEAR = 1.5
#: So many places are rendered anew, if their mean correlation is this part of the highest one.
_HYPOTHESES, _WORTH = 5, 0.4
#: Places nearer than this (chip px) are the same peak.
_APART = 6
#: Steps in which a place that is turned settles; the last one is shorter than this (chip px).
_SETTLING, _STANDS = 4, 0.3
#: Chance at which the best place passes for better than the second best one, and chips for agreeing by accident.
_UNIQUE, _ACCIDENT = 1e-3, 1e-6
#: Part of the highest mean correlation that the second highest may have. Where a pattern repeats itself it has nearly
#: all of it, and which one is higher is decided by how places fall between pixels.
_CLEARLY = 0.8
#: Chips agree within this (chip px).
_AGREE = 1.5
#: A chip fits one of two places alone if its correlation there is this, and at the other one less than half of it. If
#: so many of all chips do, and so many of them each place, the target is inconsistent: parts of it are displaced.
_FITS, _DIVIDED, _PART, _FEWEST_PART = 0.15, 0.75, 0.1, 4


@dataclass(frozen=True, eq=False)
class Level:
    """Result of one level of the search.

    Parameters
    ----------
    factor : int
        Pixels of the scene in one of its chips.
    radius : int
        Of the search, chip px.
    chips, agreeing : int
        Chips that were compared, and those that agree with the correction.
    shift : (float, float)
        Column and row (px of the scene) by which the model was off in the mean.
    """

    factor: int
    radius: int
    chips: int
    agreeing: int
    shift: tuple[float, float]


def place(
    view: SceneView, targets: Sequence[Target], reach: float, base: int, region: Region, rotation_deg: float = 0.0
) -> tuple[ImageCorrection, list[Level]]:
    """Return the model of a view with the correction under which the targets agree with it, to a few chip px.

    Parameters
    ----------
    reach : float
        How far (px of the scene) the model may be off.
    base : int
        Pixels of the scene in a chip pixel at the finest level.
    region : (left, top, right, bottom)
        The part of the scene (px) that the targets show.
    rotation_deg : float
        How far the model may be turned. Where no shift alone is found, rotations and scales are searched too.

    Raises
    ------
    InputError
        If no place within reach stands out, with the reason.
    """
    middle = (region[0] + region[2]) / 2, (region[1] + region[3]) / 2
    start = ImageCorrection.identity(view.model, "affine", middle)
    factor, radius = _coarsest(region, reach, base)
    side = _chip_side(region, factor, 3)
    shifts = _hypotheses(_correlated(view, targets, region, side, factor, radius), targets)
    alone = [shifted(start, -shift * factor) for shift in shifts]
    try:
        return _refined(view, targets, reach, base, region, (factor, radius), alone)
    except InputError as error:
        if rotation_deg:
            turned = _turned(view, targets, region, start, (factor, radius), rotation_deg)
            corrections = _distinct((_settled(view, targets, region, one, factor) for one in turned), region, factor)
            # What stands out has to do so among shifts alone too: of a pattern that repeats itself no turn is unique.
            corrections = _distinct([*corrections, *alone], region, factor)
            with contextlib.suppress(InputError):
                return _refined(view, targets, reach, base, region, (factor, radius), corrections)
        raise error from None


def _turned(
    view: SceneView,
    targets: Sequence[Target],
    region: Region,
    start: ImageCorrection,
    level: tuple[int, int],
    rotation_deg: float,
) -> list[ImageCorrection]:
    """Return the corrections of the highest places over shifts, rotations and scales, the highest first."""
    factor, radius = level
    side = _chip_side(region, factor, 3)
    origin = np.array(start.origin)
    wide = radius + margin((_spread(region, side, factor) + side * factor / 2 - origin) / factor)
    found: list[Turn] = []
    for matrix in renderings(rotation_deg):
        model = followed_by(start, affine_step(matrix, np.zeros(2)))
        shown = _correlated(replace(view, model=model), targets, region, side, factor, wide)
        if len(shown.centres) >= _FEWEST:
            found += votes(shown.smooth(), (shown.centres - origin) / factor, radius, matrix, factor)
    found.sort(key=lambda one: -one.value)
    likely = (
        followed_by(start, affine_step(turn.matrix, turn.shift))
        for turn in found
        if turn.value > _WORTH * found[0].value
    )
    return _distinct(likely, region, factor)


def _settled(
    view: SceneView, targets: Sequence[Target], region: Region, correction: ImageCorrection, factor: int
) -> ImageCorrection:
    """Return what a correction leads to where its chips agree on a better one, step by step.

    Rotation and scale are known to their steps alone, and an oblique image that is turned is sheared as well. So
    several places beside each other may lead to one correction.
    """
    # Small chips: there have to be many for slopes to be fitted.
    side = min(_LEAST_SIDE, _chip_side(region, factor, 3))
    for _ in range(_SETTLING):
        shown = _correlated(replace(view, model=correction), targets, region, side, factor, _NEXT)
        if len(shown.centres) < _FEWEST:
            break
        found = peaks(shown.surface, 2)
        before = correction
        correction, _ = agreed(correction, shown.centres, found.shift * factor, found.score, _AGREE * factor)
        if _apart(before, correction, region) < _STANDS * factor:
            break
    return correction


def _distinct(corrections: Iterable[ImageCorrection], region: Region, factor: int) -> list[ImageCorrection]:
    """Return the first corrections that are not the same as one before."""
    found: list[ImageCorrection] = []
    for one in corrections:
        if all(_apart(one, other, region) > _APART * factor for other in found):
            found.append(one)
        if len(found) == _HYPOTHESES:
            break
    return found


def _apart(one: ImageCorrection, other: ImageCorrection, region: Region) -> float:
    """Return the mean distance (px) of what two corrections of one model put over a region."""
    across, down = (np.linspace(-extent / 2, extent / 2, 4) for extent in _extent(region))
    places = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    shift = (one.coefficients - other.coefficients)[[0, 3]]
    return float(np.hypot(*(places @ (one.matrix - other.matrix).T + shift).T).mean())


def _refined(
    view: SceneView,
    targets: Sequence[Target],
    reach: float,
    base: int,
    region: Region,
    level: tuple[int, int],
    corrections: Sequence[ImageCorrection],
) -> tuple[ImageCorrection, list[Level]]:
    """Return the correction that stands out among hypotheses, refined level by level.

    Raises
    ------
    InputError
        If none does, or its chips agree no better than by accident.
    """
    factor, radius = level
    side = _chip_side(region, factor, 3)
    compared = [_correlated(replace(view, model=one), targets, region, side, factor, _NEXT) for one in corrections]
    best = _standing_out(compared, corrections, targets, reach, metres_per_pixel(view))
    correction, shown = corrections[best], compared[best]
    levels: list[Level] = []
    while True:
        found = peaks(shown.surface, 2)
        correction, agreeing = agreed(correction, shown.centres, found.shift * factor, found.score, _AGREE * factor)
        # That it is the right place among all is for the many chips of the last search to say.
        refuse_accident(int(agreeing.sum()), len(agreeing), _AGREE, 1.0, targets, reach)
        mean = correction.coefficients[[0, 3]]
        levels.append(Level(factor, radius, len(agreeing), int(agreeing.sum()), (float(mean[0]), float(mean[1]))))
        if factor <= base:
            return correction, levels
        factor, radius = max(base, factor // 2), _NEXT
        side = _chip_side(region, factor, 1)
        shown = _correlated(replace(view, model=correction), targets, region, side, factor, radius)
        if len(shown.centres) < 3:
            raise _no_overlap(targets, len(shown.centres))


@dataclass(frozen=True, eq=False)
class _Shown:
    """Correlation surfaces ``(n, k, k)`` of chips about `centres` ``(n, 2)``, px of the scene."""

    centres: Array
    surface: NDArray[np.float32]

    def smooth(self) -> NDArray[np.float32]:
        """Return the surfaces blurred by what the shift differs over a scene."""
        return np.asarray(ndimage.gaussian_filter(self.surface, (0, _SMEAR, _SMEAR), mode="nearest"))


def _extent(region: Region) -> tuple[int, int]:
    return region[2] - region[0], region[3] - region[1]


def _chip_side(region: Region, factor: int, beside: int) -> int:
    """Return the side (chip px) of chips of which so many lie beside each other, if they are not too small then."""
    whole = min(_extent(region)) // factor
    return min(max(_LEAST_SIDE, min(_SIDE, whole // beside)), whole)


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
    radius = max(_NEXT, math.ceil(reach / factor) + 2)
    if radius > _LARGEST_RADIUS:
        raise InputError(
            f"a search over {reach:.0f} px is too wide for an image of {larger} x {smaller} px",
            field="match.search",
            remedy="search less far, or measure points by hand",
        )
    return factor, radius


def _spread(region: Region, side: int, factor: int) -> NDArray[np.int_]:
    """Return first pixels ``(n, 2)`` of chips that are spread over a region and do not overlap."""
    places = []
    for first, extent in zip(region, _extent(region), strict=False):
        count = max(1, min(_PER_SIDE, extent // (side * factor)))
        cell = extent / count
        places.append([first + int(cell * (k + 0.5) - side * factor / 2) for k in range(count)])
    columns, rows = np.meshgrid(*places)
    return np.column_stack([columns.ravel(), rows.ravel()])


def _correlated(
    view: SceneView, targets: Sequence[Target], region: Region, side: int, factor: int, radius: int
) -> _Shown:
    """Correlate chips spread over a region with the targets, each with the first that shows enough there."""
    origins = _spread(region, side, factor)
    wide = side + 2 * radius
    scene = scene_chips(view, origins, side, factor)
    shown = Renderer(view, targets, origins - radius * factor, wide, factor).render(np.arange(len(origins)))
    surface = surfaces(orientation(scene), orientation(shown))
    known = (surface != 0).mean(axis=(1, 2)) > 0.2
    centres = origins + side * factor / 2
    return _Shown(centres[known], surface[known])


def _hypotheses(shown: _Shown, targets: Sequence[Target]) -> list[Array]:
    """Return the shifts (chip px) of the highest places of the mean of all surfaces, the highest first."""
    if len(shown.centres) < _FEWEST:
        raise _no_overlap(targets, len(shown.centres))
    mean = shown.smooth().mean(axis=0)
    radius = (mean.shape[0] - 1) // 2
    highest = float(mean.max())
    found: list[Array] = []
    left = mean.copy()
    rows, columns = np.indices(mean.shape)
    while len(found) < _HYPOTHESES:
        row, column = np.unravel_index(int(left.argmax()), left.shape)
        if found and not left[row, column] > _WORTH * highest:
            break
        found.append(np.array([column - radius, row - radius], dtype=float))
        left[np.maximum(np.abs(rows - row), np.abs(columns - column)) <= _APART] = -2.0
    return found


def _standing_out(
    compared: Sequence[_Shown],
    corrections: Sequence[ImageCorrection],
    targets: Sequence[Target],
    reach: float,
    pixel: float,
) -> int:
    """Return the number of the hypothesis that is clearly better than the others.

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
    means = [float(np.mean(list(one.values()))) if one else -1.0 for one in values]
    order = np.argsort(means)[::-1]
    best = int(order[0])
    for other in order[1:].tolist():
        common = [place for place in values[best] if place in values[other]]
        difference = np.array([values[best][place] - values[other][place] for place in common])
        chance = 1.0
        if len(difference) >= _FEWEST:
            chance = float(stats.ttest_1samp(difference, 0.0, alternative="greater").pvalue)
        if chance < _UNIQUE and means[other] < _CLEARLY * means[best]:
            continue
        far = float(np.hypot(*(corrections[best].coefficients - corrections[other].coefficients)[[0, 3]])) * pixel
        divided = _divided(values[best], values[other], far)
        if divided:
            raise InputError(
                f"{targets[0].called} is inconsistent: {divided}",
                file=targets[0].path,
                field=targets[0].field,
                remedy="give another reference, or cut out the part that is right and give that alone",
            )
        raise InputError(
            f"no place within {reach:.0f} px stands out: the best two of {len(compared)} are too much alike "
            f"(correlation {means[best]:.2f} and {means[other]:.2f} in the mean of {counted(len(common), 'chip')})",
            file=targets[0].path,
            field=targets[0].field,
            remedy=Text(
                f"check that {targets[0].called} shows this place, search farther (",
                Setting("match.search"),
                ") if the model may be off by more, and for rotations (",
                Setting("match.search_rotation", "5"),
                ") if it may be turned; state how wrong heights may be (",
                Setting("surface.sigma", "20"),
                ") if the DEM is coarse and the view oblique; measure points by hand where the ground is ",
                "uniform or repeats itself",
            ),
        )
    return best


def _divided(one: Mapping[tuple[float, ...], float], other: Mapping[tuple[float, ...], float], far: float) -> str:
    """Return how chips are divided among two places `far` (m) from each other, by their correlations at both.

    Returns
    -------
    str
        Empty where they are not, as in ground that repeats itself, where chips fit both.
    """
    centres = np.array([centre for centre in one if centre in other]).reshape(-1, 2)
    both = np.array([(one[tuple(c)], other[tuple(c)]) for c in centres.tolist()]).reshape(-1, 2)
    fits = (both.max(axis=1) > _FITS) & (both.min(axis=1) < both.max(axis=1) / 2)
    second = fits & (both[:, 1] > both[:, 0])
    first = fits & ~second
    least = max(_FEWEST_PART, _PART * len(both))
    if fits.sum() < _DIVIDED * len(both) or min(first.sum(), second.sum()) < least:
        return ""
    apart = centres[second].mean(axis=0) - centres[first].mean(axis=0)
    axis = int(np.abs(apart).argmax())
    side = (("left", "right"), ("upper", "lower"))[axis][int(apart[axis] > 0)]
    return (
        f"{counted(int(first.sum()), 'chip')} fit it at one place, and {counted(int(second.sum()), 'chip')}, "
        f"mostly in the {side} part of the scene, {far:.0f} m from there"
    )


def refuse_accident(
    agreeing: int, chips: int, tolerance: float, places: float, targets: Sequence[Target], reach: float
) -> None:
    """Raise an error if as many chips could as well agree by chance.

    Parameters
    ----------
    tolerance : float
        Chips that agree lie so near to each other (chip px), in searches `_NEXT` chip px wide.
    places : float
        So many other corrections could have been found instead.

    Raises
    ------
    InputError
        If that has a chance of more than one in a million.
    """
    share = min(1.0, math.pi * tolerance**2 / (2 * _NEXT + 1) ** 2)
    if float(stats.binom.sf(agreeing - 1, chips, share)) * places > _ACCIDENT:
        raise InputError(
            f"the scene and {targets[0].called} do not agree: {agreeing} of {counted(chips, 'chip')} fit together "
            f"within {reach:.0f} px of where the model puts them, which chance does as well",
            file=targets[0].path,
            field=targets[0].field,
            remedy=Text(
                f"check that {targets[0].called} shows this place, search farther (",
                Setting("match.search"),
                ") if the model may be off by more, for rotations (",
                Setting("match.search_rotation", "5"),
                ") if it may be turned, or measure points by hand",
            ),
        )


def _no_overlap(targets: Sequence[Target], count: int) -> InputError:
    why = f"it shares {counted(count, 'chip')} with the scene, and {_FEWEST} are needed"
    if not count:
        why = "where it covers the scene, it has no values or there are no heights"
    return InputError(
        f"{targets[0].called} shows too little of the scene: {why}",
        file=targets[0].path,
        field=targets[0].field,
        remedy=Text(
            "give images that overlap more, bands that have values (",
            Setting("match.reference_bands"),
            "), and heights that cover the overlap",
        ),
    )
