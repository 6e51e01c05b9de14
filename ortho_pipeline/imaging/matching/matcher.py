"""Automatic control points: match a scene with targets, and make points with covariances of the matches."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.imaging.band_shifts import BandShift, spread
from ortho_pipeline.imaging.matching.agreement import agreed, refuse_accident
from ortho_pipeline.imaging.matching.candidates import at_spots, candidates, cells_of, spots_of
from ortho_pipeline.imaging.matching.chip_search import (
    FEWEST,
    MEASURED,
    SIDE,
    SIGMAS,
    doubts,
    found_again,
    in_batches,
    in_each_band,
)
from ortho_pipeline.imaging.matching.chips import Renderer, scene_chips
from ortho_pipeline.imaging.matching.least_squares import measure
from ortho_pipeline.imaging.matching.search import Level, place
from ortho_pipeline.imaging.matching.sight import HEIGHTS, Chips, across, displacement, placed_along_sight
from ortho_pipeline.imaging.matching.targets import (
    SAMPLES,
    SceneView,
    Target,
    chip_factor,
    metres_per_pixel,
    near,
    shown_by,
    spread_over,
)
from ortho_pipeline.imaging.matching.weights import Components, components, unexplained
from ortho_pipeline.imaging.turns import orientations
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.points.image_errors import sigma_of_covariance
from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.surface.rays import meet_surface

#: Radius (chip px) of the search about the corrected model.
_RADIUS = 4
#: Matches within this distance (chip px) of the correction of the majority agree with it.
_NEAR = 2.5
#: Rounds of rendering and measuring, and the change (px) of the correction that ends them.
_ROUNDS, _STANDS = 3, 0.02
#: Matching fails if fewer than this part of the chips agree, and their scatter (chip px) is larger than this.
_MOSTLY, _VAGUE = 0.5, 0.5
#: Rounds of the test of matches against each other.
_JUDGED = 6
#: Least number of the `SAMPLES` x `SAMPLES` points of a scene that targets must show.
_SAMPLES_SHOWN = 4
#: Why a match was rejected, in words.
REASONS = {
    "hidden": "the target shows too little of the chip",
    "weak": "the best position is too weakly correlated",
    "ambiguous": "a second place fits nearly as well",
    "backward": "matching back gives another place",
    "not measured": "least-squares matching is uncertain by more than half a pixel",
    "contradicts": "contradicts the other matches",
}


@dataclass(frozen=True)
class MatchSettings:
    """Options of matching.

    Parameters
    ----------
    search : float
        Largest error (m on the ground) of the model.
    points : int
        Approximate number of matches to try.
    dem_sigma : float
        Standard deviation (m) of the DEM's heights.
    reference_sigma : float
        Standard deviation (m) per axis of the position of the whole reference.
    threads : int
    memory : int
        Bytes for all of the work, including GDAL's cache.
    rotation_deg : float
        Largest rotation of the model.
    """

    search: float
    points: int = 500
    dem_sigma: float = 0.0
    reference_sigma: float = 0.0
    threads: int = 1
    memory: int = 512_000_000
    rotation_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class Matches:
    """All tried matches, in image order, and the points made of them.

    Parameters
    ----------
    image : (n, 2)
        Centre of the scene's chip (px).
    offset : (n, 2)
        Projection of the same ground by the delivered model, minus `image`; NaN if not measured.
    score : (n,)
        Correlation of the chips after matching, -1 to 1.
    reason : (n,) of str
        Why it was rejected, a key of `REASONS`; empty if it was kept.
    cell : (n,)
        Its cell of the scene.
    scene, target : (n, s, s)
        The compared chips.
    found : (n, 2)
        Position of the scene chip's centre in the target's chip, chip px from its centre; NaN if not measured.
    ground : (n, 3)
        Where the target shows it, also of measured chips that contradict the others; NaN if not measured.
    factor : int
        Pixels of the scene in a chip pixel.
    levels : tuple of Level
    components : Components
        The parts of the covariances.
    points : Points
        The kept matches, with covariances and groups.
    coverage : float
        Share of the scene that the targets cover.
    bands : tuple of BandShift
        Shifts of single bands of the references.
    """

    image: Array
    offset: Array
    score: Array
    reason: NDArray[np.str_]
    cell: NDArray[np.int_]
    scene: NDArray[np.float32]
    target: NDArray[np.float32]
    found: Array
    ground: Array
    factor: int
    levels: tuple[Level, ...]
    components: Components
    points: Points
    coverage: float = 1.0
    bands: tuple[BandShift, ...] = ()


def match(view: SceneView, targets: Sequence[Target], settings: MatchSettings) -> Matches:
    """Match a scene with targets.

    Raises
    ------
    InputError
        If there is no overlap, no clear best position, or the agreement can be chance. The message has the reason.
    """
    reach = settings.search / metres_per_pixel(view)
    targets = near(view, targets, reach)
    # By default GDAL's cache takes a share of the machine's memory; neighbouring chips need few blocks.
    images = [view.intensity, *(target.intensity for target in targets)]
    threads = limit_cache(settings.memory, settings.threads, *(image.source.block for image in images))
    shown = _shown(view, targets)
    base = chip_factor(view, targets, shown)
    spots = spots_of(view, images)
    view = view if spots is None else replace(view, spots=spots)
    reach = max(reach, 2.0 * base)
    region = _region(view, shown)
    try:
        (correction, levels), displaced = place(view, targets, reach, base, region, settings.rotation_deg), 0.0
    except InputError as error:
        displaced = displacement(view, shown, settings.dem_sigma, base)
        correction, levels = placed_along_sight(view, targets, (base, reach), region, displaced, threads, error)
    extent = region[2] - region[0], region[3] - region[1]
    # The targets may show only a part of that rectangle.
    share = len(shown) / SAMPLES**2 * view.size[0] * view.size[1] / (extent[0] * extent[1])
    grid = cells_of(*extent, round(settings.points / min(max(share, 0.05), 1.0))) if spots is None else (spots, spots)
    cells_shown = _cells_shown(replace(view, model=correction), targets, region, grid)
    if spots is None:
        origins, cells = candidates(view, region, grid, SIDE, base, cells_shown)
    else:
        origins, cells = at_spots(view, region, SIDE, base, cells_shown)
    tried = _Tried(view, targets, origins, cells, base, threads, displaced)
    tried.search(correction)
    if displaced:
        tried.measure(correction)
    else:
        correction = tried.settled(correction, reach, orientations(settings.rotation_deg))
    tried.judge()
    matches, bands = tried.matches(settings, tuple(levels)), tried.bands(correction)
    points = replace(matches.points, sigma_alike=np.full(len(matches.points), spread(bands)))
    return replace(matches, coverage=len(shown) / SAMPLES**2, bands=bands, points=points)


def _shown(view: SceneView, targets: Sequence[Target]) -> Array:
    """Return the points ``(n, 2)``, of many spread over the scene, that a target shows by the model.

    Raises
    ------
    InputError
        If there are too few.
    """
    image = spread_over(view)
    inside = _inside(view, targets, image)
    if inside.sum() < _SAMPLES_SHOWN:
        what = "does not overlap the image"
        remedy = "give an ortho of the same place, or correct its CRS; `ortho info IMAGE` shows where each image is"
        if inside.any():
            what = f"covers {inside.mean():.1%} of the image, which is too little to match"
            remedy = "give references that cover more of it, or measure points by hand"
        raise InputError(f"{targets[0].called} {what}", file=targets[0].path, field=targets[0].field, remedy=remedy)
    return image[inside]


def _region(view: SceneView, shown: Array) -> tuple[int, int, int, int]:
    """Return the rectangle (left, top, right, bottom) of the scene about points ``(n, 2)`` that a target shows."""
    half = np.array(view.size) / (2 * SAMPLES)
    low = np.maximum(np.floor(shown.min(axis=0) - half), 0).astype(int)
    high = np.minimum(np.ceil(shown.max(axis=0) + half), view.size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _inside(view: SceneView, targets: Sequence[Target], image: Array) -> NDArray[np.bool_]:
    """Return which image points ``(n,)`` are inside a target."""
    ground = meet_surface(view.model, image, view.surface)
    # If the model is off, the surface may end too early; then use the model's reference height.
    lost = np.isnan(ground).any(axis=1)
    ground[lost] = view.model.image_to_ground(image[lost], view.model.reference_height)
    return shown_by(targets, ground, view.model.crs)


def _cells_shown(
    view: SceneView, targets: Sequence[Target], region: tuple[int, int, int, int], grid: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return which cells ``(rows, columns)`` of a region have a centre that a target shows."""
    steps = [
        region[axis] + (np.arange(grid[axis]) + 0.5) / grid[axis] * (region[axis + 2] - region[axis]) for axis in (0, 1)
    ]
    columns, rows = np.meshgrid(*steps)
    return _inside(view, targets, np.column_stack([columns.ravel(), rows.ravel()])).reshape(rows.shape)


class _Tried:
    """The tried chips, and the state of each."""

    def __init__(
        self,
        view: SceneView,
        targets: Sequence[Target],
        origins: NDArray[np.int_],
        cells: NDArray[np.int_],
        factor: int,
        threads: int,
        displaced: float,
    ) -> None:
        self.view, self.targets, self.origins, self.cells, self.factor = view, targets, origins, cells, factor
        # If heights displace chips too much (px), each chip is searched separately.
        self.threads, self.displaced = threads, displaced
        count = len(origins)
        self.centres = np.asarray(origins + SIDE * factor / 2, dtype=np.float64)
        self.scene = scene_chips(view, origins, SIDE, factor)
        self.target = np.full_like(self.scene, np.nan)
        self.reason = np.full(count, "hidden", dtype="<U12")
        self.score = np.zeros(count)
        self.offset = np.full((count, 2), np.nan)  # px, relative to the correction of the last step
        self.whole = np.zeros((count, 2), dtype=int)  # px, integer offset at which targets are rendered
        self.found = np.full((count, 2), np.nan)  # chip px, in the target's chip
        self.covariance = np.full((count, 2, 2), np.nan)
        self.ground = np.full((count, 3), np.nan)

    def bands(self, correction: SensorModel) -> tuple[BandShift, ...]:
        """Return the shifts of single bands at the kept matches, measured with the last correction."""
        good = np.flatnonzero(self.reason == "")
        return in_each_band(
            SceneView(self.view.intensity, correction, self.view.surface),
            self.targets,
            self.origins[good] + self.whole[good],
            self.scene[good],
            (self.offset[good] - self.whole[good]) / self.factor,
            self.factor,
            self.threads,
        )

    def _renderer(self, correction: SensorModel, index: NDArray[np.int_], radius: int) -> Renderer:
        seen = SceneView(self.view.intensity, correction, self.view.surface)
        origins = self.origins[index] + self.whole[index] - radius * self.factor
        return Renderer(seen, self.targets, origins, SIDE + 2 * radius, self.factor)

    def search(self, correction: SensorModel) -> None:
        """Find each chip to a chip px, near its corrected position or along the line of sight."""
        if self.displaced:
            seen, reach = SceneView(self.view.intensity, correction, self.view.surface), 2 * HEIGHTS * self.displaced
            chips = Chips(
                seen, self.targets, self.centres.astype(int), self.factor, reach + 2 * self.factor, self.threads
            )
            chips.search()
            self.offset, self.score, self.reason = chips.offset, chips.score, chips.reason
            self.whole = np.round(np.nan_to_num(self.offset)).astype(int)
            return
        renderer = self._renderer(correction, np.arange(len(self.origins)), 2 * _RADIUS)

        def work(index: NDArray[np.int_]) -> None:
            wide = renderer.render(index)
            around = scene_chips(
                self.view, self.origins[index] - _RADIUS * self.factor, SIDE + 2 * _RADIUS, self.factor
            )
            peak = found_again(self.scene[index], wide, _RADIUS)
            self.score[index], self.offset[index] = peak.score, peak.shift * self.factor
            self.reason[index] = doubts(peak, wide, around, _RADIUS)

        in_batches(work, np.arange(len(self.origins)), self.threads)

    def agreed(self, correction: ImageCorrection, searched: float | None, turns: int) -> ImageCorrection:
        """Return the correction that most offsets agree on; reject the others.

        Raises
        ------
        InputError
            If as many could agree by chance, at any position within `searched` (px) and in any of `turns` orientations.
        """
        good = np.flatnonzero(self.reason == "")
        if len(good) < FEWEST:
            raise self._too_few()
        better, agreeing = agreed(
            correction, self.centres[good], self.offset[good], self.score[good], _NEAR * self.factor
        )
        if searched is not None:
            places = turns * (2 * searched / self.factor + 1) ** 2
            refuse_accident(int(agreeing.sum()), len(good), _NEAR, places, self.targets, searched)
        self.reason[good[~agreeing]] = "contradicts"
        before = correction.ground_to_image(self._some(correction, good))
        self.offset[good] += better.ground_to_image(self._some(correction, good)) - before
        return better

    def _some(self, correction: SensorModel, index: NDArray[np.int_]) -> Array:
        return correction.image_to_ground(self.centres[index], self.view.model.reference_height)

    def measure(self, correction: SensorModel) -> None:
        """Measure the remaining chips to a fraction of a pixel, rendered again at their corrected positions."""

        radius, good = MEASURED, np.flatnonzero(self.reason == "")
        renderer = self._renderer(correction, good, radius)

        def work(batch: NDArray[np.int_]) -> None:
            index, wide = good[batch], renderer.render(batch)
            start = np.nan_to_num((self.offset[index] - self.whole[index]) / self.factor)
            start = np.where(np.abs(start) < radius - 2, start, 0.0)
            measured = measure(self.scene[index], wide, start)
            self.target[index] = wide[:, radius:-radius, radius:-radius]
            self.found[index] = measured.shift
            self.offset[index] = self.whole[index] + measured.shift * self.factor
            self.covariance[index] = measured.covariance * self.factor**2
            self.score[index] = measured.correlation
            bad = ~np.isfinite(measured.shift).all(axis=1)
            self.reason[index[bad]] = "not measured"

        in_batches(work, np.arange(len(good)), self.threads)
        good = np.flatnonzero(self.reason == "")
        self.ground[good] = meet_surface(correction, self.centres[good] + self.offset[good], self.view.surface)
        self.reason[good[np.isnan(self.ground[good]).any(axis=1)]] = "hidden"

    def settled(self, correction: ImageCorrection, searched: float, turns: int) -> ImageCorrection:
        """Return the correction on which measured chips agree, after some rounds; see `agreed`."""
        for turn in range(_ROUNDS):
            correction = self.agreed(correction, None if turn else searched, turns)
            self.measure(correction)
            good = self.reason == ""
            if not good.any() or np.hypot(*np.median(self.offset[good], axis=0)) < _STANDS:
                break
        return correction

    def judge(self) -> None:
        """Estimate the parts of the covariances, and reject matches that contradict the others."""
        origin = np.array(self.view.size) / 2
        for _ in range(_JUDGED):
            good = np.flatnonzero(self.reason == "")
            if len(good) < FEWEST:
                raise self._too_few()
            # Relative to the delivered model: this is what the user's correction has to explain.
            delivered = self.view.model.ground_to_image(self.ground[good])
            off = delivered - self.centres[good]
            design = np.column_stack([np.ones(len(good)), (self.centres[good] - origin) / origin.max()])
            along = self.view.model.ground_partials(self.ground[good])[:, :, 2]
            residuals = off - design @ _robust(design, off)
            left = unexplained(design, self.centres[good], SIDE * self.factor)
            self.components = components(residuals / np.sqrt(left), self.covariance[good], along)
            total = self.components.covariance(self.covariance[good], along)
            distance = squared_distances(residuals, total)
            bad = distance > SIGMAS**2
            if not bad.any():
                break
            self.reason[good[bad]] = "contradicts"
        residuals = residuals[~bad]
        if self.displaced:
            residuals = across(residuals, np.median(along, axis=0))
        self._refuse_vague(residuals)

    def _refuse_vague(self, residuals: Array) -> None:
        """Raise an error if similar ground elsewhere (furrows, rows of trees) explains all matches.

        Wrong heights scatter correct matches, and clouds reduce their number; neither does both.
        """
        seen = int((self.reason != "hidden").sum())
        scatter = float(np.sqrt((residuals**2).mean()))
        if len(residuals) < _MOSTLY * seen and scatter > _VAGUE * self.factor:
            raise InputError(
                f"cannot match the scene with the reference: only {len(residuals)} of {counted(seen, 'chip')} agree, "
                f"and only within {scatter:.1f} px",
                file=self.targets[0].path,
                field=self.targets[0].field,
                remedy=Text(
                    "check that the reference shows this place. Give a better DEM, or search farther with ",
                    Setting("match.search"),
                ),
            )

    def _too_few(self) -> InputError:
        counts = {name: int((self.reason == name).sum()) for name in REASONS}
        why = "; ".join(f"{count}: {REASONS[name]}" for name, count in counts.items() if count)
        return TooFewPoints(
            f"only {int((self.reason == '').sum())} of {counted(len(self.reason), 'place')} matched"
            f"{f' ({why})' if why else ''}",
            file=self.targets[0].path,
            field=self.targets[0].field,
            remedy="give images that are more alike (season, resolution), or measure points by hand",
        )

    def matches(self, settings: MatchSettings, levels: tuple[Level, ...]) -> Matches:
        """Return all tried matches, and the points."""
        good = np.flatnonzero(self.reason == "")
        partials = self.view.model.ground_partials(self.ground[good])
        # Residuals show only height errors that differ from place to place, so a stated sigma is the minimum.
        parts = replace(self.components, height=max(self.components.height, settings.dem_sigma))
        covariance = parts.covariance(self.covariance[good], partials[:, :, 2])
        groups, roles = held_out(self.centres[good])
        delivered = np.full(self.offset.shape, np.nan)
        delivered[good] = self.view.model.ground_to_image(self.ground[good]) - self.centres[good]
        crs = parse_crs(self.view.model.crs)
        names = ", ".join(os.path.basename(target.path) for target in self.targets)
        points = Points(
            ids=tuple(f"m{cell}" for cell in self.cells[good]),
            image=self.centres[good],
            ground=self.ground[good],
            roles=roles,
            sigma_image=sigma_of_covariance(covariance),
            sigma_ground=np.zeros((len(good), 3)),
            crs=crs,
            source=f"matched with {names}",
            covariance_image=covariance,
            groups=groups,
            sigma_common=np.full(len(good), settings.reference_sigma),
        )
        return Matches(
            self.centres,
            delivered,
            self.score,
            self.reason,
            self.cells,
            self.scene,
            self.target,
            self.found,
            self.ground,
            self.factor,
            levels,
            parts,
            points,
        )


def _robust(design: Array, values: Array) -> Array:
    """Return the coefficients ``(k, 2)`` of a robust fit (Huber's weights)."""
    weight = np.ones(len(values))
    coefficients: Array = np.zeros((design.shape[1], 2))
    for _ in range(15):
        root = np.sqrt(weight)[:, None]
        coefficients = np.asarray(np.linalg.lstsq(root * design, root * values, rcond=None)[0], dtype=np.float64)
        length = np.hypot(*(values - design @ coefficients).T)
        scale = max(1.2 * float(np.median(length)), 1e-9)
        weight = np.minimum(1.0, scale / np.maximum(length, 1e-12))
    return coefficients


def held_out(image: Array) -> tuple[NDArray[np.int_], NDArray[np.str_]]:
    """Return the groups ``(n,)`` of points that share errors, and their roles: every fifth cell checks.

    Cells have about ten points each, so that check points are not neighbours of control points. Checking cells are a
    knight's move apart: five in any five by five.
    """
    low, extent = image.min(axis=0), np.maximum(np.ptp(image, axis=0), 1.0)
    columns, rows = cells_of(float(extent[0]), float(extent[1]), int(np.clip(len(image) / 10, 10, 100)))
    place = np.minimum(((image - low) / extent * (columns, rows)).astype(int), (columns - 1, rows - 1))
    roles = np.where((place[:, 0] + 2 * place[:, 1]) % 5 == 2, "check", "control")
    return place[:, 1] * columns + place[:, 0], roles
