"""Options of a user, grouped as the pipeline takes them."""

# Annotations are read from the classes: as values, not as text.
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Protocol, runtime_checkable

from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options.option import CORRECTIONS, PIXEL_ORIGINS, Option, PathLike, documented
from ortho_pipeline.options.output import OutputOptions


@documented
@dataclass(frozen=True)
class SceneOptions:
    """How to open the image.

    Examples
    --------
    >>> op.SceneOptions(rpc="sidecar")
    SceneOptions(rpc='sidecar')
    """

    sensor: Annotated[
        str | None,
        Option("--sensor", "Sensor of the image; 'ortho sensors' lists them.", "NAME"),
    ] = None
    rpc: Annotated[
        str | None,
        Option("--rpc", "Which RPC to use, if there are several, or an RPC file.", "tag|sidecar|FILE"),
    ] = None
    model: Annotated[
        PathLike | None, Option("--model", "Use this saved *_model.json instead of the image's own model.", kind="file")
    ] = None
    crop_offset: Annotated[
        Sequence[float] | None,
        Option(
            "--crop-offset",
            "If the image is a crop: position of its first pixel in the full image.",
            "COL,ROW",
            kind="pair",
        ),
    ] = None
    sensor_options: Annotated[
        Mapping[str, str],
        Option("--sensor-option", "Option of the sensor; 'ortho sensors' lists them.", "K=V", kind="keys"),
    ] = field(default_factory=dict)
    ortho: Annotated[bool, Option("--ortho", "If no sensor recognises the image, open it as a finished ortho.")] = False
    allow_network: Annotated[
        bool, Option("--allow-network", "Allow URLs (http, https, s3, gs, az) and /vsi paths.", in_file=False)
    ] = False
    roots: Annotated[
        Sequence[PathLike],
        Option(
            "--root",
            "Also allow files in this folder, for example the sources of a VRT.",
            "DIR",
            kind="folders",
            in_file=False,
        ),
    ] = ()

    @property
    def access(self) -> dict[str, Any]:
        """Permissions to open files, as `raster.open_dataset` takes them."""
        return {"allow_network": self.allow_network, "roots": tuple(self.roots)}

    @property
    def files(self) -> dict[str, str | os.PathLike[str]]:
        """Files that the scene is read from, apart from the image, by role."""
        sensor_files = {name: value for name, value in self.sensor_options.items() if _is_file(value)}
        own = {"RPC": self.rpc, "model": self.model}
        return {**{role: path for role, path in own.items() if path is not None}, **sensor_files}


def _is_file(value: object) -> bool:
    """Return whether a text names a file, on disk or in an archive as GDAL writes it."""
    return isinstance(value, str | os.PathLike) and (os.fspath(value).startswith("/vsi") or os.path.isfile(value))


@runtime_checkable
class PointTable(Protocol):
    """Points that are read already: `ortho_pipeline.Points`."""

    @property
    def ids(self) -> tuple[str, ...]: ...
    @property
    def source(self) -> str: ...


#: Chips are held in memory, and more matches do not improve a model.
_MOST_MATCHES = 100_000
VERTICAL_FORMS = "ellipsoid, egm96, egm2008, EPSG:n or a grid file"
PIXEL_ORIGIN = Option(
    "--pixel-origin",
    "What (0, 0) is in CSV, ODM and link files: the outer corner or the centre of the first pixel. With -1, that "
    "place is (1, 1).",
    choices=tuple(PIXEL_ORIGINS),
)
CHECK = Option("--check", "Reserve these control points as check points: every Nth, or by id.", "every:N|ids:A,B")
MODEL_CRS = "Ground CRS of fitted models: geocentric, geographic, utm or EPSG:n."


@documented
@dataclass(frozen=True)
class PointOptions:
    """Points, and what to adjust to them.

    `gcps` may also be a table of points that is already read, in pixels of this image.

    Examples
    --------
    >>> op.PointOptions(gcps="gcps.csv", correction="shift")
    PointOptions(gcps='gcps.csv', correction='shift')
    """

    gcps: Annotated[
        PathLike | PointTable | None,
        Option(
            "--gcps",
            "Points file: CSV, GeoJSON, QGIS .points, ODM gcp_list.txt, ENVI .pts, ASP .gcp or ArcGIS link table. "
            "'own' takes the GCPs stored in the image.",
            "FILE|own",
        ),
    ] = None
    crs: Annotated[str | None, Option("--points-crs", "CRS of the points, if their file does not state it.", "CRS")] = (
        None
    )
    vertical: Annotated[
        str | None, Option("--points-vertical", f"Height datum of the points: {VERTICAL_FORMS}.", "DATUM")
    ] = None
    pixel_origin: Annotated[str, PIXEL_ORIGIN] = "corner"
    check: Annotated[str | None, CHECK] = None
    select: Annotated[
        str | None,
        Option(
            "--select",
            "Points to use as control: N well spread, N of one region, by id, or N at random. Others are check points.",
            "even:N|cluster:N|ids:A,B|random:N:SEED",
        ),
    ] = None
    correction: Annotated[
        str | None,
        Option(
            "--correction",
            "What to adjust: image coordinates (shift, shift-drift, affine), or the parameters of the model "
            "(model), such as the exterior orientation of a frame.",
            unset="a shift; with a reference, what the matches justify",
            choices=CORRECTIONS,
        ),
    ] = None
    fit_model: Annotated[
        str | None,
        Option(
            "--fit-model",
            "Fit this model to the points instead of using the image's own; 'ortho models' lists them.",
            "NAME",
        ),
    ] = None
    model_crs: Annotated[str | None, Option("--model-crs", MODEL_CRS, "CRS", unset="CRS of the points")] = None
    prune: Annotated[bool, Option("--prune", "Remove parameters that the points do not justify.")] = False
    params: Annotated[str | None, Option("--params", "Adjust only these parameters.", "A,B,C", unset="all")] = None
    significance: Annotated[
        float,
        Option(
            "--significance",
            "Significance level: a parameter with a larger p is not justified.",
            "P",
            kind="number",
            above=0,
            below=1,
        ),
    ] = 0.05
    ridge: Annotated[
        str,
        Option("--ridge", "Regularisation of fitted models: a method, or a weight W.", "auto|none|gcv|lcurve|W"),
    ] = "auto"
    near: Annotated[
        float | None,
        Option(
            "--near",
            "State the relative error of points closer than this.",
            "M",
            kind="number",
            above=0,
            unset="a distance with as many pairs as points",
        ),
    ] = None


@documented
@dataclass(frozen=True)
class SurfaceOptions:
    """Where the heights come from: a DEM, or one ellipsoidal height in metres.

    Examples
    --------
    >>> op.SurfaceOptions(dem="dem.tif", vertical="egm2008")
    SurfaceOptions(dem='dem.tif', vertical='egm2008')
    """

    dem: Annotated[
        PathLike | None,
        Option(
            "--dem",
            "DEM: a file, a pattern of files, or a STAC item or collection. 'auto' takes the cells of the Copernicus "
            "DEM under the scene.",
            "FILE|URL|auto",
        ),
    ] = None
    vertical: Annotated[
        str | None, Option("--dem-vertical", f"Height datum of the DEM: {VERTICAL_FORMS}.", "DATUM")
    ] = None
    override_vertical: Annotated[
        bool,
        Option(
            "--override-dem-vertical",
            Text("Use ", Setting("surface.vertical"), " even if the DEM declares another datum."),
        ),
    ] = False
    fill: Annotated[
        str,
        Option(
            "--dem-fill",
            "Gaps in the DEM: stop with an error, mask the pixels, take the nearest height, or ellipsoidal height M.",
            "error|mask|nearest|M",
            kind="number or word",
        ),
    ] = "error"
    height: Annotated[
        float | None,
        Option("--height", "Flat ground at this ellipsoidal height, instead of a DEM.", "M", kind="number"),
    ] = None
    sigma: Annotated[
        float | PathLike | None,
        Option(
            "--dem-sigma",
            "Accuracy of the heights (standard deviation): a number, or a raster such as Copernicus' HEM.",
            "M|FILE",
            kind="number or word",
            unset="not stated: matching and adjust estimate it, ties assumes 10",
        ),
    ] = None
    source: Annotated[
        PathLike | None,
        Option(
            "--dem-source",
            Text(
                "Where ",
                Setting("surface.dem", "auto"),
                " looks for cells: a folder, or an address (https, s3, gs, az).",
            ),
            "DIR|URL",
            unset="environment variable ORTHO_DEM_SOURCE, else the public bucket",
        ),
    ] = None


@documented
@dataclass(frozen=True)
class MatchOptions:
    """Automatic control points: the scene is matched with reference orthoimages.

    Examples
    --------
    >>> op.MatchOptions(reference=("reference.tif",), search=50.0)
    MatchOptions(reference=('reference.tif',), search=50.0)
    """

    reference: Annotated[
        Sequence[PathLike],
        Option(
            "--reference",
            "Orthoimages to match. Where several overlap, the first is used.",
            "ORTHO[,...]",
            kind="files",
        ),
    ] = ()
    reference_bands: Annotated[
        Sequence[int] | None,
        Option(
            "--reference-bands",
            "Bands of the reference to match, numbered from 1.",
            "N[,...]",
            kind="integers",
            above=0,
            unset="the four with the most content",
        ),
    ] = None
    search: Annotated[
        float | None,
        Option(
            "--search",
            "Search radius on the ground: the largest expected error of the image's position.",
            "M",
            kind="number",
            above=0,
            unset="three times the stated accuracy; if none is stated, 100 m (for a finished ortho 100 m or 30 pixels, "
            "whichever is larger), but at most a quarter of the image",
        ),
    ] = None
    search_rotation: Annotated[
        float | None,
        Option(
            "--search-rotation",
            "Largest expected rotation of the image's model, in degrees; 180 for any.",
            "DEG",
            kind="number",
            above=0,
            below=180.001,
            unset="5 if the model comes from orbit or attitude metadata, else 0",
        ),
    ] = None
    points: Annotated[
        int | None,
        Option(
            "--match-points",
            "Approximate number of matches.",
            "N",
            kind="integer",
            above=0,
            below=_MOST_MATCHES + 1,
            unset="500; fewer ties in small images, where neighbours would share pixels",
        ),
    ] = None
    reference_sigma: Annotated[
        float | None,
        Option(
            "--reference-sigma",
            "Accuracy of the reference: standard deviation of its position, per axis.",
            "M",
            kind="number",
            above=0,
        ),
    ] = None
    gcps_as: Annotated[
        str,
        Option(
            "--gcps-as",
            Text("Use of ", Setting("points.gcps"), " when matching: only as check points, or also as control."),
            choices=("check", "control"),
        ),
    ] = "check"

    @property
    def wanted(self) -> int:
        """Number of matches to look for."""
        return 500 if self.points is None else self.points


#: The groups, by the name that they have in messages, in the pipeline file and as arguments of the commands.
GROUPS: Mapping[str, type] = {
    "scene": SceneOptions,
    "points": PointOptions,
    "surface": SurfaceOptions,
    "match": MatchOptions,
    "output": OutputOptions,
}
