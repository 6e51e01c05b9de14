"""Files: on disk, in archives and behind URLs; read within limits, written whole or not at all.

Imports nothing above `errors`.
"""

from __future__ import annotations

from ortho_pipeline.files.locks import Lock, open_itself
from ortho_pipeline.files.reading import UTF_16, Checksums, decoded, parse_json, read_bounded, read_json, sha256, states
from ortho_pipeline.files.whole import (
    Outputs,
    allowed,
    append_line,
    clear_up,
    confined,
    json_text,
    part_of_outputs,
    retire,
    staged,
    sync_folder,
    together,
    whole_or_nothing,
    write_json,
    write_text,
)

__all__ = [
    "UTF_16",
    "Checksums",
    "Lock",
    "Outputs",
    "allowed",
    "append_line",
    "clear_up",
    "confined",
    "decoded",
    "json_text",
    "open_itself",
    "parse_json",
    "part_of_outputs",
    "read_bounded",
    "read_json",
    "retire",
    "sha256",
    "staged",
    "states",
    "sync_folder",
    "together",
    "whole_or_nothing",
    "write_json",
    "write_text",
]
