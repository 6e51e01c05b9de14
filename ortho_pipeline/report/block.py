"""The report of a block: one record of images, rays and points, as JSON, as a page, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ortho_pipeline.block.fit import BlockAdjustment, BlockFit, BlockPoint, Ray, merged
from ortho_pipeline.block.heights.record import HeightsRecord
from ortho_pipeline.block.network import NetworkRecord
from ortho_pipeline.block.shared.priors import SharedParameterRecord
from ortho_pipeline.block.variances.components import VariancesRecord
from ortho_pipeline.display.drawing import Drawing, round_down, style_sheet
from ortho_pipeline.display.notices import Notice, doubted, to_document
from ortho_pipeline.display.numbers import metres, px, significant, size_m
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors.texts import Text, counted
from ortho_pipeline.estimation.blunders import contradicting
from ortho_pipeline.estimation.records import Rmse, is_known
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.points.rows import ROLES
from ortho_pipeline.report.block_records import (
    AbsoluteAccuracy,
    BlockHeadline,
    BlockImage,
    BlockProvenance,
    BlockReport,
    RelativeAccuracy,
)
from ortho_pipeline.report.matching import RELATIVE
from ortho_pipeline.report.network.cards import PICTURES, card, rays_by_image
from ortho_pipeline.report.network.drawing import plot_network
from ortho_pipeline.report.network.facts import displaced_checks, found_network, placed, suffices_for, thinly_covered
from ortho_pipeline.report.page.advice import WORDS, Signal, shortened, signal_lines, signals
from ortho_pipeline.report.page.behaviour import policy, script
from ortho_pipeline.report.page.locator import plot_locator
from ortho_pipeline.report.records import UNKNOWN, RpcRecord
from ortho_pipeline.report.summary import (
    HELD,
    RoleErrors,
    about_block,
    error_lines,
    error_table,
    errors_of_block,
)
from ortho_pipeline.report.wording import (
    ENOUGH_CHECK_POINTS,
    FEW,
    NO_SCALE,
    NOTHING_LEFT,
    NOTICED,
    fitness,
    instead,
    refuted,
    scale_rules,
)

if TYPE_CHECKING:
    from ortho_pipeline.block.start import Start
    from ortho_pipeline.exchange.rpc_fit import RpcExport

#: Rays that are drawn of each image, points that are listed on the page.
_DRAWN_RAYS, _LISTED = 400, 400
#: What makes points of known ground a test.
KEPT_OUT = "whose ground coordinates were not used"
TIED = "their image measurements were used as tie points"
#: What the headline says of a block that only ties hold together.
_NO_CHECKS = "there are no check points"
#: A frame's side, the longest arrow in it, and the margin in which arrows of points at its edge end.
_SIDE, _ARROW, _MARGIN = 420.0, 44.0, 48.0
#: What parameters of a camera are called, with the unit in which people read lengths.
_CAMERA = {
    "focal_length": ("focal length", "mm"),
    **{f"{axis}0": (f"principal point {axis}", "mm") for axis in "xy"},
    "pitch_y": ("height of a pixel", "mm"),
    **{name: (f"radial distortion {name}", "") for name in ("k1", "k2", "k3")},
    **{name: (f"tangential distortion {name}", "") for name in ("p1", "p2")},
}


def build_report(
    *,
    fit: BlockFit,
    starts: Mapping[str, Start],
    exported: Mapping[str, RpcExport],
    provenance: Mapping[str, Any],
    warnings: Sequence[Notice],
    join_limit: float = math.inf,
    dem_unused: bool = False,
) -> BlockReport:
    """Collect everything that the report says (docs/engineering/formats.md)."""
    places = placed(fit, starts)
    network, of_network = found_network(fit, join_limit, dem_unused)
    pixel = max((max(place["ground_pixel_m"] or (0.0,)) for place in places.values()), default=0.0) or None
    suffices = suffices_for(fit, pixel)
    images = {}
    for label, start in starts.items():
        found = exported.get(label)
        images[label] = BlockImage(
            path=str(start.scene.path),
            size=(start.scene.width, start.scene.height),
            sensor=start.scene.sensor,
            model=start.name,
            model_source=start.source,
            facts={str(key): str(value) for key, value in start.scene.facts.items()},
            rpc=None if found is None else RpcRecord(exact=found.exact, max_error_px=found.max_error_px),
            **places[label],
        )
    adjustment = fit.record
    noted = to_document([*warnings, *of_network, *thinly_covered(places), *displaced_checks(fit)])
    return BlockReport(
        images=images,
        adjustment=adjustment,
        provenance=BlockProvenance.model_validate(json_value(provenance)),
        warnings=tuple(noted["warnings"]),
        notices=tuple(noted["notices"]),
        headline=_corrected(
            headline(adjustment, relative=any(one.code == RELATIVE for one in warnings), pixel=pixel), noted["notices"]
        ),
        network=network,
        absolute=_absolute(fit),
        relative=_relative(network),
        map_scale=None if refuted(noted["notices"]) else suffices,
    )


# -- words -----------------------------------------------------------------------------------------------------------


def headline(adjustment: BlockAdjustment, *, relative: bool = False, pixel: float | None = None) -> BlockHeadline:
    """Say how accurate the block is from the best evidence that there is: check points.

    Neither the fit of control points nor how well ties agree is evidence. Matches are `relative` to their reference;
    they are seen in one image each, and measured check points in two or more come first. `pixel` is the largest on the
    ground, m.
    """
    to = ", relative to the reference" if relative else ""
    notes = [f"{adjustment.gauge[0].upper()}{adjustment.gauge[1:]}."]

    def said(figure: str, what: str, height: str | None = None) -> BlockHeadline:
        return BlockHeadline(figure=figure, height=height, what=what, notes=tuple(notes))

    if known := adjustment.object_rms.check:
        if known.n < ENOUGH_CHECK_POINTS:
            notes.append(FEW)
        part = "" if pixel is None else f" ({px(known.plan / pixel)} of {size_m(pixel)})"
        what = f"RMSE in plan{part} and height at {counted(known.n, 'check point')}, {KEPT_OUT}; {TIED}"
        return said(metres(known.plan), what, metres(known.h))
    # The ground of control is held by its sigma: how well it fits is to be seen in the images.
    seen = [image.rms.back_projected for image in adjustment.images.values()]
    if check := merged(*(one.check for one in seen)):
        what = f"RMSE of {counted(check.n, 'measurement')} of check points in the images{to}"
        return said(px(check.total), f"{what}, {KEPT_OUT}; {TIED}")
    control = merged(*(one.control for one in seen))
    if adjustment.object_rms.control and control:
        if not adjustment.redundancy:
            return said(UNKNOWN, NOTHING_LEFT)
        fit = f"{px(control.total)} RMSE of {counted(control.n, 'measurement')} of control points in the images{to}"
        notes.insert(0, f"The fit: {fit}. This does not test the accuracy.")
        return said(UNKNOWN, _NO_CHECKS)
    sizes = [math.hypot(*ray.residual) for ray in adjustment.rays if ray.used and is_known(ray.residual)]
    if sizes:
        of = counted(len(sizes), "image measurement")
        agree = f"The images agree to {px(float(np.median(sizes)))} (median residual of {of})."
        notes.insert(0, f"{agree} This tests neither positions nor heights.")
    return said(UNKNOWN, _NO_CHECKS)


def _corrected(head: BlockHeadline, notices: Sequence[Mapping[str, Any]]) -> BlockHeadline:
    """Return the headline as an error leaves it: without a figure that it makes untrue."""
    found = instead(f"{head.figure} and {head.height}" if head.height else head.figure, head.what, notices)
    return (
        head
        if found is None
        else BlockHeadline(figure=UNKNOWN, height=None, what=found[0], notes=(found[1], *head.notes))
    )


def verdict(report: BlockReport) -> str | None:
    """Say which known points contradict the block, and what the accuracy suffices for; None where there is neither."""
    if refuted(report.notices):
        return NO_SCALE
    said = []
    for role in ("check", "control"):
        names = list(dict.fromkeys(one.point for one in report.adjustment.outlying if one.role == role))
        if names:
            known = [one for one in report.adjustment.points if one.role == role and one.residual != (None, None, None)]
            against = contradicting(len(names), len(known), names, "the block", role)
            said.append(f"{against}{_without(known, names) if role == 'check' else ''}.")
    if report.map_scale is not None:
        part = any(one["code"] == "points-cover-part" for one in report.notices)
        where = " in plan" + (", where there are points" if part else "")
        said.append(f"{fitness(report.map_scale, where)} This does not cover heights.")
    return " ".join(said) or None


def _without(known: Sequence[BlockPoint], names: Sequence[str]) -> str:
    """Say what the RMSE of check points is without some, and that these therefore do not decide it."""
    rest = np.array([one.residual for one in known if one.id not in names], dtype=float)
    if not len(rest):
        return ""
    squares = rest**2
    plan, height = (math.sqrt(np.nanmean(part)) for part in (squares[:, 0] + squares[:, 1], squares[:, 2]))
    it = "it" if len(names) == 1 else "them"
    return f": without {it} {metres(plan)} in plan and {metres(height)} in height"


def summary_text(report: BlockReport) -> str:
    """Return the report as a screenful of text."""
    adjustment, head = report.adjustment, report.headline
    wide = max([5, *map(len, report.images)])
    lines = [f"{'image':<{wide}}  {'rays':>6}  {'residuals col, row (px)':>24}  {'at check points (px)':>21}  model"]
    for label, image in report.images.items():
        found = adjustment.images[label]
        pairs = f"  {_pair(found.rms.residuals.all):>24}  {_pair(found.rms.back_projected.check):>21}"
        lines.append(f"{label:<{wide}}  {found.rays:>6}{pairs}  {image.model} of {image.model_source}")
    for role, rms in (("control", adjustment.object_rms.control), ("check", adjustment.object_rms.check)):
        if rms:
            if max(map(abs, (*rms.min, *rms.max))) < HELD:
                held = "held at the given coordinates, so no RMSE on the ground"
                lines.append(f"{counted(rms.n, f'{role} point')}: {held}")
                continue
            axes = zip("ENh", (rms.x, rms.y, rms.h), rms.min, rms.max, strict=True)
            # Errors are adjusted minus known ground; residuals are the opposite.
            text = ", ".join(f"{axis} {value:.3f} ({-b:+.2f} to {-a:+.2f})" for axis, value, a, b in axes)
            lines.append(f"{counted(rms.n, f'{role} point')}: RMSE {text} m")
    sigma0 = "unknown" if adjustment.sigma0 is None else f"{adjustment.sigma0:.3g}"
    lines += variance_lines(adjustment.variances)
    expected, unknown = sigma_lines(report), head.figure == UNKNOWN
    lines += [*height_lines(adjustment.heights), *camera_lines(adjustment.shared_parameters)]
    lines += [] if unknown else expected
    lines.append(
        f"Redundancy {adjustment.redundancy}, sigma0 {sigma0}, {counted(len(adjustment.rejected), 'gross error')}"
    )
    said, errors = _signals_of(report), errors_of_block(report)
    first = [
        *accuracy_lines(report, errors),
        *_notes(head, said),
        *(expected if unknown else []),
        *error_lines(errors),
        *signal_lines(said),
    ]
    return Text.joined("\n", [*first, *lines])


def accuracy_lines(report: BlockReport, errors: Sequence[RoleErrors]) -> list[str]:
    """Return the accuracy of a block with CE90 and LE90, and what it is from."""
    head, check = report.headline, next((one for one in errors if one.role == "check"), None)
    if head.figure == UNKNOWN:
        return [f"{head.figure}: {head.what}"]
    if head.height is None or check is None or check.le90 is None:
        return [f"Accuracy {head.figure}", f"{head.what[0].upper()}{head.what[1:]}."]
    plan, height = (f"90 {metres(value)}" for value in (check.ce90, check.le90))
    said = f"Accuracy {head.figure} in plan (CE{plan}), {head.height} in height (LE{height})"
    return [said, f"{head.what[0].upper()}{head.what[1:]}."]


def _signals_of(report: BlockReport) -> list[Signal]:
    tested = report.headline.figure != UNKNOWN or refuted(report.notices) is not None
    return signals(report.warnings, report.notices, tested=tested)


def _notes(head: BlockHeadline, said: Sequence[Signal]) -> list[str]:
    """Return the reservations of the headline without those that a notice states."""
    return [note for note in head.notes if note not in NOTICED or not said]


def height_lines(heights: HeightsRecord | None) -> list[str]:
    """Say how many heights a DEM gave to points, how accurate they are, and its bias."""
    if heights is None:
        return []
    left = f", {len(heights.left_out)} left out" if heights.left_out else ""
    if heights.at_breaks > heights.used:
        left += f", {heights.at_breaks} where it differs from a plane by more than its sigma allows"
    sigma = f"sigma {significant(heights.sigma_m)} m ({heights.sigma_is})"
    bias = f"bias {heights.bias_m:+.2f} m (sigma {significant(heights.bias_sigma_m)} m)"
    return [f"{counted(heights.used, 'height')} of the DEM{left}: {sigma}, {bias}"]


def camera_lines(parameters: Sequence[SharedParameterRecord]) -> list[str]:
    """Say what the block found of cameras: focal lengths, and which parameters changed significantly."""
    if not parameters:
        return []
    found = []
    for one in parameters:
        if one.name == "focal_length":
            change, sigma = (100 * part / one.prior.value for part in (one.value - one.prior.value, one.sigma))
            found.append(
                f"Camera of {counted(one.images, 'image')}: focal length {change:+.2f} % (sigma {sigma:.2f} %)"
            )
    named = (_CAMERA.get(one.name, (one.name, ""))[0] for one in parameters if one.significant)
    changed = ", ".join(dict.fromkeys(named)) or "none"
    return [*found, f"Parameters of the camera that changed significantly: {changed}"]


def sigma_lines(report: BlockReport) -> list[str]:
    """Return the sigmas of ground points, and of the relative positions of images with points in common."""
    found = []
    if (ground := report.absolute) is not None:
        found.append(
            f"Expected absolute accuracy: sigma {significant(ground.east_m)} m east, "
            f"{significant(ground.north_m)} m north, "
            f"{significant(ground.height_m)} m in height (median of {counted(ground.points, 'point')})"
        )
    if (pairs := report.relative) is not None:
        found.append(
            f"Expected relative position of {counted(pairs.pairs, 'pair')} of images: "
            f"sigma {significant(pairs.median_px)} px or {significant(pairs.median_m)} m (median), "
            f"{significant(pairs.worst_px)} px (worst)"
        )
    return found


def _absolute(fit: BlockFit) -> AbsoluteAccuracy | None:
    known = np.isfinite(fit.ground_sigmas).all(axis=1)
    # Sigmas of points lack the errors of models that are not adjusted. Matched control counts as exact to a millimetre.
    if not fit.parameters or not known.any():
        return None
    free = known & ~fit.used_ground
    sigmas = fit.ground_sigmas[free if free.any() else known]
    east, north, up = np.median(sigmas, axis=0).tolist()
    return AbsoluteAccuracy(east_m=east, north_m=north, height_m=up, points=len(sigmas))


def _relative(network: NetworkRecord) -> RelativeAccuracy | None:
    known = [(one.sigma_px, one.sigma_m) for one in network.pairs if one.sigma_px is not None]
    if not known:
        return None
    sizes, lengths = np.array(known, dtype=float).T
    return RelativeAccuracy(
        pairs=len(known),
        median_px=float(np.median(sizes)),
        median_m=float(np.median(lengths)),
        worst_px=float(sizes.max()),
    )


def variance_lines(variances: VariancesRecord) -> list[str]:
    """Return the estimated accuracy of control whose ground states no sigma."""
    ground = variances.unstated_ground
    number = max(ground.xy.points, ground.h.points)
    if not number:
        return []
    who = counted(number, "control point states", "control points state")
    if not variances.separable:
        return [f"{who} no ground accuracy; their ground errors count as measuring errors"]
    found = [
        f"{significant(part.sigma)} m in {what} (redundancy {part.redundancy:.1f})"
        for what, part in (("plan", ground.xy), ("height", ground.h))
        if part.sigma is not None
    ]
    return [f"{who} no ground accuracy; estimated: {', '.join(found)}"]


def _pair(rms: Rmse | None) -> str:
    return "-" if rms is None else f"{rms.col:.3f}  {rms.row:.3f}"


# -- page ------------------------------------------------------------------------------------------------------------


def page(report: BlockReport, pictures: Mapping[str, bytes] | None = None) -> str:
    """Return the report as one page that needs no other file and no network; `pictures` are PNGs of its images."""
    adjustment, rays = report.adjustment, rays_by_image(report)
    shown = pictures or {}
    plots = {label: plot_rays(report, label, rays[label]) for label in list(report.images)[:PICTURES]}
    cards = [
        card(
            report,
            label,
            shown.get(label),
            None if (plot := plots.get(label)) is None else plot.svg(),
            _frame_in(report.images[label].size),
            rays[label],
        )
        for label in report.images
    ]
    plan, network = plot_ground(report), plot_network(report)
    places = [place for image in report.images.values() for place in image.outline or ()]
    where = plot_locator((places[0][0], places[0][1])) if places else None
    said, errors = _signals_of(report), errors_of_block(report)
    return render(
        "report/block.html.j2",
        report=report,
        adjustment=adjustment,
        head=report.headline,
        about=about_block(report),
        unknown=report.headline.figure == UNKNOWN,
        errors=error_table(errors),
        tested=next((one for one in errors if one.role == "check"), None),
        notes=_notes(report.headline, said),
        verdict=verdict(report),
        marks=_marks(report),
        scale_rules=None if report.map_scale is None else scale_rules(report.map_scale),
        ground_sigmas=variance_lines(adjustment.variances),
        expected=sigma_lines(report),
        camera=_CAMERA,
        roles={role: sum(point.role == role for point in adjustment.points) for role in ROLES},
        points=sorted(
            zip(adjustment.points, report.network.largest_deg, strict=True), key=lambda one: ROLES.index(one[0].role)
        )[:_LISTED],
        cards=cards,
        network=None if network is None else network.svg(),
        locator=None if where is None else where.svg(),
        plan=None if plan is None else plan.svg(),
        plot_style=style_sheet(),
        provenance=report.provenance.to_json(),
        signals=shortened(said, "left-out", "no-rpc"),  # the JSON has all
        levels=WORDS,
        script=script(),
        policy=policy(script()),
    )


def _marks(report: BlockReport) -> list[str]:
    """Return what the marks on the map of the block mean."""
    there = {point.role for point in report.adjustment.points}
    kinds = {"control": "dots: control points", "check": "squares: check points", "tie": "small dots: tie points"}
    said = [what for role, what in kinds.items() if role in there]
    said += ["crosses: rejected points"] if report.adjustment.rejected else []
    weak = any(pair.weak for pair in report.network.pairs)
    said += ["red lines: pairs whose relative position is uncertain"] if weak else []
    return [*said, "red rings: contradicting points"] if doubted(report.notices) else said


def plot_rays(report: BlockReport, label: str, rays: Sequence[Ray]) -> Drawing | None:
    """Draw reprojection residuals of an image over its frame: those of known ground, of ties those of the adjusted."""
    roles = {point.id: point.role for point in report.adjustment.points}
    shown = []
    for ray in rays:
        role = roles[ray.id]
        vector = ray.residual if role == "tie" else ray.back_projected
        if is_known(vector) and is_known(ray.measured):
            shown.append((ray.measured, vector, role if ray.used else "out", f"{ray.id} ({role})"))
    title = f"Residuals of {counted(len(shown), 'ray')} over the frame of {label}"
    return _vectors(title, shown[:: max(1, len(shown) // _DRAWN_RAYS)], report.images[label].size, "px")


def _frame_in(size: Sequence[int]) -> tuple[float, float, float, float]:
    """Return left, top, width and height of the frame of an image in its drawing, per cent."""
    scale = _SIDE / max(size)
    wide, tall = max(size[0] * scale, 300.0) + 2 * _MARGIN, size[1] * scale + 2 * _MARGIN + 30
    return 100 * _MARGIN / wide, 100 * _MARGIN / tall, 100 * size[0] * scale / wide, 100 * size[1] * scale / tall


def plot_ground(report: BlockReport) -> Drawing | None:
    """Draw adjusted minus known ground in plan, north up, at the points in degrees made even for their latitude."""
    known = [point for point in report.adjustment.points if None not in (*point.residual, *point.ground)]
    if len(known) < 2:
        return None
    places, errors = np.array([point.ground[:2] for point in known]), -np.array([point.residual for point in known])
    places[:, 0] = np.unwrap(places[:, 0], period=360.0) * math.cos(math.radians(float(places[:, 1].mean())))
    places[:, 1] *= -1.0
    low = places.min(axis=0)
    size = float((places.max(axis=0) - low).max()) or 1.0
    at = (places - low + 0.04 * size) / (1.08 * size) * 1000.0
    extent = at.max(axis=0) + 40.0
    shown = [
        (
            place.tolist(),
            [east, -north],
            point.role if _takes_part(point) else "out",
            f"{point.id} ({point.role}): E {east:+.2f}, N {north:+.2f}, h {up:+.2f} m",
        )
        for place, (east, north, up), point in zip(at, errors.tolist(), known, strict=True)
    ]
    return _vectors("Adjusted minus known ground in plan", shown, extent.tolist(), "m")


def _takes_part(point: BlockPoint) -> bool:
    return point.role != "control" or point.used_ground


def _vectors(
    title: str, shown: Sequence[tuple[Sequence[float], Sequence[float], str, str]], size: Sequence[float], unit: str
) -> Drawing | None:
    """Draw vectors at their places in a frame; control and check with their marks, ties as plain arrows."""
    if not shown:
        return None
    scale = _SIDE / max(size)
    wide, tall = size[0] * scale, size[1] * scale
    drawing = Drawing(max(wide, 300.0) + 2 * _MARGIN, tall + 2 * _MARGIN + 30, title, "block")
    drawing.rect("frame", _MARGIN, _MARGIN, wide, tall)
    longest = max((math.hypot(*vector) for _, vector, kind, _ in shown if kind != "out"), default=0.0)
    arrow = _ARROW / longest if longest > 0 else 0.0
    for place, vector, kind, name in shown:
        x, y = (_MARGIN + value * scale for value in place)
        with drawing.titled(f"{name}\n{vector[0]:+.3f}, {vector[1]:+.3f} {unit}"):
            if kind != "out":
                drawing.arrow("bar" if kind == "tie" else kind, x, y, vector[0] * arrow, vector[1] * arrow)
            if kind != "tie":
                drawing.mark(kind, x, y)
    if longest > 0:
        bar = round_down(longest)
        drawing.arrow("bar", _MARGIN, tall + 2 * _MARGIN + 8, bar * arrow, 0.0)
        drawing.text(_MARGIN + bar * arrow + 10, tall + 2 * _MARGIN + 12, f"{bar:g} {unit}")
    return drawing
