"""The report of a block as records: its JSON, its page and docs/block_report.schema.json follow them.

Numbers that do not exist are None. Residuals in images are measured minus predicted, in pixels (column, row); those on
the ground known minus adjusted, in metres east, north, up.
"""

from __future__ import annotations

from typing import Any, Literal

from ortho_pipeline.block.fit import BlockAdjustment
from ortho_pipeline.block.network import NetworkRecord
from ortho_pipeline.estimation.records import NoticeDocument
from ortho_pipeline.files.json.records import Count, Pair, Record, Words
from ortho_pipeline.report.records import InputFile, MapScaleRecord, RpcRecord, Size


class BlockImage(Record):
    """An image of the block, and the model that was adjusted.

    Where it lies is at the middle height of the points: `outline` has the longitudes and latitudes of its corners, from
    the first pixel along the first row. `ground_pixel_m` is the pixel there, along the row and along the column.
    `incidence_deg` is the angle of the line of sight from the vertical, `sensor_azimuth_deg` the azimuth in which the
    sensor stands. `covered` is the share (0 to 1) that its points speak for: their hull and half the
    distance between them.
    """

    path: str
    size: Size
    sensor: str
    model: str
    model_source: str
    facts: dict[str, str]
    rpc: RpcRecord | None
    outline: tuple[Pair, ...] | None
    ground_pixel_m: Pair | None = None
    incidence_deg: float | None
    sensor_azimuth_deg: float | None
    covered: float


class BlockProvenance(Record):
    """Files, options and versions with which the same result can be made again."""

    command: str | None
    inputs: tuple[InputFile, ...]
    options: dict[str, dict[str, Any]]
    software: dict[str, str]


class BlockHeadline(Record):
    """The accuracy in words: a figure, that of heights, a phrase that follows, and reservations."""

    figure: str
    height: str | None
    what: str
    notes: tuple[str, ...]


class AbsoluteAccuracy(Record):
    """Standard deviations on the ground, metres: medians over the points, with the errors of the datum.

    Control points count only where there are no others.
    """

    east_m: float
    north_m: float
    height_m: float
    points: Count


class RelativeAccuracy(Record):
    """Standard deviations of the relative positions of images with common points, where they are largest.

    They do not include the errors of the datum, which all images share.
    """

    pairs: Count
    median_px: float
    median_m: float
    worst_px: float


class BlockReport(Record):
    """The content of block_report.json. Numbers that do not exist are null."""

    document: Literal["ortho-pipeline block report"] = "ortho-pipeline block report"
    schema_version: Literal[1] = 1
    images: dict[str, BlockImage]
    adjustment: BlockAdjustment
    provenance: BlockProvenance
    warnings: tuple[Words, ...]
    notices: tuple[NoticeDocument, ...]
    headline: BlockHeadline
    network: NetworkRecord
    absolute: AbsoluteAccuracy | None
    relative: RelativeAccuracy | None
    map_scale: MapScaleRecord | None
