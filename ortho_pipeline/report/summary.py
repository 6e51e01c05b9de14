"""What pages and the terminal say first: what the scene is, and the errors of its points as people know them."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.display.numbers import (
    area_km2,
    metres,
    plain_size,
    px,
    share,
    short,
    signed,
    size_m,
    size_text,
)
from ortho_pipeline.errors.texts import Text, counted
from ortho_pipeline.estimation.records import Bias, Parameter, Point, is_known
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array
from ortho_pipeline.report.block_records import BlockReport
from ortho_pipeline.report.map_scale import ce90_of
from ortho_pipeline.report.matching import is_relative
from ortho_pipeline.report.page.advice import Signal, signal_lines, signals
from ortho_pipeline.report.page.locator import place_of
from ortho_pipeline.report.page.ortho_map import Paper, degrees
from ortho_pipeline.report.records import UNKNOWN, Dem, FlatGround, SceneReport
from ortho_pipeline.report.wording import NO_SCALE, NOTICED, evidence_of, fit_notes, refuted

#: Ground that stays this close (m) to its given coordinates was held, not tested.
HELD = 0.0005
_AXES = ("x (east)", "y (north)", "z (height)")


@dataclass(frozen=True)
class AxisErrors:
    """Mean, standard deviation (None for one point) and RMSE of errors along an axis, metres."""

    axis: str
    mean: float
    std: float | None
    rmse: float


@dataclass(frozen=True)
class RoleErrors:
    """Errors of the points of a role on the ground; `role` is ``check``, ``matched`` or ``control``.

    `ce90` is of x and y, `le90` of z, both in metres.
    """

    role: str
    title: str
    n: int
    axes: tuple[AxisErrors, ...]
    ce90: float
    le90: float | None

    @classmethod
    def of(cls, role: str, title: str, errors: Array) -> RoleErrors:
        """Return those of errors ``(N, 2)`` or ``(N, 3)`` in metres, of at least one point."""
        spread = errors.std(axis=0, ddof=1) if len(errors) > 1 else [None] * errors.shape[1]
        rmse = np.sqrt((errors**2).mean(axis=0))
        rows = zip(_AXES, errors.mean(axis=0).tolist(), spread, rmse.tolist(), strict=False)
        axes = tuple(AxisErrors(axis, mean, None if std is None else float(std), rms) for axis, mean, std, rms in rows)
        le90 = ce90_of(errors[:, 2:]) if errors.shape[1] == 3 else None
        return cls(role, title, len(errors), axes, ce90_of(errors[:, :2]), le90)


def errors_of_points(report: SceneReport) -> list[RoleErrors]:
    """Return the errors of check points and of control points on the ground: where the ortho shows them minus truth."""
    adjustment, matched = report.adjustment, report.matched_places
    apart = adjustment.rmse.matched is not None
    relative = is_relative(adjustment)
    kinds: dict[str, list[Point]] = {"check": [], "matched": [], "control": []}
    for point in adjustment.points:
        if point.role == "check":
            kinds["matched" if apart and point.image in matched else "check"].append(point)
        elif point.kind == "control":
            kinds["control"].append(point)
    titles = {
        "check": "check points (measured)" if apart else "check points",
        "matched": "check points (matches)",
        "control": "control points (the fit)" if adjustment.parameters else "points (model as delivered)",
    }
    if relative and not apart:
        titles["check"] += " (relative to the reference)"
    found = []
    for role, points in kinds.items():
        errors = [point.residual_m for point in points if is_known(point.residual_m)]
        if errors:
            found.append(RoleErrors.of(role, titles[role], np.array(errors, dtype=np.float64)))
    return found


def errors_of_block(report: BlockReport) -> list[RoleErrors]:
    """Return the errors of check points and of control points of a block: adjusted minus known ground.

    Control that is held at its coordinates has none.
    """
    found = []
    for role, title in (("check", "check points"), ("control", "control points (the fit)")):
        rows = [one.residual for one in report.adjustment.points if one.role == role and None not in one.residual]
        errors = -np.array(rows, dtype=np.float64)
        if rows and not (role == "control" and np.abs(errors).max() < HELD):
            found.append(RoleErrors.of(role, title, errors))
    return found


def circular_error(report: SceneReport) -> float | None:
    """Return the CE90 (m) of the points that the headline is from; None where they give none."""
    if report.headline.figure == UNKNOWN:
        return None
    evidence = evidence_of(report.adjustment, report.matching)
    if evidence == "loo":
        return None if report.map_scale is None else report.map_scale.ce90
    role = "control" if evidence == "delivered" else evidence
    return next((one.ce90 for one in errors_of_points(report) if one.role == role), None)


def first_notes(report: SceneReport, said: Sequence[Signal]) -> list[str]:
    """Return the reservations of the headline without those of analysts, and without those that a notice states."""
    hidden = {*fit_notes(report.adjustment), *(NOTICED if said else ())}
    return [note for note in report.headline.notes if note not in hidden]


def signals_of(report: SceneReport) -> list[Signal]:
    """Return the notices of a report, the gravest first."""
    tested = report.headline.figure != UNKNOWN or refuted(report.notices) is not None
    return signals(report.warnings, report.notices, tested=tested)


def about(report: SceneReport) -> dict[str, str]:
    """Return what a scene is: when it was acquired and processed, its area and place, and the sensor."""
    output = (report.provenance.options or {}).get("output", {})
    area, place = _area(report), place_of(report)
    texts = {
        "Acquired": acquired([output.get("acquired") or report.scene.facts.get("acquired")]) or "unknown",
        "Processed": processed(),
        "Area": area and area_km2(area),
        "Place": place and place_text(place),
        "Sensor": sensors_text([report.scene.sensor], [report.scene.facts]),
    }
    return {key: text for key, text in texts.items() if text}


def about_block(report: BlockReport) -> dict[str, str]:
    """Return what the images of a block are, as `about`."""
    images = report.images.values()
    outlines = [np.array(image.outline) for image in images if image.outline]
    middle = np.concatenate(outlines).mean(axis=0) if outlines else None
    pixels = [max(image.ground_pixel_m) for image in images if image.ground_pixel_m]
    texts = {
        "Acquired": acquired(image.facts.get("acquired") for image in images) or "unknown",
        "Processed": processed(),
        "Area": area_km2(_area_of(outlines)) if outlines else None,
        "Place": None if middle is None else place_text(middle.tolist()),
        "Pixel": " to ".join(dict.fromkeys(map(size_m, (min(pixels), max(pixels))))) if pixels else None,
        "Sensor": sensors_text((image.sensor for image in images), (image.facts for image in images)),
    }
    return {key: text for key, text in texts.items() if text}


def _area_of(outlines: Sequence[Array]) -> float:
    """Return the area of outlines together, longitudes and latitudes, in square metres."""
    import shapely

    first = outlines[0][0]
    scale = metres_per_degree(np.array([[*first, 0.0]]))[0]
    # Over the antimeridian longitudes go on.
    shapes = [shapely.Polygon(((corners - first + 180.0) % 360.0 - 180.0) * scale) for corners in outlines]
    return float(shapely.union_all([shape.buffer(0) for shape in shapes]).area)


def _area(report: SceneReport) -> float | None:
    """Return the area that the ortho has pixels of, or that the image covers, square metres."""
    if report.ortho is not None:
        paper = Paper(report.ortho)
        scale = abs(float(np.linalg.det(paper.middle()[1])))
        share = report.ortho.valid_share
        area = paper.width * paper.height / scale * (1.0 if share is None else share) if scale else math.nan
    elif report.scene.ground_pixel_m is not None:
        area = math.prod(report.scene.size) * math.prod(report.scene.ground_pixel_m)
    else:
        return None
    return area if math.isfinite(area) and area > 0 else None


def acquired(times: Iterable[Any]) -> str | None:
    """Return the day on which images were acquired, or the first and the last; None where none is stated."""
    days = sorted({_day(str(one)) for one in times if one not in (None, "", "None")})
    return None if not days else days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"


def _day(text: str) -> str:
    try:
        time_ = datetime.fromisoformat(text.strip())
        return (time_ if time_.tzinfo is None else time_.astimezone(UTC)).date().isoformat()
    except (ValueError, OverflowError):
        return text[:40]


def processed() -> str:
    """Return the day of today, UTC; that of ``SOURCE_DATE_EPOCH``, as builds that are to be repeated state it."""
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    return time.strftime("%Y-%m-%d", time.gmtime(int(given) if given.isdecimal() and len(given) < 12 else None))


def place_text(place: Sequence[float]) -> str:
    """Return a longitude and a latitude in degrees and minutes."""
    lon, lat = (round(value * 60) / 60 for value in place)
    return f"{degrees(lat, 'NS')}, {degrees(lon, 'EW')}"


def sensors_text(names: Iterable[str], facts: Iterable[Mapping[str, Any]]) -> str:
    """Return the sensors of images, and of which satellites they are, where the metadata say so."""
    kinds = dict.fromkeys(names)
    named = (one.get("satellite") for one in facts)
    satellites = dict.fromkeys(str(name)[:40] for name in named if name not in (None, "", "None"))
    said = ", ".join(list(kinds)[:4])
    return f"{', '.join(list(satellites)[:4])} ({said})" if satellites else said


# -- the terminal ----------------------------------------------------------------------------------------------------


def summary_text(report: SceneReport) -> str:
    """Return the report as a screenful of text, without colours: accuracy, points, what to do, then details."""
    said = signals_of(report)
    lines = [*first_lines(report), *signal_lines(said)]
    lines += [Text(f"{key:<10}", value) for key, value in _detail_rows(report)]
    return Text.joined("\n", lines)


def first_lines(report: SceneReport) -> list[Text]:
    """Return what a scene is, its accuracy and the errors of its points, a text for each line."""
    known = about(report)
    acquired_ = "" if known["Acquired"] == "unknown" else f", acquired {known['Acquired']}"
    place = ", ".join(known[key] for key in ("Area", "Place") if key in known)
    rows = [
        ("scene", f"{report.scene.name}{acquired_}, sensor {known['Sensor']}"),
        *([("area", place)] if place else []),
        *_accuracy_rows(report),
        *(("", Text.read(note)) for note in first_notes(report, signals_of(report))),
    ]
    if report.map_scale or refuted(report.notices):
        rows.append(("map scale", report.map_scale.statement if report.map_scale else NO_SCALE))
    lines = [Text(f"{key:<10}", value) for key, value in rows]
    return [*lines, *map(Text, error_lines(errors_of_points(report)))]


def _accuracy_rows(report: SceneReport) -> list[tuple[str, str]]:
    head, ce90 = report.headline, circular_error(report)
    if head.figure == UNKNOWN:
        return [("accuracy", f"unknown: {head.what}")]
    circle = "" if ce90 is None else f", CE90 {metres(ce90)}"
    figure = f"{head.figure}{circle}" if head.metres is None else f"{head.metres}{circle} ({head.figure} in the image)"
    return [("accuracy", figure), ("", head.what)]


def error_lines(roles: Sequence[RoleErrors]) -> list[str]:
    """Return a table of the errors of points, metres: a line for each axis of each role."""
    if not roles:
        return []
    wide = max(len(one.title) for one in roles) + 1
    lines = [f"{'errors, m':<{wide}} {'points':>6}  {'':<10} {'mean':>8} {'std. dev.':>9} {'RMSE':>8}"]
    for one, rows in error_table(roles):
        for number, (axis, mean, std, rmse) in enumerate(rows):
            name, count = ("", "") if number else (one.title, str(one.n))
            lines.append(f"{name:<{wide}} {count:>6}  {axis:<10} {mean:>8} {std:>9} {rmse:>8}")
    return lines


def error_table(roles: Sequence[RoleErrors]) -> list[tuple[RoleErrors, list[tuple[str, ...]]]]:
    """Return the errors of each role as texts: axis, mean, standard deviation, RMSE; in centimetres or millimetres."""
    found = []
    for one in roles:
        digits = 2 if max(axis.rmse for axis in one.axes) >= 0.1 else 3
        found.append((one, [_texts(row, digits) for row in one.axes]))
    return found


def _texts(row: AxisErrors, digits: int) -> tuple[str, ...]:
    numbers = [None if value is None else round(value, digits) + 0.0 for value in (row.mean, row.std, row.rmse)]
    signs = ("+" if numbers[0] else "", "", "")
    texts = ["–" if value is None else f"{value:{sign}.{digits}f}" for value, sign in zip(numbers, signs, strict=True)]
    return row.axis, *(text.replace("-", "−") for text in texts)


def _detail_rows(report: SceneReport) -> list[tuple[str, str]]:
    """Return what analysts and operators look up: model, fit, heights, ortho and warp."""
    adjustment = report.adjustment
    values = [f"{name} {_parameter(entry)}" for name, entry in adjustment.parameters.items()]
    rows = [("model", f"{adjustment.model} of {report.scene.model_source}")]
    rows += [("", ", ".join(values))] if values else []
    if raw := adjustment.raw_bias:
        rows.append(("raw bias", f"{_bias(raw)} (measured minus delivered model, {counted(raw.n, 'point')})"))
    rows += [("fit", note.removeprefix("The fit: ")) for note in fit_notes(adjustment)]
    named = {one.get("point") for one in report.notices if one["code"] == "left-out"}
    rows += [("left out", f"{one.id}: {one.reason}") for one in adjustment.rejected if one.id not in named]
    if report.matching:
        rows.append(("matching", report.matching.text()))
    if report.surface:
        rows.append(("heights", _surface_text(report.surface)))
    if ortho := report.ortho:
        steps = " x ".join(short(step) for step in ortho.resolution)
        rows.append(("ortho", f"{size_text(ortho.size)} px of {steps} {ortho.unit}, {ortho.crs_label}"))
    if warp := report.warp:
        by = f" (GDAL's {warp.transformer} transformer)" if warp.transformer else ""
        rows.append(("warp", f"at most {px(warp.max_error_px)} from the exact model{by}"))
        if warp.hidden_share is not None:
            filled = "" if warp.filled_share is None else f"; {share(warp.filled_share)} filled from another ortho"
            rows.append(("visible", f"{share(1.0 - warp.hidden_share)} of the area of the image{filled}"))
    if read := report.provenance.network_bytes:
        rows.append(("network", f"{plain_size(read)} read"))
    return rows


def _bias(raw: Bias) -> str:
    return f"column {signed(raw.col)} px, row {signed(raw.row)} px"


def _parameter(entry: Parameter) -> str:
    return f"{short(entry.value, '+')} ±{short(entry.sigma)}"


def _surface_text(surface: FlatGround | Dem) -> str:
    if isinstance(surface, FlatGround):
        return f"flat ground at {metres(surface.constant_height)} above the ellipsoid"
    covered = "" if surface.coverage is None else f", covers {share(surface.coverage)} of the scene"
    items = f"{counted(len(surface.items), 'item')} of " if surface.items else ""
    return f"{items}{Path(surface.path).name}, heights above {surface.vertical_label}{covered}"
