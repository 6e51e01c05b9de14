"""The outcome of a run: of each scene and of the whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Outcome:
    """The outcome of a scene.

    Parameters
    ----------
    status : {'done', 'unchanged', 'failed', 'missing'}
        Missing: not finished by any worker, in a summary of many workers.
    facts : mapping
        JSON values: sensor, model, RMSE, ortho, view.
    error : mapping, optional
        Kind, message, file, field, remedy, and the trace of what is not an `OrthoError`.
    """

    name: str
    status: str
    seconds: float = 0.0
    files: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    error: Mapping[str, Any] | None = None

    def text(self) -> str:
        """Return the outcome as one line."""
        if self.error is not None:
            return f"{self.name}: {self.status}: {self.error['message']}"
        return f"{self.name}: {self.status}, {self.seconds:.1f} s"


@dataclass(frozen=True)
class BatchResult:
    """The outcome of all scenes."""

    scenes: tuple[Outcome, ...]
    files: Mapping[str, Path]
    seconds: float
    mosaic: Mapping[str, Any] | None = None

    def count(self, status: str) -> int:
        """Return how many scenes ended so."""
        return sum(scene.status == status for scene in self.scenes)

    @property
    def failed(self) -> int:
        """How many scenes, or the mosaic of them, could not be made."""
        return self.count("failed") + self.count("missing") + bool(self.mosaic and self.mosaic.get("error"))

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho run --json`` (docs/run.md)."""
        return {
            "schema_version": SCHEMA_VERSION,
            "counts": {status: self.count(status) for status in ("done", "unchanged", "failed")}
            | ({"missing": self.count("missing")} if self.count("missing") else {}),
            "seconds": self.seconds,
            "scenes": [dict(vars(scene)) for scene in self.scenes],
            "mosaic": self.mosaic,
            "files": {name: str(path) for name, path in self.files.items()},
        }
