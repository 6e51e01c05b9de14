"""The formats that a model is exported in: a table of them, and one call for each."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.display.notices import to_document
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.csm import write_csm
from ortho_pipeline.exchange.gcp import Gcps, gcps_of_model, gcps_of_points, write_gcps, write_geolocation
from ortho_pipeline.exchange.rpc import (
    RpcExport,
    export_rpc,
    write_rpb,
    write_rpc_txt,
    write_tagged_copy,
    write_vrt,
)
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.flat import FlatSurface

#: What ``ortho export --format`` takes, and what the file's name ends with.
ENDINGS = {
    "rpc-txt": "_RPC.TXT",
    "rpb": ".RPB",
    "vrt": ".vrt",
    "tag": "_rpc.tif",
    "gcp": "_gcp.vrt",
    "gcp-tag": "_gcp.tif",
    "geolocation": "_geolocation.vrt",
    "csm": "_csm.json",
}
FORMATS = tuple(ENDINGS)


def check_formats(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the formats, each once.

    Raises
    ------
    InputError
        If one is unknown.
    """
    unknown = [name for name in formats if name not in ENDINGS]
    if unknown or not formats:
        raise InputError(
            f"no format is called {', '.join(unknown) or 'nothing'}",
            field="formats",
            remedy=f"one or more of {', '.join(FORMATS)}",
        )
    return tuple(dict.fromkeys(formats))


class Export:
    """Writes one model in any of the formats and notes how well each stands for it.

    Parameters
    ----------
    dataset : gdal.Dataset
        The image.
    size : (int, int)
        Its columns and rows.
    surface : Surface, optional
        Where grids of points get their heights from.
    control : Points
        The measured points that the model was adjusted to, gross errors not among them; where there are any, they are
        the control points of the formats ``gcp``.
    left_out : sequence of (str, str)
        Measured control points that are not, with the reason.
    force : bool
        Accept an RPC that is off by more than 0.1 px.
    """

    def __init__(
        self,
        dataset: gdal.Dataset,
        model: SensorModel,
        size: tuple[int, int],
        surface: Surface | None,
        control: Points,
        left_out: Sequence[tuple[str, str]] = (),
        *,
        force: bool = False,
    ) -> None:
        self.dataset, self.model, self.size = dataset, model, size
        self.surface, self.control, self.left_out, self.force = surface, control, tuple(left_out), force
        self.document: dict[str, Any] = {"exact": None, "max_error_px": None, **to_document(())}

    @functools.cached_property
    def rpc(self) -> RpcExport:
        """The model as RPC."""
        exported = export_rpc(self.model, force=self.force)
        self.document |= {"exact": exported.exact, "max_error_px": exported.max_error_px}
        self.document |= to_document(exported.warnings)
        return exported

    def write(self, name: str, path: Path) -> None:
        """Write one format."""
        writers: dict[str, Callable[[], object]] = {
            "rpc-txt": lambda: write_rpc_txt(self.rpc.rpc, path),
            "rpb": lambda: write_rpb(self.rpc.rpc, path),
            "vrt": lambda: write_vrt(self.dataset, self.rpc.rpc, path),
            "tag": lambda: write_tagged_copy(self.dataset, self.rpc.rpc, path),
            "gcp": lambda: write_gcps(self.dataset, self._gcps(), path),
            "gcp-tag": lambda: write_gcps(self.dataset, self._gcps(), path),
            "geolocation": lambda: self._geolocation(path),
            "csm": lambda: self._csm(path),
        }
        writers[name]()

    def _gcps(self) -> Gcps:
        left_out: list[dict[str, str]] = []
        if len(self.control):
            gcps, source = gcps_of_points(self.control), "the measured control points"
            left_out = [{"id": name, "reason": reason} for name, reason in self.left_out]
        else:
            gcps, source = gcps_of_model(self.model, self.size, self.surface), f"a grid{self._where()}"
        self.document["gcps"] = {"n": len(gcps), "source": source, "left_out": left_out}
        return gcps

    def _geolocation(self, path: Path) -> None:
        worst = write_geolocation(self.dataset, self.model, self.size, self.surface, path)
        self.document["geolocation"] = {"max_error_px": worst, "heights": f"the model{self._where()}"}

    def _csm(self, path: Path) -> None:
        self.document["csm"] = {"max_error_px": write_csm(self.model, path, force=self.force)}

    def _where(self) -> str:
        surface = self.surface or FlatSurface(self.model.reference_height)
        return f" {surface.describe()}"

    def summary(self, model: str, source: str) -> str:
        """Say in a line each what was written and how well it stands for the model."""
        lines = [f"Model {model} of {source}"]
        if self.document["exact"] is not None:
            worst = self.document["max_error_px"]
            lines.append("RPC: exact" if self.document["exact"] else f"RPC: refitted, at most {worst:.2g} px off")
        if "gcps" in self.document:
            lines.append("Control points: {n}, {source}".format(**self.document["gcps"]))
            lines += ["Left out: {id} ({reason})".format(**one) for one in self.document["gcps"]["left_out"]]
        if "csm" in self.document:
            lines.append("CSM state: at most {max_error_px:.2g} px off".format(**self.document["csm"]))
        if "geolocation" in self.document:
            found = self.document["geolocation"]
            lines.append(f"Geolocation: {found['heights']}, {found['max_error_px']:.2g} px off between its samples")
        return "\n".join([*lines, *(f"Warning: {text}" for text in self.document["warnings"])])
