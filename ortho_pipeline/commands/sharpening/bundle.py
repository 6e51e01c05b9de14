"""`ortho rectify --sharpen`: both images of a bundle in; their orthos on one grid and the pan-sharpened ortho out.

The panchromatic image is adjusted to the points. Errors of orbit and attitude are common to both images, so its
correction also corrects the model of the multispectral image, in pixels of that image.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.heights.opening import gaps_masked
from ortho_pipeline.commands.rectification import rectify
from ortho_pipeline.commands.results import Result, to_store
from ortho_pipeline.commands.sharpening.sharpen import multispectral, panchromatic, sharpen
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError, OrthoError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.estimation.ground_residuals import metre_partials
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.geodesy.crs import ground_transform, map_crs
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection, SensorModel
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.correction import COEFFICIENTS
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.pansharpened import colour_bands
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.footprint import output_crs

#: Options that open one image and cannot open both.
_OF_ONE = ("rpc", "model", "crop_offset")


@to_store(folder="sharpened")
def rectify_bundle(
    pan: str | os.PathLike[str],
    colours: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    weights: Sequence[float] | None = None,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    output: OutputOptions = OutputOptions(),
    progress: Progress | None = None,
    command: str | None = None,
    overwrite: bool = False,
) -> Result:
    """Make the orthos of a panchromatic and a multispectral image with one adjustment, and sharpen the latter.

    Both orthos have one grid, so each image is resampled once.

    Returns
    -------
    Result
        The files of `rectify` for the panchromatic image, the ortho `multispectral`, and those of `sharpen`.

    Raises
    ------
    InputError
        As `rectify` and `sharpen`, and for an adjustment that the multispectral image cannot take over.
    """
    _refuse_options(pan, colours, scene, points)
    panchromatic(RasterSource(pan, **scene.access))
    multispectral(RasterSource(colours, **scene.access))
    opened = inputs.open_scene(colours, scene)
    _require_detail(inputs.open_scene(pan, scene), opened, scene, output)
    common: dict[str, Any] = {"surface": surface, "progress": progress, "command": command, "overwrite": overwrite}
    sharp = rectify(pan, folder, scene=scene, points=points, match=match, output=output, **common)
    adjusted = read_model_file(sharp.files["model"]).model
    model = taken_over(adjusted, opened)
    ratio = _ratio_in(grid_of(sharp.files["ortho"]), model, opened)
    origin = {"from": Path(pan).name} if isinstance(adjusted, ImageCorrection) else None
    corrected = dataclasses.replace(opened, models={model.kind: model}, adjusted=origin)
    access = SceneOptions(allow_network=scene.allow_network, roots=scene.roots)
    own = OutputOptions(
        like=sharp.files["ortho"], resampling="cubic", nodata=output.nodata, format=output.format,
        creation_options=output.creation_options, memory=output.memory, threads=output.threads,
        tolerance=output.tolerance, dem_interpolation=output.dem_interpolation,
    )  # fmt: skip
    # Only the area of the panchromatic ortho needs heights, and it has them.
    common["surface"] = gaps_masked(surface)
    wide = rectify(corrected, folder, scene=access, output=own, **common)
    done = sharpen(
        sharp.files["ortho"], wide.files["ortho"], folder, weights=weights, ratio=ratio, scene=access, output=output,
        progress=progress,
    )  # fmt: skip
    files = {
        **sharp.files,
        "multispectral": wide.files["ortho"],
        "sharpened": done.files["ortho"],
        "quality": done.files["json"],
    }
    document = {**sharp.document, "sharpening": done.document}
    document |= {name: done.document[name] for name in ("warnings", "notices")}
    return Result(files, document, Text(sharp.summary, "\n\nPan-sharpened:\n", done.summary), sharp.failure)


def find_bundle(
    images: tuple[str | os.PathLike[str], str | os.PathLike[str]], options: SceneOptions
) -> tuple[str | os.PathLike[str], str | os.PathLike[str]] | None:
    """Return the panchromatic image first, then the multispectral one; None if two images are no bundle.

    They are one if the multispectral image is coarser, and its middle is in the panchromatic one.
    """
    try:
        counts = [len(colour_bands(RasterSource(path, **options.access))) for path in images]
        pan, colours = images if counts[0] == 1 else images[::-1]
        if min(counts) != 1 or max(counts) < 2 or Path(pan).stem == Path(colours).stem:
            return None
        sharp, wide = inputs.open_scene(pan, options), inputs.open_scene(colours, options)
        taken_over(sharp.model, wide)
        image = sharp.model.ground_to_image(ground_transform(wide.model.crs, sharp.model.crs)(_middle(wide)))
    except OrthoError:
        return None
    return (pan, colours) if ((image >= 0) & (image <= [sharp.width, sharp.height])).all() else None


def _refuse_options(
    pan: str | os.PathLike[str], colours: str | os.PathLike[str], scene: SceneOptions, points: PointOptions
) -> None:
    if Path(pan).stem == Path(colours).stem:
        raise InputError(
            "both images have the same name, so their orthos would have, too",
            file=colours,
            field="sharpen",
            remedy="make each ortho in its own folder, and sharpen the orthos",
        )
    for name in _OF_ONE:
        # These words choose the RPC of any image.
        common = name == "rpc" and scene.rpc in ("tag", "sidecar")
        if getattr(scene, name) is not None and not common:
            raise InputError(
                Text(Setting(f"scene.{name}"), " opens one image, and these are two"),
                field=f"scene.{name}",
                remedy="leave it out; or make each ortho by itself, and sharpen the orthos",
            )
    if points.correction == "model" or points.fit_model is not None:
        field = "points.fit_model" if points.fit_model is not None else "points.correction"
        raise InputError(
            "the multispectral image can take over a correction in the image only",
            field=field,
            remedy=Text(
                "use ", Setting("points.correction", "affine"), "; or make each ortho by itself, and sharpen the orthos"
            ),
        )


def _require_detail(pan: Scene, colours: Scene, scene: SceneOptions, output: OutputOptions) -> None:
    """Refuse images that are no bundle, and pixels of an ortho that are too large, before the first ortho is made."""
    model, resolution = taken_over(pan.model, colours), output.resolution
    if output.like is not None:
        with completed(os.fspath(output.like), field="output.like"):
            grid = grid_of(output.like, **scene.access)
        _ratio_in(grid, model, colours, "output.like")
    elif resolution is not None:
        crs = map_crs(output.crs) if output.crs else output_crs(pan.model, pan.width, pan.height)
        dx, dy = (resolution, resolution) if isinstance(resolution, int | float) else resolution
        _ratio_in(Grid(crs, 0.0, 0.0, dx, dy, 1, 1), model, colours)


def _ratio_in(grid: Grid, model: SensorModel, scene: Scene, option: str = "output.resolution") -> int:
    """Return how many pixels of an ortho a pixel in the middle of an image is wide.

    Raises
    ------
    InputError
        If the pixels of the ortho are about as large, so that there is no detail to add.
    """
    image = np.array([scene.width / 2, scene.height / 2]) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    ground = ground_transform(model.crs, grid.crs)(model.image_to_ground(image, model.reference_height))
    ratio = np.sqrt(abs(np.linalg.det((ground[1:, :2] - ground[0, :2]) / [grid.dx, grid.dy])))
    if not ratio >= 1.5:
        raise InputError(
            f"the pixels of this image are {significant(float(ratio))} times as wide as those of the ortho, so there "
            "is no detail to add",
            file=scene.path,
            field=option,
            remedy=Text("leave out ", Setting(option), ", or make the ortho of this image alone"),
        )
    return round(float(ratio))


def _middle(scene: Scene) -> Array:
    """Return the ground ``(1, 3)`` in the middle of a scene, at its reference height."""
    return scene.model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), scene.model.reference_height)


def taken_over(adjusted: SensorModel, scene: Scene) -> SensorModel:
    """Return the model of a scene with the correction of the panchromatic model.

    Raises
    ------
    InputError
        If the scene does not show the place of the panchromatic image, or is not coarser.
    """
    delivered = adjusted.model if isinstance(adjusted, ImageCorrection) else adjusted
    middle = _middle(scene)
    there = ground_transform(scene.model.crs, delivered.crs)(middle)
    # Pixels in a square metre of the ground; NaN where a model does not reach.
    with np.errstate(invalid="ignore"):
        fine, coarse = (
            float(abs(np.linalg.det(metre_partials(model, ground)[0][0])))
            for model, ground in ((delivered, there), (scene.model, middle))
        )
    ratio = np.sqrt(fine / coarse)
    if not np.isfinite(ratio):
        raise InputError(
            "this image does not show the place of the panchromatic image",
            file=scene.path,
            field="sharpen",
            remedy="give the multispectral image of the same acquisition",
        )
    if ratio < 1.5:
        raise InputError(
            f"the pixels of this image are {significant(ratio)} times as wide as the panchromatic ones, so it is not "
            "coarser",
            file=scene.path,
            field="sharpen",
            remedy=Text(
                "give the multispectral image with ", Setting("sharpen"), ", and the panchromatic one as IMAGE"
            ),
        )
    if not isinstance(adjusted, ImageCorrection):
        return scene.model
    image = np.array([adjusted.origin])
    ground = ground_transform(delivered.crs, scene.model.crs)(
        delivered.image_to_ground(image, delivered.reference_height)
    )
    ((column, row),) = scene.model.ground_to_image(ground).tolist()
    shifts = np.array([name.endswith("_shift") for name in COEFFICIENTS])
    coefficients = np.where(shifts, adjusted.coefficients / ratio, adjusted.coefficients)
    return ImageCorrection(scene.model, adjusted.correction, (column, row), coefficients)
