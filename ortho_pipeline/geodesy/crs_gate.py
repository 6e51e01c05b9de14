"""The gate for texts that state a coordinate system: none of them leads PROJ to a file of strangers.

PROJ opens what `+init=`, `+nadgrids=`, `+geoidgrids=`, ``PROJ4_GRIDS`` and ``PARAMETERFILE`` name, wherever it is, and
waits for pipes. It looks for a bare name in its own folders, and that of GDAL then in the working folder.
"""

from __future__ import annotations

import json
import os
import re

import pyproj

from ortho_pipeline.errors import CrsError

#: Where a value or a name begins in a PROJ string, in WKT (which also has typographic quotes) and in JSON.
_START = r"""(?:^|[=,@"'“\[(])\s*"""
#: What PROJ does not look for in its folders: paths from the root, the home or the working folder, drives and URLs.
_ELSEWHERE = r"(?:[/\\~]|\.\.?[/\\]|[a-z]:[/\\]|[a-z][a-z0-9+.-]+://)"
#: Addresses of documents, and addresses that represent a code, come first and are skipped: nothing opens them.
_LEADS = re.compile(
    r"""(?:\b(?:URI|CITATION|REMARK)\s*[\[(]|"(?:\$schema|uri|citation|remarks)"\s*[:,])\s*["“]\s*https?://"""
    rf"|^\s*https?://(?:www\.)?opengis\.net/|(?P<path>{_START}{_ELSEWHERE}|[/\\]\.\.(?![^/\\,\"'\s]))",
    re.IGNORECASE,
)
#: The rest of a value or name, up to what ends it.
_VALUE = re.compile(_START + r"""([^=,@"'“”\[\]()]+)""")
#: Of every eighth system in the databases of EPSG and Esri the longest text has 7,000 characters.
_LONGEST = 100_000
_REMEDY = "give EPSG:n, WKT or a PROJ string without file paths; PROJ finds grids in its own folder by name"


def refuse_files(text: str) -> None:
    """Refuse a text that states a coordinate system and leads to a file outside of PROJ's own folders.

    Parameters
    ----------
    text : str
        A code, a name, WKT, PROJJSON or a PROJ string. Whether it is a sound one, PROJ tells.

    Raises
    ------
    CrsError
        If it names a path, an address, or what the working folder has and PROJ's folders have not; or has a percent
        sign.
    """
    if len(text) > _LONGEST:
        raise CrsError(f"this coordinate system is too long ({len(text)} characters)", field="CRS", remedy=_REMEDY)
    if text.lstrip().startswith("{"):
        text = _unescaped(text)
    if "%" in text:
        # PROJ 9.5 takes the name of a missing grid for a format: %s and %n there end the process.
        raise CrsError("a coordinate system must not contain a percent sign", field="CRS", remedy=_REMEDY)
    if any(match["path"] is not None for match in _LEADS.finditer(text)):
        raise CrsError(
            "this coordinate system refers to a file by its path; such files are not opened",
            field="CRS",
            remedy=_REMEDY,
        )
    for match in _VALUE.finditer(text):
        for name in {match[1].strip(), match[1].split(maxsplit=1)[0] if match[1].strip() else ""}:
            if name and _is_of_working_folder(name):
                raise CrsError(
                    f"this coordinate system refers to {name[:80]!r}, which is a file in the current folder",
                    field="CRS",
                    remedy="run the command in another folder, or install the grid in PROJ's own folder",
                )


def _is_of_working_folder(name: str) -> bool:
    try:
        if os.path.isdir(name) or not os.path.lexists(name):
            return False
        folders = [*pyproj.datadir.get_data_dir().split(os.pathsep), pyproj.datadir.get_user_data_dir()]
        return not any(os.path.isfile(os.path.join(folder, name)) for folder in folders)
    except ValueError:
        # A text that can be no name: NUL, surrogates.
        return False


def _unescaped(text: str) -> str:
    """Return JSON without escapes, and with every value of a key that is given twice."""
    try:
        return json.dumps(json.loads(text, object_pairs_hook=list), ensure_ascii=False)
    except (ValueError, RecursionError) as error:
        raise CrsError("this is not a coordinate system: the JSON is not valid", field="CRS", remedy=_REMEDY) from error
