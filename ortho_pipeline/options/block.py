"""Options of a block of images."""

# Annotations are read from the class: as values, not as text.
from dataclasses import dataclass
from typing import Annotated

from ortho_pipeline.options.groups import CHECK, MODEL_CRS, PIXEL_ORIGIN, VERTICAL_FORMS
from ortho_pipeline.options.option import CORRECTIONS, Option, PathLike, documented
from ortho_pipeline.options.texts import Setting, Text


@documented
@dataclass(frozen=True)
class BlockOptions:
    """Which points of a block there are, and what is adjusted to them.

    `model` is a name among the models of each scene, or a family that is fitted to the control points of each image.
    """

    points: Annotated[
        PathLike | None,
        Option(
            "--points",
            "Rays: CSV (id,image,col,row[,x,y,h,role,...]), GeoJSON with 'ji' by image, or ODM gcp_list.txt.",
            "FILE",
        ),
    ] = None
    ties: Annotated[
        str | None,
        Option(
            "--ties",
            Text("Find tie points between the images by matching, besides those of ", Setting("points.points"), "."),
            choices=("auto",),
        ),
    ] = None
    gcps: Annotated[
        PathLike | None, Option("--gcps", "Ground of the points: CSV (id,x,y,h,...) or GeoJSON.", "FILE")
    ] = None
    crs: Annotated[str | None, Option("--points-crs", "CRS of the ground, where its file has none.", "CRS")] = None
    vertical: Annotated[
        str | None, Option("--points-vertical", f"Height datum of the ground: {VERTICAL_FORMS}.", "DATUM")
    ] = None
    pixel_origin: Annotated[str, PIXEL_ORIGIN] = "corner"
    check: Annotated[str | None, CHECK] = None
    model: Annotated[
        str | None,
        Option(
            "--model",
            "One of the images' models, such as rpc or pushbroom, or a model fitted to points (see 'ortho models').",
            "NAME",
            unset="the images' best",
        ),
    ] = None
    correction: Annotated[
        str | None,
        Option(
            "--correction",
            "What is adjusted: the image points, or the parameters of the model itself.",
            unset="the model's own if it has any, else a shift",
            choices=CORRECTIONS,
        ),
    ] = None
    ground_sigma: Annotated[
        str | None,
        Option(
            "--ground-sigma",
            "Sigmas (m) in plan and height of ground that states none in the points file.",
            "XY[,H]",
            unset="estimated",
        ),
    ] = None
    model_crs: Annotated[str | None, Option("--model-crs", MODEL_CRS, "CRS")] = None
    hold: Annotated[
        float | None,
        Option(
            "--hold",
            "Hold the orientation at its start values with this sigma.",
            "PX",
            kind="number",
            above=0,
            unset="without control, the accuracy that the metadata state, else 10",
        ),
    ] = None
    dem_heights: Annotated[
        str,
        Option(
            "--dem-heights",
            Text("Use the heights of ", Setting("surface.dem"), " as observations of the ties, or only to match."),
            choices=("on", "off"),
        ),
    ] = "on"
    dem_bias: Annotated[
        float | None,
        Option(
            "--dem-bias",
            "Standard deviation of an error that all heights of the DEM share.",
            "M",
            kind="number",
            unset="that of a single height",
        ),
    ] = None
    dem_correlation: Annotated[
        float | None,
        Option(
            "--dem-correlation",
            "Distance over which DEM errors are correlated, by exp(-d / M).",
            "M",
            kind="number",
            above=0,
            unset="each sample of the DEM has its own error",
        ),
    ] = None
    dem_shift: Annotated[
        str | None,
        Option(
            "--dem-shift",
            "Correct the position of the DEM by this (metres east and north), or by the estimate.",
            "estimate|E,N",
            unset="the estimate is only reported",
        ),
    ] = None
    dem_shift_sigma: Annotated[
        float | None,
        Option(
            "--dem-shift-sigma",
            "Standard deviation of the horizontal position of the DEM, in each axis.",
            "M",
            kind="number",
            unset="half a sample",
        ),
    ] = None
    spot_heights: Annotated[
        PathLike | None,
        Option(
            "--spot-heights",
            "Known heights, such as of laser altimetry: CSV, GeoJSON or GeoParquet with x, y, h, sigma. They fix the "
            "bias of the DEM.",
            "FILE",
        ),
    ] = None
    spot_crs: Annotated[
        str | None, Option("--spot-heights-crs", "CRS of the spot heights, where their file has none.", "CRS")
    ] = None
    spot_vertical: Annotated[
        str | None, Option("--spot-heights-vertical", f"Height datum of the spot heights: {VERTICAL_FORMS}.", "DATUM")
    ] = None
    join_limit: Annotated[
        float,
        Option(
            "--join-limit",
            "Warn if the relative position of two images with common points has a larger sigma.",
            "PX",
            kind="number",
            above=0,
        ),
    ] = 0.5
