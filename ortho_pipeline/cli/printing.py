"""Print the results of commands: tables for people, one JSON document for programs."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shlex
import sys
import traceback
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.cli.flags import FLAGS, as_typed, name_as_typed, with_flags
from ortho_pipeline.cli.machine.browser import page_of, show_page
from ortho_pipeline.cli.machine.terminal import printable_json, say
from ortho_pipeline.errors.texts import counted

if TYPE_CHECKING:
    from ortho_pipeline.commands.results import CompareResult, FitResult, Result
    from ortho_pipeline.estimation.records import Rmse, RmseOnGround
    from ortho_pipeline.runtime.process_limits import Progress

#: Exit codes of a command that made none, or only a part, of its outputs.
FAILED, PARTLY_DONE = 1, 3
#: More points than this are not all printed, but so many of them.
_PRINTED, _WORST = 60, 20


def print_json(document: Any) -> None:
    """Print a document for programs.

    Examples
    --------
    >>> print_json({"count": 2})
    {
     "count": 2
    }
    """
    context = click.get_current_context(silent=True)
    stdout = context.meta.get("stdout") if context else None
    click.echo(printable_json(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)), file=stdout)


def print_warnings(warnings: Any) -> None:
    """Print warnings on stderr.

    Examples
    --------
    >>> print_warnings(["the DEM covers 83 % of the scene"])
    """
    for warning in warnings:
        say(f"Warning: {as_typed(warning)}", err=True)


def print_notices(document: Mapping[str, Any]) -> None:
    """Print the errors, warnings and notes of a document on stderr, each with its remedy; with ``-q`` no notes."""
    from ortho_pipeline.report.page.advice import signal_lines, signals

    found = signals(document.get("warnings", ()), document.get("notices", ()))
    quiet = click.get_current_context().meta.get("quiet")
    for line in signal_lines([one for one in found if one.level != "know" or not quiet]):
        say(as_typed(line), err=True)


def print_result(result: Result, as_json: bool) -> None:
    """Print summary, warnings and files of a result, or its document; end with exit code 3 if its report failed."""
    if as_json:
        print_json(result.to_json())
        show_page(page_of(result.files))
    else:
        say(as_typed(result.summary))
        print_notices(result.document)
        # The summary, which has the notices of a report, is not printed then.
        if click.get_current_context().meta.get("quiet"):
            print_notices(result.document.get("report") or {})
        print_files(result.files)
    if result.failure is not None:
        context = click.get_current_context()
        if context.meta.get("debug"):
            say("".join(traceback.format_exception(result.failure)), err=True)
        name_as_typed(result.failure, context.command)
        say(f"Error: {result.failure}", err=True)
        context.exit(PARTLY_DONE)


def print_files(files: Mapping[str, Any]) -> None:
    """Print the files of a result, the page last; open it if ``--open`` was given."""
    page = page_of(files)
    for name, path in files.items():
        if path is not page:
            say(f"  {name:<10} {path}")
    show_page(page)
    if page is not None:
        say(f"Report: {page}")


def checked_text(name: str, checked: Mapping[str, Any]) -> str:
    """Return the result of a dry run of a scene (`commands.check`)."""
    points, grid = checked["points"], checked["grid"]
    parts = [
        f"{checked['sensor']}, {checked['model']}",
        f"{counted(points['control'], 'control point')}, {counted(points['check'], 'check point')}",
        f"DEM covers {100 * checked['coverage']:.1f} %",
        f"{grid['size'][0]} x {grid['size'][1]} px of {grid['resolution'][0]:g} in {grid['crs']}",
    ]
    warnings = (f"  Warning: {as_typed(text)}" for text in checked["warnings"])
    return "\n".join([f"{name}: {'; '.join(parts)}", *warnings])


def print_fit(result: FitResult) -> None:
    """Print accuracy, errors and notices, then residuals (of many points the largest) and statistics."""
    from ortho_pipeline.report import document as reports
    from ortho_pipeline.report.summary import first_lines

    document = result.to_json()
    made = reports.build_report(
        scene=result.scene, fit=result.fit, matching=result.matching, near=result.near, warnings=result.warnings
    )
    for line in first_lines(made):
        say(as_typed(line))
    print_notices({"warnings": made.warnings, "notices": made.notices})
    say(f"\nModel {document['model']} of {document['model_source']}")
    if document["raw_bias"] and document["parameters"]:
        bias = document["raw_bias"]
        say(f"Model as delivered: column {bias['col']:+.3f}, row {bias['row']:+.3f} on average")
    _print_parameters(document)
    _print_residuals(document)
    _print_rmses(document)
    if result.matching:
        say(f"Matching: {result.matching.text()}")
    for role, found in document["covariance"].items():
        if found:
            say(f"Residuals of {role} points: {found['statement']}")
    sigma0 = "unknown" if document["sigma0"] is None else f"{document['sigma0']:.3g}"
    say(f"Redundancy {document['redundancy']}, sigma0 {sigma0}")


def _print_residuals(document: Mapping[str, Any]) -> None:
    """Print the residuals of each point, and those that the other points predict."""
    wide = max([len(point["id"]) for point in document["points"]] + [5])
    say(f"\n{'point':<{wide}}  role     used    column       row   left out: col.    row")
    points, rest = _worst(document["points"])
    for point in points:
        numbers = [*point["residual"], *point["loo_residual"]]
        shown = "".join(f"{'-' if value is None else f'{value:+.3f}':>10}" for value in numbers)
        say(f"{point['id']:<{wide}}  {point['role']:<8} {'yes' if point['used'] else 'no':<4}{shown}")
    if rest:
        say(f"and {counted(rest, 'point')} with smaller residuals (--json has all)")
    say("\nResiduals are measured minus predicted, in pixels. 'left out': the other points predict this one.")


def _print_rmses(document: Mapping[str, Any]) -> None:
    """Print the RMSE of each role in pixels."""
    labels = {"control": "control", "check": "check", "loo": "leave-one-out", "matched": "matched"}
    for which, rmse in document["rmse"].items():
        text = "no points"
        if rmse is not None:
            sizes = f"column {rmse['col']:.3f}, row {rmse['row']:.3f}, both {rmse['total']:.3f}"
            text = f"{sizes}  ({counted(rmse['n'], 'point')})"
        say(f"RMSE {labels[which]:<14} {text}")


def _worst(points: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], int]:
    """Return the points to print, and how many are left: of many those with the largest residuals, the worst first."""

    def size(point: Mapping[str, Any]) -> float:
        return math.hypot(*(math.inf if value is None else value for value in point["residual"]))

    if len(points) <= _PRINTED:
        return points, 0
    return sorted(points, key=size, reverse=True)[:_WORST], len(points) - _WORST


def _print_parameters(document: Mapping[str, Any]) -> None:
    """Print each parameter with its Student test and its total correlation."""
    if not document["parameters"]:
        return
    statistics = document["statistics"]
    wide = max(len(name) for name in (*document["parameters"], "parameter"))
    say(f"  {'parameter':<{wide}} {'value':>14} {'sigma':>9} {'t':>8} {'p':>7}  total correlation")
    for name, parameter in document["parameters"].items():
        t, p, total = (statistics[key][name] for key in ("t", "p", "total_correlation"))
        chance = "-" if p is None else ("< 0.001" if p < 0.001 else f"{p:.3f}")
        numbers = f"{parameter['value']:>+14.6g} {parameter['sigma']:>9.2g} {'-' if t is None else f'{t:.1f}':>8}"
        weak = "  not justified" if name in statistics["not_justified"] else ""
        say(f"  {name:<{wide}} {numbers} {chance:>7}  {'-' if total is None else f'{total:.3f}':>17}{weak}")
    if statistics["not_justified"]:
        say(f"  not justified: p above {statistics['significance']:g}; --prune takes such parameters out")


def view_text(view: Mapping[str, Any] | None) -> str:
    """Return the direction of view and the size of a pixel along and across it."""
    if view is None:
        return "unknown: the centre of the image does not meet the ground"
    azimuth = view["sensor_azimuth_deg"]
    place = (
        "straight down"
        if azimuth is None
        else (f"{view['incidence_deg']:.1f} deg off vertical, sensor at azimuth {azimuth:.0f} deg")
    )
    along, across = view["pixel_m"]["along_view"], view["pixel_m"]["across_view"]
    return f"{place}; pixel size {along:.3g} m along the view, {across:.3g} m across"


@contextlib.contextmanager
def progress(*, lines: bool = False) -> Iterator[Progress | None]:
    """Yield what shows the stage of a job and its progress on stderr.

    Parameters
    ----------
    lines : bool
        Print each stage once, as a line, where there is no terminal. Without it there is nothing to call then.
    """
    if click.get_current_context().meta.get("quiet"):
        yield None
        return
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield _print_stage if lines else None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda stage, share: bar.update(task, description=escape(stage), completed=share)


def _print_stage(stage: str, share: float) -> None:
    say(f"{share:4.0%}  {stage}", err=True)


def print_models(models: list[dict[str, Any]]) -> None:
    """Print the model families, one a line."""
    say(f"{'model':<13} {'parameters':>10} {'points':>7} {'ground':>7}  suits")
    for model in models:
        numbers = f"{model['parameters']:>10} {model['minimum_points']:>7} {str(model['dimensions']) + 'D':>7}"
        say(f"{model['name']:<13} {numbers}  {model['suits']}")


def print_sensor_test(tested: Mapping[str, Any]) -> None:
    """Print that a sensor passes the contract, what was tested, and what no program can test."""
    origin = f"{tested['distribution']} {tested['version']}".strip()
    columns, rows = tested["size"]
    image = "this image" if tested["recognised"] else "not this image"
    say(f"The sensor {tested['sensor']} passes the contract with {tested['image']}.")
    say(f"  plugin      {tested['plugin']} of {origin}: names, options and arguments")
    say(f"  recognises  {image}; no raster in memory, no TIFF without other files")
    say(f"  scene       {columns} x {rows} pixels, model from {tested['model_source']}; facts, priors and domain")
    for name, kind in tested["models"].items():
        label = name if name == kind else f"{name} ({kind})"
        say(f"  model {label}: shapes, NaN, distant points, ground to image and back, derivatives, parameters, copies")
    image = shlex.join(["ortho", "info", str(tested["image"])])
    say(f"Not tested: where the camera looks. Compare the corners with the vendor's: {image}")


def print_comparison(result: CompareResult, units: str) -> None:
    """Print the recommendation of a comparison, then its table; `units` are ``px`` or ``m``."""
    from ortho_pipeline.report.wording import option_of_choice

    compared, points = result.comparison, result.comparison.points
    wide = max([len(row.model) for row in compared.rows] + [5])
    axes = ("column", "row") if units == "px" else ("x", "y")
    reason = compared.recommendation.reason
    say(f"* Recommended: {reason}." if compared.recommended else f"No model is recommended: {reason}.")
    if (option := option_of_choice(compared)) is not None:
        say(f"  Next: use {with_flags(option, FLAGS)} in other commands, such as rectify.")
    print_notices({"warnings": compared.warnings, "notices": compared.notices})
    say(f"\n{counted(points.control, 'control point')}, {counted(points.check, 'check point')}; RMSE in {units}")
    say(
        f"\n{'':<{wide}}  {'':>6} {'control (the fit)':^28}  {'check':^28}  {'left out':>8} {'condi-':>8}\n"
        f"{'model':<{wide}}  {'param.':>6} "
        + 2 * f"{'n':>4}{axes[0]:>8}{axes[1]:>8}{'total':>8}  "
        + f"{'in turn':>8} {'tion':>8}"
    )
    notes: list[str] = []
    for row in compared.rows:
        mark = "*" if row.model == compared.recommended else " "
        if row.error:
            say(f"{row.model:<{wide}}{mark} {row.parameters:>6}    not fitted: {as_typed(row.error)}")
            continue
        rmse = row.rmse if units == "px" else row.rmse_m
        condition = "-" if row.condition is None else f"{row.condition:.3g}"
        numbers = f"{_errors(rmse.control)}  {_errors(rmse.check)}"
        loo = _error(rmse.loo.total if rmse.loo else None)
        line = f"{row.model:<{wide}}{mark} {row.parameters:>6} {numbers}  {loo} {condition:>8}"
        if row.warnings:
            notes += [text for text in row.warnings if text not in notes]
            line += "  " + ",".join(f"[{notes.index(text) + 1}]" for text in row.warnings)
        say(line)
    for number, text in enumerate(map(as_typed, notes), 1):
        say(f"\n[{number}] {text}" if number == 1 else f"[{number}] {text}")
    for point in compared.left_out:
        say(f"\nLeft out of all models: {point.id} ({point.reason})")
    print_files(result.files)


def _errors(rmse: Rmse | RmseOnGround | None) -> str:
    if rmse is None:
        return f"{0:>4}{'-':>8}{'-':>8}{'-':>8}"
    return f"{rmse.n:>4}" + "".join(_error(value) for name, value in rmse if name != "n")


def _error(value: float | None) -> str:
    if value is None:
        return f"{'-':>8}"
    return f"{value:>8.3f}" if value < 1000 else f"{value:>8.2g}"
