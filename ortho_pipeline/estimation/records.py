"""The published results of an adjustment: points, parameters and their tests, and root mean squares.

Missing numbers are None. A residual is measured minus predicted, in pixels (column, row).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self, TypeGuard

import numpy as np
import pydantic

from ortho_pipeline.estimation.blunders import OutlyingPoint
from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.estimation.spatial.shared_errors import SharedErrors
from ortho_pipeline.files.json.records import Count, Pair, Record, Words
from ortho_pipeline.models.base import Array

#: Of a point for which it may be unknown.
Residual = tuple[float | None, float | None]
Role = Literal["control", "check", "tie"]
#: A warning with its code and what it is about (docs/notices.md).
NoticeDocument = Annotated[
    dict[str, Any],
    pydantic.Field(
        json_schema_extra={
            "properties": {
                "code": {"type": "string", "pattern": "^[a-z0-9]+(-[a-z0-9]+)*$"},
                "text": {"type": "string"},
            },
            "required": ["code", "text"],
        }
    ),
]


def is_known(values: Residual | None) -> TypeGuard[Pair]:
    """Return whether both components of a vector are known."""
    return values is not None and None not in values


class Rmse(Record):
    """Root mean square in pixels."""

    col: float
    row: float
    total: float
    n: Count

    @classmethod
    def of(cls, residuals: Array) -> Self | None:
        """Return the record of residuals ``(N, 2)``; None without residuals."""
        if not len(residuals):
            return None
        col, row = (residuals**2).mean(axis=0)
        return cls(col=math.sqrt(col), row=math.sqrt(row), total=math.sqrt(col + row), n=len(residuals))


class RmseOnGround(Record):
    """Root mean square in metres on the ground."""

    x: float
    y: float
    total: float
    n: Count

    @classmethod
    def of(cls, shifts: Array) -> Self | None:
        """Return the record of shifts ``(N, 2)`` in metres; None without shifts."""
        rmse = Rmse.of(shifts)
        return None if rmse is None else cls(x=rmse.col, y=rmse.row, total=rmse.total, n=rmse.n)


class RmseOfView(Record):
    """Root mean square in pixels along and across the direction of view."""

    along: float
    across: float
    n: Count


class Rmses(Record):
    """RMSE of control points (the fit), of check points, and of control points left out one at a time (loo).

    If there are both measured and matched check points, `check` is absolute, of the measured ones, and `matched` is
    relative to the reference, of the matched ones.
    """

    control: Rmse | None
    check: Rmse | None
    loo: Rmse | None
    matched: Rmse | None = None


class RmsesOnGround(Record):
    """As `Rmses`."""

    control: RmseOnGround | None
    check: RmseOnGround | None
    loo: RmseOnGround | None
    matched: RmseOnGround | None = None


class RmsesOfView(Record):
    """RMSE of control points (the fit) and of check points."""

    control: RmseOfView | None
    check: RmseOfView | None


class Bias(Record):
    """Mean and scatter of the residuals of the model as delivered, over the used points."""

    col: float
    row: float
    std_col: float
    std_row: float
    n: Count


class Parameter(Record):
    """An adjusted parameter."""

    value: float
    sigma: float | None


class CommonError(Record):
    """An error common to many points, such as the error of a reference for its matches: metres true east and north.

    `estimate_m` is its estimate from other points, and `estimate_sigma_m` the standard deviation of the estimate.
    `per_sigma` is the error of each parameter per standard deviation of what remains; a block does not state it.
    """

    points: Count
    sigma_m: float
    estimate_m: Pair
    estimate_sigma_m: Pair
    per_sigma: tuple[Pair, ...] | None = None

    @classmethod
    def of(cls, common: CommonGroundError, gain: Array | None = None) -> Self:
        """Return the published record of the unknown, with the gain ``(P, 2)`` of the parameters of one image."""
        estimate, left = common.value * common.sigma, np.sqrt(np.diag(common.left)) * common.sigma
        found = {"points": common.points, "sigma_m": common.sigma, "estimate_m": estimate, "estimate_sigma_m": left}
        return cls.model_validate({**found, **({} if gain is None else {"per_sigma": gain})})


class Statistics(Record):
    """Tests of the parameters; ridge is the weight of the regularisation, condition the condition number."""

    correlation: tuple[tuple[float | None, ...], ...]
    total_correlation: dict[str, float | None]
    t: dict[str, float | None]
    p: dict[str, float | None]
    significance: float
    not_justified: tuple[str, ...]
    degrees_of_freedom: float | None
    effective_parameters: float | None
    ridge: float | None
    condition: float | None
    corner_ratio: float | None = None
    common_error: CommonError | None = None


class GroupedStatistics(Statistics):
    """Tests of the parameters if points have groups."""

    shared_errors: SharedErrors


class Point(Record):
    """A point in the image: `residual_m` is its position in the ortho minus its true position, metres east and north.

    `view_residual` is along and across the direction of view, `raw_residual` that of the model as delivered. `lon_lat`
    is its true position and `shown_lon_lat` its position in the ortho, degrees (WGS 84).
    """

    id: str
    role: Role
    used: bool
    image: Residual | None
    predicted: Residual | None
    residual: Residual | None
    loo_residual: Residual | None
    raw_residual: Residual | None = None
    residual_m: Residual | None = None
    view_residual: Residual | None = None
    height_m: float | None = None
    lon_lat: Residual | None = None
    shown_lon_lat: Residual | None = None

    @property
    def length(self) -> float | None:
        """Length of the residual in pixels."""
        return math.hypot(*self.residual) if is_known(self.residual) else None

    @property
    def kind(self) -> Literal["control", "check", "out"]:
        """The symbol of the point in drawings."""
        if self.role == "control" and not self.used:
            return "out"
        return "check" if self.role == "check" else "control"


class LeftOut(Record):
    """A point that was left out as a gross error."""

    id: str
    reason: str


class Adjustment(Record):
    """The adjusted model, and how well it fits the points."""

    model: str
    parameters: dict[str, Parameter]
    points: tuple[Point, ...]
    rmse: Rmses
    raw_bias: Bias | None
    redundancy: int
    sigma0: float | None
    rejected: tuple[LeftOut, ...]
    outlying: tuple[OutlyingPoint, ...] = ()
    rmse_of_agreeing_checks: Rmse | None = None
    warnings: tuple[Words, ...] = ()
    notices: tuple[NoticeDocument, ...] = ()
    statistics: Statistics | GroupedStatistics | None = None
