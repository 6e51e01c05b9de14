"""The report of a scene as records: its JSON, its page, its plots and docs/report.schema.json follow them.

Numbers that do not exist are None. A residual is measured minus predicted, in pixels (column, row).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import pydantic

from ortho_pipeline.estimation.choice.comparison import ComparisonRecord
from ortho_pipeline.estimation.records import (
    Adjustment,
    Count,
    NoticeDocument,
    Pair,
    RmsesOfView,
    RmsesOnGround,
)
from ortho_pipeline.estimation.spatial.correlation import Covariances
from ortho_pipeline.files.json.records import Record, Words
from ortho_pipeline.points.control_hull import ControlHull
from ortho_pipeline.report.layers.accuracy import AccuracyLayer
from ortho_pipeline.report.layers.angles import AnglesLayer
from ortho_pipeline.report.map_scale import MapScaleRecord
from ortho_pipeline.report.matching import MatchingRecord
from ortho_pipeline.warp.job import WarpRecord

Size = tuple[Annotated[int, pydantic.Field(ge=1)], Annotated[int, pydantic.Field(ge=1)]]


# -- where it comes from ---------------------------------------------------------------------------------------------


class InputFile(Record):
    """A file that was read."""

    role: str
    path: str
    bytes: Count
    sha256: Annotated[str, pydantic.Field(pattern="^[0-9a-f]{64}$")]


class ImageFile(Record):
    """The image that was opened."""

    path: str
    size: Size


class Provenance(Record):
    """Files, options and versions with which the same result can be made again."""

    command: str | None = None
    inputs: tuple[InputFile, ...] = ()
    image: ImageFile | None = None
    sensor: str | None = None
    model_source: str | None = None
    points: dict[str, Any] | None = None
    surface: dict[str, Any] | None = None
    options: dict[str, dict[str, Any]] | None = None
    software: dict[str, str] | None = None
    network_bytes: int | None = None


class PixelOnGround(Record):
    """Size of a pixel on level ground, metres along and across the direction of view."""

    along_view: float
    across_view: float


class View(Record):
    """Direction of view in the middle of the image; azimuth from the ground to the sensor, null straight down."""

    incidence_deg: float
    sensor_azimuth_deg: float | None
    pixel_m: PixelOnGround


class SceneRecord(Record):
    """The scene; geometry is that of its middle, by the adjusted model. `middle_lon_lat` is at its reference height."""

    name: str
    size: Size
    sensor: str
    model_source: str
    facts: dict[str, Any]
    ground_pixel_m: Pair | None
    lean_m_per_m: float | None
    lean_azimuth_deg: float | None
    view: View | None = None
    middle_lon_lat: Pair | None = None


# -- accuracy --------------------------------------------------------------------------------------------------------


#: In place of a figure: nothing tests the result, or an error makes the figure untrue.
UNKNOWN = "Accuracy unknown"


class Headline(Record):
    """The accuracy in words: a figure, the same in metres, a phrase that follows, and reservations."""

    figure: str
    metres: str | None
    what: str
    notes: tuple[str, ...]


# -- heights and the ortho -------------------------------------------------------------------------------------------


class PointHeights(Record):
    """Heights of the points minus those of the DEM: median, robust standard deviation, and the largest with its point.

    `without` points are where the DEM has no height. Reports of version 0.6 have none of the last three.
    """

    median_m: float
    spread_m: float
    n: Count
    warning: str | None
    largest_m: float | None = None
    largest_at: str | None = None
    without: Count = 0


class FlatGround(Record):
    """Flat ground, metres above the ellipsoid."""

    coverage: float | None
    constant_height: float


class Dem(Record):
    """The DEM, and how its heights were understood."""

    coverage: float | None
    path: str
    crs: str | None = None
    declared_vertical: str | None = None
    declared_by: Literal["code", "name"] | None = None
    option: str | None = None
    override: bool = False
    vertical: str | None = None
    vertical_label: str | None = None
    metres_per_unit: float | None = None
    fill: str | float | None = None
    warnings: tuple[str, ...] = ()
    #: How far a block moved the DEM to the east and north, and raised it, metres.
    moved_m: Pair | None = None
    raised_m: float | None = None
    #: Of heights that were found: the cells that have land, those that have none, and those that the source lacks.
    cells: tuple[str, ...] = ()
    sea_cells: tuple[str, ...] = ()
    missing_cells: tuple[str, ...] = ()
    #: Of a STAC collection: the items' ids, the documents that lead to them, and what declares the height datum.
    items: tuple[str, ...] = ()
    documents: tuple[str, ...] = ()
    declared_in: Literal["files", "items"] | None = None


class RpcRecord(Record):
    """The adjusted model as RPC: exactly, or fitted to it."""

    exact: bool
    max_error_px: float


class OrthoRecord(Record):
    """The grid of the ortho; extent is left, bottom, right, top.

    `crs` is what programs read: a code (``EPSG:n``), or WKT where the CRS has none.
    """

    crs: str
    crs_name: str
    unit: str
    extent: tuple[float, float, float, float]
    resolution: Pair
    size: Size
    valid_share: float | None

    @property
    def crs_label(self) -> str:
        """The CRS as people read it: its code or its name."""
        return self.crs_name if "[" in self.crs else self.crs


class SceneReport(Record):
    """The content of <stem>_report.json. Numbers that do not exist are null."""

    document: Literal["ortho-pipeline report"] = "ortho-pipeline report"
    schema_version: Literal[1] = 1
    scene: SceneRecord
    adjustment: Adjustment
    rmse_m: RmsesOnGround
    view_rmse: RmsesOfView
    covariance: Covariances = Covariances()
    map_scale: MapScaleRecord | None = None
    control_hull: ControlHull | None = None
    comparison: ComparisonRecord | None
    matching: MatchingRecord | None = None
    heights: PointHeights | None
    surface: FlatGround | Dem | None
    rpc: RpcRecord | None
    ortho: OrthoRecord | None
    warp: WarpRecord | None
    accuracy: AccuracyLayer | None = None
    angles: AnglesLayer | None = None
    provenance: Provenance
    warnings: tuple[Words, ...]
    notices: tuple[NoticeDocument, ...] = ()
    headline: Headline

    @property
    def matched_places(self) -> frozenset[Pair]:
        """Places in the image that were looked for in a reference."""
        return frozenset() if self.matching is None else frozenset(one.image for one in self.matching.candidates)
