"""What an adjustment results in, as it is published: points, parameters and their tests, and root mean squares.

Numbers that do not exist are None. A residual is measured minus predicted, in pixels (column, row).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self, TypeGuard

import numpy as np
import pydantic

from ortho_pipeline.estimation.blunders import OutlyingPoint
from ortho_pipeline.estimation.observations.common_unknown import CommonUnknown
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
    """Tell whether a vector is known, in both axes."""
    return values is not None and None not in values


class Rmse(Record):
    """Root mean square in pixels."""

    col: float
    row: float
    total: float
    n: Count

    @classmethod
    def of(cls, residuals: Array) -> Self | None:
        """Return that of residuals ``(N, 2)``; None for no residuals."""
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
        """Return that of shifts ``(N, 2)`` in metres; None for none."""
        found = Rmse.of(shifts)
        return None if found is None else cls(x=found.col, y=found.row, total=found.total, n=found.n)


class RmseOfView(Record):
    """Root mean square in pixels along and across the direction of view."""

    along: float
    across: float
    n: Count


class Rmses(Record):
    """Over control points (the fit), check points, and control points left out in turn.

    Where check points were measured beside matches, `check` is of those, absolute, and `matched` of the matches that
    were held out, relative to their reference.
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
    """Over control points (the fit) and check points."""

    control: RmseOfView | None
    check: RmseOfView | None


class Bias(Record):
    """Mean and scatter of measured minus predicted of the model as delivered, over the used points."""

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
    """An error that points have in common, as matches that of their reference: metres true east and north.

    `estimate_m` is what other points tell of it, and `estimate_sigma_m` what that leaves.
    """

    points: Count
    sigma_m: float
    estimate_m: Pair
    estimate_sigma_m: Pair

    @classmethod
    def of(cls, common: CommonUnknown) -> Self:
        """Return what is published of the unknown."""
        estimate, left = common.value * common.sigma, np.sqrt(np.diag(common.left)) * common.sigma
        return cls(points=common.points, sigma_m=common.sigma, estimate_m=tuple(estimate), estimate_sigma_m=tuple(left))


class Statistics(Record):
    """Tests of the parameters; ridge is the regularisation, condition that of the design."""

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
    """Tests of the parameters where points have groups."""

    shared_errors: SharedErrors


class Point(Record):
    """A point in the image: `residual_m` is where the ortho shows it minus where it belongs, metres east and north.

    `view_residual` is along and across the direction of view, `raw_residual` of the model as delivered. `lon_lat` is
    where it belongs and `shown_lon_lat` where the ortho shows it, degrees (WGS 84).
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
        """Length of the residual, px."""
        return math.hypot(*self.residual) if is_known(self.residual) else None

    @property
    def kind(self) -> Literal["control", "check", "out"]:
        """The mark that it is drawn with."""
        if self.role == "control" and not self.used:
            return "out"
        return "check" if self.role == "check" else "control"


class LeftOut(Record):
    """A point that was left out as a gross error."""

    id: str
    reason: str


class Adjustment(Record):
    """The model that was adjusted to the points, and how well it fits them."""

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
