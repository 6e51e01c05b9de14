"""The displacement of a finished ortho from references: match, correct, and match again with the correction.

The first matching finds the displacement of the whole ortho. If the displacement bends, chips are matched again under
the smooth field of the first matches. So matches that bend with their neighbours are not left out.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ortho_pipeline.commands.control.matching import Matched, match_scene, open_reference_views
from ortho_pipeline.commands.orthos.masks import ClassMask
from ortho_pipeline.commands.orthos.opening import filled_of, open_ortho
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.ground_residuals import metre_partials, shifts_of
from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField
from ortho_pipeline.estimation.spatial.shared_errors import MATCHED_ALIKE
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.matching.chip_search import SIDE
from ortho_pipeline.imaging.matching.least_squares import RIM
from ortho_pipeline.imaging.matching.matcher import REASONS
from ortho_pipeline.imaging.matching.sight import displaced_parts
from ortho_pipeline.models import ImageCorrection, SensorModel, SmoothField
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.orthos.smooth_field import bending_of
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.points.image_errors import sigma_of_covariance
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.flat import FlatSurface

#: Cells per side in which an ortho is looked at.
CELLS = 16
#: Default search radius: metres, pixels, and part of the shorter side.
_METRES, _PIXELS, _PART = 100.0, 30.0, 0.25
#: Matchings after the first, at most, and how far (px, and chip px) they search.
_AGAIN, _NEAR, _NEAR_CHIPS = 2, 6.0, 3.0
#: The field of a matching is followed by another one if it bends by so many px (and chip px), or if so many matches
#: contradicted the others.
_BENDS, _CONTRADICT = 0.3, 0.1
#: Knots of the field along the longer side, at most.
_KNOTS = 14
#: How much the displacement of a field may change per pixel, unless stated.
BENDING = 0.02
#: Part of the noise of a match that all matches share, besides `MATCHED_ALIKE`: objects with a direction, such as
#: shadows, change alike all over an image. No match shows it. The likeliest value in 90 drawn pairs of known truth.
_ALIKE = 0.06
#: Number of bands that are tried alone if all of them together do not match.
_SINGLE = 3


@dataclass(frozen=True, eq=False)
class MeasuredOrtho:
    """The displacement of an ortho at its matches: position in the ortho minus position in the references.

    Parameters
    ----------
    scene : Scene
        Its model is the map grid.
    matched : Matched
        The last matching.
    searched : Matched
        The first one.
    ids : tuple of str
        Names of the matches.
    image : (n, 2)
        Places of matches in the ortho, px.
    ground : (n, 3)
        Their positions in the references.
    displacement : (n, 2)
        Metres to true east and north.
    sigma : (n,)
        Standard deviation (px) of each match alone.
    apart : (n,) of bool
        Which matches are in parts that are displaced from the rest.
    reasons : dict of str to int
        How many tried matches were rejected, by reason.
    metres : (2, 2)
        Metres to east and north of a pixel along columns and rows, in the middle.
    opened : SceneOptions
        What may be opened.
    band : int, optional
        The band that was compared, if only one was.
    """

    scene: Scene
    matched: Matched
    searched: Matched
    ids: tuple[str, ...]
    image: Array
    ground: Array
    displacement: Array
    sigma: Array
    apart: NDArray[np.bool_]
    reasons: Mapping[str, int]
    metres: Array
    opened: SceneOptions
    band: int | None = None

    @functools.cached_property
    def pixel(self) -> float:
        """Size (m) of a pixel in the middle."""
        return pixel_of(self.scene)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.scene.width, self.scene.height

    @property
    def chip(self) -> float:
        """Side (px) of the part of a chip that is compared: matches share noise up to that distance."""
        return float((SIDE - 2 * RIM) * self.matched.matches.factor)

    def alike(self, noise: float | Array) -> Array:
        """Return the standard deviation (px) of an error that all matches share; noise (px) is that of one match."""
        matches = self.matched.matches
        stated = max(float(matches.points.sigma_alike.max(initial=0.0)), MATCHED_ALIKE * matches.factor)
        return np.asarray(np.hypot(stated, _ALIKE * noise))

    @functools.cached_property
    def filled(self) -> Array:
        """Shares ``(CELLS, CELLS)`` of pixels that have a value, in cells along rows and columns."""
        return filled_of(self.scene, self.opened, CELLS)

    @property
    def shown(self) -> Array:
        """Which cells ``(CELLS, CELLS)`` show ground: half of their pixels have a value, or as many as in any cell."""
        return np.asarray(self.filled >= min(0.5, self.filled.max()))

    @functools.cached_property
    def rest(self) -> MeasuredOrtho:
        """The same without parts that are displaced."""
        return self.selected(~self.apart)

    @functools.cached_property
    def field(self) -> DisplacementField:
        """The field of the displacement (m) over the image (px), without parts that are displaced."""
        if self.apart.any():
            return self.rest.field
        return DisplacementField.of(self.image, self.displacement, self.sigma, self.chip)

    @property
    def local(self) -> NDArray[np.bool_]:
        """Which matches ``(n,)`` differ from their neighbours and are in no displaced part."""
        found = np.zeros(len(self.image), dtype=bool)
        found[~self.apart] = self.field.local
        return found

    @property
    def residuals(self) -> Array:
        """Displacement ``(n, 2)`` in px: measured minus the map grid."""
        return np.asarray(self.image - self.scene.model.ground_to_image(self.ground))

    def selected(self, index: NDArray[np.bool_]) -> MeasuredOrtho:
        """Return it with some of its matches ``(n,)``."""
        return replace(
            self,
            ids=tuple(np.array(self.ids)[index].tolist()),
            image=self.image[index],
            ground=self.ground[index],
            displacement=self.displacement[index],
            sigma=self.sigma[index],
            apart=self.apart[index],
        )


def measure_ortho(
    image: str | os.PathLike[str] | Scene,
    match: MatchOptions,
    *,
    scene: SceneOptions = SceneOptions(),
    masks: Sequence[ClassMask] = (),
    band: int | None = None,
    output: OutputOptions = OutputOptions(),
    rounds: int = _AGAIN,
    whole: bool = False,
) -> MeasuredOrtho:
    """Match an ortho with references.

    Parameters
    ----------
    rounds : int
        Most matchings after the first, while many matches contradict it: places that bend or move get better ones.
    whole : bool
        Search rejected chips farther, and add those in parts that are displaced to the matches.

    Raises
    ------
    InputError
        If the image is not an ortho, or matching fails.
    """
    opened = open_ortho(image, scene)
    options = replace(match, search=match.search or default_search(opened))
    bands: list[int | None] = [band]
    if band is None:
        bands += _single_bands(opened, scene)
    first: InputError | None = None
    for one in bands:
        try:
            found = _matched(opened, options, scene, masks, one, output, rounds)
        except InputError as error:
            # Of several bands, one may be more like the reference than their mean.
            first = first or error
            continue
        found = replace(found, band=one)
        return _with_displaced_parts(found, options, masks, output) if whole else found
    assert first is not None
    raise first


def default_search(scene: Scene) -> float:
    """Return the default search radius (m) of an ortho: 100 m or 30 pixels, at most a quarter of its shorter side."""
    pixel = pixel_of(scene)
    return min(max(_METRES, _PIXELS * pixel), _PART * min(scene.width, scene.height) * pixel)


def pixel_of(scene: Scene) -> float:
    """Return the size (m) of a pixel in the middle of an ortho."""
    middle = scene.model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), 0.0)
    plan, _ = metre_partials(scene.model, middle)
    return float(1.0 / np.sqrt(abs(np.linalg.det(plan[0]))))


def _single_bands(scene: Scene, options: SceneOptions) -> list[int | None]:
    averaged = Intensity(RasterSource(scene.path, **options.access)).averaged
    return list(averaged[:_SINGLE]) if len(averaged) > 1 else []


def _matched(
    scene: Scene,
    options: MatchOptions,
    opened: SceneOptions,
    masks: Sequence[ClassMask],
    band: int | None,
    output: OutputOptions,
    rounds: int,
) -> MeasuredOrtho:
    """Match with one band or all, again until the correction follows the displacement."""
    source = RasterSource(scene.path, **opened.access)
    intensity = _intensity(source, () if band is None else (band,), masks, opened)

    def matching(model: SensorModel, again: MatchOptions) -> Matched:
        view = replace(scene, models={model.kind: model})
        return match_scene(
            view, again, FlatSurface(0.0), opened, output.threads, output.memory, intensity=intensity
        )  # fmt: skip

    searched = matched = matching(scene.model, options)
    found = _measured(scene, matched, searched, opened)
    for _ in range(rounds):
        model = following(found)
        if model is None:
            break
        radius = max(_NEAR, _NEAR_CHIPS * matched.matches.factor) * found.pixel
        try:
            matched = matching(model, replace(options, search=radius, search_rotation=None))
        except InputError:
            break
        better = _measured(scene, matched, searched, opened)
        if len(better.image) < len(found.image):
            break
        found = better
    return found


def _with_displaced_parts(
    found: MeasuredOrtho, options: MatchOptions, masks: Sequence[ClassMask], output: OutputOptions
) -> MeasuredOrtho:
    """Return matches also of parts that match elsewhere: the displacement of the rest is not that of the ortho."""
    view, references = open_reference_views(found.scene, options, FlatSurface(0.0), found.opened)
    bands = () if found.band is None else (found.band,)
    intensity = _intensity(RasterSource(found.scene.path, **found.opened.access), bands, masks, found.opened)
    affine = affine_of(found)
    view = replace(view, intensity=intensity, model=affine)
    matches, reach = found.matched.matches, found.searched.search.distance / found.pixel
    threads = output.threads or os.cpu_count() or 1
    index, offset, covariance = displaced_parts(
        view, references, matches.image, matches.reason, matches.factor, reach, threads
    )
    image = matches.image[index]
    ground = affine.image_to_ground(image + offset, 0.0)
    displacement = _displacement(found.scene.model, image, ground)
    sigma = np.maximum(sigma_of_covariance(covariance), np.median(found.sigma))
    reason = np.delete(matches.reason, index)
    return replace(
        found,
        ids=found.ids + tuple(f"m{cell}" for cell in matches.cell[index]),
        image=np.concatenate([found.image, image]),
        ground=np.concatenate([found.ground, ground]),
        displacement=np.concatenate([found.displacement, displacement]),
        sigma=np.concatenate([found.sigma, sigma]),
        apart=np.arange(len(found.image) + len(index)) >= len(found.image),
        reasons={name: int((reason == name).sum()) for name in REASONS if (reason == name).any()},
    )


def _intensity(
    source: RasterSource, bands: Sequence[int], masks: Sequence[ClassMask], opened: SceneOptions
) -> Intensity:
    count = len(source.bands)
    absent = [band for band in bands if not 1 <= band <= count]
    if absent:
        raise InputError(
            f"there is no band {absent[0]}: the ortho has {counted(count, 'band')}",
            file=source.path,
            field="band",
            remedy=f"give one from 1 to {count}",
        )
    if not masks:
        return Intensity(source, bands)
    from ortho_pipeline.commands.orthos.masks import Masked

    return Masked(source, bands, masks, opened)


def _measured(scene: Scene, matched: Matched, searched: Matched, opened: SceneOptions) -> MeasuredOrtho:
    points = matched.matches.points
    middle = scene.model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), 0.0)
    metres = np.linalg.inv(metre_partials(scene.model, middle)[0][0])
    return MeasuredOrtho(
        scene,
        matched,
        searched,
        points.ids,
        points.image,
        points.ground,
        _displacement(scene.model, points.image, points.ground),
        points.sigma_image,
        np.zeros(len(points), dtype=bool),
        matched.record.reasons,
        metres,
        opened,
    )


def _displacement(model: SensorModel, image: Array, ground: Array) -> Array:
    """Return the displacement ``(n, 2)`` in metres of ground that an ortho shows at places ``(n, 2)`` px."""
    return shifts_of(model, ground, image - model.ground_to_image(ground))


def following(measured: MeasuredOrtho) -> SensorModel | None:
    """Return the map grid with the correction that the matches follow; None if it is no better than the last one."""
    affine = affine_of(measured)
    left = measured.image - affine.ground_to_image(measured.ground)
    field = DisplacementField.of(measured.image, left, measured.sigma, measured.chip)
    bends = np.abs(field.mean(measured.image)).max()
    reason = measured.matched.matches.reason
    contradict = float((reason == "contradicts").sum()) / max(1, int((reason != "hidden").sum()))
    if bends < _BENDS * measured.matched.matches.factor and contradict < _CONTRADICT:
        return None
    return smooth_field(affine, field, measured.size, BENDING)


def affine_of(measured: MeasuredOrtho) -> ImageCorrection:
    """Return the map grid with an affine correction, fitted robustly to the matches."""
    model, origin = measured.scene.model, (measured.size[0] / 2, measured.size[1] / 2)
    predicted = model.ground_to_image(measured.ground)
    design = np.column_stack([np.ones(len(predicted)), predicted - origin])
    off, weight = measured.image - predicted, np.ones(len(predicted))
    found = np.zeros((3, 2))
    for _ in range(15):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * design, root * off, rcond=None)[0]
        length = np.hypot(*(off - design @ found).T)
        weight = np.minimum(1.0, max(1.5 * float(np.median(length)), 1e-9) / np.maximum(length, 1e-12))
    return ImageCorrection(model, "affine", origin, np.concatenate([found[:, 0], found[:, 1]]))


def smooth_field(model: SensorModel, field: DisplacementField, size: tuple[int, int], bending: float) -> SmoothField:
    """Return a model under a field that bends by no more than so many px per px, smoothed until it does.

    Parameters
    ----------
    field : DisplacementField
        In px, of what the model leaves.
    """
    columns, rows = (max(3, round(_KNOTS * side / max(size)) + 1) for side in size)
    across, down = (np.linspace(0, side, 3 * count) for side, count in zip(size, (columns, rows), strict=True))
    places = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    low, high = (field.origin + bound * field.scale for bound in (field.place.min(axis=0), field.place.max(axis=0)))
    # Outside the area of the matches the field keeps its value at the edge.
    values = field.mean(np.clip(places, low, high)).reshape(len(down), len(across), 2)
    flat = SmoothField(model, size, np.zeros((rows, columns, 2)))
    for smoothing in range(40):
        blurred = gaussian_filter(values, (smoothing, smoothing, 0), mode="nearest") if smoothing else values
        found = np.einsum(
            "ri,ijk,cj->rck", np.linalg.pinv(flat.splines(1, down)), blurred, np.linalg.pinv(flat.splines(0, across))
        )
        if bending_of(found, flat.spacing) <= bending:
            break
    return SmoothField(model, size, found)
