"""The report in words: the headline, the verdict on map scales, and what makes a figure untrue."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeGuard

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import (
    class_size,
    metres,
    px,
    size_m,
)
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.blunders import contradicting
from ortho_pipeline.estimation.choice.comparison import ComparisonRecord
from ortho_pipeline.estimation.records import Adjustment, Rmse, RmseOnGround, RmsesOnGround
from ortho_pipeline.models import families
from ortho_pipeline.report.map_scale import PIXEL, POSITION, scale_text, usual_scale
from ortho_pipeline.report.matching import MatchingRecord, Tested, is_relative
from ortho_pipeline.report.records import UNKNOWN, Headline, MapScaleRecord, SceneReport

#: ASPRS Positional Accuracy Standards (2023): no claim of accuracy below this number of check points.
ENOUGH_CHECK_POINTS = 30
#: From so many measured points on their figure leads before that of matches.
_LEADING = 3
#: In place of a map scale that an error makes untrue.
NO_SCALE = "No map scale until this error is corrected."
#: Errors that make a figure untrue, besides those that say by how much.
_UNTRUE = {
    "reference-made-of-scene": "the reference seems to be made from this scene, so the matches test nothing",
    "model-elsewhere": "the delivered model and the points are several images apart",
    "undecided-contradiction": "points contradict each other, and the block does not tell which one is wrong",
}
#: Notes of headlines that a notice says too, with what to do.
FEW = f"Fewer than {ENOUGH_CHECK_POINTS} check points: the accuracy is indicative (ASPRS 2023)."
NO_CHECK_POINTS = "There are no check points."
NOTICED = (FEW, NO_CHECK_POINTS)
#: Why the accuracy is unknown where control points determine the parameters and no more.
NOTHING_LEFT = "no point is left to test the fit"
#: The points that an accuracy is from.
Evidence = Literal["matched", "check", "delivered", "loo"]


def few_check_points(count: int) -> Notice:
    """Return the notice that there are too few check points for a claim of accuracy."""
    text = (
        f"{counted(count, 'check point')}: fewer than the {ENOUGH_CHECK_POINTS} that ASPRS 2023 asks for"
        if count
        else f"there are no check points; ASPRS 2023 asks for {ENOUGH_CHECK_POINTS}"
    )
    return Notice("few-check-points", text, count=count, enough=ENOUGH_CHECK_POINTS)


#: Measurements that are nearer to each other (px) are one point: files round.
_SAME_PLACE = 1e-3


def headline(
    adjustment: Adjustment,
    rmse_m: RmsesOnGround | None,
    before: Headline | None = None,
    *,
    adjusted: Mapping[str, Any] | None = None,
    matching: MatchingRecord | None = None,
) -> Headline:
    """Say how accurate the result is, in words, from the best evidence that there is.

    Parameters
    ----------
    rmse_m : RmsesOnGround, optional
        The accuracy on the ground, where it is known.
    before : Headline, optional
        What is said where there are no points (`delivered.accuracy_before`).
    adjusted : mapping, optional
        How the model was adjusted before; a point that took part then is no test now.
    matching : MatchingRecord, optional
        Where points were matched: their figures are relative to the reference.
    """
    again = points_again(adjustment, adjusted)
    if not adjustment.points or again:
        what = f"this model was adjusted to {again} of these points" if again else "there are no points"
        nothing = Headline(figure=UNKNOWN, metres=None, what=what, notes=())
        return nothing if again or before is None else before
    rmse, ground = adjustment.rmse, rmse_m or RmsesOnGround(control=None, check=None, loo=None)
    notes = [*_left_out_notes(adjustment), *fit_notes(adjustment), *_outlying_notes(adjustment)]
    if matching is not None and matching.relative is not None:
        return _of_matches(matching, matching.relative, notes)
    evidence, to = evidence_of(adjustment), ", relative to the reference" if is_relative(adjustment) else ""
    perhaps = "of a model that was adjusted before; a test only if it was adjusted to other points"
    if evidence == "check" and rmse.check:
        apart = f"that took no part in the adjustment{to}" if adjusted is None or adjusted.get("points") else perhaps
        what = f"RMSE at {counted(rmse.check.n, 'check point')} {apart}"
        if rmse.check.n < ENOUGH_CHECK_POINTS:
            notes.append(FEW)
        return _headline(rmse.check, ground.check, what, notes)
    if evidence == "delivered" and rmse.control:
        points = counted(rmse.control.n, "point")
        what = (
            f"RMSE at {points} {perhaps}"
            if adjusted is not None
            else f"RMSE at {points} of the model as delivered, which was not adjusted to them"
        )
        return _headline(rmse.control, ground.control, what, notes)
    notes.append(NO_CHECK_POINTS)
    if evidence == "loo" and rmse.loo:
        notes.append("An error common to all control points cannot be detected.")
        what = f"RMSE of {counted(rmse.loo.n, 'control point')}, each left out in turn{to}"
        return _headline(rmse.loo, ground.loo, what, notes)
    return Headline(figure=UNKNOWN, metres=None, what=NOTHING_LEFT, notes=tuple(notes))


def points_again(adjustment: Adjustment, adjusted: Mapping[str, Any] | None) -> int:
    """Return how many points that a test would be from took part when the model was adjusted before."""
    before = [one["image"] for one in (adjusted or {}).get("points") or () if one.get("used")]
    if not before or adjustment.parameters:
        return 0
    role = "check" if adjustment.rmse.check else "control"
    tests = [one.image for one in adjustment.points if one.role == role and one.image is not None]
    return sum(any(_is_near(one, other) for other in before) for one in tests)


def _is_near(one: Sequence[float | None], other: Sequence[float | None]) -> bool:
    return all(a is not None and b is not None and abs(a - b) < _SAME_PLACE for a, b in zip(one, other, strict=True))


def evidence_of(adjustment: Adjustment, matching: MatchingRecord | None = None) -> Evidence | None:
    """Return which points the accuracy is from; None where nothing tests the result.

    Control points test a model only if it was not adjusted to them, or if each is left out in turn.
    """
    rmse = adjustment.rmse
    if matching is not None and matching.relative is not None and not _leads(matching.absolute):
        return "matched" if rmse.matched else "check"
    if rmse.check:
        return "check"
    if rmse.control and not adjustment.parameters:
        return "delivered"
    return "loo" if rmse.loo and adjustment.redundancy else None


def _leads(absolute: Tested | None) -> TypeGuard[Tested]:
    """Tell whether so many points were measured that their figure leads before that of matches."""
    return absolute is not None and absolute.n >= _LEADING


def verdict(report: SceneReport) -> str:
    """Say which map scale the accuracy suffices for, and what sets the limit."""
    if refuted(report.notices):
        return NO_SCALE
    found = report.map_scale
    if found is None:
        if report.headline.figure == UNKNOWN:
            return "No map scale: there are no check points."
        return "No map scale: without measured check points the accuracy is relative to the reference."
    return fitness(found)


def refuted(notices: Iterable[Mapping[str, Any]]) -> str | None:
    """Say which error makes a figure of accuracy and a map scale untrue; None where there is none.

    Every output asks this: report, terminal, JSON, the page of a run and the STAC item.
    """
    for one in notices:
        if one["code"] == "checks-apart":
            what = "the block" if "rmse_m" in one else "the control points"  # a block has metres
            # Earlier versions did not count them.
            return contradicting(one.get("off", 0), one["count"], one["points"], what)
        if one["code"] == "heights-disagree":
            return _moving(f"the heights of points and DEM differ by {metres(abs(one['median_m']))}", one)
        if one["code"] == "surface-not-ground":
            return _moving(f"the surface is typically {metres(one['typical_m'])} from the points", one)
        if one["code"] in _UNTRUE:
            return _UNTRUE[one["code"]]
    return None


def _moving(cause: str, notice: Mapping[str, Any]) -> str:
    moved = notice.get("moved_m")
    return cause if moved is None else f"{cause}, which moves the ortho by {metres(moved)}"


def instead(figure: str, what: str, notices: Iterable[Mapping[str, Any]]) -> tuple[str, str] | None:
    """Return what a headline says in place of a figure that an error makes untrue, and a note; None where none does."""
    against = refuted(notices)
    if against is None or figure == UNKNOWN:
        return None
    return against, f"Do not rely on this figure: {figure}, {what}."


def corrected(head: Headline, notices: Iterable[Mapping[str, Any]]) -> Headline:
    """Return the headline of a scene as an error leaves it: without a figure that it makes untrue."""
    figure = f"{head.figure} ({head.metres})" if head.metres else head.figure
    found = instead(figure, head.what, notices)
    return (
        head if found is None else Headline(figure=UNKNOWN, metres=None, what=found[0], notes=(found[1], *head.notes))
    )


def unsettled(report: SceneReport) -> str | None:
    """Return what the headline adds: its figure is no accuracy yet; the figure without contradicting points."""
    for one in report.adjustment.notices:
        if one["code"] == "checks-apart":
            rest = one.get("rest")
            if rest is None:
                return "Not settled"
            more = "" if len(one["points"]) <= 3 else " and others"
            return f"Not settled: {px(rest)}{_on_ground(report, rest)} without {', '.join(one['points'][:3])}{more}"
    return None


def _on_ground(report: SceneReport, pixels: float) -> str:
    pixel = report.scene.ground_pixel_m
    return "" if pixel is None else f" ({metres(pixels * math.sqrt(pixel[0] * pixel[1]))})"


def option_of_choice(comparison: ComparisonRecord | None) -> Text | None:
    """Return the option with which other commands use the recommended model."""
    if comparison is None or comparison.recommendation.model is None:
        return None
    model = comparison.recommendation.model
    if model in {family.name for family in families()}:
        return Text(Setting("points.fit_model", model))
    return Text(Setting("points.correction", model.partition("+")[2] or "none"))


def runner_up(report: SceneReport) -> str | None:
    """Say how a recommended model compares to the others, and how far points that chose it are a test of it."""
    comparison = report.comparison
    if comparison is None or comparison.recommendation.model is None:
        return None
    chosen, checked = comparison.recommendation.model, comparison.recommendation.criterion == "check"
    found = {
        row.model: (_rms_of([row.rmse.check, row.rmse.loo if row.parameters else row.rmse.control]), row.parameters)
        for row in comparison.rows
        if not row.error and row.model != chosen
    }
    sizes = {name: size for name, (size, _) in found.items() if size is not None}
    if not sizes:
        return None
    nearest = min(sizes, key=lambda name: sizes[name])
    plain = next((name for name in sizes if not found[name][1]), None)
    told = (
        []
        if re.search(rf"(?<![\w+-]){re.escape(nearest)}(?![\w+-])", comparison.recommendation.reason)
        else [f"The next best model is {nearest} with {px(sizes[nearest])}"]
    )
    told += [] if plain is None or plain == nearest else [f"{plain} as supplied has {px(sizes[plain])}"]
    said = [f"{' and '.join(told)}."] if told else []
    if checked:
        said.append(
            "The check points took no part in the adjustments, but they helped to choose the model. So their RMSE can "
            "be a little too small; only other check points are an independent test."
        )
    return " ".join(said) or None


def _rms_of(parts: Iterable[Rmse | None]) -> float | None:
    """Return the root mean square over all points of some roles together."""
    known = [one for one in parts if one is not None]
    return math.sqrt(sum(one.n * one.total**2 for one in known) / sum(one.n for one in known)) if known else None


def fitness(found: MapScaleRecord, where: str = "") -> str:
    """Say which map scale an accuracy suffices for, `where`, and what sets the limit."""
    error, pixel = f"error ({size_m(found.rmse)})", f"pixel size ({size_m(found.pixel or 0.0)})"
    by_error, by_pixel = usual_scale(found.rmse / POSITION), usual_scale((found.pixel or 0.0) / PIXEL)
    limit, other, alone = (pixel, error, by_error) if found.limited_by == "pixel" else (error, pixel, by_pixel)
    if found.paper_scale is None:
        return f"Not good enough for a usual map scale{where}: the {limit} is too large."
    said = f"Good enough for maps at {scale_text(found.paper_scale)}{where}. The {limit} sets this limit"
    if found.pixel is None or alone == found.paper_scale:
        return f"{said}."
    return f"{said}; the {other} alone would allow {scale_text(alone)}."


def scale_rules(found: MapScaleRecord) -> list[tuple[str, str, str, str]]:
    """Return the rules that `fitness` and the standards go by: name, what it asks, what is found, and the result."""
    rows = [
        (
            "RMSE in plan",
            "at most 0.25 mm at map scale",
            metres(found.rmse),
            scale_text(usual_scale(found.rmse / POSITION)),
        )
    ]
    if found.pixel is not None:
        rows.append(
            (
                "Pixel size",
                "at most 0.1 mm at map scale; the larger of image and ortho",
                size_m(found.pixel),
                scale_text(usual_scale(found.pixel / PIXEL)),
            )
        )
    survey = f", check points themselves {metres(found.survey)}" if found.survey else ""
    needs = "" if found.claim else f" (a claim needs {ENOUGH_CHECK_POINTS} check points)"
    rows.append(
        (
            "ASPRS 2023, horizontal class",
            "RMSE including the error of the check points, rounded up",
            f"{found.rmse:.2f} m{survey}",
            f"{class_size(found.class_cm)}{needs}",
        )
    )
    rows.append(
        (
            "NMAS 1947",
            "90 % of the points within 1/30 inch at map scale (1/50 inch at 1:20,000 and smaller)",
            metres(found.ce90),
            scale_text(found.nmas_scale),
        )
    )
    return rows


def _of_matches(matching: MatchingRecord, relative: Tested, notes: list[str]) -> Headline:
    """Say what measured points tell, and apart from that how well matches agree that were held out.

    From three measured points on these lead: matches do not know where the reference lies.
    """
    said, absolute = matching.absolute_text(), matching.absolute
    apart = "that took no part in the adjustment"
    held_out = f"RMSE at {counted(relative.n, 'match', 'matches')} {apart}, relative to the reference"
    if not _leads(absolute):
        if said:
            notes = [f"{said} {FEW}", *notes]
        return Headline(
            figure=px(relative.px),
            metres=None if relative.m is None else metres(relative.m),
            what=held_out,
            notes=(matching.floor(), *notes),
        )
    ground = "" if relative.m is None else f" ({metres(relative.m)})"
    notes = [f"Relative: {px(relative.px)}{ground} {held_out}.", matching.floor(), *notes]
    if absolute.n < ENOUGH_CHECK_POINTS:
        notes.insert(0, FEW)
    what = f"RMSE at {counted(absolute.n, 'measured check point')} {apart}"
    on_ground = None if absolute.m is None else metres(absolute.m)
    return Headline(figure=px(absolute.px), metres=on_ground, what=what, notes=tuple(notes))


def _headline(rmse: Rmse, ground: RmseOnGround | None, what: str, notes: Iterable[str]) -> Headline:
    on_ground = None if ground is None else metres(ground.total)
    return Headline(figure=px(rmse.total), metres=on_ground, what=what, notes=tuple(notes))


def fit_notes(adjustment: Adjustment) -> list[str]:
    """Say how well the model fits its own control points."""
    control, parameters = adjustment.rmse.control, len(adjustment.parameters)
    if not control or not parameters:
        return []
    points = counted(control.n, "control point")
    if adjustment.redundancy:
        return [f"The fit: {px(control.total)} RMSE at {points}, redundancy {adjustment.redundancy}."]
    exactly = f"{counted(parameters, 'parameter')} always fit {points} exactly"
    return [f"No redundancy: {exactly}. This proves nothing about accuracy."]


def _left_out_notes(adjustment: Adjustment) -> list[str]:
    """Say how many control points were left out, and what it means if that is wrong."""
    if not adjustment.rejected:
        return []
    lost = counted(len(adjustment.rejected), "control point")
    several = " If you trust most of them, the model does not suit the scene." if len(adjustment.rejected) > 1 else ""
    return [f"{lost} left out.{several}"]


def _outlying_notes(adjustment: Adjustment) -> list[str]:
    """Say which check points contradict the others, and what the figure would be without them."""
    names = [one.id for one in adjustment.outlying if one.role == "check"]
    if not names or refuted(adjustment.notices):
        return []  # the verdict and a notice state it
    said = f"Probably wrong, but counted: check point{'s' if len(names) > 1 else ''} {', '.join(names)}"
    rest = adjustment.rmse_of_agreeing_checks
    return [f"{said}; without {px(rest.total)} at {counted(rest.n, 'check point')}." if rest else f"{said}."]
