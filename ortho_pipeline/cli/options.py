"""The options that several commands share, as decorators; each group arrives as one object of `options`."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import click

from ortho_pipeline.cli.command import Megabytes, OneOrTwo
from ortho_pipeline.options import (
    PIXEL_ORIGINS,
    PIXEL_TYPES,
    BlockOptions,
    OutputOptions,
    PointOptions,
    SceneOptions,
    SurfaceOptions,
)


def json_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--json``, and remember it for errors."""

    def remember(ctx: click.Context, _: click.Parameter, value: bool) -> bool:
        ctx.meta["json"] = value
        return value

    return click.option(
        "--json", "as_json", is_flag=True, callback=remember, is_eager=True, help="Print one JSON document on stdout."
    )(command)


def _grouped(
    name: str, make: Callable[..., Any], *options: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add click options to a command and hand them to it as one object, the keyword argument `name`."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def wrapper(**given: Any) -> Any:
            fields = {key.removeprefix(prefix): given.pop(key) for key in list(given) if key.startswith(prefix)}
            return command(**given, **{name: make(**fields)})

        for option in reversed(options):
            wrapper = option(wrapper)
        return wrapper

    prefix = f"{name}_"
    return decorate


class _Nodata(click.ParamType):
    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Return the number, or 'nan', which JSON has not."""
        try:
            number = float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number (or nan).", param, ctx)
        if math.isinf(number):
            self.fail("infinity is not a value for nodata.", param, ctx)
        return "nan" if math.isnan(number) else number


_FILE = click.Path(dir_okay=False)

_SENSOR_OPTIONS = (
    click.option("--sensor", "scene_sensor", metavar="NAME", help="Sensor of the image (see 'ortho sensors')."),
    click.option(
        "--rpc", "scene_rpc", metavar="tag|sidecar|FILE", help="Which RPC, where there are several, or an RPC file."
    ),
    click.option(
        "--sensor-option",
        "scene_sensor_options",
        multiple=True,
        metavar="K=V",
        callback=lambda ctx, parameter, values: _key_values(values),
        help="Option of the sensor (see 'ortho sensors'); may be repeated.",
    ),
    click.option(
        "--allow-network",
        "scene_allow_network",
        is_flag=True,
        help="Open URLs (http, https, s3, gs, az) and /vsi paths.",
    ),
    click.option(
        "--root",
        "scene_roots",
        multiple=True,
        type=click.Path(exists=True, file_okay=False),
        metavar="DIR",
        help="A folder that files may lead to (a VRT), besides their own; may be repeated.",
    ),
)
scene_options = _grouped(
    "scene",
    SceneOptions,
    *_SENSOR_OPTIONS[:2],
    click.option("--model", "scene_model", type=_FILE, help="A saved *_model.json in place of the image's model."),
    click.option(
        "--crop-offset",
        "scene_crop_offset",
        metavar="COL,ROW",
        callback=lambda ctx, parameter, value: None if value is None else _pair(value),
        help="First pixel of this image in the one that its model belongs to, where it is a crop.",
    ),
    *_SENSOR_OPTIONS[2:],
)
#: The same for the images of a block, where a saved model cannot take the place of all.
sensor_options = _grouped("scene", SceneOptions, *_SENSOR_OPTIONS)

point_options = _grouped(
    "points",
    PointOptions,
    click.option(
        "--gcps",
        "points_gcps",
        metavar="FILE|own",
        help="Points: CSV, GeoJSON, QGIS .points, ODM gcp_list.txt, ENVI .pts, ASP .gcp, ArcGIS link table; or 'own' "
        "for those in the image.",
    ),
    click.option("--points-crs", "points_crs", metavar="CRS", help="CRS of the points, where their file has none."),
    click.option(
        "--points-vertical",
        "points_vertical",
        metavar="DATUM",
        help="Height datum of the points: ellipsoid, egm96, egm2008, EPSG:n or a grid file.",
    ),
    click.option(
        "--pixel-origin",
        "points_pixel_origin",
        type=click.Choice(list(PIXEL_ORIGINS)),
        default="corner",
        show_default=True,
        help="What CSV, ODM and link files call the first pixel: its outer corner or its centre (0, 0), or its corner "
        "or its centre (1, 1).",
    ),
    click.option("--check", "points_check", metavar="every:N|ids:A,B", help="Points that check and do not control."),
    click.option(
        "--select",
        "points_select",
        metavar="even:N|cluster:N|ids:A,B|random:N:SEED",
        help="Points that control: N well spread, N of one region, these, or N by lot; all others check.",
    ),
    click.option(
        "--correction",
        "points_correction",
        type=click.Choice(["none", "shift", "shift-drift", "affine", "model"]),
        help="What is adjusted: the image points, or the parameters of the model itself, such as the exterior "
        "orientation of a frame  [default: shift if there are control points]",
    ),
    click.option(
        "--fit-model",
        "points_fit_model",
        metavar="NAME",
        help="Fit a model from the points alone (see 'ortho models'), in place of the image's own.",
    ),
    click.option(
        "--model-crs",
        "points_model_crs",
        metavar="CRS",
        help="Ground of fitted models: geocentric, geographic, utm or EPSG:n  [default: that of the points]",
    ),
    click.option("--prune", "points_prune", is_flag=True, help="Remove parameters that the points do not justify."),
    click.option("--params", "points_params", metavar="A,B,C", help="Adjust these parameters only  [default: all]"),
    click.option(
        "--significance",
        "points_significance",
        type=click.FloatRange(0, 1, min_open=True, max_open=True),
        default=0.05,
        show_default=True,
        help="Above this chance (p) a parameter is not justified.",
    ),
    click.option(
        "--ridge",
        "points_ridge",
        metavar="auto|none|gcv|lcurve|W",
        default="auto",
        show_default=True,
        help="Regularisation of fitted models: found, or of this weight.",
    ),
    click.option(
        "--near",
        "points_near",
        type=click.FloatRange(min=0, min_open=True),
        metavar="M",
        help="Points closer than this are neighbours in the analysis of residuals.",
    ),
)

block_options = _grouped(
    "points",
    BlockOptions,
    click.option(
        "--points",
        "points_points",
        metavar="FILE",
        required=True,
        help="Rays: CSV (id,image,col,row[,x,y,h,role,...]), GeoJSON with 'ji' by image, or ODM gcp_list.txt.",
    ),
    click.option("--gcps", "points_gcps", metavar="FILE", help="Ground of the points: CSV (id,x,y,h,...) or GeoJSON."),
    click.option("--points-crs", "points_crs", metavar="CRS", help="CRS of the ground, where its file has none."),
    click.option(
        "--points-vertical",
        "points_vertical",
        metavar="DATUM",
        help="Height datum of the ground: ellipsoid, egm96, egm2008, EPSG:n or a grid file.",
    ),
    click.option(
        "--pixel-origin",
        "points_pixel_origin",
        type=click.Choice(list(PIXEL_ORIGINS)),
        default="corner",
        show_default=True,
        help="What CSV, ODM and link files call the first pixel: its outer corner or its centre (0, 0), or its corner "
        "or its centre (1, 1).",
    ),
    click.option("--check", "points_check", metavar="every:N|ids:A,B", help="Points that check and do not control."),
    click.option(
        "--model",
        "points_model",
        metavar="NAME",
        help="One of the images' models, such as rpc or pushbroom, or a model fitted to points (see 'ortho models')  "
        "[default: the images' best]",
    ),
)

surface_options = _grouped(
    "surface",
    SurfaceOptions,
    click.option("--dem", "surface_dem", metavar="FILE", help="Digital elevation model."),
    click.option(
        "--dem-vertical",
        "surface_vertical",
        metavar="DATUM",
        help="Height datum of the DEM: ellipsoid, egm96, egm2008, EPSG:n or a grid file.",
    ),
    click.option(
        "--override-dem-vertical",
        "surface_override_vertical",
        is_flag=True,
        help="Believe --dem-vertical even where the DEM declares another datum.",
    ),
    click.option(
        "--dem-fill",
        "surface_fill",
        metavar="error|mask|nearest|M",
        default="error",
        show_default=True,
        help="Where the DEM has no height: stop, leave pixels out, take the nearest, or an ellipsoidal height.",
    ),
    click.option("--height", "surface_height", type=float, metavar="M", help="One ellipsoidal height, no DEM."),
)

output_options = _grouped(
    "output",
    lambda creation_options, bands, **fields: OutputOptions(
        creation_options=dict(creation_options), bands=bands or None, **fields
    ),
    click.option("--output-crs", "-t_srs", "output_crs", metavar="CRS", help="[default: the UTM zone of the scene]"),
    click.option(
        "--resolution",
        "-tr",
        "output_resolution",
        type=OneOrTwo(),
        metavar="X [Y]",
        help="Pixel size in units of the output CRS  [default: the ground sample distance]",
    ),
    click.option(
        "--extent",
        "-te",
        "output_extent",
        type=float,
        nargs=4,
        metavar="XMIN YMIN XMAX YMAX",
        help="Taken as it is  [default: the scene's footprint]",
    ),
    click.option(
        "--align", "-tap", "output_align", is_flag=True, help="Widen --extent to whole multiples of the resolution."
    ),
    click.option(
        "--resampling",
        "-r",
        "output_resampling",
        type=click.Choice(["nearest", "bilinear", "cubic", "lanczos", "average"]),
        default="bilinear",
        show_default=True,
    ),
    click.option(
        "--band",
        "-b",
        "output_bands",
        type=click.IntRange(min=1),
        multiple=True,
        metavar="N",
        help="Only this band; may be repeated, in the order of the ortho  [default: all]",
    ),
    click.option(
        "--output-type",
        "-ot",
        "output_dtype",
        type=click.Choice(PIXEL_TYPES, case_sensitive=False),
        metavar="|".join(PIXEL_TYPES),
        help="Type of the pixels; values beyond its range are clamped  [default: that of the image]",
    ),
    click.option(
        "--nodata",
        "-dstnodata",
        "output_nodata",
        type=_Nodata(),
        metavar="VALUE",
        help="Of pixels without an image  [default: that of the image, or a mask]",
    ),
    click.option(
        "--dem-interpolation",
        "output_dem_interpolation",
        type=click.Choice(["bilinear", "cubic"]),
        default="bilinear",
        show_default=True,
        help="Between the samples of the DEM.",
    ),
    click.option(
        "--format", "-of", "output_format", type=click.Choice(["COG", "GTiff"]), default="COG", show_default=True
    ),
    click.option(
        "--creation-option",
        "-co",
        "output_creation_options",
        multiple=True,
        metavar="K=V",
        callback=lambda ctx, parameter, values: [_key_value(value) for value in values],
        help="Option of GDAL's driver; may be repeated.",
    ),
    click.option(
        "--engine",
        "output_engine",
        type=click.Choice(["ortho", "gdal"]),
        default="ortho",
        show_default=True,
        help="Our warper, or GDAL's with its own transformers, exactly (slow; for comparison).",
    ),
    click.option(
        "--memory",
        "-wm",
        "output_memory",
        type=Megabytes(),
        default="512",
        show_default=True,
        metavar="MB",
        help="Bound on windows and caches; or with a unit, such as 2GB.",
    ),
    click.option("--threads", "output_threads", type=click.IntRange(min=1), help="[default: all processors]"),
    click.option(
        "--tolerance",
        "output_tolerance",
        type=click.FloatRange(min=0, min_open=True),
        default=0.01,
        show_default=True,
        metavar="PX",
        help="Bound on the warper's geometric error, in source pixels.",
    ),
    click.option("--stac", "output_stac", is_flag=True, help="Write a STAC item of the ortho too."),
    click.option(
        "--acquired", "output_acquired", metavar="TIME", help="Of acquisition (RFC 3339), where the metadata have none."
    ),
)

image_argument = click.argument("image", type=click.Path())
folder_option = click.option(
    "--output", "-o", "folder", type=click.Path(file_okay=False), required=True, metavar="DIR", help="Output folder."
)


def _pair(text: str) -> tuple[float, float]:
    try:
        column, row = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not COL,ROW") from None
    return column, row


def _key_values(texts: tuple[str, ...]) -> dict[str, str]:
    pairs = [_key_value(text) for text in texts]
    found = dict(pairs)
    if len(found) != len(pairs):
        raise click.BadParameter("one key is given twice")
    return found


def _key_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise click.BadParameter(f"{text!r} is not KEY=VALUE")
    return key, value
