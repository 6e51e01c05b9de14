"""A scene adjusted to its points: its own model with a correction, or a model family from the points alone."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.commands.control.matching import Matched
from ortho_pipeline.commands.control.points import control_of, refuse_contradictions, with_heights
from ortho_pipeline.commands.resolved.opening import resolve
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors import CoverageError, InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.choice import comparison as comparing
from ortho_pipeline.estimation.coordinate_swaps import refuse_swapped
from ortho_pipeline.estimation.family_fit import OWN, Removed, fit_family, fit_own, prune, restricted, ridge_of
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.estimation.ground_residuals import in_metres
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection, Pieces, SensorModel, families
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, PointOptions
from ortho_pipeline.points import Points, marks_warning
from ortho_pipeline.points.control_hull import uncovered
from ortho_pipeline.report.matching import MatchingRecord
from ortho_pipeline.report.wording import ENOUGH_CHECK_POINTS, few_check_points
from ortho_pipeline.surface.base import Surface

#: A delivered model that is so many image sizes off belongs to another place, or reads its metadata wrongly.
_ELSEWHERE = 3.0
#: Number of measured points that locate a reference, and significance of their mean in sigmas.
_AGREE, _SIGMAS = 3, 4.0
#: Margin around the points, as a share of their extent, for the height range of the DEM.
_MARGIN = 0.25


@dataclass(frozen=True)
class Adjusted:
    """A scene and what was adjusted to its points.

    Parameters
    ----------
    scene : Scene
        Its models are those that were adjusted: of an image without a model of its own, the fitted family.
    fit : Fit
    removed : tuple of Removed
        Parameters that ``--prune`` took out.
    matched : Matched, optional
        The matching that points came from.
    notes : tuple of Notice
        What was chosen for the user.
    """

    scene: Scene
    fit: Fit
    removed: tuple[Removed, ...] = ()
    matched: Matched | None = None
    notes: tuple[Notice, ...] = ()

    @property
    def model(self) -> SensorModel:
        """The adjusted model of the image, without a correction that corrects nothing."""
        model = self.fit.model
        if not isinstance(model, ImageCorrection):
            return model
        inner = model.model.first if isinstance(model.model, Pieces) else model.model
        return inner if model.correction == "none" else dataclasses.replace(model, model=inner)

    def record(self) -> dict[str, Any]:
        """Return what the model was adjusted by as JSON values: now, or before where it comes adjusted from a file."""
        return self.fit.to_json() if self.scene.adjusted is None else dict(self.scene.adjusted)

    @property
    def matching(self) -> MatchingRecord | None:
        """The matches, with the test of the fit at them; None without matching."""
        return None if self.matched is None else self.matched.tested_by(self.fit)

    def warnings(self, surface: Surface | None) -> tuple[Notice, ...]:
        """Return the notices to read before the numbers are trusted."""
        scene, adjusted, points = self.scene, self.fit, self.fit.points
        unsuited = [name for name in scene.models if name in scene.unsuited]
        notices = [*scene.notices, *(Notice("unsuited-model", scene.unsuited[name], model=name) for name in unsuited)]
        notices += adjusted.warnings
        if surface is not None:
            notices += surface.provenance.get("warnings", [])
        if self.matched is not None:
            notices += self.matched.notices
        notices += self.notes
        notices += self._doubtful()
        notices += marks_warning(points, adjusted.used & points.control)
        inside = ((points.image >= 0) & (points.image <= (scene.width, scene.height))).all(axis=1)
        if not inside.all():
            outside = np.array(points.ids)[~inside].tolist()
            text = f"points outside the image, but used: {', '.join(outside)}"
            notices.append(Notice("outside-of-image", text, points=outside))
        notices += self._elsewhere() + self._too_many_parameters()
        if len(adjusted.param_names):
            notices += uncovered(points.image[adjusted.used], (self.scene.width, self.scene.height))
        if adjusted.used.any() and len(adjusted.param_names) and adjusted.redundancy == 0:
            text = "no redundancy: the RMSE of the control points is zero by construction and proves nothing"
            notices.append(Notice("no-redundancy", text))
        checks = int(points.check.sum())
        if len(points) and checks < ENOUGH_CHECK_POINTS:
            notices.append(few_check_points(checks))
        if self.removed:
            names = ", ".join(f"{parameter.name} (t {parameter.t:.1f})" for parameter in self.removed)
            text = f"removed parameters that the points do not justify: {names}"
            notices.append(
                Notice("parameters-removed", text, parameters=[parameter.name for parameter in self.removed])
            )
        return tuple(dict.fromkeys(notices))

    def _doubtful(self) -> list[Notice]:
        """Return a notice for each rejected point, and each that contradicts the others without a common notice."""
        left = [
            Notice("left-out", f"point {name} was rejected: {reason}", point=name, reason=reason)
            for name, reason in self.fit.rejected
        ]
        named = {
            name for notice in self.fit.warnings if notice.code == "checks-apart" for name in notice.fields["points"]
        }
        return left + [
            Notice(
                "contradicting-point",
                f"{notice.role} point {notice.id} contradicts the others: {notice.reason}",
                point=notice.id,
                role=notice.role,
            )
            for notice in self.fit.outlying
            if notice.role == "control" or notice.id not in named
        ]

    def _too_many_parameters(self) -> list[Notice]:
        """Return a notice if several parameters of a correction beyond a shift are not significant."""
        adjusted = self.fit
        names, weak = adjusted.param_names, adjusted.not_justified
        if (
            not isinstance(adjusted.model, ImageCorrection)
            or adjusted.redundancy < 1
            or len(names) < 3
            or len(weak) < 2
        ):
            return []
        number = f"{len(weak)} of {counted(len(names), 'parameter')}"
        text = f"the points do not justify {number} of the correction: {', '.join(weak)}"
        return [Notice("parameters-not-justified", text, parameters=list(weak))]

    def _elsewhere(self) -> list[Notice]:
        """Return a warning if the delivered model shows another place than the points."""
        bias = self.fit.raw_bias
        if bias is None or self.fit.model_name in {family.name for family in families()}:
            return []
        sizes = max(abs(bias.col) / self.scene.width, abs(bias.row) / self.scene.height)
        if not sizes > _ELSEWHERE:
            return []
        text = (
            f"the delivered model is {sizes:.3g} image sizes away from the points. Possible causes: points or metadata "
            "of another scene, swapped longitude and latitude, or an angle with the wrong sign or unit"
        )
        return [Notice("model-elsewhere", text, image_sizes=sizes)]


def adjustable(request: Request) -> Resolved:
    """Resolve a request for an adjustment; to fit a model family, the image needs no model.

    Raises
    ------
    InputError
        If options contradict each other, and as `resolve`.
    """
    points, scene = request.points, request.scene
    refuse_contradictions(points, request.match)
    if points.fit_model is None:
        if points.model_crs is not None:
            raise InputError(
                Text(Setting("points.model_crs"), " is only for fitted models"),
                field="points.model_crs",
                remedy=Text("give ", Setting("points.fit_model")),
            )
        if points.ridge != "auto":
            raise InputError(
                Text(Setting("points.ridge"), " is only for fitted models"),
                field="points.ridge",
                remedy=Text("give ", Setting("points.fit_model")),
            )
        return resolve(request)
    if scene.model is not None or points.correction is not None:
        other = "scene.model" if scene.model is not None else "points.correction"
        raise InputError(
            Text(
                Setting("points.fit_model"),
                " replaces the image's own model, and ",
                Setting(other),
                " needs it",
            ),
            field="points.fit_model",
            remedy=Text("leave out one of ", Setting("points.fit_model"), " and ", Setting(other)),
        )
    if not request.has_control:
        raise InputError(
            "a fitted model needs control points",
            field="points.gcps",
            remedy=Text("give a file of points with ", Setting("points.gcps")),
        )
    if points.fit_model not in {family.name for family in families()}:
        raise InputError(
            f"there is no model {points.fit_model!r}",
            field="points.fit_model",
            remedy=f"use one of {', '.join(family.name for family in families())} (see `ortho models`)",
        )
    return resolve(request, needs_model=False)


def adjust(resolved: Resolved) -> Adjusted:
    """Adjust the model of a scene, or fit the family of the options to the points alone.

    Without points the delivered model is used.

    Raises
    ------
    InputError
        If points are missing or wrong, or do not determine the model.
    """
    scene, request = resolved.scene, resolved.request
    options, match, surface = request.points, request.match, resolved.surface
    points, matched = control_of(resolved)
    is_delivered = request.scene.model is None or scene.adjusted is None
    notes: tuple[Notice, ...] = ()
    if matched is not None and options.correction is options.fit_model is None and is_delivered:
        correction, note = by_matches(scene, matched.matches.points)
        options, notes = dataclasses.replace(options, correction=correction), (note,)
    done = (
        _from_points(scene, options, points, surface)
        if options.fit_model
        else _corrected(scene, options, is_delivered, points, surface)
    )
    warnings = *done.fit.warnings, *relative_to_reference(done.fit, match)
    adjusted = dataclasses.replace(done.fit, significance=options.significance, warnings=warnings)
    done = dataclasses.replace(done, fit=adjusted, matched=matched, notes=notes)
    if not options.prune:
        return done
    pruned = prune(done.fit)
    if options.fit_model:
        scene = dataclasses.replace(done.scene, models={options.fit_model: pruned.fit.model})
        done = dataclasses.replace(done, scene=scene)
    return dataclasses.replace(done, fit=pruned.fit, removed=tuple(pruned.removed))


def relative_to_reference(adjusted: Fit, match: MatchOptions) -> list[Notice]:
    """Return a notice if control was matched, here or by `ortho match`: accuracy is then relative."""
    count, control = int((adjusted.points.groups[adjusted.used] >= 0).sum()), int(adjusted.used.sum())
    if not count:
        return []
    sigma = float(adjusted.points.sigma_common[adjusted.used].max()) or match.reference_sigma
    part = (
        "all control points were matched" if count == control else f"{count} of {control} control points were matched"
    )
    common = adjusted.common_error
    floor = "The accuracy of the reference is not stated"
    if sigma:
        floor = f"The reference is accurate to {metres(sigma)} per axis, which the residuals do not show"
    if common is not None:
        floor += " but the sigmas of the parameters include"
    text = (
        f"accuracy is relative to the reference, because {part}. {floor}. An error common to scene and reference "
        "cannot be detected"
    )
    if common is not None and common.value.any():
        east, north = common.value * common.sigma
        text += ". The measured points show that the reference is displaced by "
        text += f"{east:+.2f} m along x and {north:+.2f} m along y"
    relative = Notice(
        "relative-to-reference",
        text,
        reference_sigma_m=sigma,
        matched=count,
        control=control,
        in_sigmas=common is not None,
    )
    off = _reference_off(adjusted) if count == control else None
    if off is None:
        return [relative]
    east, north = off.mean(axis=0).tolist()
    text = (
        f"{counted(len(off), 'measured check point')} show that the reference, and so the ortho, is displaced by "
        f"{east:+.2f} m along x and {north:+.2f} m along y"
    )
    return [relative, Notice("reference-displaced", text, reference_off_m=[east, north], points=len(off))]


def _reference_off(adjusted: Fit) -> Array | None:
    """Return the displacement (m, x and y) of the reference at each check point, if it is significant."""
    points = adjusted.points
    measured = points.tests & (points.groups < 0) & ~np.isin(points.ids, [point.id for point in adjusted.outlying])
    shifts = in_metres(adjusted, adjusted.residuals)[measured]
    shifts = shifts[np.isfinite(shifts).all(axis=1)]
    if len(shifts) < _AGREE:
        return None
    scatter = shifts.std(axis=0, ddof=1) / np.sqrt(len(shifts))
    return shifts if (abs(shifts.mean(axis=0)) > _SIGMAS * scatter).any() else None


def by_matches(scene: Scene, points: Points) -> tuple[str, Notice]:
    """Return the correction that many matches justify, as `ortho compare` recommends it, and a notice.

    Of shift, shift-drift, affine, and the model's own parameters where it has some, the one with the fewest parameters
    whose error is expected to be within 2 % of the smallest over the scene.
    """
    own = scene.shared_model
    kinds = [name for name in comparing.CORRECTIONS if name != "none"] + ([OWN] if own.param_names else [])
    names = {comparing.own_name(own, kind): kind for kind in kinds}
    compared = comparing.compare(points, tuple(names), own=own, priors=scene.priors, size=(scene.width, scene.height))
    chosen = "shift" if compared.recommended is None else names[compared.recommended]
    text = Text(
        f"correction {chosen!r} chosen automatically: {compared.recommendation.reason}. Choose another with ",
        Setting("points.correction"),
    )
    return chosen, Notice("correction-by-matches", text, correction=chosen)


def params_of(options: PointOptions) -> tuple[str, ...] | None:
    """Return the names of ``--params``, None without it."""
    if options.params is None:
        return None
    return tuple(dict.fromkeys(name.strip() for name in options.params.split(",") if name.strip()))


def _corrected(
    scene: Scene, options: PointOptions, is_delivered: bool, points: Points, surface: Surface | None
) -> Adjusted:
    if options.correction != OWN:
        # A model that adjusts its own parameters may start anywhere.
        refuse_swapped(scene.shared_model, points, scene.height)
    points = with_heights(points, surface)
    correction = options.correction
    if correction is None:
        correction = "shift" if points.control.any() and is_delivered else "none"
    elif correction != "none" and not is_delivered:
        raise InputError(
            "this model is already adjusted; adjusting it again would count points twice",
            field="points.correction",
            remedy=Text("leave out ", Setting("scene.model"), " to adjust the delivered model with all points"),
        )
    if correction == OWN:
        scene = _by_own_parameters(scene)
        return Adjusted(scene, fit_own(restricted(scene.model, params_of(options)), points, scene.priors))
    start = ImageCorrection.identity(scene.shared_model, correction, (scene.width / 2, scene.height / 2))
    start = restricted(start, params_of(options))
    name = scene.model.kind if correction == "none" else f"{scene.model.kind}+{correction}"
    return Adjusted(scene, fit(start, points, robust=correction != "none", name=name))


def _by_own_parameters(scene: Scene) -> Scene:
    """Return the scene with its first model that has parameters in front, such as a pushbroom before an RPC."""
    chosen = scene.adjustable
    if chosen is None or scene.models[chosen] is scene.model:
        return scene
    rest = {name: model for name, model in scene.models.items() if name != chosen}
    source = f"metadata of {Path(scene.path).name}"
    return dataclasses.replace(scene, models={chosen: scene.models[chosen], **rest}, model_source=source)


def _from_points(scene: Scene, options: PointOptions, points: Points, surface: Surface | None) -> Adjusted:
    name = str(options.fit_model)
    points = heights_where_wanted(points, surface, name)
    adjusted = fit_family(
        name,
        points,
        crs=options.model_crs,
        size=(scene.width, scene.height),
        heights=heights_around(points, surface),
        ridge=ridge_of(options.ridge),
        params=params_of(options),
    )
    source = f"{counted(int(adjusted.used.sum()), 'control point')} of {Path(points.source).name or scene.path}"
    fitted = dataclasses.replace(scene, models={name: adjusted.model}, model_source=source)
    return Adjusted(fitted, adjusted)


def heights_where_wanted(points: Points, surface: Surface | None, *names: str) -> Points:
    """Fill missing heights from the surface; without one they are an error unless all models are 2D."""
    flat = {family.name for family in families() if family.dimensions == 2}
    if surface is None and set(names) <= flat:
        return points
    return with_heights(points, surface)


def heights_around(points: Points, surface: Surface | None) -> tuple[float, float] | None:
    """Return the lowest and highest terrain around the points (m); None without a surface there."""
    if surface is None or not len(points):
        return None
    plan = np.column_stack([points.ground[:, :2], np.zeros(len(points))])
    try:
        return surface.range_under(plan, points.crs, _MARGIN)
    except CoverageError:
        return None
