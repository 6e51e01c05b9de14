"""`ortho match`: a scene, its references and heights in; control points out."""

from __future__ import annotations

import os
from pathlib import Path

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.control.matching import match_scene
from ortho_pipeline.commands.results import Result
from ortho_pipeline.commands.scene_fit import on_surface
from ortho_pipeline.display.notices import to_document
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import write_points

#: Suffixes of files that say all that is known of a match.
_SUFFIXES = (".geojson", ".csv", ".tsv")


def match(
    image: str | os.PathLike[str],
    output: str | os.PathLike[str],
    match: MatchOptions,
    *,
    scene: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
) -> Result:
    """Match a scene with reference orthoimages and write the control and check points that this gives.

    Parameters
    ----------
    output : path
        A ``.geojson`` or ``.csv`` file, written whole or not at all.

    Raises
    ------
    InputError
        For whatever the user can correct; a place that cannot be told is no point.
    """
    if not match.reference:
        raise InputError(
            "there is nothing to match with", field="match.reference", remedy="give an orthoimage of the same place"
        )
    files = {"points": Path(output)}
    if files["points"].suffix.lower() not in _SUFFIXES:
        raise InputError(
            "matches are not written in this format", file=output, field="output",
            remedy=f"one of {', '.join(_SUFFIXES)}",
        )  # fmt: skip
    inputs.check_paths(files, image, scene, PointOptions(), surface, match)
    opened = inputs.open_scene(image, scene)
    heights = inputs.open_surface(surface, scene)
    opened = on_surface(opened, heights)
    matched = match_scene(opened, match, heights, scene)
    read = inputs.files_read(image, scene, PointOptions(), surface, match, opened)
    record = inputs.provenance(
        opened, PointOptions(), heights, inputs.hashed(read), None, {"scene": scene, "surface": surface, "match": match}
    )  # fmt: skip
    write_points(matched.matches.points, output)
    document = {"matching": matched.to_json(), "provenance": record, **to_document([*opened.notices, *matched.notices])}
    text = "\n".join(f"{name:<10}{said}" for name, said in matched.summary())
    return Result(files, document, text)
