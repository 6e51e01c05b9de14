"""Options of a block of images."""

# Annotations are read from the class: as values, not as text.
from dataclasses import dataclass
from typing import Annotated

from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options.groups import CHECK, MODEL_CRS, PIXEL_ORIGIN, VERTICAL_FORMS
from ortho_pipeline.options.option import CORRECTIONS, Option, PathLike, documented


@documented
@dataclass(frozen=True)
class BlockOptions:
    """Points of a block, and what to adjust to them.

    `model` names a model of each scene, or a family to fit to the control points of each image.
    """

    points: Annotated[
        PathLike | None,
        Option(
            "--points",
            "Image points: CSV (id,image,col,row[,x,y,h,role,...]), GeoJSON with 'ji' by image, ODM gcp_list.txt "
            "or ASP .gcp.",
            "FILE",
        ),
    ] = None
    ties: Annotated[
        str | None,
        Option(
            "--ties",
            Text("Find tie points by matching the images, in addition to those of ", Setting("points.points"), "."),
            choices=("auto",),
        ),
    ] = None
    gcps: Annotated[
        PathLike | None, Option("--gcps", "Ground coordinates of the points: CSV (id,x,y,h,...) or GeoJSON.", "FILE")
    ] = None
    crs: Annotated[
        str | None, Option("--points-crs", "CRS of the ground coordinates, if their file does not state it.", "CRS")
    ] = None
    vertical: Annotated[
        str | None, Option("--points-vertical", f"Height datum of the ground coordinates: {VERTICAL_FORMS}.", "DATUM")
    ] = None
    pixel_origin: Annotated[str, PIXEL_ORIGIN] = "corner"
    check: Annotated[str | None, CHECK] = None
    model: Annotated[
        str | None,
        Option(
            "--model",
            "A model of the images, such as rpc or pushbroom, or one to fit to points; 'ortho models' lists these.",
            "NAME",
            unset="the images' best",
        ),
    ] = None
    correction: Annotated[
        str | None,
        Option(
            "--correction",
            "What to adjust: image coordinates (shift, shift-drift, affine), or the parameters of the model (model).",
            unset="the model's own parameters if it has any, else a shift",
            choices=CORRECTIONS,
        ),
    ] = None
    ground_sigma: Annotated[
        str | None,
        Option(
            "--ground-sigma",
            "Standard deviations (m) in plan and height of ground coordinates whose file states none.",
            "XY[,H]",
            unset="estimated",
        ),
    ] = None
    model_crs: Annotated[str | None, Option("--model-crs", MODEL_CRS, "CRS")] = None
    hold: Annotated[
        float | None,
        Option(
            "--hold",
            "Keep the orientation near its start values, with this sigma.",
            "PX",
            kind="number",
            above=0,
            unset="with control, not held; without, the accuracy in the metadata, or 10 if they state none",
        ),
    ] = None
    dem_heights: Annotated[
        str,
        Option(
            "--dem-heights",
            Text("Use the heights of ", Setting("surface.dem"), " as observations of the ties, or only for matching."),
            choices=("on", "off"),
        ),
    ] = "on"
    dem_bias: Annotated[
        float | None,
        Option(
            "--dem-bias",
            "Standard deviation of the error that all heights of the DEM have in common.",
            "M",
            kind="number",
            unset="as --dem-sigma; 10 m without one; 100 m with spot heights",
        ),
    ] = None
    dem_correlation: Annotated[
        float | None,
        Option(
            "--dem-correlation",
            "Distance over which the errors of the DEM are correlated, as exp(-d / M).",
            "M",
            kind="number",
            above=0,
            unset="errors of the samples are independent",
        ),
    ] = None
    dem_shift: Annotated[
        str | None,
        Option(
            "--dem-shift",
            "Correct the position of the DEM by metres east and north, or by the estimate.",
            "estimate|E,N",
            unset="the estimate is only reported",
        ),
    ] = None
    dem_shift_sigma: Annotated[
        float | None,
        Option(
            "--dem-shift-sigma",
            "Standard deviation of the horizontal position of the DEM, per axis.",
            "M",
            kind="number",
            unset="half a sample",
        ),
    ] = None
    spot_heights: Annotated[
        PathLike | None,
        Option(
            "--spot-heights",
            "Known heights, such as laser altimetry, that fix the bias of the DEM: CSV, GeoJSON or GeoParquet with "
            "x, y, h, sigma.",
            "FILE",
        ),
    ] = None
    spot_crs: Annotated[
        str | None, Option("--spot-heights-crs", "CRS of the spot heights, if their file has none.", "CRS")
    ] = None
    spot_vertical: Annotated[
        str | None, Option("--spot-heights-vertical", f"Height datum of the spot heights: {VERTICAL_FORMS}.", "DATUM")
    ] = None
    join_limit: Annotated[
        float,
        Option(
            "--join-limit",
            "Warn if the relative position of two images with common points is less certain than this.",
            "PX",
            kind="number",
            above=0,
        ),
    ] = 0.5
