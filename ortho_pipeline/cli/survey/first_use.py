"""What a new user types first: `ortho` alone, `ortho info` and `ortho init`."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.cli.flags import FLAGS
from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import json_option, scene_options
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json, print_result, print_warnings, view_text
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.options import SceneOptions

if TYPE_CHECKING:
    from ortho_pipeline.commands.survey.folder import FolderSurvey

#: The five most common tasks, and their commands.
STEPS = (
    ("List your files and the next command", "ortho info FOLDER"),
    ("Make an ortho with your control points", "ortho rectify scene.tif --dem dem.tif --gcps points.csv -o out"),
    (
        "Make one with automatic control points",
        "ortho rectify scene.tif --dem auto --allow-network --reference ortho.tif -o out",
    ),
    ("Compare models on the same points", "ortho compare scene.tif --gcps points.csv -o out"),
    ("Make many orthos", "ortho init FOLDER && ortho run FOLDER/pipeline.yaml"),
)


def print_steps() -> None:
    """Print the most common tasks."""
    wide = max(len(what) for what, _ in STEPS)
    say("Orthorectify satellite images and report how accurate the result is.\n")
    for what, line in STEPS:
        say(f"  {what:<{wide}}   {line}")
    say("\n'ortho --help' lists all commands. 'ortho COMMAND --help' explains one. 'ortho doctor' checks your set-up.")


@click.command(cls=Command)
@click.argument("image", metavar="IMAGE|FOLDER", type=click.Path())
@scene_options
@json_option
def info(image: str, scene: SceneOptions, as_json: bool) -> None:
    """Describe an image, a DEM, an ortho or a folder.

    For an image: sensor, model and its file, position, ground sample distance. For a DEM or an ortho: its grid, and
    the option to use it with. For a FOLDER: its scenes, DEMs and points, and the next command.
    """
    from ortho_pipeline import commands

    try:
        document = commands.info(image, scene)
    except InputError:
        # Some formats are folders; any other folder is one of files.
        if not os.path.isdir(image):
            raise
        return _print_survey(image, scene, as_json)
    if as_json:
        return print_json(document)
    if "kind" in document:
        return _print_map_raster(document)
    lines = {
        "Image": f"{document['image']}  ({document['size'][0]} x {document['size'][1]})",
        "Sensor": document["sensor"],
        "Models": ", ".join(document["models"]),
        "Read from": document["model_source"],
        "Heights": "{:.0f} to {:.0f} m (ellipsoidal)".format(*document["height_range"]),
        "Pixel": f"{document['gsd_m']:.3g} m at {document['reference_height']:.0f} m",
        "View": view_text(document["view"]),
        "UTM": document["utm"],
        "Corners": "lon,lat "
        + "  ".join("outside" if lon is None else f"{lon:.5f},{lat:.5f}" for lon, lat in document["corners_lon_lat"]),
        **({"Belongs to": ", ".join(document["same_acquisition"])} if document["same_acquisition"] else {}),
        **{name: str(value) for name, value in document["facts"].items()},
    }
    for name, value in lines.items():
        say(f"{name:<10} {value}")
    print_warnings(document["warnings"])
    return None


def _print_map_raster(document: Mapping[str, Any]) -> None:
    dem = document["kind"] == "dem"
    option = FLAGS[document["option"]]
    lines = {
        "Raster": f"{document['image']}  ({document['size'][0]} x {document['size'][1]})",
        "Looks like": "a DEM: one band of signed numbers on a map grid"
        if dem
        else "an ortho or another map raster; it has no sensor model",
        "Bands": f"{document['bands']}, {document['type']}, nodata {document['nodata']}",
        "CRS": document["crs"],
        **({"Heights": _heights_text(document)} if dem else {}),
        "Pixel": "{:.6g} x {:.6g} ".format(*document["pixel"]) + document["unit"],
        "Extent": " ".join(f"{value:.10g}" for value in document["extent"]),
        "Use it as": f"{option} {document['image']}" + (" --dem-vertical DATUM" * (dem and not document["vertical"])),
        **({} if dem else {"Check it": f"ortho verify {document['image']} --reference REFERENCE -o out"}),
    }
    for name, value in lines.items():
        say(f"{name:<10} {value}")


def _heights_text(document: Mapping[str, Any]) -> str:
    heights = document["heights"]
    spread = "no valid sample found" if heights is None else "about {:.0f} to {:.0f}".format(*heights)
    return f"{spread}, {document['vertical'] or 'height datum not declared'}"


def _print_survey(folder: str, scene: SceneOptions, as_json: bool) -> None:
    from ortho_pipeline.commands.survey.folder import bundle_in, survey

    seen = survey(folder, scene)
    steps = next_steps(seen, bundle_in(seen, scene))
    if as_json:
        return print_json({**seen.to_json(), "next": steps})
    wide = max([0, *(len(file.path) for file in seen.found)])
    for file in seen.found:
        say(f"{file.kind:<12} {file.path:<{wide}}   {file.said}")
    say("\nNext:" if seen.found else "Next:")
    for line in steps:
        say(f"  {line}")
    return None


def _without_models(seen: FolderSurvey, images: Sequence[str]) -> list[str]:
    """Return the next steps where no raw image has a sensor model."""
    if not (points := seen.of("points")):
        return ["No image has a sensor model. Put the metadata (RPC, DIMAP, .IMD ...) next to the image."]
    files = [os.path.join(seen.folder, name) for name in (images[0], points[0])]
    line = shlex.join(["ortho", "compare", files[0], "--gcps", files[1]])
    return ["No image has a sensor model. Fit one to the points:", f"  {line}"]


def _without_images(seen: FolderSurvey) -> list[str]:
    """Return the next steps where no image is raw."""
    maps = [os.path.join(seen.folder, name) for name in seen.of("map image")]
    if not maps:
        return ["No scenes found. Outputs of ortho are not listed; 'ortho info FILE' describes one."]
    reference = maps[1:2] or ["ORTHO"]
    line = shlex.join(["ortho", "verify", maps[0], "--reference", *reference])
    return [
        "The map images are finished orthos. Measure how accurate one is, with another one of the place:",
        f"  {line}",
    ]


def _control_of(seen: FolderSurvey, scene: str, block: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return what to say of the control of scenes, and the options that give it; `block` are points of several."""
    from ortho_pipeline.commands.survey.folder import INCOMPLETE

    points, maps = block or seen.beside(scene, "points"), seen.beside(scene, "map image")
    if points:
        incomplete = any(file.path == points[0] and file.said.startswith(INCOMPLETE) for file in seen.found)
        note = (
            f"{points[0]} does not state the CRS or the height datum of its points. Add what its author states: "
            "'--points-crs EPSG:n', '--points-vertical egm96', '--points-vertical egm2008' or "
            "'--points-vertical ellipsoid'."
        )
        option = "--points" if block and len(seen.of("scene")) > 1 else "--gcps"
        return [note] if incomplete else [], [option, os.path.join(seen.folder, points[0])]
    if maps:
        note = f"No control points found for {scene}. The command below matches them with {maps[0]}."
        return [note], ["--reference", os.path.join(seen.folder, maps[0])]
    note = (
        f"No control points found for {scene}. The ortho will be as accurate as the delivered model. "
        "To improve it, add measured points ('--gcps FILE') or an ortho of the same place ('--reference ORTHO')."
    )
    return [note], []


def next_steps(seen: FolderSurvey, bundle: tuple[str, str] | None) -> list[str]:
    """Return the next steps for the files of a folder, which may be a bundle: sentences, and commands to paste."""
    from ortho_pipeline.commands.survey.folder import NO_DATUM

    scenes, images = seen.of("scene"), seen.of("image")

    def at(name: str) -> str:
        return os.path.join(seen.folder, name)

    if not scenes:
        return _without_models(seen, images) if images else _without_images(seen)
    # Points of a block are for both images; a bundle has those of its panchromatic image.
    bundle = None if seen.beside(scenes[0], "block points") else bundle
    scenes = scenes if bundle is None else [bundle[0]]
    dems = seen.beside(scenes[0], "dem")
    notes, words = [], ["--dem", at(dems[0])] if dems else ["--dem", "auto", "--allow-network"]
    if not dems:
        notes.append(
            f"No DEM found for {scenes[0]}. '--dem auto --allow-network' downloads the Copernicus DEM under the scene. "
            "Or use '--dem FILE', or '--height M' for flat ground."
        )
    elif any(entry.path == dems[0] and entry.said.endswith(NO_DATUM) for entry in seen.found):
        notes.append(
            f"{dems[0]} does not declare its height datum. Add the one that its vendor states: '--dem-vertical egm96', "
            "'--dem-vertical egm2008' or '--dem-vertical ellipsoid'."
        )
    points = seen.beside(scenes[0], "points")
    block = [] if points and len(scenes) == 1 else seen.beside(scenes[0], "block points")
    more, given = _control_of(seen, scenes[0], block)
    notes, words = [*notes, *more], [*words, *given]
    if len(scenes) == 1:
        colours = ["--sharpen", at(bundle[1])] if bundle else []
        what = "Make both orthos, and pan-sharpen the multispectral one:" if bundle else "Make the ortho:"
        return [*notes, what, "  " + shlex.join(["ortho", "rectify", at(scenes[0]), *colours, *words, "-o", "out"])]
    frames = [file for file in seen.found if file.kind == "scene" and "frame" in file.models]
    if block or (len(frames) == len(scenes) and not points):
        # Photos at the rim show more than a surface model that was made of them.
        words += ["--dem-fill", "mask"] if frames and dems else []
        line = shlex.join(["ortho", "adjust", str(seen.folder), "--ties", "auto", *words, "--orthos", "-o", "out"])
        what = counted(len(scenes), "photo" if len(frames) == len(scenes) else "scene")
        return [*notes, f"Adjust the {what} together, and make their orthos:", f"  {line}"]
    file = at("pipeline.yaml")
    network = [] if all(seen.beside(name, "dem") for name in scenes) else ["--allow-network"]
    lines = [
        shlex.join(words)
        for words in (
            ["ortho", "init", str(seen.folder)],
            ["ortho", "run", file, "--dry-run", *network],
            ["ortho", "run", file, *network],
        )
    ]
    return [*notes, f"Make the orthos of {counted(len(scenes), 'scene')}:", *(f"  {line}" for line in lines)]


@click.command(cls=Command)
@click.argument("folder", type=click.Path(file_okay=False))
@click.option(
    "--output",
    "-o",
    "path",
    type=click.Path(dir_okay=False),
    metavar="FILE",
    help="Path of the pipeline file.  [default: pipeline.yaml in the folder]",
)
@click.option("--overwrite", is_flag=True, help="Overwrite an existing file.")
@scene_options
@json_option
def init(folder: str, path: str | None, overwrite: bool, scene: SceneOptions, as_json: bool) -> None:
    """Write a pipeline file for the scenes of FOLDER.

    The file is input for 'ortho run'. Its comments explain each setting.
    """
    from ortho_pipeline.commands.survey.pipeline_file import init as write

    print_result(write(folder, path, options=scene, overwrite=overwrite), as_json)
