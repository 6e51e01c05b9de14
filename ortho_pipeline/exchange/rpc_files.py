"""RPC text formats of vendors and other programs, read and written without GDAL.

=====================  ============================================  =======================================
format                 pixel origin in the file                      written by
=====================  ============================================  =======================================
RPC text               centre of the first pixel is (0, 0)           IKONOS, OrbView-3, Planet, EROS, Kompsat
RPB                    centre (0, 0)                                 DigitalGlobe, Maxar
DigitalGlobe XML       centre (0, 0)                                 the same, all metadata in one file
DIMAP RPC XML          centre (1, 1); Pleiades Neo (0, 0)            Pleiades, SPOT 6-7
OTB keyword list       centre (0, 0)                                 Orfeo Toolbox (``.geom``), shareloc
=====================  ============================================  =======================================

All of them become an `RPC` in this package's convention: the centre of the first pixel is (0.5, 0.5). A number that is
not finite, or a missing coefficient, is an `InputError` that names file and field.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from ortho_pipeline import files
from ortho_pipeline.errors import InputError, completed, reads
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.locations import VsiPath
from ortho_pipeline.models.rational import RPC

#: Limits in bytes of XML, and of the other formats, which usually have 20 kB.
MAX_SIZE, MAX_PLAIN = 5_000_000, 1_000_000
TEXT_SUFFIXES = frozenset({".txt", ".rpb", ".rpc", ".xml", ".geom"})
#: Field of `RPC` by its name in GDAL, with its unit in RPC text.
SCALARS = {
    "LINE_OFF": ("row_off", "pixels"),
    "SAMP_OFF": ("col_off", "pixels"),
    "LAT_OFF": ("lat_off", "degrees"),
    "LONG_OFF": ("lon_off", "degrees"),
    "HEIGHT_OFF": ("h_off", "meters"),
    "LINE_SCALE": ("row_scale", "pixels"),
    "SAMP_SCALE": ("col_scale", "pixels"),
    "LAT_SCALE": ("lat_scale", "degrees"),
    "LONG_SCALE": ("lon_scale", "degrees"),
    "HEIGHT_SCALE": ("h_scale", "meters"),
}
COEFFICIENTS = {
    "LINE_NUM_COEFF": "row_num",
    "LINE_DEN_COEFF": "row_den",
    "SAMP_NUM_COEFF": "col_num",
    "SAMP_DEN_COEFF": "col_den",
}
ERRORS = {"ERR_BIAS": "err_bias", "ERR_RAND": "err_rand"}
# The order of the fields in RPB and in the XML of the same vendor.
_RPB_NAMES = {
    "ERR_BIAS": "errBias",
    "ERR_RAND": "errRand",
    "LINE_OFF": "lineOffset",
    "SAMP_OFF": "sampOffset",
    "LAT_OFF": "latOffset",
    "LONG_OFF": "longOffset",
    "HEIGHT_OFF": "heightOffset",
    "LINE_SCALE": "lineScale",
    "SAMP_SCALE": "sampScale",
    "LAT_SCALE": "latScale",
    "LONG_SCALE": "longScale",
    "HEIGHT_SCALE": "heightScale",
    "LINE_NUM_COEFF": "lineNumCoef",
    "LINE_DEN_COEFF": "lineDenCoef",
    "SAMP_NUM_COEFF": "sampNumCoef",
    "SAMP_DEN_COEFF": "sampDenCoef",
}
_FROM_RPB = {name.upper(): key for key, name in _RPB_NAMES.items()}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?", re.ASCII)
# Bounded repeats: no malicious file makes it slow.
_RPB_ITEM = re.compile(r"(\w{1,40})[ \t]*=[ \t]*(?:\(([^()]{0,8000})\)|\"([^\"\n]{0,200})\"|([^;\n(\"]{0,200}))\s*;")
_CENTRE = 0.5
_REMEDY = Text("give the RPC file as the vendor delivers it, or another one (", Setting("scene.rpc", "FILE"), ")")


# -- reading ---------------------------------------------------------------------------------------------------------


@reads(_REMEDY)
def read_rpc_text(path: str | PathLike[str]) -> RPC:
    """Read an RPC from any of the text formats of this module.

    Raises
    ------
    InputError
        If the file cannot be read, has no RPC, or a field is missing, not finite, or zero where it must not be.

    Examples
    --------
    >>> read_rpc_text("sample_data/scene_RPC.TXT").h_off
    1000.0
    """
    text = _text_of(path)
    lowered = text[:100_000].lower()
    if text.lstrip()[:1] == "<":
        fields, origin = _fields_of_xml(text, path)
    elif len(text) > MAX_PLAIN:
        raise InputError("this file is larger than 1 MB, so it is not an RPC text", file=path)
    elif "linenumcoef" in lowered:
        fields, origin = _fields_of_rpb(text, path), 0.0
    elif "line_num_coeff_00" in lowered:
        fields, origin = _fields_of_geom(text, path), 0.0
    else:
        fields, origin = _fields_of_lines(text, path), 0.0
    return rpc_of_fields(fields, path, origin=origin)


def size_of_image(path: Path | VsiPath) -> tuple[int, int] | None:
    """Return columns and rows of the image for which an RPC file was made; None if the file does not state them."""
    if path.suffix.lower() != ".geom" or not path.is_file():
        return None
    sizes = dict(
        re.findall(r"^[ \t]*number_(samples|lines):[ \t]*(\d{1,9})[ \t\r]*$", _text_of(path), re.MULTILINE | re.ASCII)
    )
    return (int(sizes["samples"]), int(sizes["lines"])) if len(sizes) == 2 else None


def rpc_of_fields(fields: Mapping[str, str], file: str | PathLike[str] | None = None, *, origin: float = 0.0) -> RPC:
    """Make an RPC from texts under GDAL's names.

    Parameters
    ----------
    fields : mapping of str to str
        Numbers; units after them are ignored. Coefficients are one text of 20, or ``LINE_NUM_COEFF_1`` to ``_20``.
    file : path, optional
        For messages.
    origin : float
        Coordinate of the centre of the first pixel in the file.

    Raises
    ------
    InputError
        If a field is missing or wrong.

    Examples
    --------
    >>> rpc_of_fields(open_dataset("sample_data/scene.tif").GetMetadata("RPC")).h_off
    1000.0
    """
    with completed(file, remedy=_REMEDY):
        return _rpc(fields, file, origin)


def _rpc(fields: Mapping[str, str], file: str | PathLike[str] | None, origin: float) -> RPC:
    if not any(key in fields or f"{key}_1" in fields for key in (*SCALARS, *COEFFICIENTS)):
        raise InputError(
            "there is no RPC in this file", file=file, remedy="give an RPC text, .RPB, DIMAP RPC XML or OTB .geom file"
        )
    values: dict[str, object] = {}
    for key, (name, _) in SCALARS.items():
        values[name] = _number(fields.get(key), file, key)
    for key, name in COEFFICIENTS.items():
        values[name] = _coefficients(fields, key, file)
    for key, name in ERRORS.items():
        values[name] = _error(fields.get(key), file, key)
    for name in ("row_off", "col_off"):
        values[name] += _CENTRE - origin  # type: ignore[operator]
    try:
        return RPC(**values)  # type: ignore[arg-type]
    except InputError as error:
        names = {name: key for key, (name, _) in SCALARS.items()} | {name: key for key, name in COEFFICIENTS.items()}
        field = ", ".join(names.get(name, name) for name in (error.field or "").split(", "))
        raise InputError(error.message, file=file, field=field, remedy=error.remedy) from error


def _text_of(path: str | PathLike[str]) -> str:
    data = files.read_bounded(path, MAX_SIZE)
    if len(data) > MAX_SIZE:
        raise InputError("this file is larger than 5 MB, so it is not an RPC file", file=path)
    if data.startswith(files.UTF_16):
        raise InputError("this file is UTF-16 text", file=path, remedy="save it as UTF-8")
    if b"\0" in data:
        raise InputError("this is a binary file, not RPC text", file=path)
    return files.decoded(data)


def _number(text: str | None, file: str | PathLike[str] | None, field: str) -> float:
    if text is None or not text.strip():
        raise InputError("this field of the RPC is missing", file=file, field=field)
    token = text.split(maxsplit=1)[0][:60]
    if not _NUMBER.fullmatch(token):
        raise InputError(f"{token!r} is not a number", file=file, field=field)
    value = float(token.replace("D", "e").replace("d", "e"))
    if not math.isfinite(value):
        raise InputError(f"{token} is too large for a number", file=file, field=field)
    return value


def _error(text: str | None, file: str | PathLike[str] | None, field: str) -> float | None:
    # GDAL and the TIFF tag write "unknown" as a negative number; this is no reason to refuse a model.
    if text is None or not text.strip() or text.split()[0].lower().lstrip("+-") == "nan":
        return None
    value = _number(text, file, field)
    return value if value >= 0.0 else None


def _coefficients(fields: Mapping[str, str], key: str, file: str | PathLike[str] | None) -> list[float]:
    if key in fields:
        tokens = fields[key].replace(",", " ").split(maxsplit=21)
        if len(tokens) != 20:
            raise InputError(f"there must be 20 coefficients, not {len(tokens)}", file=file, field=key)
        return [_number(token, file, f"{key} {n}") for n, token in enumerate(tokens, 1)]
    return [_number(fields.get(f"{key}_{n}"), file, f"{key}_{n}") for n in range(1, 21)]


def _put(fields: dict[str, str], key: str, value: str, file: str | PathLike[str]) -> None:
    if fields.setdefault(key, value) != value:
        raise InputError("this field appears twice, with different values", file=file, field=key)


def _is_rpc_key(key: str) -> bool:
    return key in SCALARS or key in ERRORS or re.sub(r"_\d+$", "", key) in COEFFICIENTS


def _fields_of_lines(text: str, path: str | PathLike[str]) -> dict[str, str]:
    fields: dict[str, str] = {}
    for line in text.splitlines():
        key, colon, value = line[:500].partition(":" if ":" in line[:500] else "=")
        key = key.strip().upper().replace("LON_", "LONG_")
        if colon and _is_rpc_key(key):
            _put(fields, key, value.strip(), path)
    return fields


def _fields_of_geom(text: str, path: str | PathLike[str]) -> dict[str, str]:
    fields: dict[str, str] = {}
    renamed = {"BIAS_ERROR": "ERR_BIAS", "RAND_ERROR": "ERR_RAND"}
    for line in text.splitlines():
        key, _, value = line[:500].partition(":")
        key, value = key.strip(), value.strip()
        if key.startswith("adjustment_") and key.endswith((".parameter", ".center")) and _number(value, path, key):
            raise InputError("this file contains an adjustment, which cannot be applied", file=path, field=key)
        key = key.rpartition(".")[2].upper().replace("LON_", "LONG_")
        if key == "POLYNOMIAL_FORMAT" and value != "B":
            raise InputError(f"polynomials of format {value!r} cannot be read, only B (RPC00B)", file=path, field=key)
        term = re.fullmatch(r"(\w+_COEFF)_(\d\d)", key, re.ASCII)
        if term:
            key = f"{term[1]}_{int(term[2]) + 1}"
        key = renamed.get(key, key)
        if _is_rpc_key(key):
            _put(fields, key, value, path)
    # The toolbox writes 0 for an unknown accuracy.
    return {key: value for key, value in fields.items() if key not in ERRORS or value != "0"}


def _fields_of_rpb(text: str, path: str | PathLike[str]) -> dict[str, str]:
    fields: dict[str, str] = {}
    for item in _RPB_ITEM.finditer(text):
        name = item[1].upper()
        value = next((part for part in item.groups()[1:] if part is not None), "")
        if name == "SPECID":
            _check_spec(value, path)
        elif name in _FROM_RPB:
            _put(fields, _FROM_RPB[name], value.strip(), path)
    return fields


def _check_spec(text: str, path: str | PathLike[str]) -> None:
    if text.strip().upper() != "RPC00B":
        raise InputError(f"{text[:40]!r} cannot be read, only RPC00B", file=path, field="SpecId")


def _fields_of_xml(text: str, path: str | PathLike[str]) -> tuple[dict[str, str], float]:
    from defusedxml import ElementTree
    from defusedxml.common import DefusedXmlException

    try:
        # Without the declaration: it may name another encoding than that of the decoded text.
        root = ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]{0,300}\?>", "", text, count=1), forbid_dtd=True)
    except (ElementTree.ParseError, DefusedXmlException, ValueError) as error:
        raise InputError(f"this is not well-formed XML ({error})", file=path) from error
    parts: dict[str, list[Any]] = {}
    for element in root.iter():
        tag = element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""
        parts.setdefault(tag, []).append(element)
    if "RFM_Validity" in parts or "Inverse_Model" in parts or "GroundtoImage_Values" in parts:
        profile = _first_text(parts, "METADATA_PROFILE")
        # Pleiades Neo counts pixels from 0, its predecessors and SPOT from 1.
        origin = 0.0 if "PNEO" in profile.upper() else 1.0
        fields: dict[str, str] = {}
        # Version 3 (Pleiades Neo) has another name for the model from ground to image.
        for tag in ("RFM_Validity", "Inverse_Model", "GroundtoImage_Values"):
            for child in parts.get(tag, [[]])[0]:
                key = str(child.tag).rpartition("}")[2]
                if _is_rpc_key(key):
                    _put(fields, key, (child.text or "").strip(), path)
        return fields, origin
    if "SPECID" in parts:
        _check_spec(_first_text(parts, "SPECID"), path)
    return {key: _first_text(parts, tag) for tag, key in _FROM_RPB.items() if tag in parts}, 0.0


def _first_text(parts: Mapping[str, list[Any]], tag: str) -> str:
    elements = parts.get(tag)
    return (elements[0].text or "").strip() if elements else ""


# -- writing ---------------------------------------------------------------------------------------------------------


def rpc_metadata(rpc: RPC) -> dict[str, str]:
    """Return the items of GDAL's metadata domain ``RPC``.

    Reading them again gives the same model to the last bit (offsets of less than half a pixel: to 1e-16 px).
    """
    fields: dict[str, str] = {}
    for key, name in ERRORS.items():
        value = getattr(rpc, name)
        if value is not None and math.isfinite(value):
            fields[key] = repr(float(value))
    for key, (name, _) in SCALARS.items():
        value = getattr(rpc, name) - (_CENTRE if name in ("row_off", "col_off") else 0.0)
        fields[key] = repr(float(value))
    for key, name in COEFFICIENTS.items():
        fields[key] = " ".join(repr(float(value)) for value in getattr(rpc, name))
    return fields


def write_rpc_txt(rpc: RPC, path: str | PathLike[str]) -> None:
    """Write RPC text. GDAL reads it next to an image if it is named ``<image>_RPC.TXT`` or ``<image>_rpc.txt``.

    Raises
    ------
    InputError
        If the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> path = f"{tempfile.mkdtemp()}/scene_RPC.TXT"
    >>> write_rpc_txt(read_rpc_text("sample_data/scene_RPC.TXT"), path)
    >>> open(path).readline().split()[0]
    'LINE_OFF:'
    """
    fields = rpc_metadata(rpc)
    lines = [f"{key}: {fields[key]} {unit}" for key, (_, unit) in SCALARS.items()]
    for key in COEFFICIENTS:
        lines += [f"{key}_{n}: {value}" for n, value in enumerate(fields[key].split(), 1)]
    lines += [f"{key}: {fields[key]} meters" for key in ERRORS if key in fields]
    files.write_text(path, "\n".join(lines) + "\n")


def write_rpb(rpc: RPC, path: str | PathLike[str]) -> None:
    """Write an ``.RPB`` file, which GDAL reads next to an image.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    fields = rpc_metadata(rpc)
    lines = ['satId = "????";', 'bandId = "?";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    for key, name in _RPB_NAMES.items():
        if key in COEFFICIENTS:
            values = ",\n".join(f"\t\t\t{value}" for value in fields[key].split())
            lines.append(f"\t{name} = (\n{values});")
        elif key in fields:
            lines.append(f"\t{name} = {fields[key]};")
    lines += ["END_GROUP = IMAGE", "END;"]
    files.write_text(path, "\n".join(lines) + "\n")


def write_geom(rpc: RPC, size: tuple[int, int], path: str | PathLike[str]) -> None:
    """Write a keyword list (``.geom``) of Orfeo Toolbox, which shareloc and CARS read, too.

    Parameters
    ----------
    size : (int, int)
        Columns and rows of the image.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    fields = rpc_metadata(rpc)
    lines = [f"{key.lower()}:  {fields[key]}" for key in SCALARS]
    for key in COEFFICIENTS:
        lines += [f"{key.lower()}_{n:02d}:  {value}" for n, value in enumerate(fields[key].split())]
    # The toolbox writes 0 for an unknown accuracy.
    lines += [
        f"{name}:  {fields.get(key, 0)}" for name, key in (("bias_error", "ERR_BIAS"), ("rand_error", "ERR_RAND"))
    ]
    lines += ["polynomial_format:  B", "type:  ossimRpcModel"]
    lines += [f"number_lines:  {size[1]}", f"number_samples:  {size[0]}"]
    files.write_text(path, "\n".join(lines) + "\n")


def write_rpc_xml(rpc: RPC, path: str | PathLike[str]) -> None:
    """Write the RPC part of DigitalGlobe's XML, the form in which Ames Stereo Pipeline reads and writes an RPC.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    fields = rpc_metadata(rpc)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<isd>", "<RPB>", "<SPECID>RPC00B</SPECID>", "<IMAGE>"]
    for key, name in _RPB_NAMES.items():
        tag = name.upper()
        if key in COEFFICIENTS:
            lines.append(f"<{tag}List><{tag}>{fields[key]}</{tag}></{tag}List>")
        elif key in fields:
            lines.append(f"<{tag}>{fields[key]}</{tag}>")
    files.write_text(path, "\n".join([*lines, "</IMAGE>", "</RPB>", "</isd>"]) + "\n")
