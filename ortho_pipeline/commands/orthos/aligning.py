"""`ortho align`: move a finished ortho onto references, with one resampling."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.commands.inputs import check_paths
from ortho_pipeline.commands.orthos.masks import ClassMask
from ortho_pipeline.commands.orthos.measuring import BENDING, MeasuredOrtho, affine_of, measure_ortho, smooth_field
from ortho_pipeline.commands.orthos.resampling import write_resampled
from ortho_pipeline.commands.orthos.statistics import Verified, tested_cells
from ortho_pipeline.commands.orthos.verifying import displacements, document_of, provenance_of
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import Result, to_store
from ortho_pipeline.commands.scene_fit import by_matches
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField
from ortho_pipeline.estimation.statistics import chance_of_mean
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.exchange.moved_grid import moved_geotransform, write_moved
from ortho_pipeline.files import retire, staged, states, together, write_json
from ortho_pipeline.files.folders import listed_paths
from ortho_pipeline.files.locations import Location
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.imaging.matching.matcher import held_out
from ortho_pipeline.models import ImageCorrection, MapGrid, SensorModel, SmoothField
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.raster.source import Grid, open_dataset
from ortho_pipeline.report.orthos.page import write_page
from ortho_pipeline.report.orthos.summary import summary_text
from ortho_pipeline.runtime.process_limits import Progress, one_blas_thread

#: A field is justified if it predicts held-out matches better: by this part of the variance, at this chance, and if it
#: bends by so many pixels (RMS).
_BETTER, _CHANCE, _BENDS = 0.2, 1e-3, 0.05
#: Matches count as of a local change if they are so many sigmas, and so many px, from what most say.
_SIGMAS, _LEAST, _MOST = 4.0, 0.5, 0.25


class Chosen(NamedTuple):
    """The correction that the matches justify, and why."""

    kind: str
    model: SensorModel
    shift: Array
    reason: str


@to_store(folder="align")
@one_blas_thread()
@cache_restored()
def align(
    ortho: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    match: MatchOptions,
    scene: SceneOptions = SceneOptions(),
    output: OutputOptions | None = None,
    masks: Sequence[str | os.PathLike[str]] = (),
    band: int | None = None,
    shift_only: bool = False,
    bending: float = BENDING,
    resample: bool = True,
    progress: Progress | None = None,
    command: str | None = None,
) -> Result:
    """Move a finished ortho onto references, with one resampling on its own grid.

    Parameters
    ----------
    output : OutputOptions, optional
        By default cubic resampling, as a COG.
    shift_only : bool
        Correct a shift only. Default: the correction that the matches justify.
    bending : float
        Largest change of a field's displacement per pixel.
    resample : bool
        If False, correct a shift only: keep the pixels and move the map grid (a VRT, or a copy with the format GTiff).
    command : str, optional
        The command line, for the report.

    Raises
    ------
    InputError
        If the image is not an ortho, or matching fails.

    Examples
    --------
    >>> displaced = op.rectify("sample_data/scene.tif", out, surface=op.SurfaceOptions(dem="sample_data/dem.tif"))
    >>> match = op.MatchOptions(reference=["sample_data/reference.tif"], points=150)
    >>> done = op.align(displaced.files["ortho"], out / "aligned", match=match)
    >>> done.document["correction"]["kind"]
    'shift'
    """
    _refuse_unusable(Location(ortho), match, bending, resample)
    output = OutputOptions(resampling="cubic") if output is None else output
    hidden = [ClassMask.parse(text) for text in listed_paths(masks, "masks")]
    request = Request(ortho, scene, match=match, output=output)
    ledger = Ledger(begun=states([*(path for _, path in request.files), *(mask.path for mask in hidden)]))
    measured = measure_ortho(ortho, match, scene=scene, masks=hidden, band=band, output=output, whole=True)
    before = Verified.of(measured).relative().to_json(measured.pixel)
    chosen = _choose(measured, shift_only or not resample, bending)
    stem = Path(ortho).stem
    as_vrt = not resample and output.format != "GTiff"
    files = {"ortho": Path(folder) / f"{stem}_aligned{'.vrt' if as_vrt else '.tif'}"}
    for name, ending in (("model", "_aligned_model.json"), ("json", "_align.json"), ("html", "_align.html"),
                         ("displacements", "_displacements.geojson")):  # fmt: skip
        files[name] = Path(folder) / f"{stem}{ending}"
    check_paths(files, request)
    record = provenance_of(request, measured.scene, None, hidden, command)
    # The masks show the ground where the ortho showed it before.
    column, row = chosen.shift.tolist()
    moved = [dataclasses.replace(mask, shift=(column, row)) for mask in hidden]
    # Next to this ortho, one of an earlier run in the other format would be taken for it.
    other = files["ortho"].with_suffix(".tif" if as_vrt else ".vrt")
    is_input = other.resolve() in {Path(path).resolve() for _, path in request.files}
    with together(folder, stem):
        if resample:
            write_resampled(
                measured.scene, chosen.model, _output_grid(measured), files["ortho"], output, scene, progress
            )
        else:
            dataset = open_dataset(ortho, **scene.access)
            write_moved(dataset, moved_geotransform(_grid_of(measured).geotransform, chosen.shift), files["ortho"])
        document = _after(files["ortho"], measured, match, scene, output, moved, band) | {"before": before}
        document["correction"] = _described(chosen)
        document["resampled"] = resample
        document["provenance"] = record
        if files["json"].is_file() and not is_input:
            retire([other])
        write_json(files["json"], document)
        write_json(files["displacements"], displacements(measured))
        size = measured.size
        write_model_file(SavedModel(chosen.model, measured.scene.sensor, str(ortho), size, {}), files["model"])
        access = scene.access | {"roots": (Path(ortho).parent, *scene.roots)}
        write_page(document, files["html"], staged(files["ortho"]), access)
        ledger.require_unchanged()
    return Result(files, document, summary_text(document))


def _refuse_unusable(ortho: Location, match: MatchOptions, bending: float, resample: bool) -> None:
    if not match.reference:
        raise InputError(
            "no reference to align the ortho with",
            field="match.reference",
            remedy=Text("give an orthoimage of the same place with ", Setting("match.reference", "FILE")),
        )
    if not 0 < bending <= 0.2:
        raise InputError(
            f"the bending must be above 0 and at most 0.2 px per pixel, not {bending:g}",
            field="bending",
            remedy="give 0.02",
        )
    if not resample and (ortho.is_far or ortho.in_archive):
        raise InputError(
            "a new map grid without resampling needs an ortho that is a file on this machine",
            file=ortho,
            field="resample",
            remedy="copy the ortho to this machine, or resample it",
        )


# -- which correction ------------------------------------------------------------------------------------------------


def _choose(measured: MeasuredOrtho, shift_only: bool, bending: float) -> Chosen:
    """Return a shift, or the correction that the matches justify."""
    # A field bends too little to follow the edge of a displaced part, and would displace the ground around it.
    measured = measured.rest
    most = _of_most(measured)
    kept = measured.selected(most)
    cells = tested_cells(kept)
    affine = affine_of(kept)
    left = kept.image - affine.ground_to_image(kept.ground)
    field = DisplacementField.of(kept.image, left, kept.sigma, kept.chip)
    kind, reason = ("shift", "as requested") if shift_only else _justified(kept, field, cells)
    # Of the whole displacement, in px, what an area of the ortho has in the mean, whatever the places of matches.
    whole = affine.ground_to_image(_unmoved(kept, cells)) - cells + field.mean(cells)
    shift = np.median(whole, axis=0) if kind != "shift" else _middle(whole)
    origin = (measured.size[0] / 2, measured.size[1] / 2)
    if kind == "shift":
        coefficients = np.array([shift[0], 0.0, 0.0, shift[1], 0.0, 0.0])
        return Chosen("shift", ImageCorrection(kept.scene.model, "shift", origin, coefficients), shift, reason)
    if kind == "affine":
        return Chosen("affine", affine, shift, reason)
    return Chosen("field", smooth_field(affine, field, measured.size, bending), shift, reason)


def _unmoved(measured: MeasuredOrtho, cells: Array) -> Array:
    """Return the ground that the map grid puts at cells."""
    return measured.scene.model.image_to_ground(cells, 0.0)


def _middle(values: Array) -> Array:
    """Return the mean ``(2,)`` of values in which large deviations count little."""
    middle = np.median(values, axis=0)
    for _ in range(20):
        length = np.hypot(*(values - middle).T)
        scale = max(2.0 * float(np.median(length)), 1e-9)
        weight = np.minimum(1.0, scale / np.maximum(length, 1e-12))[:, None]
        middle = (weight * values).sum(axis=0) / weight.sum()
    return np.asarray(middle)


def _of_most(measured: MeasuredOrtho) -> NDArray[np.bool_]:
    """Tell which matches ``(n,)`` move with most others; a landslide or a harvest does not."""
    left = measured.image - affine_of(measured).ground_to_image(measured.ground)
    length = np.hypot(*left.T)
    limit = max(_SIGMAS * 0.85 * float(np.median(length)), _LEAST * measured.matched.matches.factor)
    apart = length > limit
    field = DisplacementField.of(measured.image, left, measured.sigma, measured.chip)
    # Where many are apart, the displacement as a whole bends: then only single matches are of no use.
    return ~field.local if apart.mean() > _MOST else ~(apart | field.local)


def _justified(kept: MeasuredOrtho, field: DisplacementField, cells: Array) -> tuple[str, str]:
    """Return the correction with the fewest parameters that predicts held-out matches as well as any other."""
    groups, _ = held_out(field.origin + field.place * field.scale)
    with_field, without = field.held_out(groups)
    chance = chance_of_mean(without - with_field) if len(without) > 2 else 1.0
    better = 1.0 - float(with_field.sum() / max(without.sum(), 1e-300))
    bends = float(np.sqrt((field.mean(cells) ** 2).sum(axis=1).mean()))
    if chance < _CHANCE and better > _BETTER and bends > _BENDS:
        less = f"its mean square error is {100 * better:.0f} % smaller than that of an affine transformation"
        return "field", f"at matches that took no part, {less}"
    points = kept.matched.matches.points
    inside = np.isin(np.round(points.image, 6).view("c16").ravel(), np.round(kept.image, 6).view("c16").ravel())
    correction, _ = by_matches(kept.scene, points.select(inside))
    if correction == "shift":
        return "shift", "rotation, scale and bending are not significant"
    return "affine", "rotation or scale is significant; bending is not"


# -- pixels ----------------------------------------------------------------------------------------------------------


def _grid_of(measured: MeasuredOrtho) -> MapGrid:
    model = measured.scene.model
    assert isinstance(model, MapGrid)
    return model


def _output_grid(measured: MeasuredOrtho) -> Grid:
    """Return the grid of the ortho; of one that is not north-up, a north-up grid about it with its pixel size."""
    model, size = _grid_of(measured), measured.size
    left, dx, skew, top, other, dy = model.geotransform
    crs = parse_crs(model.map_crs)
    if skew == other == 0 and dx > 0 > dy:
        return Grid(crs, left, top, dx, -dy, *size)
    low, high = model.corners[:, :2].min(axis=0), model.corners[:, :2].max(axis=0)
    return Grid.of_extent(crs, (*low, *high), model.pixel)


def _after(
    path: Path,
    measured: MeasuredOrtho,
    match: MatchOptions,
    scene: SceneOptions,
    output: OutputOptions,
    masks: Sequence[ClassMask],
    band: int | None,
) -> dict[str, Any]:
    """Return the document of the aligned ortho, measured in its own pixels, before it has its name."""
    opened = dataclasses.replace(scene, roots=(Path(measured.scene.path).parent, *scene.roots))
    # What is left is small, but not in parts that are displaced.
    again = dataclasses.replace(match, search_rotation=None)
    made = staged(path)
    try:
        found = measure_ortho(
            made, again, scene=opened, masks=masks, band=band or measured.band, output=output, whole=True
        )
    except OrthoError as error:
        if error.file == str(made):
            error.file = str(measured.scene.path)
        raise
    return document_of(found, match) | {"ortho": str(path)}


def _described(chosen: Chosen) -> dict[str, Any]:
    inner = chosen.model.model if isinstance(chosen.model, SmoothField) else chosen.model
    assert isinstance(inner, ImageCorrection)
    return {
        "kind": chosen.kind,
        "reason": chosen.reason,
        "shift_px": chosen.shift.tolist(),
        "coefficients": inner.coefficients.tolist(),
        "bending_px_per_px": chosen.model.bending if isinstance(chosen.model, SmoothField) else 0.0,
    }
