"""Plugin for CSM states of line scanners and frames, which Ames Stereo Pipeline and ISIS read: the format ``csm``.

This package also reads states, because each state is read back before it is written. The sensor ``asp`` opens images
with a state next to them, like those with other cameras of Ames Stereo Pipeline; it imports `ortho_csm.files`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ortho_csm.files import write_csm
from ortho_pipeline.plugin import Export, Format, hookimpl


@hookimpl
def ortho_formats() -> Iterable[Format]:
    """Offer the format ``csm``."""
    yield Format("csm", "CSM state of a line scanner or a frame", "_csm.json", write)


def write(export: Export, path: Path) -> float:
    """Write the state of a model; return by how many pixels it differs from it at most."""
    return write_csm(export.model, path, force=export.force)
