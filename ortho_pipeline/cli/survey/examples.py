"""Examples of every command of the host: they stand in its help; tests run them in a copy of the sample data."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence

#: By the words of the command; each with what it is for.
EXAMPLES: Mapping[str, Sequence[tuple[str, str]]] = {
    "info": (
        ("What is this image, and where does its model come from?", "ortho info scene.tif"),
        ("What lies in a folder, and what to type next:", "ortho info orbview3"),
    ),
    "init": (("A commented file for all scenes of a folder:", "ortho init orbview3"),),
    "fit": (
        (
            "How far is the delivered model off, and what is left after a shift?",
            "ortho fit scene.tif --gcps gcps.geojson",
        ),
        (
            "Only the parameters that the points justify:",
            "ortho fit scene.tif --gcps gcps.geojson --correction affine --prune",
        ),
        ("Every third point only checks:", "ortho fit scene.tif --gcps gcps.csv --check every:3 --json"),
    ),
    "compare": (
        (
            "Every model on the same points, and which one to believe:",
            "ortho compare scene.tif --gcps gcps.geojson -o compared",
        ),
        (
            "Some of them, in metres:",
            "ortho compare scene.tif --gcps gcps.geojson --models rpc+shift,affine3d,dlt --units m",
        ),
    ),
    "rectify": (
        ("With control points:", "ortho rectify scene.tif --gcps gcps.geojson --dem dem.tif -o out"),
        (
            "Without, by matching an orthoimage of the place:",
            "ortho rectify scene.tif --reference reference.tif --dem dem.tif -o matched",
        ),
        (
            "On a grid of your own, on flat ground, as gdalwarp would be told:",
            "ortho rectify scene.tif --height 800 -t_srs EPSG:32636 -tr 10 10 -r cubic -co COMPRESS=ZSTD -o flat",
        ),
    ),
    "match": (
        (
            "Control points from an orthoimage, and a page that shows them:",
            "ortho match scene.tif --reference reference.tif --dem dem.tif -o matches.geojson --report matches.html",
        ),
    ),
    "export": (
        (
            "The adjusted RPC as a text file and as a VRT around the image:",
            "ortho export scene.tif --gcps gcps.geojson --format rpc-txt,vrt -o exported",
        ),
    ),
    "report": (("The plots of a report as pictures:", "ortho report out/scene_report.json --plots plots"),),
    "adjust": (
        (
            "A stereo pair with measured points:",
            "ortho adjust cartosat/BANDF.tif cartosat/BANDA.tif --points cartosat/points.csv -o block",
        ),
    ),
    "ties": (
        (
            "Tie points between two images, without a hand:",
            "ortho ties cartosat/BANDF.tif cartosat/BANDA.tif --dem cartosat/dem.tif -o ties.csv",
        ),
    ),
    "intersect": (
        (
            "Ground coordinates of points that two images show:",
            "ortho intersect cartosat/BANDF.tif cartosat/BANDA.tif --points cartosat/points.csv -o ground.csv",
        ),
    ),
    "run": (
        ("Open everything and make nothing:", "ortho run orbview3/pipeline.yaml --dry-run"),
        ("Make what is missing or has changed:", "ortho run orbview3/pipeline.yaml --executor sequential"),
        ("In what state is each scene?", "ortho run orbview3/pipeline.yaml --list"),
    ),
    "mosaic": (
        (
            "One raster of two orthos on one grid, the seam where they look alike:",
            "ortho mosaic west/scene_ortho.tif east/scene_ortho.tif -o mosaic.tif --seamlines",
        ),
    ),
    "edge": (("How sharp is the image in truth?", "ortho edge scene.tif -o sharpness"),),
    "register": (
        (
            "Bands of cameras of their own as one image:",
            "ortho register red.tif nir.tif -o bands",
        ),
    ),
    "verify": (
        (
            "How accurate is an ortho, relative to another one of the place?",
            "ortho verify out/scene_ortho.tif --reference reference.tif -o verified",
        ),
    ),
    "align": (
        (
            "Move an ortho onto another one, resampled once:",
            "ortho align out/scene_ortho.tif --reference reference.tif -o aligned",
        ),
    ),
    "dem-check": (("A DEM against surveyed heights:", "ortho dem-check dem.tif --points gcps.csv"),),
    "sensors": (("Which products are recognised?", "ortho sensors"),),
    "models": (("Which families can be fitted to points, and from how many on?", "ortho models"),),
    "doctor": (("Is everything here that is needed?", "ortho doctor"),),
    "cache list": (("What was fetched, and where it lies:", "ortho cache list"),),
    "cache verify": (("Is it whole?", "ortho cache verify"),),
    "cache clear": (("Remove it:", "ortho cache clear"),),
}


def with_examples(text: str | None, examples: Sequence[tuple[str, str]]) -> str | None:
    """Return the help of a command with its examples, as lines that are not wrapped."""
    if not examples:
        return text
    lines = [f"    {line}" for about, command in examples for line in (f"# {about}", command)]
    return "\n\n".join([inspect.cleandoc(text or ""), "\b\nExamples:", "\n".join(["\b", *lines])])
