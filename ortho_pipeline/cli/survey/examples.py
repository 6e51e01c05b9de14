"""Examples of every command of the host, for its help; tests run them in a copy of the sample data."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence

#: By the words of the command; each with its purpose.
EXAMPLES: Mapping[str, Sequence[tuple[str, str]]] = {
    "info": (
        ("Show the sensor of an image and the source of its model:", "ortho info scene.tif"),
        ("List the files of a folder and the next command:", "ortho info orbview3"),
    ),
    "init": (("Write a commented pipeline file for all scenes of a folder:", "ortho init orbview3"),),
    "fit": (
        (
            "Show the error of the delivered model, and the residuals after a shift:",
            "ortho fit scene.tif --gcps gcps.geojson",
        ),
        (
            "Keep only the parameters that the points justify:",
            "ortho fit scene.tif --gcps gcps.geojson --correction affine --prune",
        ),
        ("Reserve every third point as a check point:", "ortho fit scene.tif --gcps gcps.csv --check every:3 --json"),
    ),
    "compare": (
        (
            "Compare all models:",
            "ortho compare scene.tif --gcps gcps.geojson -o compared",
        ),
        (
            "Compare three of them, in metres:",
            "ortho compare scene.tif --gcps gcps.geojson --models rpc+shift,affine3d,dlt --units m",
        ),
    ),
    "rectify": (
        ("With control points:", "ortho rectify scene.tif --gcps gcps.geojson --dem dem.tif -o out"),
        (
            "With automatic control points from an orthoimage:",
            "ortho rectify scene.tif --reference reference.tif --dem dem.tif -o matched",
        ),
        (
            "On your own grid and flat ground, with the flags of gdalwarp:",
            "ortho rectify scene.tif --height 800 -t_srs EPSG:32636 -tr 10 10 -r cubic -co COMPRESS=ZSTD -o flat",
        ),
    ),
    "match": (
        (
            "Find control points in an orthoimage, with a page that shows them:",
            "ortho match scene.tif --reference reference.tif --dem dem.tif -o matches.geojson --report matches.html",
        ),
    ),
    "export": (
        (
            "Write the adjusted RPC as a text file and as a VRT of the image:",
            "ortho export scene.tif --gcps gcps.geojson --format rpc-txt,vrt -o exported",
        ),
    ),
    "report": (("Write the plots of a report as SVG:", "ortho report out/scene_report.json --plots plots"),),
    "adjust": (
        (
            "Adjust a stereo pair with measured points:",
            "ortho adjust cartosat/BANDF.tif cartosat/BANDA.tif --points cartosat/points.csv -o block",
        ),
    ),
    "ties": (
        (
            "Find tie points between two images:",
            "ortho ties cartosat/BANDF.tif cartosat/BANDA.tif --dem cartosat/dem.tif -o ties.csv",
        ),
    ),
    "intersect": (
        (
            "Compute ground coordinates of points measured in two images:",
            "ortho intersect cartosat/BANDF.tif cartosat/BANDA.tif --points cartosat/points.csv -o ground.csv",
        ),
    ),
    "run": (
        ("Check all inputs; make nothing:", "ortho run orbview3/pipeline.yaml --dry-run"),
        ("Make the scenes that are missing or have changed:", "ortho run orbview3/pipeline.yaml --executor sequential"),
        ("Show the state of each scene:", "ortho run orbview3/pipeline.yaml --list"),
    ),
    "mosaic": (
        (
            "Combine two orthos, with the seam line where they differ least:",
            "ortho mosaic west/scene_ortho.tif east/scene_ortho.tif -o mosaic.tif --seamlines",
        ),
    ),
    "edge": (("Measure the sharpness of an image:", "ortho edge scene.tif -o sharpness"),),
    "register": (
        (
            "Align two bands:",
            "ortho register red.tif nir.tif -o bands",
        ),
    ),
    "verify": (
        (
            "Measure the accuracy of an ortho relative to another ortho:",
            "ortho verify out/scene_ortho.tif --reference reference.tif -o verified",
        ),
    ),
    "align": (
        (
            "Move an ortho onto another ortho, with one resampling:",
            "ortho align out/scene_ortho.tif --reference reference.tif -o aligned",
        ),
    ),
    "stack": (
        (
            "Make the orthos of a folder agree, with dates from their names:",
            "ortho stack series --date-pattern %Y%m%d -o stacked",
        ),
    ),
    "sharpen": (
        (
            "Pan-sharpen two finished orthos:",
            "ortho sharpen pan/scene_ortho.tif ms/scene_ortho.tif -o sharpened",
        ),
    ),
    "dem-check": (("Compare a DEM with surveyed heights:", "ortho dem-check dem.tif --points gcps.csv"),),
    "sensors": (
        ("List the supported products:", "ortho sensors"),
        ("Test the plugin of a sensor with one of its images:", "ortho sensors --test rpc scene.tif"),
    ),
    "models": (("List the models, with the number of points that each needs:", "ortho models"),),
    "doctor": (("Check the installation:", "ortho doctor"),),
    "cache list": (("List the cached files:", "ortho cache list"),),
    "cache verify": (("Verify their checksums:", "ortho cache verify"),),
    "cache clear": (("Delete them:", "ortho cache clear"),),
}


def with_examples(text: str | None, examples: Sequence[tuple[str, str]]) -> str | None:
    """Return the help of a command with its examples, as lines that are not wrapped."""
    if not examples:
        return text
    lines = [f"    {line}" for about, command in examples for line in (f"# {about}", command)]
    return "\n\n".join([inspect.cleandoc(text or ""), "\b\nExamples:", "\n".join(["\b", *lines])])
