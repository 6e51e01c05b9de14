"""The command line: each command parses, calls a function of `commands`, prints.

Heavy imports happen inside the commands, so that ``ortho --help`` answers at once.
"""

from __future__ import annotations

import gc
import importlib
import logging
import shlex
import sys
import traceback
from typing import Any

import click

from ortho_pipeline.cli.batch import mosaic, run
from ortho_pipeline.cli.block import adjust, intersect
from ortho_pipeline.cli.machine.cache import cache
from ortho_pipeline.cli.machine.doctor import doctor
from ortho_pipeline.cli.matching import match, ties
from ortho_pipeline.cli.measuring import measure
from ortho_pipeline.cli.options import (
    click_options,
    dem_datum_options,
    folder_option,
    image_argument,
    json_option,
    match_options,
    network_option,
    output_options,
    point_options,
    scene_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Group
from ortho_pipeline.cli.printing import (
    print_comparison,
    print_fit,
    print_json,
    print_models,
    print_result,
    progress,
)
from ortho_pipeline.cli.signals import ended_by_signals
from ortho_pipeline.cli.studies import reproduce, simulate
from ortho_pipeline.cli.survey.first_use import info, init, print_steps
from ortho_pipeline.errors import InputError, OrthoError, Terminated
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions

FAILED, CORRECTABLE, INTERRUPTED = 1, 2, 130


class _Commands(Group):
    """Turns errors into messages on stderr and exit codes, with ``--json`` also into a document on stdout."""

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **extra: Any) -> click.Context:
        command = shlex.join([info_name or "ortho", *args])
        try:
            ctx = super().make_context(info_name, args, *more, **extra)
        except click.UsageError as error:
            _print_usage_error(command, error)
            raise
        ctx.meta["command"] = command
        return ctx

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except OrthoError as error:
            return self._fail(ctx, error, CORRECTABLE if isinstance(error, InputError) else FAILED)
        except KeyboardInterrupt:
            click.echo("Interrupted.", err=True)
            return ctx.exit(INTERRUPTED)
        except ImportError as error:
            # Every command loads GDAL when it begins its work.
            missing = _without_gdal()
            return self._fail(ctx, missing or _fault(error), CORRECTABLE if missing else FAILED)
        except MemoryError as error:
            short = OrthoError("there is not enough memory", remedy="give less work at once (--memory MB, --threads 1)")
            short.__cause__ = error
            return self._fail(ctx, short, FAILED)
        except click.UsageError as error:
            _print_usage_error(ctx.meta["command"], error)
            raise
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError, Terminated):
            raise
        except (Exception, SystemExit) as error:
            # A library or a plugin that exits by itself would say that all is well.
            return self._fail(ctx, _fault(error), FAILED)

    def _fail(self, ctx: click.Context, error: OrthoError, code: int) -> None:
        """Print an error, with ``--debug`` after its traceback, and end with an exit code."""
        if ctx.meta.get("debug"):
            click.echo("".join(traceback.format_exception(error)), err=True)
        click.echo(f"Error: {error}", err=True)
        if ctx.meta.get("json"):
            print_json({"schema_version": 1, "error": _error_document(error)})
        ctx.exit(code)


def _print_usage_error(command: str, error: click.UsageError) -> None:
    """Print the document of an error in the command line itself, of which only the words are known."""
    if "--json" in shlex.split(command):
        parameter = getattr(error, "param", None)
        field = parameter.opts[0] if parameter is not None else getattr(error, "option_name", None)
        remedy = f"see '{error.ctx.command_path} --help'" if error.ctx is not None else "see 'ortho --help'"
        told = {"kind": "UsageError", "message": error.format_message(), "file": None, "field": field, "remedy": remedy}
        print_json({"schema_version": 1, "error": told})


def _fault(error: BaseException) -> OrthoError:
    """Return an error that nobody foresaw as one that people can report."""
    fault = OrthoError(
        f"{type(error).__name__}: {error}" if str(error) else type(error).__name__,
        remedy="this is a fault of ortho-pipeline: run it again with --debug and report the traceback",
    )
    fault.__cause__ = error
    return fault


def _without_gdal() -> InputError | None:
    """Return what to do if GDAL cannot be loaded; None if it can."""
    try:
        importlib.import_module("osgeo.gdal_array")
    except ImportError as problem:
        missing = InputError(
            f"GDAL's Python bindings cannot be loaded ({problem})",
            remedy='pip install "ortho-pipeline[wheel]", or build those of your GDAL library (docs/install.md)',
        )
        missing.__cause__ = problem
        return missing
    return None


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
    from ortho_pipeline.files.locations import close_network

    # What a command loads is never garbage: looking through it over and over takes a twelfth of a small scene's time.
    gc.set_threshold(50_000, 20, 50)
    # Before GDAL is loaded, which reads the environment; worker processes inherit it.
    close_network()
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING, stream=sys.stderr)
    with ended_by_signals():
        try:
            cli(prog_name="ortho")
        except KeyboardInterrupt:
            # Before a command has begun; later `_Commands` says so.
            click.echo("Interrupted.", err=True)
            raise SystemExit(INTERRUPTED) from None


@click.group(
    cls=_Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(package_name="ortho-pipeline", prog_name="ortho")
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Orthorectify satellite scenes, and say honestly how good the result is.

    Exit codes: 0 done, 1 failed, 2 you can correct it (the message says how), 3 partly done (run), 130 interrupted.
    """
    if ctx.invoked_subcommand is None:
        print_steps()


cli.add_command(info)
cli.add_command(init)
cli.add_command(simulate)
cli.add_command(reproduce)
cli.add_command(run)
cli.add_command(adjust)
cli.add_command(intersect)
cli.add_command(match)
cli.add_command(ties)
cli.add_command(measure)
cli.add_command(mosaic)
cli.add_command(doctor)
cli.add_command(cache)

# -- commands --------------------------------------------------------------------------------------------------------


@cli.command()
@json_option
def sensors(as_json: bool) -> None:
    """List the sensors that are installed."""
    from ortho_pipeline import commands

    document = commands.sensors()
    if as_json:
        return print_json(document)
    for sensor in document["sensors"]:
        click.echo(f"{sensor['name']:<14} {sensor['description']}   [{sensor['distribution']} {sensor['version']}]")
        for option, text in sensor["options"].items():
            click.echo(f"{'':<14}   {option}: {text}")
    for broken in document["broken"]:
        click.echo(f"left out: {broken['plugin']} ({broken['error']})", err=True)
    return None


@cli.command()
@json_option
def models(as_json: bool) -> None:
    """List the models that can be fitted to points alone."""
    from ortho_pipeline import commands

    listed = commands.models()
    if as_json:
        return print_json(listed)
    return print_models(listed)


@cli.command()
@image_argument
@point_options
@match_options
@scene_options
@surface_options
@json_option
def fit(
    image: str,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Adjust the model of IMAGE to control points and show every residual (measured minus predicted, pixels)."""
    from ortho_pipeline import commands

    result = commands.fit(image, points, scene, surface, match)
    if as_json:
        return print_json(result.to_json())
    print_fit(result)
    return None


@cli.command()
@image_argument
@click.option("--models", default="all", show_default=True, metavar="all|A,B,C", help="Which models.")
@click.option("--units", type=click.Choice(["px", "m"]), default="px", show_default=True, help="Of the table.")
@click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help="Folder of the report.")
@point_options
@match_options
@scene_options
@surface_options
@json_option
def compare(
    image: str,
    models: str,
    units: str,
    folder: str | None,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Fit many models to the same points of IMAGE and recommend one.

    The image's own model takes part with each of its corrections (rpc, rpc+shift, rpc+shift-drift, rpc+affine). With
    -o the report of the recommended model is written, with the comparison in it.
    """
    from ortho_pipeline import commands

    command = click.get_current_context().meta["command"]
    result = commands.compare(
        image, points, models=models, folder=folder, scene=scene, surface=surface, match=match, command=command
    )  # fmt: skip
    if as_json:
        return print_json(result.to_json())
    return print_comparison(result, units)


@cli.command(
    one="It takes one image; 'ortho run PIPELINE.yaml' makes many, and all outputs go to the folder of '-o DIR'."
)
@image_argument
@folder_option
@click.option(
    "--overwrite",
    "-overwrite",
    is_flag=True,
    help="Remove old models that would attach to the ortho, and what an unreported earlier run left. Outputs of the "
    "same name are replaced without it.",
)
@point_options
@match_options
@scene_options
@surface_options
@output_options
@json_option
def rectify(
    image: str,
    folder: str,
    overwrite: bool,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    output: OutputOptions,
    as_json: bool,
) -> None:
    """Make the orthoimage of IMAGE, its adjusted model, and the accuracy report."""
    from ortho_pipeline import commands

    with progress("Orthorectifying") as advance:
        result = commands.rectify(
            image,
            folder,
            scene=scene,
            points=points,
            surface=surface,
            match=match,
            output=output,
            progress=advance,
            overwrite=overwrite,
            command=click.get_current_context().meta["command"],
        )
    print_result(result, as_json)


@cli.command()
@image_argument
@folder_option
@click.option(
    "--format",
    "formats",
    multiple=True,
    metavar="F[,F...]",
    help="rpc-txt, rpb, tag, vrt, gcp, gcp-tag, geolocation, csm; may be repeated  [default: the four kinds of RPC]",
)
@click.option("--force", is_flag=True, help="Accept an RPC that is more than 0.1 px from the model.")
@point_options
@match_options
@scene_options
@surface_options
@json_option
def export(
    image: str,
    folder: str,
    formats: tuple[str, ...],
    force: bool,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Write the model of IMAGE for GDAL and every GIS, adjusted if --gcps or a --reference are given.

    RPC as text, RPB, VRT and tag of a copy; control points (the measured ones, or else a grid) as VRT and copy; or
    geolocation arrays.
    """
    from ortho_pipeline import commands

    chosen = [name.strip() for text in formats for name in text.split(",")]
    given: dict[str, Any] = {"formats": chosen} if chosen else {}
    result = commands.export(
        image, folder, scene=scene, points=points, surface=surface, match=match, force=force, **given
    )  # fmt: skip
    print_result(result, as_json)


@cli.command()
@click.argument("report_file", metavar="REPORT.json", type=click.Path())
@click.option("--plots", "folder", required=True, type=click.Path(file_okay=False), metavar="DIR", help="Where to.")
@click.option(
    "--kind", type=click.Choice(["svg", "png"]), default="svg", show_default=True, help="PNG needs matplotlib."
)
@json_option
def report(report_file: str, folder: str, kind: str, as_json: bool) -> None:
    """Write the plots of a report, each as a picture of its own."""
    from ortho_pipeline import commands

    print_result(commands.write_plots(report_file, folder, kind), as_json)


@cli.command()
@image_argument
@click.option("--edge", metavar="X1,Y1,X2,Y2", help="Columns and rows of its ends  [default: edges are looked for]")
@click.option("--band", type=click.IntRange(min=1), default=1, show_default=True)
@click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help="For JSON and a plot.")
@network_option
@json_option
def edge(image: str, edge: str | None, band: int, folder: str | None, scene: SceneOptions, as_json: bool) -> None:
    """Measure the effective resolution of IMAGE from straight edges (edge spread, line spread, width in pixels)."""
    from ortho_pipeline import commands

    print_result(commands.edge(image, folder, edge=edge, band=band, allow_network=scene.allow_network), as_json)


@cli.command()
@click.argument("images", nargs=-1, required=True, type=click.Path())
@folder_option
@click.option("--reference", metavar="IMAGE", help="Onto which the others are brought  [default: the first]")
@click.option(
    "--transform",
    type=click.Choice(["similarity", "affine", "projective", "poly2"]),
    default="projective",
    show_default=True,
)
@scene_options
@json_option
def register(
    images: tuple[str, ...], folder: str, reference: str | None, transform: str, scene: SceneOptions, as_json: bool
) -> None:
    """Bring single bands IMAGES onto one of them and write one image of all, which opens as the reference did.

    For bands of one acquisition that were taken by cameras of their own. The metadata file of the reference is carried
    along, or its model written as a model file.
    """
    from ortho_pipeline.commands import bands

    print_result(bands.register(images, folder, reference=reference, transform=transform, scene=scene), as_json)


@cli.command("dem-check")
@click.argument("dem", type=click.Path())
@click.option("--points", required=True, metavar="FILE", help="Check heights: CSV or GeoJSON with x, y, h.")
@click_options("points", PointOptions, "crs", "vertical")
@dem_datum_options
@network_option
@json_option
def dem_check(
    dem: str,
    points: str,
    points_crs: str | None,
    points_vertical: str | None,
    surface: SurfaceOptions,
    scene: SceneOptions,
    as_json: bool,
) -> None:
    """Compare a DEM with check heights: bias, RMSE, NMAD and LE90, also by the slope of the terrain."""
    from ortho_pipeline import commands

    given = {"crs": points_crs, "vertical": points_vertical}
    print_result(commands.dem_check(dem, points, **given, surface=surface, scene=scene), as_json)
