"""What the adjustment of a block results in, as it is published.

Numbers that do not exist are None. Residuals in images are measured minus predicted, in pixels (column, row); those on
the ground known minus adjusted, in metres east, north, up.
"""

from __future__ import annotations

import math

from ortho_pipeline.block.reliability.known_points import ContradictedPoint
from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.block.variances.components import VariancesRecord
from ortho_pipeline.estimation.records import CommonError, NoticeDocument, Parameter, Residual, Rmse, Role, SharedErrors
from ortho_pipeline.files.json.records import Count, Record, Words

Triple = tuple[float, float, float]
#: Of a point of which it may be unknown.
OnGround = tuple[float | None, float | None, float | None]


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


class BlockPoint(Record):
    """A point: its adjusted longitude, latitude and height, its sigma in metres, and known minus adjusted ground."""

    id: str
    role: Role
    used_ground: bool
    ground: OnGround
    sigma: OnGround
    residual: OnGround


class Ray(Record):
    """A point in an image: its residual at the adjusted ground, and at the known ground."""

    id: str
    image: str
    used: bool
    measured: Residual
    residual: Residual
    back_projected: Residual


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
