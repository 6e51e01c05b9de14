"""The formats in which the host exports a model, and the `Export` that each of them receives."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.display.notices import to_document
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.gcp import gcps_of_model, gcps_of_points, write_gcps, write_geolocation
from ortho_pipeline.exchange.rpc import (
    RpcExport,
    export_rpc,
    write_rpb,
    write_rpc_txt,
    write_tagged_copy,
    write_vrt,
)
from ortho_pipeline.exchange.rpc_files import write_geom, write_rpc_xml
from ortho_pipeline.hookspecs import Format
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.flat import FlatSurface


def check_formats(names: Sequence[str], known: Mapping[str, Format]) -> tuple[Format, ...]:
    """Return the formats with these names, each once.

    Raises
    ------
    InputError
        If one is unknown.
    """
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(
            f"unknown format {', '.join(unknown)}" if unknown else "no format is given",
            field="formats",
            remedy=f"use one or more of {', '.join(known)}",
        )
    return tuple(known[name] for name in dict.fromkeys(names))


@dataclass(frozen=True)
class Export:
    """A model to export, with its image; the function `write` of a `Format` receives it.

    Parameters
    ----------
    dataset : gdal.Dataset
        The image.
    model : SensorModel
        Its model, adjusted if there were points.
    size : (int, int)
        Columns and rows of the image.
    surface : Surface, optional
        Heights for grids of points.
    control : Points
        The measured points to which the model was adjusted, without gross errors. If there are any, the formats
        ``gcp`` write them.
    left_out : sequence of (str, str)
        The other measured control points, with the reason.
    force : bool
        The user accepts a file that differs from the model by more than 0.1 px.
    document : dict
        Facts about the files as JSON values; the host writes it.

    Examples
    --------
    >>> points, image = op.read_points("sample_data/gcps.geojson"), open_dataset("sample_data/scene.tif")
    >>> Export(image, op.open_scene("sample_data/scene.tif").model, (1000, 1000), None, points).rpc.exact
    True
    """

    dataset: gdal.Dataset
    model: SensorModel
    size: tuple[int, int]
    surface: Surface | None
    control: Points
    left_out: Sequence[tuple[str, str]] = ()
    force: bool = False
    document: dict[str, Any] = field(
        default_factory=lambda: {"exact": None, "max_error_px": None, **to_document(())}, repr=False
    )

    @functools.cached_property
    def rpc(self) -> RpcExport:
        """The model as RPC."""
        exported = export_rpc(self.model, force=self.force)
        worst = {"exact": exported.exact, "max_error_px": exported.max_error_px}
        self.document.update(worst, **to_document(exported.warnings))
        return exported

    def write(self, kind: Format, path: Path) -> None:
        """Write one format."""
        worst = kind.write(self, path)
        if worst is not None:
            self.document[kind.name] = {"max_error_px": worst}

    def summary(self, model: str, source: str, written: Sequence[Format]) -> str:
        """Return a line for each file: what it is, and how well it represents the model."""
        lines = [f"Model {model} of {source}"]
        if self.document["exact"] is not None:
            worst = self.document["max_error_px"]
            lines.append(
                "RPC: exact" if self.document["exact"] else f"RPC: refitted, at most {significant(worst)} px off"
            )
        if "gcps" in self.document:
            lines.append("Control points: {n}, {source}".format(**self.document["gcps"]))
            lines += ["Left out: {id} ({reason})".format(**point) for point in self.document["gcps"]["left_out"]]
        lines += [
            f"{kind.title}: at most {significant(self.document[kind.name]['max_error_px'])} px off"
            for kind in written
            if kind.name not in FORMATS
        ]
        if "geolocation" in self.document:
            arrays = self.document["geolocation"]
            lines.append(
                f"Geolocation: {arrays['heights']}, {significant(arrays['max_error_px'])} px off between its samples"
            )
        return "\n".join([*lines, *(f"Warning: {text}" for text in self.document["warnings"])])


def _write_gcps(export: Export, path: Path) -> None:
    """Write the measured control points, or a grid."""
    left_out: list[dict[str, str]] = []
    if len(export.control):
        gcps, source = gcps_of_points(export.control), "the measured control points"
        left_out = [{"id": name, "reason": reason} for name, reason in export.left_out]
    else:
        gcps, source = gcps_of_model(export.model, export.size, export.surface), f"a grid{_where(export)}"
    export.document["gcps"] = {"n": len(gcps), "source": source, "left_out": left_out}
    write_gcps(export.dataset, gcps, path)


def _write_geolocation(export: Export, path: Path) -> None:
    worst = write_geolocation(export.dataset, export.model, export.size, export.surface, path)
    export.document["geolocation"] = {"max_error_px": worst, "heights": f"the model{_where(export)}"}


def _where(export: Export) -> str:
    surface = export.surface or FlatSurface(export.model.reference_height)
    return f" {surface.describe()}"


#: The formats of the host. The first four are the default. Each writes its largest error into the document.
FORMATS: Mapping[str, Format] = {
    name: Format(name, title, ending, write)
    for name, title, ending, write in (
        ("rpc-txt", "RPC as text", "_RPC.TXT", lambda export, path: write_rpc_txt(export.rpc.rpc, path)),
        ("rpb", "RPC as DigitalGlobe writes it", ".RPB", lambda export, path: write_rpb(export.rpc.rpc, path)),
        ("vrt", "RPC over the image", ".vrt", lambda export, path: write_vrt(export.dataset, export.rpc.rpc, path)),
        (
            "tag",
            "RPC in the TIFF tag of a copy",
            "_rpc.tif",
            lambda export, path: write_tagged_copy(export.dataset, export.rpc.rpc, path),
        ),
        (
            "geom",
            "RPC as keyword list of OTB, shareloc and CARS",
            ".geom",
            lambda export, path: write_geom(export.rpc.rpc, export.size, path),
        ),
        (
            "rpc-xml",
            "RPC as XML of DigitalGlobe and Ames Stereo Pipeline",
            "_rpc.xml",
            lambda export, path: write_rpc_xml(export.rpc.rpc, path),
        ),
        ("gcp", "ground control points", "_gcp.vrt", _write_gcps),
        ("gcp-tag", "ground control points in a copy", "_gcp.tif", _write_gcps),
        ("geolocation", "geolocation arrays", "_geolocation.vrt", _write_geolocation),
    )
}
#: Names that a format of a plugin cannot have: those of the formats above, and other keys of the document.
RESERVED = {*FORMATS, "exact", "files", "gcps", "model", "notices", "warnings"}
