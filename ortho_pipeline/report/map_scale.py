"""Map scales that the accuracy suffices for: by a rule of the OrbView-3 paper, ASPRS 2023, and NMAS.

All three take the errors on the ground (where the ortho shows a point minus where it belongs, on the assumption that
the DEM is right there) of points that took no part in the adjustment. Points that contradict the others count.

- The paper: a position to 0.25 mm in the map (2.5 m for 1:10,000), and pixels of at most 0.1 mm in it (1 m): those of
  the image or of the ortho, whichever are larger.
- ASPRS 2023: the horizontal accuracy class is the RMSE of both axes together, with that of the check points' own
  coordinates, in whole centimetres; no class may be claimed with fewer than 30 check points.
- NMAS: of the points tested at most one in ten is off by more than 1/30 inch in the map, or 1/50 inch at 1:20,000 and
  smaller scales. So the largest such scale is asked for among the usual ones: the rule has a step.

Source: Bueyueksalih et al. (OrbView-3), conclusion; ASPRS Positional Accuracy Standards for Digital Geospatial Data,
edition 2 (2023), horizontal accuracy; United States National Map Accuracy Standards (1947), paragraph 1.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
import pydantic

from ortho_pipeline.display.numbers import class_size
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import in_metres
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.models.base import Array

Evidence = Literal["check", "delivered", "loo"]
Limit = Literal["pixel", "accuracy"]

#: Denominators of the usual scales of maps.
SCALES = tuple(int(step * 10**power) for power in range(2, 7) for step in (1, 2, 2.5, 5))
#: ASPRS 2023: fewer check points support no claim.
ENOUGH_CHECK_POINTS = 30
#: In the map, metres: what the paper asks of positions and of pixels.
POSITION, PIXEL = 0.25e-3, 0.1e-3
#: NMAS: 1/30 inch at scales larger than 1:20,000, 1/50 inch from there on.
_INCH, _STEP = 0.0254, 20_000


class MapScaleRecord(Record):
    """The largest map scales that the accuracy suffices for; docs/accuracy.md says what each number is."""

    # A scale is its denominator, None where even 1:5,000,000 is too large. Only check points and those of a delivered
    # model are independent of the adjustment. At most one point in ten exceeds ce90 (m); class_cm is that of ASPRS
    # 2023, survey (m) the RMSE of the check points themselves in it (0: not stated), claim whether it may be claimed.
    evidence: Evidence
    n: Annotated[int, pydantic.Field(ge=1)]
    rmse: float
    ce90: float
    pixel: float | None
    paper_scale: int | None
    limited_by: Limit | None
    class_cm: int
    survey: float
    claim: bool
    nmas_scale: int | None
    statement: str


def map_scale(fit: Fit, pixel: float | None) -> MapScaleRecord | None:
    """Return the map scales that a fit suffices for; None where nothing tests it.

    Parameters
    ----------
    pixel : float, optional
        Size of a pixel on the ground, metres: the larger of image and ortho.
    """
    for evidence, residuals in _evidence(fit).items():
        errors = in_metres(fit, residuals)
        tested = np.isfinite(errors).all(axis=1)
        if tested.any():
            sigmas = fit.points.sigma_ground[tested, :2] if evidence != "loo" else np.zeros((1, 2))
            return judge(errors[tested], evidence, pixel, float(np.sqrt((sigmas**2).sum(axis=1).mean())))
    return None


def _evidence(fit: Fit) -> dict[Evidence, Array]:
    """Return residuals (px) by what they are evidence of, the best first; NaN for points that are none."""
    if not len(fit.points):
        return {}
    # A scale is a claim about the ground: points that were matched are relative to another image.
    measured = (fit.points.groups < 0)[:, None]
    found: dict[Evidence, Array] = {"check": np.where(fit.points.check[:, None] & measured, fit.residuals, np.nan)}
    if not len(fit.param_names):
        found["delivered"] = np.where(fit.used[:, None] & measured, fit.residuals, np.nan)
    elif fit.redundancy > 0:
        found["loo"] = np.where(measured, fit.loo_residuals, np.nan)
    return found


def ce90_of(errors: Array) -> float:
    """Return the size that at most one in ten of errors ``(N, K)`` in metres exceeds; of few, the largest."""
    return float(np.sort(np.linalg.norm(errors, axis=1))[len(errors) - 1 - len(errors) // 10])


def judge(errors: Array, evidence: Evidence, pixel: float | None, survey: float = 0.0) -> MapScaleRecord:
    """Return the verdicts on errors ``(N, 2)`` in metres of at least one point.

    The pixel counts in two digits: 2.503 m is a pixel of 2.5 m.
    """
    pixel = None if pixel is None else float(f"{pixel:.2g}")
    squares = (errors**2).sum(axis=1)
    count, rmse = len(squares), float(np.sqrt(squares.mean()))
    ce90 = ce90_of(errors)
    limited: Limit | None = None if pixel is None else ("pixel" if pixel / PIXEL > rmse / POSITION else "accuracy")
    paper = usual_scale(max(rmse / POSITION, (pixel or 0.0) / PIXEL))
    nmas = next((scale for scale in SCALES if ce90 <= nmas_limit(scale) * (1 + 1e-9)), None)
    found = MapScaleRecord(
        evidence=evidence,
        n=count,
        rmse=rmse,
        ce90=ce90,
        pixel=pixel,
        paper_scale=paper,
        limited_by=limited,
        class_cm=math.ceil(100 * math.hypot(rmse, survey) - 1e-9),
        survey=survey,
        claim=evidence != "loo" and count >= ENOUGH_CHECK_POINTS,
        nmas_scale=nmas,
        statement="",
    )
    return found.replaced(statement=_statement(found))


def _statement(found: MapScaleRecord) -> str:
    """Return the map scale in words, with what it rests on."""
    base = {
        "check": counted(found.n, "check point"),
        "delivered": f"{counted(found.n, 'point')} of the delivered model",
        "loo": f"{counted(found.n, 'control point')} left out in turn",
    }[found.evidence]
    by = {"pixel": " (limited by the pixel size)", "accuracy": " (limited by the error)", None: ""}[found.limited_by]
    said = f"{scale_text(found.paper_scale, none='no usual map scale')}{by}."
    if not found.claim:
        asks = "30 check points" if found.evidence != "check" else "30"
        return f"{said} Indicative: {base}; ASPRS 2023 asks for {asks}."
    said += f" ASPRS 2023 class {class_size(found.class_cm)} at {base}."
    return said if found.survey else f"{said} It does not include the error of the check points themselves."


def usual_scale(smallest: float) -> int | None:
    """Return the first usual denominator from the smallest possible on, None beyond the last."""
    # A hair, so that an RMSE of 2.5 m serves 1:10,000.
    return next((scale for scale in SCALES if scale >= smallest * (1 - 1e-9)), None)


def nmas_limit(scale: float) -> float:
    """Return how far (m) nine of ten points may be off in a map of a scale (its denominator) by NMAS."""
    return scale * _INCH / (30 if scale < _STEP else 50)


def scale_text(denominator: int | None, none: str = "no usual scale") -> str:
    """Return a map scale as people write it, such as ``1:25,000``."""
    return none if denominator is None else f"1:{denominator:,}"
