"""Results of commands: documents for ``--json``, files, and their looks in a notebook."""

from __future__ import annotations

import functools
import inspect
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, ParamSpec, TypeVar, cast

from ortho_pipeline.commands.control.matching import Matched
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import OrthoError, ReportError, error_document
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.estimation.choice.comparison import ComparisonRecord
from ortho_pipeline.estimation.family_fit import Removed
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import viewing
from ortho_pipeline.estimation.spatial.correlation import analyse_fit
from ortho_pipeline.files import part_of_outputs, retire, staged, together, write_text
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.host.registry import fault_of_plugin
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.report import document as report
from ortho_pipeline.report.map_scale import map_scale
from ortho_pipeline.report.matching import MatchingRecord
from ortho_pipeline.report.notebook import tables
from ortho_pipeline.report.records import SceneReport
from ortho_pipeline.report.wording import refuted
from ortho_pipeline.stores.delivery import address_of, delivered

SCHEMA_VERSION = 1
#: How the names of a scene's outputs end, after its stem.
ENDINGS = {
    "ortho": "_ortho.tif",
    "model": "_model.json",
    "rpc": "_RPC.TXT",
    "vrt": ".vrt",
    "residuals": "_residuals.geojson",
    "style": "_residuals.qml",
    "report": "_report.json",
    "html": "_report.html",
    "stac": "_stac.json",
    "thumbnail": "_thumbnail.png",
    "overview": "_overview.png",
    "visibility": "_visibility.tif",
    "angles": "_angles.tif",
    "angles_style": "_angles.qml",
    "shadow": "_shadow.tif",
    "accuracy": "_accuracy.tif",
    "accuracy_style": "_accuracy.qml",
}
#: Outputs that are only made where an option asks for them: field of `OutputOptions` -> what it asks for.
_ASKED = {
    "stac": ("stac", "thumbnail", "overview"),
    "accuracy_raster": ("accuracy", "accuracy_style"),
    "visibility": ("visibility",),
    "angles": ("angles", "angles_style", "shadow"),
}

#: Outputs of a scene that describe the others.
OF_REPORT = ("residuals", "style", "report", "html", "stac", "thumbnail", "overview")

_P = ParamSpec("_P")
_R = TypeVar("_R")


@dataclass(frozen=True)
class FitResult:
    """A scene and what was adjusted to its points."""

    scene: Scene
    fit: Fit
    warnings: tuple[Notice, ...]
    removed: tuple[Removed, ...]
    near: float | None
    matched: Matched | None

    @property
    def matching(self) -> MatchingRecord | None:
        """The matches, with the test of the fit at them; None without matching."""
        return None if self.matched is None else self.matched.tested_by(self.fit)

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho fit --json`` (docs/engineering/formats.md)."""
        covariance = analyse_fit(self.fit, near=self.near)
        document = self.fit.to_json() | to_document([*self.warnings, *report.patterns(covariance)])
        pixels = viewing(self.fit.model, self.scene.width, self.scene.height)["ground_pixel_m"]
        scale = None if refuted(document["notices"]) else map_scale(self.fit, max(pixels) if pixels else None)
        return {
            "schema_version": SCHEMA_VERSION,
            "sensor": self.scene.sensor,
            "model": document.pop("model"),
            "model_source": self.scene.model_source,
            **document,
            "removed": json_value(self.removed),
            **({} if self.matching is None else {"matching": self.matching.to_json()}),
            "map_scale": None if scale is None else scale.to_json(),
            "covariance": covariance.to_json(),
        }


@dataclass(frozen=True)
class Result:
    """Files that a command wrote (paths, or addresses in a store), their document, and a summary for people."""

    files: Mapping[str, Any]
    document: Mapping[str, Any]
    summary: str
    #: Reason why the report failed; the files are complete without it.
    failure: ReportError | None = None

    def to_json(self) -> dict[str, Any]:
        """Return files and document as JSON values, and ``error`` where the report could not be made."""
        files = {name: str(path) for name, path in self.files.items()}
        failed = {} if self.failure is None else {"error": error_document(self.failure)}
        return {"schema_version": SCHEMA_VERSION, "files": files, **self.document, **failed}

    def _repr_html_(self) -> str:
        """Show the report in a notebook, or the summary where there is none."""
        if "html" in self.files:
            page = self.files["html"]
            return tables.page_html(page.read_text(encoding="utf-8")) if isinstance(page, Path) else self.summary
        return tables.text_html(self.summary)


@dataclass(frozen=True)
class CompareResult:
    """A comparison of models, and the report that was written, if any."""

    scene: Scene
    comparison: ComparisonRecord
    matched: Matched | None
    files: Mapping[str, Path] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho compare --json`` (docs/engineering/formats.md)."""
        document = self.comparison.model_dump(mode="json", exclude_unset=True, exclude={"files"})
        matching = {} if self.matched is None else {"matching": self.matched.to_json()}
        return {**document, **matching, "files": {name: str(path) for name, path in self.files.items()}}


def outputs(folder: str | os.PathLike[str], stem: str, options: OutputOptions) -> dict[str, Path]:
    """Return the paths of the outputs of a scene by what they are, of those that are made if all goes well."""
    idle = {kind for field, kinds in _ASKED.items() if not getattr(options, field) for kind in kinds}
    idle |= {"visibility"} if options.visibility == "nodata" else set()
    return {kind: Path(folder) / f"{stem}{ending}" for kind, ending in ENDINGS.items() if kind not in idle}


def outputs_together(command: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let the outputs of a command (its first parameter is a file, another one `folder`) appear together.

    In a store of objects too: they are made on this machine and uploaded then.
    """
    signature = inspect.signature(command)

    @functools.wraps(command)
    def wrapper(*given: _P.args, **named: _P.kwargs) -> _R:
        bound = signature.bind(*given, **named).arguments
        if bound.get("folder") is None:
            return command(*given, **named)
        if address_of(bound["folder"]) is not None:
            name = Path(next(iter(bound.values()))).stem
            return _to_store(wrapper, signature.bind(*given, **named), "folder", name)
        with together(bound["folder"], Path(next(iter(bound.values()))).stem):
            return command(*given, **named)

    return wrapper


def to_store(**outputs: str | None) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Let outputs of a command go to a store of objects too.

    Parameters
    ----------
    **outputs : str or None
        Parameters of the command that name a folder, with what its outputs are called together; or (None) a file,
        after which they are called, and with which what is written next to it goes along.
    """

    def decorate(command: Callable[_P, _R]) -> Callable[_P, _R]:
        signature = inspect.signature(command)

        @functools.wraps(command)
        def wrapper(*given: _P.args, **named: _P.kwargs) -> _R:
            bound = signature.bind(*given, **named)
            for parameter, name in outputs.items():
                address = address_of(bound.arguments.get(parameter))
                if address is not None:
                    called = name or PurePosixPath(address).stem
                    return cast(_R, _to_store(wrapper, bound, parameter, called, is_file=name is None))
            return command(*given, **named)

        return wrapper

    return decorate


def _to_store(
    command: Callable[..., Any], bound: inspect.BoundArguments, parameter: str, name: str, *, is_file: bool = False
) -> Any:
    """Run a command in a folder of this machine, upload what it wrote, and return its result with the addresses."""
    address, file = str(bound.arguments[parameter]).rstrip("/"), ""
    if is_file:
        address, _, file = address.rpartition("/")
    own = bound.arguments.get("allow_network", False)
    allowed = own or bound.arguments.get("scene", SceneOptions()).allow_network
    with delivered(address, name, allow_network=allowed, keep=_goes_along) as delivery:
        folder = delivery.folder
        bound.arguments[parameter] = folder / file
        result = command(*bound.args, **bound.kwargs)
        files: dict[str, Any] = {}
        for role, path in result.files.items():
            if not isinstance(path, Path) or not path.is_relative_to(folder):
                files[role] = path
            elif _goes_along(path):
                files[role] = f"{address}/{path.relative_to(folder).as_posix()}"
    return replace(result, files=files)


def _goes_along(path: Path) -> bool:
    """Return whether a file is valid elsewhere; a VRT refers to an image by a relative path."""
    return path.suffix != ".vrt" or 'relativeToVRT="1"' not in path.read_text(encoding="utf-8", errors="replace")


def attempted(make: Callable[[], _R], files: dict[str, Path], *of_report: str) -> _R | ReportError:
    """Make a report, which must not cost the other outputs: return the error if that fails.

    Parameters
    ----------
    make : callable
        Makes the report and writes its files.
    files : dict
        Outputs of the command. If it fails, those `of_report` are taken out: none of them is written, and those of an
        earlier command go, because they describe other outputs.
    """
    try:
        with part_of_outputs():
            return make()
    except Exception as error:
        retire(files.pop(kind) for kind in of_report if kind in files)
        why = f"{type(error).__name__}: {error}".removesuffix(": ")
        remedy = "this is a bug in ortho-pipeline: please report it with the traceback"
        if known := error if isinstance(error, OrthoError) else fault_of_plugin(error):
            why, remedy = known.message, known.remedy or remedy
        failure = ReportError(
            Text("the report could not be made (", why, "); the other outputs are complete"), remedy=remedy
        )
        failure.__cause__ = error
        return failure


def write_report(
    made: SceneReport,
    fit: Fit,
    files: dict[str, Path],
    matched: Matched | None,
    pixels: RasterSource | None,
) -> None:
    """Write report and residuals; without points there are no residuals, and they are taken out of `files`.

    The page shows chips of the matches and, from `pixels` (the raster of the scene), of measured points.
    """
    if len(fit.points):
        write_text(files["residuals"], json.dumps(report.residuals_geojson(fit), allow_nan=False))
        write_text(files["style"], report.residuals_style(made))
    else:
        del files["residuals"], files["style"]
    report.write_report_json(made, files["report"])
    report.write_report_html(
        made,
        files["html"],
        ortho=staged(files["ortho"]) if "ortho" in files else None,
        matches=None if matched is None else matched.matches,
        pixels=pixels,
    )
