"""The report of a block as records: its JSON, its page and docs/block_report.schema.json follow them.

Numbers that do not exist are None. Residuals in images are measured minus predicted, in pixels (column, row); those on
the ground known minus adjusted, in metres east, north, up.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from ortho_pipeline.block.reliability.known_points import ContradictedPoint
from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.files.json.records import Record, Words
from ortho_pipeline.report.adjustment_records import (
    CommonError,
    Count,
    NoticeDocument,
    Pair,
    Parameter,
    Residual,
    Rmse,
    Role,
    SharedErrors,
)
from ortho_pipeline.report.records import InputFile, MapScaleRecord, RpcRecord, Size

Triple = tuple[float, float, float]
#: Of a point of which it may be unknown.
OnGround = tuple[float | None, float | None, float | None]


class BlockImage(Record):
    """An image of the block, and the model that was adjusted.

    Where it lies is at the middle height of the points: `outline` has the longitudes and latitudes of its corners, from
    the first pixel along the first row. `view` is the angle of the line of sight from the vertical and the azimuth in
    which the sensor stands, degrees. `covered` is the share (0 to 1) that its points speak for: their hull and half the
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
    incidence_deg: float | None
    sensor_azimuth_deg: float | None
    covered: float


class RmseByRole(Record):
    """Over the points of each role in one image."""

    control: Rmse | None
    check: Rmse | None
    tie: Rmse | None

    @property
    def all(self) -> Rmse | None:
        """Over the points of all roles."""
        return merged(self.control, self.check, self.tie)


class ImageRms(Record):
    """At the adjusted ground, at the known ground, and at the known ground with the models as they were."""

    residuals: RmseByRole
    back_projected: RmseByRole
    raw_residuals: RmseByRole


class AdjustedImage(Record):
    """The adjusted parameters of an image, and how well its rays fit."""

    parameters: dict[str, Parameter]
    rays: Count
    rms: ImageRms


class ObjectRms(Record):
    """Root mean squares on the ground, in plan and height, and the least and greatest residual."""

    x: float
    y: float
    h: float
    plan: float
    n: Count
    min: Triple
    max: Triple


class ObjectRmsByRole(Record):
    """Of control points, whose ground was used, and of check points, whose ground was not."""

    control: ObjectRms | None
    check: ObjectRms | None


class ImageVariance(Record):
    """The factor of the stated sigmas of measurements, and their part of the redundancy."""

    factor: float
    redundancy: float


class GroundVariance(Record):
    """The sigma of ground that states none, of how many points, and its part of the redundancy."""

    sigma: float | None
    points: Count
    redundancy: float


class UnstatedGround(Record):
    """In plan (each axis) and in height."""

    xy: GroundVariance
    h: GroundVariance


class VariancesRecord(Record):
    """Standard deviations of the observations, as stated or found; separable is whether they can be told apart."""

    image: ImageVariance
    unstated_ground: UnstatedGround
    separable: bool


class BlockPoint(Record):
    """A point: its adjusted longitude, latitude and height, its sigma in metres, and known minus adjusted ground."""

    id: str
    role: Role
    used_ground: bool
    ground: OnGround
    sigma: OnGround
    residual: OnGround


class ImagePairRecord(Record):
    """Two images, the number of points that both have rays of, and the median angle between these rays.

    `sigma_px` and `sigma_m` say how far they may be shifted against each other (standard deviation) along
    `azimuth_deg`, where that is most. A join beyond the limit is `weak`.
    """

    first: str
    second: str
    points: Count
    angle_deg: float
    sigma_px: float | None = None
    sigma_m: float | None = None
    azimuth_deg: float | None = None
    weak: bool = False


class Angles(Record):
    """The largest angle between two rays of each point, degrees, over the points that have two."""

    points: Count
    least: float
    median: float
    greatest: float


class NetworkRecord(Record):
    """What ties the images: pairs with points in common, the angles at which rays meet, parts that hang together.

    `largest_deg` has the largest angle of each point, in the order of the adjustment's points.
    """

    pairs: tuple[ImagePairRecord, ...]
    angles: Angles | None
    parts: tuple[tuple[str, ...], ...]
    largest_deg: tuple[float | None, ...]


class Ray(Record):
    """A point in an image: its residual at the adjusted ground, and at the known ground."""

    id: str
    image: str
    used: bool
    measured: Residual
    residual: Residual
    back_projected: Residual


class HeightsRecord(Record):
    """What a DEM said of the heights of ties: how many, their sigma, and the DEM's bias and shift, metres.

    `left_out` contradicted their ties, at breaks the DEM is no plane, `without` lie in voids. `sigma_is` says who says
    the sigma. Shifts are east and north.
    """

    used: Count
    left_out: Count
    at_breaks: Count
    without: Count
    sigma_m: float
    sigma_is: Literal["stated", "estimated", "assumed"]
    rms_m: float | None
    bias_m: float
    bias_sigma_m: float
    bias_prior_m: float
    shift_m: Pair
    shift_sigma_m: Pair
    shift_prior_m: float
    correlation_m: float | None


class BlockAdjustment(Record):
    """The adjustment of all images and points together; gauge names what defines the datum."""

    gauge: str
    sigma0: float | None
    redundancy: int
    degrees_of_freedom: float
    condition: float | None
    iterations: Count
    variances: VariancesRecord
    images: dict[str, AdjustedImage]
    object_rms: ObjectRmsByRole
    points: tuple[BlockPoint, ...]
    rays: tuple[Ray, ...]
    rejected: tuple[GrossError, ...]
    outlying: tuple[ContradictedPoint, ...]
    warnings: tuple[Words, ...]
    notices: tuple[NoticeDocument, ...]
    common_error: CommonError | None = None
    shared_errors: dict[str, SharedErrors] | None = None
    heights: HeightsRecord | None = None


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
    map_scale: MapScaleRecord | None


def merged(*parts: Rmse | None) -> Rmse | None:
    """Return the root mean squares of several groups together; None where there is no point."""
    groups = [part for part in parts if part]
    number = sum(part.n for part in groups)
    if not number:
        return None
    col, row = (
        sum(part.n * square**2 for part, square in zip(groups, squares, strict=True)) / number
        for squares in ([part.col for part in groups], [part.row for part in groups])
    )
    return Rmse(col=math.sqrt(col), row=math.sqrt(row), total=math.sqrt(col + row), n=number)
