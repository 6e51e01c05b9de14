"""Options of an ortho."""

# Annotations are read from the class: as values, not as text.
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options.option import PIXEL_TYPES, RESAMPLING, Option, PathLike, documented


@documented
@dataclass(frozen=True)
class OutputOptions:
    """Form of the ortho, and how to compute it.

    `memory` is in bytes.

    Examples
    --------
    >>> op.OutputOptions(crs="EPSG:32636", resolution=5.0)
    OutputOptions(crs='EPSG:32636', resolution=5.0)
    """

    crs: Annotated[
        str | None, Option("--output-crs -t_srs", "CRS of the ortho.", "CRS", unset="the UTM zone of the scene")
    ] = None
    resolution: Annotated[
        float | Sequence[float] | None,
        Option(
            "--resolution -tr",
            "Pixel size, in units of the output CRS.",
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
            "Bounds of the ortho. The upper left corner is exact, then whole pixels follow.",
            "XMIN YMIN XMAX YMAX",
            kind="box",
            unset="the scene's footprint",
        ),
    ] = None
    like: Annotated[
        PathLike | None,
        Option(
            "--like",
            "Take CRS, resolution and extent from this raster, so that pixels coincide.",
            "RASTER",
            kind="file",
        ),
    ] = None
    align: Annotated[
        bool, Option("--align -tap", Text("Widen ", Setting("output.extent"), " to multiples of the resolution."))
    ] = False
    resampling: Annotated[str, Option("--resampling -r", "Resampling method.", choices=RESAMPLING)] = "bilinear"
    bands: Annotated[
        Sequence[int] | None,
        Option(
            "--band -b",
            "Bands of the image to use, numbered from 1, in this order.",
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
            "Pixel type; values outside its range are clamped.",
            "|".join(PIXEL_TYPES),
            unset="type of the image",
            choices=PIXEL_TYPES,
        ),
    ] = None
    nodata: Annotated[
        float | str | None,
        Option(
            "--nodata -dstnodata",
            "Pixel value outside the image.",
            "VALUE",
            kind="number or nan",
            unset="nodata of the image, else a mask",
        ),
    ] = None
    dem_interpolation: Annotated[
        str, Option("--dem-interpolation", "Interpolation between samples of the DEM.", choices=("bilinear", "cubic"))
    ] = "bilinear"
    format: Annotated[str, Option("--format -of", "Format of the ortho.", choices=("COG", "GTiff"))] = "COG"
    creation_options: Annotated[
        Mapping[str, str], Option("--creation-option -co", "Creation option of the GDAL driver.", "K=V", kind="keys")
    ] = field(default_factory=dict)
    engine: Annotated[
        str,
        Option(
            "--engine",
            "Our warper, or GDAL's with its exact transformers (slow; for comparison).",
            choices=("ortho", "gdal"),
        ),
    ] = "ortho"
    memory: Annotated[
        int,
        Option(
            "--memory -wm",
            "Memory for windows and caches, in MB or with a unit, such as 2GB.",
            "MB",
            kind="bytes",
            above=15_999_999,
            in_file=False,
        ),
    ] = 512_000_000
    threads: Annotated[
        int | None,
        Option("--threads", "Number of threads.", "N", unset="all processors", kind="integer", above=0, in_file=False),
    ] = None
    tolerance: Annotated[
        float,
        Option(
            "--tolerance", "Largest geometric error of the warp, in pixels of the image.", "PX", kind="number", above=0
        ),
    ] = 0.01
    accuracy_raster: Annotated[
        bool,
        Option(
            "--accuracy-raster",
            Text(
                "Also write a raster of the accuracy at each place. State the accuracy of the heights with ",
                Setting("surface.sigma"),
                ".",
            ),
        ),
    ] = False
    visibility: Annotated[
        str | None,
        Option(
            "--visibility",
            "Find ground that other terrain hides: write a mask of it, or leave its pixels empty (nodata). With a "
            "DSM, nodata gives a true ortho; gaps of the DSM are then empty, too.",
            choices=("mask", "nodata"),
        ),
    ] = None
    fill_from: Annotated[
        PathLike | None,
        Option(
            "--fill-from",
            Text(
                "Fill the pixels that ", Setting("output.visibility", "nodata"), " empties from this ortho (any grid)."
            ),
            "ORTHO",
            kind="file",
        ),
    ] = None
    angles: Annotated[
        bool,
        Option(
            "--angles",
            "Also write the view angles at each place. If the position of the sun is known, also its angles and "
            "the shadows.",
        ),
    ] = False
    sun: Annotated[
        Sequence[float] | None,
        Option(
            "--sun",
            Text("Azimuth and elevation of the sun in degrees, for ", Setting("output.angles"), "."),
            "AZ,EL",
            kind="pair",
            unset="from the metadata",
        ),
    ] = None
    layer_step: Annotated[
        int,
        Option(
            "--layer-step",
            "Pixel size of the layers of accuracy and angles, in pixels of the ortho.",
            "N",
            kind="integer",
            above=0,
        ),
    ] = 16
    stac: Annotated[bool, Option("--stac", "Also write a STAC item.")] = False
    acquired: Annotated[
        str | None, Option("--acquired", "Time of acquisition (RFC 3339), if the metadata do not state it.", "TIME")
    ] = None

    @property
    def files(self) -> dict[str, str | os.PathLike[str]]:
        """Rasters that an ortho is made with, apart from the image, by role."""
        rasters = {"other ortho": self.fill_from, "grid": self.like}
        return {role: path for role, path in rasters.items() if path is not None}
