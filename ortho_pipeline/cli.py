"""The command line: each command parses, calls `pipeline`, prints.

Heavy imports happen inside the commands, so that ``ortho --help`` answers at once.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions

if TYPE_CHECKING:
    from ortho_pipeline.pipeline import FitResult, Result

FAILED, CORRECTABLE, INTERRUPTED = 1, 2, 130


class _Commands(click.Group):
    """Turns errors into messages on stderr and exit codes, with ``--json`` also into a document on stdout."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except OrthoError as error:
            click.echo(f"Error: {error}", err=True)
            if ctx.meta.get("json"):
                _print_json({"schema_version": 1, "error": _error_document(error)})
            ctx.exit(CORRECTABLE if isinstance(error, InputError) else FAILED)
        except KeyboardInterrupt:
            click.echo("Interrupted.", err=True)
            ctx.exit(INTERRUPTED)


def _error_document(error: OrthoError) -> dict[str, str | None]:
    return {
        "kind": type(error).__name__,
        "message": error.message,
        "file": error.file,
        "field": error.field,
        "remedy": error.remedy,
    }


def main() -> None:
    """Run the command line."""
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING, stream=sys.stderr)
    cli(prog_name="ortho")


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="ortho-pipeline", prog_name="ortho")
def cli() -> None:
    """Orthorectify satellite scenes, and say honestly how good the result is.

    Exit codes: 0 done, 1 failed, 2 you can correct it (the message says how), 130 interrupted.
    """


# -- options that several commands share -----------------------------------------------------------------------------


def _json_option(command: Callable[..., Any]) -> Callable[..., Any]:
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


_FILE = click.Path(dir_okay=False)

_scene_options = _grouped(
    "scene",
    SceneOptions,
    click.option("--sensor", "scene_sensor", metavar="NAME", help="Sensor of the image (see 'ortho sensors')."),
    click.option(
        "--rpc", "scene_rpc", metavar="tag|sidecar|FILE", help="Which RPC, where there are several, or an RPC file."
    ),
    click.option("--model", "scene_model", type=_FILE, help="A saved *_model.json in place of the image's model."),
    click.option("--allow-network", "scene_allow_network", is_flag=True, help="Open URLs and /vsi paths too."),
)

_point_options = _grouped(
    "points",
    PointOptions,
    click.option(
        "--gcps",
        "points_gcps",
        metavar="FILE|own",
        help="Points: CSV, GeoJSON, QGIS .points, ODM gcp_list.txt, ENVI .pts; or 'own' for those in the image.",
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
        type=click.Choice(["corner", "center"]),
        default="corner",
        show_default=True,
        help="What (0, 0) is in CSV files: the outer corner of the first pixel or its centre.",
    ),
    click.option("--check", "points_check", metavar="every:N|ids:A,B", help="Points that check and do not control."),
    click.option(
        "--correction",
        "points_correction",
        type=click.Choice(["none", "shift", "shift-drift", "affine"]),
        help="What is adjusted, in image space  [default: shift if there are control points]",
    ),
)

_surface_options = _grouped(
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

_output_options = _grouped(
    "output",
    lambda creation_options, memory_mb, **fields: OutputOptions(
        creation_options=dict(creation_options), memory=memory_mb * 1_000_000, **fields
    ),
    click.option("--output-crs", "-t_srs", "output_crs", metavar="CRS", help="[default: the UTM zone of the scene]"),
    click.option(
        "--resolution",
        "-tr",
        "output_resolution",
        type=float,
        metavar="R",
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
        "--resampling",
        "-r",
        "output_resampling",
        type=click.Choice(["nearest", "bilinear", "cubic"]),
        default="bilinear",
        show_default=True,
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
        help="Our warper, or GDAL's exact one (slow; for comparison).",
    ),
    click.option(
        "--memory",
        "output_memory_mb",
        type=click.IntRange(min=16),
        default=512,
        show_default=True,
        metavar="MB",
        help="Bound on windows and caches.",
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
)

_image = click.argument("image", type=click.Path())
_folder = click.option(
    "--output", "-o", "folder", type=click.Path(file_okay=False), required=True, metavar="DIR", help="Output folder."
)


def _key_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise click.BadParameter(f"{text!r} is not KEY=VALUE")
    return key, value


# -- commands --------------------------------------------------------------------------------------------------------


@cli.command()
@_json_option
def sensors(as_json: bool) -> None:
    """List the sensors that are installed."""
    from ortho_pipeline import pipeline

    document = pipeline.sensors()
    if as_json:
        return _print_json(document)
    for sensor in document["sensors"]:
        click.echo(f"{sensor['name']:<14} {sensor['description']}   [{sensor['distribution']} {sensor['version']}]")
        for option, text in sensor["options"].items():
            click.echo(f"{'':<14}   {option}: {text}")
    for broken in document["broken"]:
        click.echo(f"left out: {broken['plugin']} ({broken['error']})", err=True)
    return None


@cli.command()
@_image
@_scene_options
@_json_option
def info(image: str, scene: SceneOptions, as_json: bool) -> None:
    """Describe an image: sensor, model and where it was read from, position, ground sample distance."""
    from ortho_pipeline import pipeline

    document = pipeline.info(image, scene)
    if as_json:
        return _print_json(document)
    lines = {
        "Image": f"{document['image']}  ({document['size'][0]} x {document['size'][1]})",
        "Sensor": document["sensor"],
        "Models": ", ".join(document["models"]),
        "Read from": document["model_source"],
        "Heights": "{:.0f} to {:.0f} m (ellipsoidal)".format(*document["height_range"]),
        "Pixel": f"{document['gsd_m']:.3g} m at {document['reference_height']:.0f} m",
        "UTM": document["utm"],
        "Corners": "  ".join("outside" if lon is None else f"{lon:.5f},{lat:.5f}" for lon, lat in
                             document["corners_lon_lat"]),
        **{name: str(value) for name, value in document["facts"].items()},
    }  # fmt: skip
    for name, value in lines.items():
        click.echo(f"{name:<10} {value}")
    _print_warnings(document["warnings"])
    return None


@cli.command()
@_image
@_point_options
@_scene_options
@_surface_options
@_json_option
def fit(image: str, points: PointOptions, scene: SceneOptions, surface: SurfaceOptions, as_json: bool) -> None:
    """Adjust the model of IMAGE to control points and show every residual (measured minus predicted, pixels)."""
    from ortho_pipeline import pipeline

    result = pipeline.fit(image, points, scene, surface)
    if as_json:
        return _print_json(result.to_json())
    _print_fit(result)
    return None


@cli.command()
@_image
@_folder
@_point_options
@_scene_options
@_surface_options
@_output_options
@_json_option
def rectify(
    image: str,
    folder: str,
    points: PointOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    output: OutputOptions,
    as_json: bool,
) -> None:
    """Make the orthoimage of IMAGE, its adjusted model, and the accuracy report."""
    from ortho_pipeline import pipeline

    with _progress("Orthorectifying") as progress:
        result = pipeline.rectify(
            image, folder, scene=scene, points=points, surface=surface, output=output, progress=progress
        )
    _print_result(result, as_json)


@cli.command()
@_image
@_folder
@click.option(
    "--as",
    "formats",
    multiple=True,
    type=click.Choice(["rpctxt", "rpb", "vrt", "tif"]),
    help="May be repeated  [default: all four]",
)
@_point_options
@_scene_options
@_surface_options
@_json_option
def export(
    image: str,
    folder: str,
    formats: tuple[str, ...],
    points: PointOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Write the model of IMAGE as RPC files that GDAL and every GIS read, adjusted if --gcps are given."""
    from ortho_pipeline import pipeline

    chosen = formats or pipeline.FORMATS
    result = pipeline.export(image, folder, formats=chosen, scene=scene, points=points, surface=surface)
    _print_result(result, as_json)


@cli.command()
@_json_option
def doctor(as_json: bool) -> None:
    """Show what is installed: GDAL, PROJ, geoid grids, plugins."""
    from ortho_pipeline import pipeline

    document = pipeline.doctor()
    if as_json:
        return _print_json(document)
    gdal, proj = document["gdal"], document["proj"]
    click.echo("Packages   " + ", ".join(f"{name} {version}" for name, version in document["packages"].items()))
    click.echo(f"GDAL       {gdal['version']} (bindings {gdal['bindings']}), reads {', '.join(gdal['drivers'])}")
    click.echo(f"PROJ       {proj['proj']}, looks in {', '.join(proj['search_path'])}")
    for grid in document["grids"]:
        click.echo(f"{grid['datum']:<10} " + (f"{grid['path']}" if grid["found"] else f"missing: {grid.get('remedy')}"))
    for plugin in document["plugins"]:
        click.echo(f"plugin     {plugin['plugin']} ({plugin['distribution']} {plugin['version']})")
    for broken in document["broken"]:
        click.echo(f"broken     {broken['plugin']}: {broken['error']}")
    return None


# -- printing --------------------------------------------------------------------------------------------------------


def _print_json(document: Any) -> None:
    click.echo(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False))


def _print_warnings(warnings: Any) -> None:
    for warning in warnings:
        click.echo(f"Warning: {warning}", err=True)


def _print_result(result: Result, as_json: bool) -> None:
    if as_json:
        return _print_json(result.to_json())
    click.echo(result.summary)
    for name, path in result.files.items():
        click.echo(f"  {name:<10} {path}")
    return None


def _print_fit(result: FitResult) -> None:
    document = result.to_json()
    click.echo(f"Sensor {document['sensor']}, model {document['model']} of {document['model_source']}")
    for name, parameter in document["parameters"].items():
        click.echo(f"  {name:<12} {parameter['value']:+14.6g}  sigma {parameter['sigma']:.2g}")
    wide = max([len(point["id"]) for point in document["points"]] + [5])
    click.echo(f"\n{'point':<{wide}}  role     used    column       row   left out: col.    row")
    for point in document["points"]:
        numbers = [*point["residual"], *point["loo_residual"]]
        shown = "".join(f"{'-' if value is None else f'{value:+.3f}':>10}" for value in numbers)
        click.echo(f"{point['id']:<{wide}}  {point['role']:<8} {'yes' if point['used'] else 'no':<4}{shown}")
    click.echo("\nResiduals are measured minus predicted, in pixels; 'left out': had the point taken no part.")
    if document["raw_bias"] and document["parameters"]:
        bias = document["raw_bias"]
        click.echo(f"Model as delivered: column {bias['col']:+.3f}, row {bias['row']:+.3f} on average")
    for which, label in (("control", "control"), ("check", "check"), ("loo", "leave-one-out")):
        rmse = document["rmse"][which]
        text = "no points" if rmse is None else (
            f"column {rmse['col']:.3f}, row {rmse['row']:.3f}, both {rmse['total']:.3f}  ({rmse['n']} points)"
        )  # fmt: skip
        click.echo(f"RMSE {label:<14} {text}")
    sigma0 = "unknown" if document["sigma0"] is None else f"{document['sigma0']:.3g}"
    click.echo(f"Redundancy {document['redundancy']}, sigma0 {sigma0}")
    _print_warnings(document["warnings"])


@contextlib.contextmanager
def _progress(title: str) -> Iterator[Callable[[float], None] | None]:
    """Yield a callable that moves a progress bar on stderr; None where nobody is watching."""
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda share: bar.update(task, completed=share)
