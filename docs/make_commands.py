"""Write a page of each command into docs/commands, from what its help says: ``make docs``.

The help says what an option does; `NEEDS` says when a person needs it, and `OTHERWISE` where a command differs. Options
appear under the headings of `NEEDS`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import click

from ortho_pipeline.cli.program import cli

FOLDER = Path(__file__).resolve().parent / "commands"
_EXAMPLES = re.compile(r"\n*\x08?\nExamples:\n(?P<lines>.*)\Z", re.DOTALL)
#: Commands of experiments, and those that only list or remove: their few options need no more than their help.
PLAIN = ("simulate", "reproduce", "cache")
#: By heading: each option, and when a person needs it.
NEEDS: Mapping[str, Mapping[str, str]] = {
    "Start here": {
        "output": "Always: it says where the results go.",
        "gcps": "You have points. Without points the model stays as delivered, and its accuracy is unknown.",
        "points": "You have measured the same points in several images.",
        "dem": "Points without heights take theirs from the DEM, and matching needs it in hilly ground.",
        "dry-run": "You want to check all inputs before anything is written.",
    },
    "Coordinates and heights": {
        "points-crs": "The points file does not state its CRS.",
        "points-vertical": "The points file does not state its height datum.",
        "pixel-origin": "Your program counts pixels from their centres, or from (1, 1).",
        "dem-vertical": "The DEM does not declare its height datum.",
        "override-dem-vertical": "The DEM declares a datum, and you know that it is wrong.",
        "height": "You have no DEM, and the ground is flat.",
        "dem-fill": "The DEM has holes or does not cover the scene, and you accept a substitute there.",
        "dem-source": "The cells of `--dem auto` are in your own folder or bucket.",
        "dem-sigma": "You know how accurate the heights are.",
        "dem-heights": "The DEM must help only to find ties, because it is wrong or much coarser than the images.",
        "dem-bias": "You know how far all heights of the DEM may be off together.",
        "dem-correlation": "You know that neighbouring heights of the DEM are off together, and over which distance.",
        "dem-shift": "The DEM is shifted against the images, and these are right.",
        "dem-shift-sigma": "You know how far the DEM may be shifted in plan.",
        "spot-heights": "You have a DEM and some more accurate heights, such as of ICESat-2 or of lakes.",
        "spot-heights-crs": "The file of the spot heights does not state its CRS.",
        "spot-heights-vertical": "The file of the spot heights does not state its height datum.",
        "dem-interpolation": "The DEM is so coarse that its facets are visible: then use `cubic`.",
    },
    "Control and check points": {
        "check": "The file does not say which points check. Always reserve some points.",
        "select": "You want to test how few points are enough, or you have many and want a well-spread subset.",
        "near": "The residual analysis must use another neighbour distance than its own choice.",
    },
    "What is adjusted": {
        "correction": "A shift is not enough. Long strips: `shift-drift`. Attitude errors: `affine`. Cameras: `model`.",
        "fit-model": "The image has no model of its own, or you do not trust it.",
        "model-crs": "A fitted model must use other ground coordinates than those of the points.",
        "prune": "You want to keep only the parameters that the points justify.",
        "significance": "You want another threshold than 5 %.",
        "shift-only": "A finished ortho must only be shifted.",
        "max-bending": "The displacement of a finished ortho changes faster than 0.02 px per pixel.",
        "params": "You want to adjust some parameters of a camera and keep the others.",
        "ridge": "A rational model has too many parameters, and the automatic weight does not suit you.",
        "models": "An earlier run saved the models of the images as `_model.json`.",
        "units": "You want the table of `compare` in metres.",
        "ground-sigma": "The points file states no accuracy of the ground, and you know it.",
        "hold": "A block has no control, and you know how accurate its delivered orientation is.",
        "join-limit": "Two images must fit better than 0.5 px, or may fit worse.",
    },
    "Automatic points": {
        "reference": "Control points come from an orthoimage of the same place.",
        "reference-bands": "The reference has many bands, and you know which look most like the scene.",
        "reference-sigma": "You know how accurate the reference is: then always state it.",
        "search": "The delivered model may be off by more than 100 m, or is known to be much better.",
        "search-rotation": "The image may be rotated. The search time grows with the angle.",
        "match-points": "500 are too many (quick looks) or too few (large scenes).",
        "gcps-as": "Surveyed points must control together with the matches, and not only check.",
        "mask": "Clouds, snow or water hide parts of a finished ortho, and a raster of classes shows where.",
        "compare-band": "One band of a finished ortho looks most like the reference.",
        "ties": "A block needs tie points, and you do not want to measure them.",
        "report": "You want to inspect the matches.",
    },
    "Measuring": {
        "no-browser": "`measure` runs on another machine than your browser.",
        "port": "`measure` needs a fixed port, for example for an SSH tunnel.",
    },
    "Which model": {
        "sensor": "No sensor recognises the image, or two do.",
        "sensor-option": "A sensor needs a value that the files do not state.",
        "test": "You write a plugin, or you suspect one.",
        "rpc": "Tag and side-car differ, or the RPC is elsewhere.",
        "model": "An earlier run saved the model as `_model.json`.",
        "ortho": "The image is a finished ortho, such as Sentinel-2 or a national mosaic, and you treat it as a scene.",
        "crop-offset": "The image is a crop of the image that the model belongs to.",
    },
    "The ortho": {
        "output-crs": "You do not want the UTM zone of the scene.",
        "resolution": "You do not want the ground sample distance.",
        "extent": "You need an exact area.",
        "align": "The extent must fit a grid of whole multiples of the resolution.",
        "like": "Pixels must match those of another raster.",
        "resampling": "Classes: `nearest`. A much coarser grid: `average`. Best appearance: `cubic`.",
        "band": "You need only some bands, or another order.",
        "output-type": "Another program needs another pixel type.",
        "nodata": "Another program needs a nodata value and cannot read a mask.",
        "format": "Another program cannot read a COG.",
        "creation-option": "You want another compression or another layout.",
        "tolerance": "The warp may be less exact than 0.01 px, or must be more exact.",
        "engine": "You want to compare with the warper of GDAL, pixel by pixel.",
        "memory": "Other programs need memory too.",
        "threads": "Other programs need processors too.",
        "overwrite": "Files of other programs are in the output folder and would attach to the ortho.",
    },
    "More outputs": {
        "orthos": "You want the orthos of a block on one grid, ready for `mosaic`.",
        "mosaic": "You want one raster of the block.",
        "export": "CARS, Ames Stereo Pipeline or s2p computes a surface from the block.",
        "accuracy-raster": "The accuracy differs over the scene: steep ground, or control in one part only.",
        "visibility": "The view is oblique. With a surface model, `nodata` makes a true ortho.",
        "fill-from": "Another ortho shows what is hidden here.",
        "angles": "Somebody corrects the radiometry for the view or the sun.",
        "sun": "The metadata do not state the position of the sun.",
        "layer-step": "The layers of accuracy and angles must be finer or coarser.",
        "require": "A script must stop if an ortho is not accurate enough.",
        "no-resample": "The pixels of a finished ortho must stay as they are.",
        "stac": "The ortho goes into a catalogue.",
        "acquired": "The metadata do not state the acquisition time.",
        "plots": "You need the plots of a report as pictures.",
        "kind": "You need PNG instead of SVG.",
        "sharpen": "You have a panchromatic and a multispectral image of one acquisition.",
        "weights": "You know how much each band contributes to the panchromatic one.",
        "ratio": "The multispectral ortho has the pixel size of the panchromatic one already.",
        "force": "An RPC that is more than 0.1 px off is good enough for you.",
        "edge": "`edge` does not find a good edge by itself.",
        "transform": "Bands differ by something other than a projective transformation.",
    },
    "Many scenes": {
        "datum": "One date of a stack, or a reference, must keep its place.",
        "date-pattern": "The dates of a stack are in the file names.",
        "neighbours": "Clouds or seasons leave too few pairs of dates that match.",
        "corrections-only": "The pixels of a stack must stay as they are.",
        "rebuild": "You do not trust the records of an earlier stack.",
        "list": "You want to see the state of each scene.",
        "schema": "You want to know what a pipeline file may contain.",
        "executor": "You do not want one process for each processor.",
        "workers": "Other programs need the processors.",
        "scheduler": "A dask cluster does the work.",
        "only": "You make single scenes.",
        "shard": "An array job makes the scenes in parts.",
        "summary": "All parts of an array job are finished.",
        "checksums": "You cannot trust the timestamps of files.",
        "order": "Another scene must be on top of the mosaic.",
        "seamlines": "The seams of the mosaic must not be visible.",
        "balance": "The scenes of the mosaic differ in brightness.",
    },
    "Files, network and messages": {
        "allow-network": "An input or output has a URL. Network access is off by default.",
        "root": "A VRT refers to files outside its own folder, and you trust it.",
        "fetch-grids": "A geoid grid is missing.",
        "open": "You want to look at the report at once.",
        "json": "A program reads the result.",
        "verbose": "You want to see what the program does.",
        "quiet": "A script needs only warnings and errors.",
        "debug": "You report a bug.",
    },
}

_SAVED = "You want to keep the result and its plots."
_NAMED = "The default name does not suit you."
_GROUND = "The ground coordinates are in another file than the image points."
_FAR = "The ortho may be displaced farther."
_CHOSEN = "The images have several models or none, and you choose one by name."
#: By command: the options that are for something else there than `NEEDS` says.
OTHERWISE: Mapping[str, Mapping[str, str]] = {
    "adjust": {
        "gcps": _GROUND,
        "dem": "Ties must be found by matching, or neighbouring orthos must fit without control points.",
        "dem-sigma": "You know how accurate the heights are: the heights of ties count accordingly.",
        "reference": "Control points of all images come from an orthoimage of the same place.",
        "model": _CHOSEN,
    },
    "compare": {"output": _SAVED, "models": "Only some models interest you."},
    "dem-check": {"points": "Always: they are the heights that the DEM is compared with."},
    "edge": {"output": _SAVED, "band": "The first band is not the one to measure."},
    "export": {
        "gcps": "The model must be adjusted to points before it is written.",
        "dem": "You export grids of points with the heights of the ground, or you match a reference.",
        "format": "You need other kinds of model files than the default ones.",
    },
    "init": {"output": _NAMED, "overwrite": "There is a pipeline file already, and you no longer need it."},
    "intersect": {"gcps": _GROUND, "model": _CHOSEN, "output": "You want the ground points in a file."},
    "match": {"dem": "Almost always: in hilly ground, matching fails without it."},
    "measure": {
        "output": _NAMED,
        "gcps": "You have points already, and add more.",
        "dem": "The ground is hilly, or the points have no heights.",
        "reference": "You read the ground coordinates from an orthoimage that is shown next to the image.",
    },
    "rectify": {
        "dem": "You make an ortho of anything but flat ground. `auto` downloads the Copernicus DEM.",
        "dem-sigma": "The reported accuracy must include the DEM error.",
    },
    "align": {"search": _FAR},
    "stack": {
        "search": _FAR,
        "reference": "All dates must agree with an orthoimage that you trust.",
        "dem": "Some dates are raw scenes.",
        "executor": "You want several processes, or the workers of dask.",
        "workers": "You want several processes.",
        "height": "Some dates are raw scenes of flat ground.",
    },
    "verify": {
        "search": _FAR,
        "output": "You want the report and the displacements in files.",
        "gcps": "You have surveyed points, which test the absolute accuracy.",
    },
    "register": {"reference": "Another image than the first one must stay in place."},
    "run": {
        "output": "The results go to object storage.",
        "root": "The pipeline file names files outside its own folder, and you trust it.",
    },
    "ties": {
        "dem": "Almost always: with it, matching finds ties in hilly ground.",
        "dem-sigma": "The DEM may be more than 10 m off: the search for ties must then go further.",
    },
}


def main(folder: Path = FOLDER) -> None:
    """Write all pages, and remove those of commands that are no more."""
    folder.mkdir(exist_ok=True)
    root = click.Context(cli, info_name="ortho", **cli.context_settings)
    pages = {f"{name}.md": page(_below(root, name)) for name in cli.list_commands(root)}
    for old in folder.glob("*.md"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")


def long_name(option: click.Option) -> str:
    """Return the longest name of an option, without its dashes."""
    return max((name for name in option.opts if name.startswith("--")), key=len).removeprefix("--")


def page(context: click.Context, level: int = 1) -> str:
    """Return the page of a command, with a section for each command below it."""
    command = context.command
    text = inspect.cleandoc(command.help or "")
    examples = _EXAMPLES.search(text)
    usage = f"Usage: {context.command_path} {' '.join(command.collect_usage_pieces(context))}"
    parts = [f"{'#' * level} {context.command_path}", _EXAMPLES.sub("", text).replace("\b\n", "")]
    if examples:
        parts.append(_code(inspect.cleandoc(examples["lines"].replace("\b", ""))))
    parts += [_code(usage), *_tables(context, level + 1)]
    if isinstance(command, click.Group):
        parts += [page(_below(context, name), level + 1).rstrip() for name in command.list_commands(context)]
    return "\n\n".join(parts) + "\n"


def _below(context: click.Context, name: str) -> click.Context:
    assert isinstance(context.command, click.Group)
    command = context.command.get_command(context, name)
    assert command is not None
    return click.Context(command, info_name=name, parent=context)


def _tables(context: click.Context, level: int) -> Iterator[str]:
    """Yield the options of a command: a heading and a table for each topic, or one table of those of `PLAIN`."""
    options = {long_name(one): one for one in context.command.get_params(context)
               if isinstance(one, click.Option) and long_name(one) != "help"}  # fmt: skip
    if context.command_path.split()[1] in PLAIN:
        if options:
            yield _table(("option", "what it does"), [_cells(one, context) for one in options.values()])
        return
    otherwise = OTHERWISE.get(context.info_name or "", {})
    for heading, needs in NEEDS.items():
        here = {**needs, **{name: need for name, need in otherwise.items() if name in needs}}
        rows = [(*_cells(options.pop(name), context), need) for name, need in here.items() if name in options]
        if rows:
            yield f"{'#' * level} {heading}"
            yield _table(("option", "what it does", "you need it when"), rows)
    if options:  # of a command that a package adds
        yield f"{'#' * level} More options"
        yield _table(("option", "what it does"), [_cells(one, context) for one in options.values()])


def _cells(option: click.Option, context: click.Context) -> tuple[str, str]:
    names, text = option.get_help_record(context) or ("", "")
    return f"`{names}`", " ".join(text.split())


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, tuple("---" for _ in heads), *(tuple(map(_cell, row)) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    """Return the text of a cell with a backslash before a bar; in code, where a bar ends no cell, it would be shown."""
    return re.sub(r"(`[^`]*`)|\|", lambda found: found[1] or "\\|", text)


def _code(text: str) -> str:
    return f"```\n{text}\n```"


if __name__ == "__main__":
    main()
