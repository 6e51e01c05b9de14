"""The orthos of a block: all images with their adjusted models, on one grid and one surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.start import Start
from ortho_pipeline.commands.control.points import no_points
from ortho_pipeline.commands.heights.opening import open_surface, require_geoid
from ortho_pipeline.commands.mosaic.assembly import mosaic as mosaic_of
from ortho_pipeline.commands.mosaic.assembly import mosaic_files
from ortho_pipeline.commands.rectification import OrthoJob, make_ortho
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.commands.results import Result, outputs
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import CoverageError, InputError, ReportError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import retire
from ortho_pipeline.geodesy.crs import map_crs
from ortho_pipeline.geodesy.naming import crs_text
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import MosaicOptions, OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored, limit_cache
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface, moved
from ortho_pipeline.surface.footprint import ground_sample_distance, lay, output_crs, two_digits

#: Outputs of `rectify` that orthos of a block do not have.
_NOT_AGAIN = ("model", "rpc", "vrt")
#: Further images outside the heights that an error names.
_NAMED = 20


@dataclass(frozen=True)
class OrthoPlan:
    """The scenes that get orthos, their outputs, surface and options on one grid.

    Of scenes that get none: notices, and outputs of earlier runs.
    """

    scenes: Mapping[str, Scene]
    files: Mapping[str, dict[str, Path]]
    surface: Surface
    options: tuple[SceneOptions, SurfaceOptions, OutputOptions]
    notices: list[Notice]
    obsolete: list[Path]

    @classmethod
    def of(
        cls,
        scenes: Mapping[str, Scene],
        files: Mapping[str, dict[str, Path]],
        fit: BlockFit,
        heights: Surface | None,
        asked: tuple[SceneOptions, SurfaceOptions, OutputOptions],
    ) -> OrthoPlan:
        """Plan the orthos of adjusted scenes, on the heights of their block or else on those of the options.

        With ``fill='mask'`` scenes outside the DEM get no ortho.

        Raises
        ------
        InputError
            As `open_surface` and `on_one_grid`.
        """
        options, surface, output = asked
        ground = corrected(heights or open_surface(surface, options, under=scenes.values()), fit)
        outside = []
        if isinstance(ground, DemSurface) and ground.fill == "mask":
            laid = {name: lay(one.model, ground, one.width, one.height) for name, one in scenes.items()}
            # Heights beyond those of a model are a fault, as of their datum: `on_one_grid` refuses them.
            outside = [name for name, one in laid.items() if not (one.coverage or one.beyond)]
        if len(outside) == len(scenes):
            outside = []  # `on_one_grid` refuses them all
        text = "the DEM does not cover this image, so it has no ortho"
        notices = [Notice("dem-covers-part", text, coverage=0.0).in_image(name) for name in outside]
        shown = {name: scene for name, scene in scenes.items() if name not in outside}
        of_shown = {name: files[name] for name in shown}
        obsolete = [path for name in outside for path in files[name].values()]
        return cls(shown, of_shown, ground, (options, surface, on_one_grid(shown, ground, output)), notices, obsolete)


def ortho_files(folder: Path, labels: Sequence[str], output: OutputOptions) -> dict[str, dict[str, Path]]:
    """Return the outputs of each image by kind, named as those of `rectify`."""
    return {
        label: {kind: path for kind, path in outputs(folder, label, output).items() if kind not in _NOT_AGAIN}
        for label in labels
    }


def adjusted_scenes(
    starts: Mapping[str, Start], fit: BlockFit, models: Mapping[str, SensorModel], files: Mapping[str, Path]
) -> dict[str, Scene]:
    """Return the scenes with their adjusted models, marked as adjusted in the block.

    Parameters
    ----------
    models : mapping
        The adjusted models.
    files : mapping
        The model files, ``<image> model``.
    """
    images = fit.record.images
    return {
        label: replace(
            start.scene,
            models={start.name: models[label]},
            model_source=files[f"{label} model"].name,
            pieces=(),
            adjusted={"gauge": fit.gauge, "sigma0": fit.sigma0, **images[label].to_json()},
        )
        for label, start in starts.items()
    }


def corrected(surface: Surface, fit: BlockFit) -> Surface:
    """Return the heights without the errors that all share; on request, without the shift."""
    heights = fit.heights
    if heights is None or not isinstance(surface, DemSurface):
        return surface
    east, north = heights.shift_m if heights.shift_applied else (0.0, 0.0)
    return moved(surface, (-east, -north, -heights.mean_error_m), np.nanmedian(fit.ground[:, :2], axis=0))


def planned(
    starts: Mapping[str, Start],
    fit: BlockFit,
    models: Mapping[str, SensorModel],
    files: Mapping[str, Path],
    of_orthos: Mapping[str, dict[str, Path]],
    heights: Surface | None,
    asked: tuple[SceneOptions, SurfaceOptions, OutputOptions | None],
) -> OrthoPlan | ReportError | None:
    """Return the plan of the orthos of a block; None where none are asked for.

    Where the DEM does not cover the images: the error. It must not cost the block, which can have taken hours.
    """
    options, surface, output = asked
    if output is None:
        return None
    scenes = adjusted_scenes(starts, fit, models, files)
    try:
        return OrthoPlan.of(scenes, of_orthos, fit, heights, (options, surface, output))
    except CoverageError as error:
        why = Text(
            "the orthos could not be made (", error.message, "); the adjusted models and the report are complete"
        )
        again = "rectify each image with its adjusted model, which needs no new matches"
        return ReportError(why, file=error.file, field=error.field, remedy=Text(error.remedy or "", f". Then {again}"))


def on_one_grid(scenes: Mapping[str, Scene], surface: Surface, output: OutputOptions) -> OutputOptions:
    """Return options with one CRS and resolution for all images: the zone of the first, the smallest pixel.

    Raises
    ------
    CoverageError
        If the heights do not cover an image. The message names all such images.
    """
    steps, crs = [], None if output.crs is None else map_crs(output.crs)
    outside: dict[str, CoverageError] = {}
    for label, scene in scenes.items():
        found = lay(scene.model, surface, scene.width, scene.height)
        try:
            require_geoid(found, scene.model, (scene.width, scene.height))
            found.require_coverage()
        except CoverageError as error:
            outside[label] = error
            continue
        crs = crs or output_crs(scene.model, scene.width, scene.height)
        steps.append(two_digits(ground_sample_distance(scene.model, crs, scene.width, scene.height, found.middle)))
    if outside:
        raise _named(outside)
    if output.like is not None or crs is None:
        return output
    resolution = min(steps) if output.resolution is None else output.resolution
    return replace(output, crs=crs_text(crs), resolution=resolution)


def _named(outside: Mapping[str, CoverageError]) -> CoverageError:
    """Return the error of the first of these images, with the names of the others."""
    (first, error), *others = outside.items()
    names = ", ".join(label for label, _ in others[:_NAMED])
    more = f", and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    also = f". The DEM does not cover these images either: {names}{more}" if others else ""
    return CoverageError(
        Text(f"image {first}: ", error.message, also),
        file=error.file,
        field=error.field,
        remedy=Text(error.remedy or "", f"; or leave {'these images' if others else 'this image'} out"),
    )


def orthos_made(
    plan: OrthoPlan | ReportError | None,
    expected: Mapping[str, Mapping[str, Path]],
    command: str | None,
    progress: Progress | None,
) -> tuple[Mapping[str, Mapping[str, Path]], ReportError | None]:
    """Make the orthos of a plan; return their outputs by image, and the first error.

    Where there are none, the `expected` outputs of an earlier adjustment go.
    """
    if isinstance(plan, OrthoPlan):
        return plan.files, next(iter(make_orthos(plan, command, progress).values()), None)
    retire(path for files in expected.values() for path in files.values())
    return {}, plan


@cache_restored()
def make_orthos(plan: OrthoPlan, command: str | None, progress: Progress | None) -> dict[str, ReportError]:
    """Make the planned orthos, and return the errors of reports by image.

    Raises
    ------
    InputError
        As `rectify`.
    """
    scenes, surface, (options, heights, output) = plan.scenes, plan.surface, plan.options
    access = SceneOptions(allow_network=options.allow_network, roots=options.roots)
    limit_cache(output.memory, 1)
    failed = dict[str, ReportError]()
    retire(plan.obsolete)
    for number, (label, scene) in enumerate(scenes.items()):

        def stage(name: str, share: float, begun: int = number) -> None:
            if progress is not None:
                progress(name, (begun + share) / len(scenes))

        request = Request(scene, access, surface=heights, output=output)
        like = None if output.like is None else grid_of(output.like, **access.access)
        resolved = Resolved(request, scene, surface, no_points(), like, Ledger.of(request, scene, surface))
        made = make_ortho(resolved, plan.files[label], OrthoJob(stage, command, label))
        if isinstance(made, ReportError):
            failed[label] = made
    return failed


def mosaic_of_orthos(
    folder: Path, mosaic: MosaicOptions | None, orthos: OutputOptions | None
) -> dict[str, dict[str, Path]]:
    """Return the outputs of the mosaic of a block, under ``mosaic``; nothing without one.

    Raises
    ------
    InputError
        If there are no orthos.
    """
    if mosaic is None:
        return {}
    if orthos is None:
        raise InputError("a mosaic needs orthos", field="mosaic", remedy=Text("add ", Setting("orthos")))
    return {"mosaic": mosaic_files(folder / "mosaic.tif")}


def with_mosaic(
    result: Result,
    orthos: Mapping[str, Mapping[str, Path]],
    of_mosaic: Mapping[str, Mapping[str, Path]],
    options: MosaicOptions,
) -> Result:
    """Return the result of a block with a mosaic of its orthos, or with the reason why there is none."""
    try:
        made = mosaic_of([files["ortho"] for files in orthos.values()], of_mosaic["mosaic"]["mosaic"], options)
    except InputError as error:
        why = Text("the mosaic could not be made (", error.message, "); the other outputs are complete")
        return Result(result.files, result.document, result.summary, ReportError(why, remedy=error.remedy))
    text = Text.joined("\n", [result.summary, made.summary])
    files, document = {**result.files, **made.files}, {**result.document, **made.document}
    return Result(files, document, text, result.failure or made.failure)
