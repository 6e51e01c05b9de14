"""RPC in and out: sidecar files, tags, GDAL's metadata domain, and RPCs fitted to any model.

GDAL's transformer and this package agree to rounding: an RPC at its own offsets gives (SAMP_OFF + 0.5, LINE_OFF + 0.5).
The text formats are in `ortho_pipeline.exchange.rpc_files`.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from osgeo import gdal

from ortho_pipeline import files
from ortho_pipeline.errors import InputError, ModelError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange.rpc_files import (
    TEXT_SUFFIXES,
    read_rpc_text,
    rpc_metadata,
    rpc_of_fields,
    write_rpb,
    write_rpc_txt,
)
from ortho_pipeline.exchange.rpc_fit import RpcExport, box_grid, domain_box, fit_rpc
from ortho_pipeline.files.folders import listing
from ortho_pipeline.files.locations import Location, VsiPath, place
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.raster.verified_writing import close, raster_output, written

__all__ = [
    "RpcExport",
    "export_rpc",
    "fit_rpc",
    "has_rpc",
    "name_sources_relatively",
    "read_rpc",
    "require_same_rpc",
    "rpc_metadata",
    "rpc_of_dataset",
    "without_georeference",
    "write_bare_vrt",
    "write_rpb",
    "write_rpc_txt",
    "write_tagged_copy",
    "write_vrt",
]

#: Corners of a chip, and how far (px) they may be from a shift and a scale: they have three decimals.
_CORNERS, _CHIP_ROUNDING = ("11", "12", "21", "22"), 0.01
#: Drivers of images that consist of several files: without the others GDAL does not open them.
_OF_SEVERAL_FILES = ("VRT", "ENVI", "EHdr", "TIL")
#: What is before the path of an archive in a name of GDAL's.
_FIRST_FOLDER = re.compile(r"^(/vsi[a-z0-9]+(?=/vsi))*/vsi[a-z0-9]+/\{*")
#: Tag and sidecar that differ by more than this at the centre (px) are different models.
DISAGREEMENT = 1.0


# -- reading ---------------------------------------------------------------------------------------------------------


def read_rpc(path: str | PathLike[str]) -> RPC:
    """Read the RPC in a file: RPC text, RPB, DIMAP or DigitalGlobe XML, OTB keyword list, or a raster that has one.

    Raises
    ------
    InputError
        If the file has no RPC, or a field is missing or wrong.

    Examples
    --------
    >>> rpc = read_rpc("sample_data/scene_RPC.TXT")
    >>> rpc.ground_to_image([[33.35, 37.25, 800.0]]).round(1)
    array([[501.9, 504.2]])
    """
    file = place(path)
    if file.suffix.lower() in TEXT_SUFFIXES or _begins_like_rpc(file):
        return read_rpc_text(file)
    return rpc_of_dataset(open_dataset(file))[0]


def has_rpc(dataset: gdal.Dataset) -> bool:
    """Return whether GDAL finds an RPC for this dataset, in it or next to it, readable or not.

    Examples
    --------
    >>> has_rpc(open_dataset("sample_data/scene.tif")), has_rpc(open_dataset("sample_data/dem.tif"))
    (True, False)
    """
    try:
        _refuse_unread_sidecar(dataset)
        return bool(dataset.GetMetadata("RPC"))
    except (RuntimeError, InputError):
        return True


def rpc_of_dataset(dataset: gdal.Dataset, choice: str | PathLike[str] | None = None) -> tuple[RPC, str]:
    """Return the RPC of an open dataset, and the name of its file or tag.

    Parameters
    ----------
    dataset : gdal.Dataset
    choice : {None, 'tag', 'sidecar'} or path
        Which RPC to use. GDAL silently prefers a sidecar to a tag; by default this is accepted only if both agree
        within a pixel at the centre of the scene.

    Raises
    ------
    InputError
        If there is no RPC, it is damaged or unreadable, the chosen one is missing, or tag and sidecar disagree.

    Examples
    --------
    >>> model, source = rpc_of_dataset(open_dataset("sample_data/scene.tif"))
    >>> source
    'sample_data/scene_RPC.TXT'
    """
    name = dataset.GetDescription()
    if choice is not None and str(choice) not in ("tag", "sidecar"):
        return _in_tile(dataset, read_rpc(choice), os.path.realpath(choice)), os.fspath(choice)
    if choice != "tag":
        _refuse_unread_sidecar(dataset)
    tag, sidecar = _own_fields(dataset), None
    fields = _fields_beside(dataset)
    beside = _sidecar_files(dataset)
    if fields and (fields != tag or any(_is_rpc_file(file) for file in beside)):
        sidecar = fields, _sidecar_source(fields, beside, name)
    if choice == "sidecar":
        tag = {}
    elif choice == "tag":
        sidecar = None
    if sidecar and tag:
        _check_agreement(rpc_of_fields(tag, name), [rpc_of_fields(*sidecar)], sidecar[1], name, "sidecar")
    if sidecar:
        return rpc_of_fields(*sidecar), sidecar[1]
    if tag:
        return _of_chip(dataset, rpc_of_fields(tag, name)), f"{name} ({_own_kind(dataset)})"
    what = "RPC" if choice is None else {"tag": "RPC tag", "sidecar": "RPC sidecar file"}[str(choice)]
    damaged = ", ".join(_unreadable_beside(place(name))) if choice != "tag" else ""
    raise InputError(
        f"there is no {what}" + (f" that can be read: {damaged} is damaged or encrypted" if damaged else ""),
        file=name,
        field="scene.rpc",
        remedy=Text("give the RPC file with ", Setting("scene.rpc", "FILE")),
    )


def require_same_rpc(dataset: gdal.Dataset, delivered: Iterable[RPC], source: str) -> None:
    """Raise an error if an image has an RPC tag that agrees with none of the RPCs in the metadata `source`.

    Raises
    ------
    InputError
        If all differ from the tag by more than a pixel at the centre of the scene: the tag is of a crop, or adjusted.

    Examples
    --------
    >>> image = open_dataset("sample_data/scene.tif")
    >>> require_same_rpc(image, [rpc_of_dataset(image)[0]], "metadata.xml")
    """
    try:
        own, _ = rpc_of_dataset(dataset, "tag")
    except InputError:
        return
    _check_agreement(own, delivered, source, dataset.GetDescription())


def _in_tile(dataset: gdal.Dataset, model: RPC, path: str) -> RPC:
    """Return the RPC of a given file; that of the mosaic that an image is a tile of is moved, as GDAL moves it."""
    fields = _fields_beside(dataset)
    if not fields or path not in {os.path.realpath(file) for file in _sidecar_files(dataset)}:
        return model
    try:
        used = rpc_of_fields(fields, path)
    except InputError:
        return model
    shift = np.array([model.col_off - used.col_off, model.row_off - used.row_off])
    same = np.allclose([*model.row_num, *model.col_num], [*used.row_num, *used.col_num], rtol=1e-12, atol=0.0)
    return used if same and np.abs(shift - np.round(shift)).max() < 1e-6 else model


def _of_chip(dataset: gdal.Dataset, model: RPC) -> RPC:
    """Return the RPC of a NITF image that was cut out of another, whose pixels its RPC has (ICHIPB); GDAL ignores it.

    Source: STDI-0002, appendix B: corners of the chip (OP) and of the full image (FI), both from the outer corner.
    """
    stated = dataset.GetMetadata() or {}
    if not any(name.startswith("ICHIP_") for name in stated):
        return model
    sides: dict[str, list[float]] = {}
    with contextlib.suppress(ValueError, KeyError):
        for axis in ("COL", "ROW"):
            chip, full = (
                np.array([float(stated[f"ICHIP_{of}_{axis}_{corner}"]) for corner in _CORNERS]) for of in ("OP", "FI")
            )
            factor, begin = np.polyfit(chip, full, 1).tolist()
            sides[axis] = [factor, begin, float(np.abs(factor * chip + begin - full).max())]
    factors = [scale for scale, _, _ in sides.values()]
    flat = len(sides) == 2 and factors[0] > 0 and abs(factors[1] / factors[0] - 1) < 1e-6
    if not flat or max(left for _, _, left in sides.values()) > _CHIP_ROUNDING:
        raise InputError(
            "this image was cut out of another (ICHIPB), in a way that its RPC cannot follow",
            file=dataset.GetDescription(),
            field="ICHIPB",
            remedy=Text("give an RPC of this image with ", Setting("scene.rpc", "FILE")),
        )
    return model.shifted(sides["COL"][1], sides["ROW"][1]).scaled(factors[0])


def _begins_like_rpc(path: Path | VsiPath) -> bool:
    head = files.read_bounded(path, 20_000).lower()
    return b"\0" not in head and b"<vrtdataset" not in head and (b"line_off" in head or b"lineoffset" in head)


def _fields_beside(dataset: gdal.Dataset) -> dict[str, str]:
    """Return GDAL's RPC domain, which prefers sidecars; empty if one is damaged or encrypted."""
    try:
        return dict(dataset.GetMetadata("RPC") or {})
    except RuntimeError:
        return {}


def _refuse_unread_sidecar(dataset: gdal.Dataset) -> None:
    """Refuse an RPC sidecar that cannot be read: GDAL would continue without it, or with a tag."""
    path = place(dataset.GetDescription())
    for file in _sidecar_names(path) if isinstance(path, Path) else []:
        if file.is_file():
            files.read_bounded(
                file,
                1_000_000,
                field="scene.rpc",
                remedy=Text(
                    "copy it again from the delivery, or choose another RPC: ",
                    Setting("scene.rpc", "tag"),
                    ", ",
                    Setting("scene.rpc", "FILE"),
                ),
            )


def _unreadable_beside(path: Path) -> list[str]:
    """Return the names of files next to an image that look like its RPC."""
    if not path.parent.is_dir():
        return []
    beside = (path.parent / name for name in listing(path.parent).beginning(path.stem))
    return sorted(file.name for file in beside if file.stem.startswith(path.stem) and _is_rpc_file(file))


def _own_fields(dataset: gdal.Dataset) -> dict[str, str]:
    """Return the RPC domain of the file itself, without sidecars."""
    name = dataset.GetDescription()
    if not place(name).is_file() or dataset.GetDriver().ShortName in _OF_SEVERAL_FILES:
        return dict(dataset.GetMetadata("RPC") or {})
    return dict(open_dataset(place(name), siblings=False).GetMetadata("RPC") or {})


def _own_kind(dataset: gdal.Dataset) -> str:
    driver = dataset.GetDriver().ShortName
    return {"GTiff": "TIFF tag", "COG": "TIFF tag", "VRT": "VRT metadata"}.get(driver, f"{driver} metadata")


def files_of(dataset: gdal.Dataset) -> list[str]:
    """Return the files of a dataset by GDAL; only the file itself if a sidecar cannot be read."""
    try:
        return list(dataset.GetFileList() or [])
    except RuntimeError:
        return [dataset.GetDescription()]


def _sidecar_files(dataset: gdal.Dataset) -> list[Path]:
    if dataset.GetDriver().ShortName == "VRT":
        return []
    own = os.path.normpath(dataset.GetDescription())
    return [place(file) for file in files_of(dataset) if os.path.normpath(file) != own]


def _is_rpc_file(path: Path) -> bool:
    return bool(re.search(r"rpc[^/]*\.(txt|xml)$|\.rpb$|\.rpc$", path.name, re.IGNORECASE))


def _sidecar_source(fields: dict[str, str], beside: list[Path], name: str) -> str:
    for path in sorted(beside, key=lambda path: not _is_rpc_file(path)):
        if path.suffix.lower() in TEXT_SUFFIXES:
            try:
                delivered, used = read_rpc_text(path), rpc_of_fields(fields, name)
            except InputError:
                continue
            # GDAL shifts the RPC of a tile of a mosaic, so compare only what it never changes.
            if np.allclose(delivered.row_num, used.row_num, rtol=1e-12, atol=0.0):
                return os.fspath(path)
    likely = [path for path in beside if _is_rpc_file(path) or path.name.endswith(".aux.xml")] or beside
    return ", ".join(map(os.fspath, likely)) or f"{name} (metadata)"


def _check_agreement(tag: RPC, others: Iterable[RPC], source: str, name: str, *choices: str) -> None:
    """Raise an error unless one of `others`, in the file `source`, agrees with the tag at the centre of the scene."""
    centre = np.array([[tag.lon_off, tag.lat_off, tag.h_off]])
    seen = tag.ground_to_image(centre)
    difference = float(np.fmin.reduce([np.abs(one.ground_to_image(centre) - seen).max() for one in others]))
    if not difference <= DISAGREEMENT:
        apart = f"by {difference:.1f} px" if np.isfinite(difference) else "completely"
        raise InputError(
            f"the RPC in the file and the RPC in {source} differ {apart} at the centre of the scene",
            file=name,
            field="scene.rpc",
            remedy=Text(
                "choose one: ",
                Text.joined(", ", [Text(Setting("scene.rpc", choice)) for choice in ("tag", *choices)]),
                ", or ",
                Setting("scene.rpc", "FILE"),
            ),
        )


# -- writing ---------------------------------------------------------------------------------------------------------


def write_vrt(dataset: gdal.Dataset, rpc: RPC, path: str | PathLike[str]) -> None:
    """Write a VRT of `dataset` with `rpc`, for any GDAL program.

    It has no GCPs and no geotransform, because GDAL prefers them to an RPC. The path of its source is relative to the
    VRT.

    Raises
    ------
    InputError
        If the folder cannot be written.
    ModelError
        If the RPC differs when it is read again.
    """
    with raster_output(path) as temporary:
        view = without_georeference(dataset)
        view.SetMetadata(rpc_metadata(rpc), "RPC")
        close(gdal.GetDriverByName("VRT").CreateCopy(os.fspath(temporary), view))
        name_sources_relatively(temporary, Path(path))
        _check_written(gdal.OpenEx(os.fspath(temporary), gdal.OF_RASTER, allowed_drivers=["VRT"]), rpc, path)


def write_bare_vrt(dataset: gdal.Dataset, path: str | PathLike[str]) -> None:
    """Write a VRT of an image without geotransform, CRS, GCPs and RPC, for programs that take these for a map.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    from defusedxml import ElementTree

    with raster_output(path) as temporary:
        with written(gdal.GetDriverByName("VRT").CreateCopy(os.fspath(temporary), dataset)):
            pass
        name_sources_relatively(temporary, Path(path))
        root = ElementTree.fromstring(temporary.read_bytes())
        located = [root.find("SRS"), root.find("GeoTransform"), root.find("GCPList")]
        located += [part for part in root.findall("Metadata") if part.get("domain") in ("RPC", "GEOLOCATION")]
        for part in located:
            if part is not None:
                root.remove(part)
        temporary.write_bytes(ElementTree.tostring(root))


def without_georeference(dataset: gdal.Dataset) -> gdal.Dataset:
    """Return a view of an image without RPC, points and geotransform, which programs would prefer to ours."""
    # A geotransform cannot be removed; with points, Translate does not copy it.
    view = gdal.Translate("", dataset, format="VRT", GCPs=[gdal.GCP()])
    view.SetGCPs([], "")
    view.SetMetadata({}, "RPC")
    # The place of a photo, which its sensor would prefer. And what Translate leaves out.
    view.SetMetadata([], "xml:XMP")
    view.SetMetadata(dataset.GetMetadata("IMD") or {}, "IMD")
    return view


def name_sources_relatively(vrt: Path, final: Path) -> None:
    """Make the source paths of a VRT relative to `final`, its final path; those in archives become absolute."""
    from defusedxml import ElementTree

    root = ElementTree.fromstring(vrt.read_bytes())
    folder = final.resolve().parent
    for source in root.iter("SourceFilename"):
        if source.get("relativeToVRT") != "1" and source.text and Path(source.text).is_file():
            source.text = os.path.relpath(Path(source.text).resolve(), folder)
            source.set("relativeToVRT", "1")
        elif source.text and (archive := Location(source.text).archive) is not None and not archive.is_absolute():
            source.text = _FIRST_FOLDER.sub(lambda before: f"{before[0]}{Path.cwd()}/", source.text, count=1)
    vrt.write_bytes(ElementTree.tostring(root))


def write_tagged_copy(dataset: gdal.Dataset, rpc: RPC, path: str | PathLike[str]) -> None:
    """Write a lossless GeoTIFF copy of `dataset` with `rpc` in its TIFF tag.

    It keeps bands, nodata, mask, palette and colour interpretation. It has no GCPs and no geotransform, because GDAL
    prefers them to an RPC.

    Raises
    ------
    InputError
        If the folder cannot be written, or has an RPC sidecar that would override the tag.
    ModelError
        If the RPC differs when it is read again.
    """
    stale = [file for file in _sidecar_names(Path(path)) if file.exists()]
    if stale:
        raise InputError("this RPC file would override the tag of the copy", file=stale[0], remedy="remove it")
    with raster_output(path) as temporary:
        view = without_georeference(dataset)
        view.SetMetadata(rpc_metadata(rpc), "RPC")
        options = ["COMPRESS=DEFLATE", "TILED=YES", "BIGTIFF=IF_SAFER"]
        close(gdal.GetDriverByName("GTiff").CreateCopy(os.fspath(temporary), view, options=options))
        _check_written(open_dataset(temporary, siblings=False), rpc, path)


def _sidecar_names(path: Path) -> list[Path]:
    # A raster in memory has no name and no sidecars.
    if not path.name:
        return []
    return [path.with_name(path.stem + end) for end in ("_RPC.TXT", "_rpc.txt", ".RPB", ".rpb", ".RPC", ".rpc")]


def _check_written(dataset: gdal.Dataset, rpc: RPC, path: str | PathLike[str]) -> None:
    written = rpc_of_fields(dataset.GetMetadata("RPC") or {}, path)
    ground = box_grid(*domain_box(rpc), (5, 5, 3))
    worst = np.nanmax(np.abs(written.ground_to_image(ground) - rpc.ground_to_image(ground)))
    if not worst < 1e-6 or dataset.GetGCPCount() or dataset.GetGeoTransform(can_return_null=True):
        raise ModelError(f"the written RPC is off by {worst:g} px when it is read again", file=path)


# -- RPC of any model ------------------------------------------------------------------------------------------------


def export_rpc(
    model: SensorModel,
    *,
    box: tuple[float, float, float, float] | None = None,
    height_range: tuple[float, float] | None = None,
    force: bool = False,
) -> RpcExport:
    """Return `model` as an RPC, exact if possible, else fitted (`fit_rpc`).

    An RPC holds a shift and a scale of each axis exactly, in its offsets and scales. It holds a cross term (column into
    row) exactly if both denominators are equal.

    Parameters
    ----------
    model : SensorModel
    box : (xmin, ymin, xmax, ymax), optional
        Region to fit, in longitude and latitude (degrees). Default: the domain of the model.
    height_range : (lo, hi), optional
        Ellipsoidal heights (m) to fit. Default: those of the domain.
    force : bool
        Accept a fit that is off by more than 0.1 px. One that is off by more than 0.02 px has a notice in `warnings`.

    Raises
    ------
    InputError, ModelError
        As `fit_rpc`.

    Examples
    --------
    >>> export_rpc(read_rpc("sample_data/scene_RPC.TXT")).exact
    True
    """
    exact = _folded(model)
    if exact is not None:
        return RpcExport(exact, True, 0.0)
    default_box, default_range = domain_box(model)
    return fit_rpc(model, box or default_box, height_range or default_range, force=force)


def _folded(model: SensorModel) -> RPC | None:
    """Return the RPC that equals `model`, or None."""
    if isinstance(model, RPC):
        return model
    inner = _folded(model.model) if isinstance(model, ImageCorrection) else None
    if inner is None or not isinstance(model, ImageCorrection):
        return None
    matrix, offset = model.matrix, model.offset
    crossed = matrix[0, 1] != 0.0 or matrix[1, 0] != 0.0
    if crossed and not np.array_equal(inner.col_den, inner.row_den):
        return None
    off = matrix @ [inner.col_off, inner.row_off] + offset
    changes: dict[str, Any] = {"col_off": float(off[0]), "row_off": float(off[1])}
    if crossed:
        ratio = inner.row_scale / inner.col_scale
        changes["col_num"] = matrix[0, 0] * inner.col_num + matrix[0, 1] * ratio * inner.row_num
        changes["row_num"] = matrix[1, 0] / ratio * inner.col_num + matrix[1, 1] * inner.row_num
    else:
        changes["col_scale"] = float(matrix[0, 0]) * inner.col_scale
        changes["row_scale"] = float(matrix[1, 1]) * inner.row_scale
    return inner._replace(**changes)
