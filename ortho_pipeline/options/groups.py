"""Options of a user, grouped as the pipeline takes them."""

# Annotations are read from the classes: as values, not as text.
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Protocol

from ortho_pipeline.options.option import (
    CORRECTIONS,
    PIXEL_ORIGINS,
    PIXEL_TYPES,
    RESAMPLING,
    Option,
    PathLike,
    documented,
)
from ortho_pipeline.options.texts import Setting, Text


@documented
@dataclass(frozen=True)
class SceneOptions:
    """How the image is opened."""

    sensor: Annotated[
        str | None, Option("--sensor", "Sensor of the image (see 'ortho sensors').", "NAME"),
    ] = None  # fmt: skip
    rpc: Annotated[
        str | None,
        Option("--rpc", "Which RPC, where there are several, or an RPC file.", "tag|sidecar|FILE"),
    ] = None
    model: Annotated[
        PathLike | None, Option("--model", "A saved *_model.json in place of the image's model.", kind="file")
    ] = None
    crop_offset: Annotated[
        Sequence[float] | None,
        Option(
            "--crop-offset", "First pixel of this image in the one that its model belongs to, where it is a crop.",
            "COL,ROW", kind="pair",
        ),
    ] = None  # fmt: skip
    sensor_options: Annotated[
        Mapping[str, str],
        Option("--sensor-option", "Option of the sensor (see 'ortho sensors').", "K=V", kind="keys"),
    ] = field(default_factory=dict)
    ortho: Annotated[bool, Option("--ortho", "An image that no sensor knows is a finished ortho.")] = False
    allow_network: Annotated[
        bool, Option("--allow-network", "Open URLs (http, https, s3, gs, az) and /vsi paths.", in_file=False)
    ] = False
    roots: Annotated[
        Sequence[PathLike],
        Option(
            "--root", "A folder that files may lead to (a VRT), besides their own.", "DIR", kind="folders",
            in_file=False,
        ),
    ] = ()  # fmt: skip

    @property
    def access(self) -> dict[str, Any]:
        """Permissions to open files, as `raster.open_dataset` takes them."""
        return {"allow_network": self.allow_network, "roots": tuple(self.roots)}

    @property
    def files(self) -> dict[str, str | os.PathLike[str]]:
        """Files besides the image that the scene is read from, by what they are."""
        given = {name: value for name, value in self.sensor_options.items() if _is_file(value)}
        own = {"RPC": self.rpc, "model": self.model}
        return {**{role: path for role, path in own.items() if path is not None}, **given}


def _is_file(value: object) -> bool:
    """Tell whether a text names a file, on disk or as GDAL names those in an archive."""
    return isinstance(value, str | os.PathLike) and (os.fspath(value).startswith("/vsi") or os.path.isfile(value))


class PointTable(Protocol):
    """Points that are read already: `ortho_pipeline.Points`."""

    @property
    def ids(self) -> tuple[str, ...]: ...
    @property
    def source(self) -> str: ...


#: Chips are held in memory, and more matches say no more of a model.
_MOST_MATCHES = 100_000
_VERTICAL_FORMS = "ellipsoid, egm96, egm2008, EPSG:n or a grid file"
_PIXEL_ORIGIN = Option(
    "--pixel-origin",
    "What CSV, ODM and link files call the first pixel: its outer corner or its centre (0, 0), or its corner or its "
    "centre (1, 1).",
    choices=tuple(PIXEL_ORIGINS),
)
_CHECK = Option("--check", "Points that check and do not control.", "every:N|ids:A,B")
_MODEL_CRS = "Ground of fitted models: geocentric, geographic, utm or EPSG:n."


@documented
@dataclass(frozen=True)
class PointOptions:
    """Which points there are, and what is adjusted to them.

    `gcps` may be points that are read already, in pixels of this image, too.
    """

    gcps: Annotated[
        PathLike | PointTable | None,
        Option(
            "--gcps",
            "Points: CSV, GeoJSON, QGIS .points, ODM gcp_list.txt, ENVI .pts, ASP .gcp, ArcGIS link table; or 'own' "
            "for those in the image.",
            "FILE|own",
        ),
    ] = None
    crs: Annotated[str | None, Option("--points-crs", "CRS of the points, where their file has none.", "CRS")] = None
    vertical: Annotated[
        str | None, Option("--points-vertical", f"Height datum of the points: {_VERTICAL_FORMS}.", "DATUM")
    ] = None
    pixel_origin: Annotated[str, _PIXEL_ORIGIN] = "corner"
    check: Annotated[str | None, _CHECK] = None
    select: Annotated[
        str | None,
        Option(
            "--select", "Points that control: N well spread, N of one region, these, or N at random; all others check.",
            "even:N|cluster:N|ids:A,B|random:N:SEED",
        ),
    ] = None  # fmt: skip
    correction: Annotated[
        str | None,
        Option(
            "--correction",
            "What is adjusted: the image points, or the parameters of the model itself, such as the exterior "
            "orientation of a frame.",
            unset="shift if there are control points",
            choices=CORRECTIONS,
        ),
    ] = None
    fit_model: Annotated[
        str | None,
        Option(
            "--fit-model",
            "Fit a model from the points alone (see 'ortho models'), in place of the image's own.",
            "NAME",
        ),
    ] = None
    model_crs: Annotated[
        str | None, Option("--model-crs", _MODEL_CRS, "CRS", unset="that of the points")
    ] = None  # fmt: skip
    prune: Annotated[bool, Option("--prune", "Remove parameters that the points do not justify.")] = False
    params: Annotated[str | None, Option("--params", "Adjust these parameters only.", "A,B,C", unset="all")] = None
    significance: Annotated[
        float,
        Option(
            "--significance", "Above this chance (p) a parameter is not justified.", kind="number", above=0, below=1
        ),
    ] = 0.05  # fmt: skip
    ridge: Annotated[
        str,
        Option("--ridge", "Regularisation of fitted models: found, or of this weight.", "auto|none|gcv|lcurve|W"),
    ] = "auto"
    near: Annotated[
        float | None,
        Option(
            "--near", "Points closer than this are neighbours in the analysis of residuals.", "M",
            kind="number", above=0,
        ),
    ] = None  # fmt: skip


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
        Option("--ties", Text(
            "Find tie points between the images by matching, besides those of ", Setting("points.points"), "."
        ), choices=("auto",)),
    ] = None  # fmt: skip
    gcps: Annotated[
        PathLike | None, Option("--gcps", "Ground of the points: CSV (id,x,y,h,...) or GeoJSON.", "FILE")
    ] = None
    crs: Annotated[str | None, Option("--points-crs", "CRS of the ground, where its file has none.", "CRS")] = None
    vertical: Annotated[
        str | None, Option("--points-vertical", f"Height datum of the ground: {_VERTICAL_FORMS}.", "DATUM")
    ] = None
    pixel_origin: Annotated[str, _PIXEL_ORIGIN] = "corner"
    check: Annotated[str | None, _CHECK] = None
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
            "--ground-sigma", "Sigmas (m) in plan and height of ground that states none in the points file.", "XY[,H]",
            unset="estimated",
        ),
    ] = None  # fmt: skip
    model_crs: Annotated[str | None, Option("--model-crs", _MODEL_CRS, "CRS")] = None
    hold: Annotated[
        float | None,
        Option(
            "--hold", "Hold the orientation at its start values with this sigma.", "PX", kind="number", above=0,
            unset="10 where nothing else gives a datum",
        ),
    ] = None  # fmt: skip


@documented
@dataclass(frozen=True)
class SurfaceOptions:
    """Where heights come from: a DEM, or one ellipsoidal height in metres."""

    dem: Annotated[
        PathLike | None,
        Option(
            "--dem", "Digital elevation model: a file, a pattern of the files that make one, a STAC item or "
            "collection, or 'auto' for the cells of the Copernicus DEM under the scene.", "FILE|URL|auto",
        ),
    ] = None  # fmt: skip
    vertical: Annotated[
        str | None, Option("--dem-vertical", f"Height datum of the DEM: {_VERTICAL_FORMS}.", "DATUM")
    ] = None
    override_vertical: Annotated[
        bool,
        Option(
            "--override-dem-vertical",
            Text("Believe ", Setting("surface.vertical"), " even where the DEM declares another datum."),
        ),
    ] = False
    fill: Annotated[
        str,
        Option(
            "--dem-fill",
            "Where the DEM has no height: stop, leave pixels out, take the nearest, or an ellipsoidal height.",
            "error|mask|nearest|M",
            kind="number or word",
        ),
    ] = "error"
    height: Annotated[
        float | None, Option("--height", "One ellipsoidal height, no DEM.", "M", kind="number")
    ] = None  # fmt: skip
    sigma: Annotated[
        float | PathLike | None,
        Option(
            "--dem-sigma", "Standard deviation of the heights, metres: a number or a raster, such as Copernicus' HEM.",
            "M|FILE", kind="number or word", unset="unknown",
        ),
    ] = None  # fmt: skip
    source: Annotated[
        PathLike | None,
        Option(
            "--dem-source", Text(
                "Where ", Setting("surface.dem", "auto"),
                " finds cells: a folder of them, or an address (https, s3, gs, az)."
            ), "DIR|URL", unset="the environment variable ORTHO_DEM_SOURCE, or the public bucket",
        ),
    ] = None  # fmt: skip


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
            "--resolution -tr", "Pixel size in units of the output CRS.", "X [Y]", unset="the ground sample distance",
            kind="one or two", above=0,
        ),
    ] = None  # fmt: skip
    extent: Annotated[
        Sequence[float] | None,
        Option(
            "--extent -te", "Bounds of the ortho, taken as they are.", "XMIN YMIN XMAX YMAX", kind="box",
            unset="the scene's footprint",
        ),
    ] = None  # fmt: skip
    like: Annotated[
        PathLike | None,
        Option(
            "--like", "Take CRS, resolution and extent from this raster, so that pixels fall on pixels.", "RASTER",
            kind="file",
        ),
    ] = None  # fmt: skip
    align: Annotated[
        bool, Option("--align -tap", Text("Widen ", Setting("output.extent"), " to whole multiples of the resolution."))
    ] = False  # fmt: skip
    resampling: Annotated[str, Option("--resampling -r", choices=RESAMPLING)] = "bilinear"
    bands: Annotated[
        Sequence[int] | None,
        Option(
            "--band -b", "Only these bands of the image, from 1, in this order.", "N[,...]", unset="all",
            kind="integers", above=0,
        ),
    ] = None  # fmt: skip
    dtype: Annotated[
        str | None,
        Option(
            "--output-type -ot", "Type of the pixels; values beyond its range are clamped.", "|".join(PIXEL_TYPES),
            unset="that of the image", choices=PIXEL_TYPES,
        ),
    ] = None  # fmt: skip
    nodata: Annotated[
        float | str | None,
        Option(
            "--nodata -dstnodata", "Value of pixels without an image.", "VALUE", kind="number or nan",
            unset="that of the image, or a mask",
        ),
    ] = None  # fmt: skip
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
            "--engine", "Our warper, or GDAL's with its own transformers, exactly (slow; for comparison).",
            choices=("ortho", "gdal"),
        ),
    ] = "ortho"  # fmt: skip
    memory: Annotated[
        int,
        Option(
            "--memory -wm", "Bound on windows and caches; or with a unit, such as 2GB.", "MB", kind="bytes",
            in_file=False,
        ),
    ] = 512_000_000  # fmt: skip
    threads: Annotated[
        int | None, Option("--threads", unset="all processors", kind="integer", above=0, in_file=False)
    ] = None
    tolerance: Annotated[
        float,
        Option(
            "--tolerance", "Bound on the warper's geometric error, in source pixels.", "PX", kind="number", above=0
        ),
    ] = 0.01  # fmt: skip
    accuracy_raster: Annotated[
        bool,
        Option(
            "--accuracy-raster", Text(
                "Write a raster of how accurate the ortho is at each place; ", Setting("surface.sigma"),
                " says how good the heights are."
            ),
        ),
    ] = False  # fmt: skip
    visibility: Annotated[
        str | None,
        Option(
            "--visibility", "Look for ground that other terrain hides: write a mask of it, or leave its pixels empty "
            "(with a surface model a true ortho).", choices=("mask", "nodata"),
        ),
    ] = None  # fmt: skip
    fill_from: Annotated[
        PathLike | None,
        Option(
            "--fill-from", Text(
                "Fill what ", Setting("output.visibility"), " leaves empty from this ortho, on any grid."
            ),
            "ORTHO", kind="file",
        ),
    ] = None  # fmt: skip
    angles: Annotated[
        bool,
        Option(
            "--angles", "Write angles of view at each place and, where the sun is known, of the sun, and which pixels "
            "lie in shadow.",
        ),
    ] = False  # fmt: skip
    sun: Annotated[
        Sequence[float] | None,
        Option(
            "--sun", Text("Azimuth and elevation of the sun, degrees, for ", Setting("output.angles"), "."), "AZ,EL",
            kind="pair", unset="that of the metadata",
        ),
    ] = None  # fmt: skip
    layer_step: Annotated[
        int,
        Option(
            "--layer-step", "Pixels of the ortho to one of the layers of accuracy and angles.", "N", kind="integer",
            above=0,
        ),
    ] = 16  # fmt: skip
    stac: Annotated[bool, Option("--stac", "Write a STAC item of the ortho too.")] = False
    acquired: Annotated[
        str | None, Option("--acquired", "Time of acquisition (RFC 3339), where the metadata have none.", "TIME")
    ] = None

    @property
    def files(self) -> dict[str, str | os.PathLike[str]]:
        """Rasters besides the image that an ortho is made with, by what they are."""
        given = {"other ortho": self.fill_from, "grid": self.like}
        return {role: path for role, path in given.items() if path is not None}


@documented
@dataclass(frozen=True)
class MatchOptions:
    """Control points without hands: the scene is matched with reference orthoimages."""

    reference: Annotated[
        Sequence[PathLike],
        Option(
            "--reference", "Orthoimages to take control points from by matching; where several show a place, the "
            "first.", "ORTHO[,...]", kind="files",
        ),
    ] = ()  # fmt: skip
    reference_bands: Annotated[
        Sequence[int] | None,
        Option(
            "--reference-bands", "Bands of the reference to compare, from 1.", "N[,...]", kind="integers", above=0,
            unset="the four with the most content",
        ),
    ] = None  # fmt: skip
    search: Annotated[
        float | None,
        Option(
            "--search", "How far the image's model may be off on the ground.", "M", kind="number", above=0,
            unset="three times the accuracy that the scene states, else 100",
        ),
    ] = None  # fmt: skip
    search_rotation: Annotated[
        float | None,
        Option(
            "--search-rotation", "How far the image's model may be turned (degrees; 180 for any angle).", "DEG",
            kind="number", above=0, below=180.001, unset="5 where the model comes from metadata on orbit or attitude, "
            "else none",
        ),
    ] = None  # fmt: skip
    points: Annotated[
        int,
        Option(
            "--match-points",
            "About how many matches are wanted.",
            "N",
            kind="integer",
            above=0,
            below=_MOST_MATCHES + 1,
        ),
    ] = 500
    reference_sigma: Annotated[
        float | None,
        Option(
            "--reference-sigma", "Standard deviation of where the reference lies as a whole, in each axis.", "M",
            kind="number", above=0,
        ),
    ] = None  # fmt: skip
    gcps_as: Annotated[
        str,
        Option(
            "--gcps-as", Text(
                "What ", Setting("points.gcps"), " are beside matches: a test that takes no part, or control too."
            ),
            choices=("check", "control"),
        ),
    ] = "check"  # fmt: skip


#: The groups, by the name that they have in messages, in the pipeline file and as arguments of the commands.
GROUPS: Mapping[str, type] = {
    "scene": SceneOptions, "points": PointOptions, "surface": SurfaceOptions, "match": MatchOptions,
    "output": OutputOptions,
}  # fmt: skip
