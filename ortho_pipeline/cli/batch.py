"""The commands `ortho run`, many scenes by a pipeline file, and `ortho mosaic`, one raster of their orthos."""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.cli.flags import as_typed
from ortho_pipeline.cli.machine.browser import open_option, page_of, show_page
from ortho_pipeline.cli.machine.terminal import printable, say
from ortho_pipeline.cli.options import (
    dry_run_option,
    executor_option,
    json_option,
    mosaic_options,
    network_option,
    scheduler_option,
    shard_option,
    workers_option,
)
from ortho_pipeline.cli.parsing import Command, Megabytes
from ortho_pipeline.cli.printing import (
    FAILED,
    PARTLY_DONE,
    checked_text,
    print_files,
    print_json,
    print_result,
    progress,
)
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.options import MosaicOptions, SceneOptions

if TYPE_CHECKING:
    from ortho_pipeline.batch.plan import Plan
    from ortho_pipeline.batch.results import BatchResult, Outcome

#: More scenes than this are only counted, except for those that failed.
_SHOWN = 60


@click.command(cls=Command)
@click.argument("pipeline_file", metavar="PIPELINE.yaml", type=click.Path(), required=False)
@executor_option("How scenes are distributed.  [default: processes; dask with --scheduler]")
@workers_option("all processors")
@click.option(
    "--threads",
    type=click.IntRange(min=1),
    metavar="N",
    help="Threads per scene.  [default: all processors, divided among the workers]",
)
@click.option(
    "--memory", "-wm", type=Megabytes(), default="512", show_default=True, metavar="MB", help="Memory per scene."
)
@scheduler_option
@click.option("--only", multiple=True, metavar="NAME", help="Make only this scene. May be repeated.")
@shard_option("Make only the K-th of N parts.")
@click.option(
    "--output",
    "-o",
    "address",
    metavar="URL",
    help="Write to this folder in object storage (s3, gs, az) instead of the file's output. Many workers can share it.",
)
@click.option("--allow-network", is_flag=True, help="Allow URLs, object storage and the download of DEM cells.")
@click.option("--summary", "as_summary", is_flag=True, help="Summarise what all parts have made; make nothing.")
@click.option(
    "--root",
    type=click.Path(file_okay=False),
    metavar="DIR",
    help="All paths of the file must be inside this folder; a parent folder allows more.  "
    "[default: folder of the file]",
)
@click.option("--checksums", is_flag=True, help="Compare files by checksum, ignoring timestamps.")
@click.option("--list", "as_list", is_flag=True, help="List the scenes and their state; make nothing.")
@dry_run_option
@click.option("--schema", "as_schema", is_flag=True, help="Print the JSON Schema of the pipeline file; make nothing.")
@open_option
@json_option
def run(
    pipeline_file: str | None,
    memory: int,
    root: str | None,
    as_list: bool,
    as_schema: bool,
    as_summary: bool,
    as_json: bool,
    address: str | None,
    dry_run: bool,
    **options: Any,
) -> None:
    """Make the orthos of all scenes in PIPELINE.yaml.

    A scene is made again only if its files, its settings or the software changed, or outputs are missing. A failed
    scene does not stop the others. An interrupted run continues where it stopped. Exit code 3: some scenes failed.
    """
    if as_schema:
        from ortho_pipeline.batch import config as batch_config

        return print_json(batch_config.schema())
    if pipeline_file is None:
        raise click.UsageError("Missing argument 'PIPELINE.yaml'.")
    from ortho_pipeline.batch import runner as batch
    from ortho_pipeline.batch.results import SCHEMA_VERSION
    from ortho_pipeline.batch.shared.arrays import part_of_array
    from ortho_pipeline.batch.shared.run import SharedFolder
    from ortho_pipeline.batch.summary import summarise
    from ortho_pipeline.stores.delivery import address_of

    if address is not None and address_of(address) is None:
        raise InputError(
            f"{address} is not in object storage",
            field="output",
            remedy=f"for a folder on this machine, write it into {pipeline_file}: `output: {address}`",
        )
    if options["shard"] == "auto":
        options["shard"] = part_of_array()
    planned = batch.plan(pipeline_file, root, allow_network=options["allow_network"])
    if as_list:
        listed = batch.list_scenes(planned)
        if as_json:
            return print_json({"schema_version": SCHEMA_VERSION, "scenes": listed})
        for scene in listed:
            say(f"{scene['name']}\t{scene['state']}\t{scene['image']}")
        return None
    if dry_run:
        return _dry_run(planned, options["only"], options["shard"], as_json)
    store = None if address is None else SharedFolder(address, options["allow_network"], checksums=options["checksums"])
    try:
        with progress(lines=True) as advance:
            result = (
                summarise(planned, store)
                if as_summary
                else batch.run(planned, memory=memory, progress=advance, store=store, **options)
            )
    except KeyboardInterrupt:
        say("Finished scenes are kept. Run the same command again to continue.", err=True)
        raise
    if as_json:
        print_json(result.to_json())
        show_page(page_of(result.files))
    else:
        _print_summary(result)
    if result.failed:
        click.get_current_context().exit(FAILED if result.count("failed") == len(result.scenes) else PARTLY_DONE)
    return None


@click.command(cls=Command)
@click.argument("orthos", metavar="ORTHO...", nargs=-1, required=True, type=click.Path())
@click.option(
    "--output",
    "-o",
    type=click.Path(dir_okay=False),
    required=True,
    metavar="FILE",
    help="The mosaic: .tif (a COG) or .vrt. Its record (.json) and page (.html) get the same name.",
)
@mosaic_options
@network_option
@open_option
@json_option
def mosaic(orthos: tuple[str, ...], output: str, mosaic: MosaicOptions, scene: SceneOptions, as_json: bool) -> None:
    """Combine ORTHOs on one grid into one raster.

    Pixels are copied, not resampled. Where one ortho is empty, another fills it. The command measures how well the
    orthos agree.
    """
    from ortho_pipeline.commands.mosaic.assembly import mosaic as command

    options = dataclasses.replace(mosaic, format="VRT" if output.lower().endswith(".vrt") else "COG")
    print_result(command(orthos, output, options, allow_network=scene.allow_network), as_json)


def _dry_run(planned: Plan, only: Sequence[str], shard: tuple[int, int] | None, as_json: bool) -> None:
    """Print the errors and warnings of each scene; exit as a run with these errors would."""
    from ortho_pipeline.batch.dry_run import check_scenes
    from ortho_pipeline.batch.results import SCHEMA_VERSION

    checked = check_scenes(planned, only, shard)
    failed = [scene for scene in checked if "error" in scene]
    if as_json:
        print_json({"schema_version": SCHEMA_VERSION, "scenes": checked})
    else:
        counts = Counter(text for scene in checked for text in scene.get("warnings", ()))
        for scene in checked:
            if "error" in scene:
                say(f"{scene['name']}: {_error_text(scene['error'])}")
            else:
                own = [text for text in scene["warnings"] if counts[text] == 1]
                say(checked_text(scene["name"], {**scene, "warnings": own}))
        for text, count in counts.items():
            if count > 1:
                say(f"Warning: {as_typed(text)} ({counted(count, 'scene')})")
        say(f"{counted(len(checked), 'scene')}: {len(checked) - len(failed)} ready, {len(failed)} with errors")
    if failed:
        click.get_current_context().exit(FAILED if len(failed) == len(checked) else PARTLY_DONE)


def _print_summary(result: BatchResult) -> None:
    """Print a table of the scenes, and each error with its remedy; of many scenes only those that failed."""
    from rich.console import Console
    from rich.table import Table

    from ortho_pipeline.report.wording import refuted

    # A table is cut to the width of the terminal; a file or a pipe has none.
    wide = None if sys.stdout.isatty() else 10_000
    console = Console(highlight=False, soft_wrap=True, width=wide)
    scenes = result.scenes if len(result.scenes) <= _SHOWN else [one for one in result.scenes if one.status == "failed"]
    table = Table(box=None, pad_edge=False)
    for title in ("scene", "state", "RMSE m", "px", "tested at", "model", "seconds"):
        table.add_column(title, justify="right" if title in ("RMSE m", "px", "seconds") else "left", no_wrap=True)
    for scene in scenes:
        table.add_row(*map(printable, _row(scene)))
    if scenes:
        with console.capture() as drawn:
            console.print(table)
        # rich ends the process where the reader of a pipe has left, which a command takes for a fault.
        click.echo(drawn.get(), nl=False)
    for scene in scenes:
        if scene.error:
            say(f"\nError: {scene.name}: {_error_text(scene.error)}")
        elif against := refuted(scene.facts.get("notices", ())):
            say(f"\nError: {scene.name}: accuracy unknown: {against}")
    counts = ", ".join(
        f"{result.count(status)} {status}"
        for status in ("done", "unchanged", "failed", "missing")
        if status != "missing" or result.count(status)
    )
    say(f"\n{counted(len(result.scenes), 'scene')}: {counts}  ({result.seconds:.1f} s)")
    if result.mosaic:
        say(_mosaic_text(result.mosaic))
    print_files(result.files)


def _row(scene: Outcome) -> list[str]:
    from rich.markup import escape

    from ortho_pipeline.report.page.run import evidence_in, tested_at

    facts = scene.facts
    found = evidence_in(facts) if facts else None
    sizes = [None if found is None else facts[which].get(found) for which in ("rmse_m", "rmse_px")]
    numbers = ["-" if size is None else f"{size:.2f}" for size in sizes]
    tested = tested_at(facts) if facts else "-"
    return [escape(scene.name), scene.status, *numbers, tested, str(facts.get("model", "-")), f"{scene.seconds:.1f}"]


def _mosaic_text(mosaic: Mapping[str, Any]) -> str:
    """Return the summary of a mosaic and its seams."""
    from ortho_pipeline.report.mosaic.document import summary_text

    if mosaic.get("error"):
        return f"mosaic: {_error_text(mosaic['error'])}"
    lines = [summary_text(mosaic)]
    if mosaic["missing"]:
        lines.append(f"not in the mosaic: {', '.join(mosaic['missing'])}")
    return "\n".join(lines)


def _error_text(error: Mapping[str, Any]) -> str:
    where = ": ".join(part for part in (error["file"], error["field"]) if part)
    text = f"{where}: {as_typed(error['message'])}" if where else as_typed(error["message"])
    return f"{text}\n  Remedy: {as_typed(error['remedy'])}" if error["remedy"] else text
