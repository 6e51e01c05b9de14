"""Options of an ortho."""

# Annotations are read from the class: as values, not as text.
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from ortho_pipeline.options.option import PIXEL_TYPES, RESAMPLING, Option, PathLike, documented
from ortho_pipeline.options.texts import Setting, Text


@documented
@dataclass(frozen=True)
class OutputOptions:
    """Form of the ortho, and how it is computed.

    `memory` is in bytes.
    """

    crs: Annotated[str | None, Option("--output-crs -t_srs", metavar="CRS", unset="the UTM zone of the scene")] = None
    resolution: Annotated[
        float | Sequence[float] | None,
        Option(
            "--resolution -tr",
            "Pixel size in units of the output CRS.",
            "X [Y]",
            unset="the ground sample distance",
            kind="one or two",
            above=0,
        ),
    ] = None
    extent: Annotated[
        Sequence[float] | None,
        Option(
            "--extent -te",
            "Bounds of the ortho, taken as they are.",
            "XMIN YMIN XMAX YMAX",
            kind="box",
            unset="the scene's footprint",
        ),
    ] = None
    like: Annotated[
        PathLike | None,
        Option(
            "--like",
            "Take CRS, resolution and extent from this raster, so that pixels fall on pixels.",
            "RASTER",
            kind="file",
        ),
    ] = None
    align: Annotated[
        bool, Option("--align -tap", Text("Widen ", Setting("output.extent"), " to whole multiples of the resolution."))
    ] = False
    resampling: Annotated[str, Option("--resampling -r", choices=RESAMPLING)] = "bilinear"
    bands: Annotated[
        Sequence[int] | None,
        Option(
            "--band -b",
            "Only these bands of the image, from 1, in this order.",
            "N[,...]",
            unset="all",
            kind="integers",
            above=0,
        ),
    ] = None
    dtype: Annotated[
        str | None,
        Option(
            "--output-type -ot",
            "Type of the pixels; values beyond its range are clamped.",
            "|".join(PIXEL_TYPES),
            unset="that of the image",
            choices=PIXEL_TYPES,
        ),
    ] = None
    nodata: Annotated[
        float | str | None,
        Option(
            "--nodata -dstnodata",
            "Value of pixels without an image.",
            "VALUE",
            kind="number or nan",
            unset="that of the image, or a mask",
        ),
    ] = None
    dem_interpolation: Annotated[
        str, Option("--dem-interpolation", "Between the samples of the DEM.", choices=("bilinear", "cubic"))
    ] = "bilinear"
    format: Annotated[str, Option("--format -of", choices=("COG", "GTiff"))] = "COG"
    creation_options: Annotated[
        Mapping[str, str], Option("--creation-option -co", "Option of GDAL's driver.", "K=V", kind="keys")
    ] = field(default_factory=dict)
    engine: Annotated[
        str,
        Option(
            "--engine",
            "Our warper, or GDAL's with its own transformers, exactly (slow; for comparison).",
            choices=("ortho", "gdal"),
        ),
    ] = "ortho"
    memory: Annotated[
        int,
        Option(
            "--memory -wm",
            "Bound on windows and caches; or with a unit, such as 2GB.",
            "MB",
            kind="bytes",
            in_file=False,
        ),
    ] = 512_000_000
    threads: Annotated[
        int | None, Option("--threads", unset="all processors", kind="integer", above=0, in_file=False)
    ] = None
    tolerance: Annotated[
        float,
        Option("--tolerance", "Bound on the warper's geometric error, in source pixels.", "PX", kind="number", above=0),
    ] = 0.01
    accuracy_raster: Annotated[
        bool,
        Option(
            "--accuracy-raster",
            Text(
                "Write a raster of how accurate the ortho is at each place; ",
                Setting("surface.sigma"),
                " says how good the heights are.",
            ),
        ),
    ] = False
    visibility: Annotated[
        str | None,
        Option(
            "--visibility",
            "Look for ground that other terrain hides: write a mask of it, or leave its pixels empty "
            "(with a surface model a true ortho).",
            choices=("mask", "nodata"),
        ),
    ] = None
    fill_from: Annotated[
        PathLike | None,
        Option(
            "--fill-from",
            Text("Fill what ", Setting("output.visibility"), " leaves empty from this ortho, on any grid."),
            "ORTHO",
            kind="file",
        ),
    ] = None
    angles: Annotated[
        bool,
        Option(
            "--angles",
            "Write angles of view at each place and, where the sun is known, of the sun, and which pixels "
            "lie in shadow.",
        ),
    ] = False
    sun: Annotated[
        Sequence[float] | None,
        Option(
            "--sun",
            Text("Azimuth and elevation of the sun, degrees, for ", Setting("output.angles"), "."),
            "AZ,EL",
            kind="pair",
            unset="that of the metadata",
        ),
    ] = None
    layer_step: Annotated[
        int,
        Option(
            "--layer-step",
            "Pixels of the ortho to one of the layers of accuracy and angles.",
            "N",
            kind="integer",
            above=0,
        ),
    ] = 16
    stac: Annotated[bool, Option("--stac", "Write a STAC item of the ortho too.")] = False
    acquired: Annotated[
        str | None, Option("--acquired", "Time of acquisition (RFC 3339), where the metadata have none.", "TIME")
    ] = None

    @property
    def files(self) -> dict[str, str | os.PathLike[str]]:
        """Rasters besides the image that an ortho is made with, by what they are."""
        given = {"other ortho": self.fill_from, "grid": self.like}
        return {role: path for role, path in given.items() if path is not None}
