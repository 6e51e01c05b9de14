"""A pipeline file for the scenes of a folder, with comments that explain each line."""

from __future__ import annotations

import json
import os
import shlex
from collections import Counter
from pathlib import Path

from ortho_pipeline.commands.results import Result
from ortho_pipeline.commands.survey.folder import FolderSurvey, Kind, survey
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import allowed, write_text
from ortho_pipeline.options import SceneOptions

NAME = "pipeline.yaml"
#: Kinds of files of a scene, with their group and key in the pipeline file.
_GROUPS: tuple[tuple[Kind, str, str], ...] = (("dem", "surface", "dem"), ("points", "points", "gcps"))


def init(
    folder: str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    *,
    options: SceneOptions = SceneOptions(),
    overwrite: bool = False,
) -> Result:
    """Write a pipeline file for the scenes of a folder.

    Parameters
    ----------
    path : path, optional
        Path of the file; default ``pipeline.yaml`` in the folder. It must be in the folder or above it, as the paths in
        it are written from there.

    Raises
    ------
    InputError
        If there is no scene with a model, the path is elsewhere, or the file exists and `overwrite` is false.
    """
    seen = survey(folder, options)
    target = Path(folder) / NAME if path is None else Path(path)
    allowed(target)
    if target.exists() and not overwrite:
        raise InputError(
            "this file already exists", file=target, remedy=Text("choose another name, or use ", Setting("overwrite"))
        )
    if not seen.of("scene"):
        raise InputError(
            "no image has a sensor model",
            file=folder,
            remedy="put the metadata (RPC, DIMAP, .IMD ...) next to the image",
        )
    prefix = os.path.relpath(Path(folder).resolve(), target.resolve().parent)
    if prefix.startswith(os.pardir):
        raise InputError(
            "a pipeline file must be in the folder of its scenes or above it",
            file=target,
            remedy="choose another path",
        )
    write_text(target, text(seen, prefix))
    skipped = [image for image in seen.found if image.kind == "image"]
    lines = [counted(len(seen.of("scene")), "scene")]
    if skipped:
        lines[0] += f", {counted(len(skipped), 'image')} skipped:"
        lines += [f"  {image.path}: {image.said}" for image in skipped]
    file = shlex.quote(str(target))
    if all(seen.beside(name, "dem") for name in seen.of("scene")):
        next_lines = f"  ortho run {file} --dry-run\n  ortho run {file}"
    else:
        next_lines = f"  ortho run {file} --allow-network --dry-run\n  ortho run {file} --allow-network"
    lines += ["Check the file, then run:", next_lines]
    document = {"scenes": seen.of("scene"), "skipped": {image.path: image.said for image in skipped}}
    return Result({"pipeline": target}, document, "\n".join(lines))


def text(seen: FolderSurvey, prefix: str = ".") -> str:
    """Return the text of the file: found files as settings, others as comments."""

    def at(name: str) -> str:
        # A JSON text is a YAML text; it protects names that begin with * or contain a colon.
        return json.dumps(name if prefix == "." else f"{prefix}/{name}", ensure_ascii=False)

    lines = [
        "# Scenes for 'ortho run'. Paths are relative to this file; every field: docs/run.md, 'ortho run --schema'.",
        "# 'ortho run FILE --dry-run' checks all inputs; 'ortho run FILE' makes the scenes that are missing.",
        "output: out                     # each scene gets a folder in it",
        "defaults:                       # settings of all scenes; a scene below may override them",
        "  surface:",
        "    dem: auto                   # the Copernicus DEM under the scene; or a file:",
        "    # dem: dem.tif",
        "    # vertical: egm2008         # its height datum, if the file does not declare it",
        "  # points:",
        '  #   gcps: "gcps/{stem}.csv"   # control points: one file per scene, named like it',
        "  # match:",
        "  #   reference: ortho.tif      # automatic control points, from an ortho of the place",
        "  # output:",
        '  #   crs: "EPSG:32636"         # default: the UTM zone of the scene',
        "  #   resolution: 2.5           # default: about that of the image",
        "scenes:",
    ]
    stems = Counter(Path(scene).stem.casefold() for scene in seen.of("scene"))
    for scene in seen.of("scene"):
        lines.append(f"  - image: {at(scene)}")
        if stems[Path(scene).stem.casefold()] > 1:
            name = "_".join(Path(scene).with_suffix("").parts)
            lines.append(f"    name: {json.dumps(name, ensure_ascii=False)}")
        for kind, group, key in _GROUPS:
            files = seen.beside(scene, kind)
            # Of several the first; which one is right only the user knows.
            lines += [f"    {group}: {{{key}: {at(file)}}}" for file in files[:1]]
            lines += [f"    # {group}: {{{key}: {at(file)}}}" for file in files[1:3]]
    return "\n".join(lines) + "\n"
