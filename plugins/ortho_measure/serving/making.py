"""Make the ortho of the present points in the background, one at a time."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from ortho_measure.project import Project
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.raster.quicklook import preview_png, reduced_grid, shaded_png
from ortho_pipeline.raster.regridded import Regridded, grid_of

#: Longer side (px) of the pictures.
_SIDE = 1400
PICTURES = ("ortho", "reference")


class Making:
    """Makes orthos of the images of a project."""

    def __init__(self, session: Project) -> None:
        self._session, self._lock = session, threading.Lock()
        self._told: dict[str, Any] = {"state": "none", "share": 0.0, "number": 0}
        self._files: dict[str, Path] = {}
        self._thread: threading.Thread | None = None

    def begin(self, number: int = 0) -> dict[str, Any]:
        """Start the ortho of an image, unless one is running, and return its progress.

        Raises
        ------
        InputError
            If the image is unknown.
        """
        if number >= len(self._session.views):
            raise InputError("unknown image", field="number")
        with self._lock:
            if self._told["state"] != "running":
                self._told = {"state": "running", "share": 0.0, "number": number}
                self._thread = threading.Thread(target=self._make, args=(number,), name="ortho", daemon=True)
                self._thread.start()
            return self._told

    def told(self) -> dict[str, Any]:
        """Return the progress: `state` is none, running, done or failed, `share` the finished part of its `stage`.

        `number` is that of the image.
        """
        with self._lock:
            return self._told

    def report(self) -> bytes:
        """Return the report of the last ortho, a page of HTML."""
        return self._file("html").read_bytes()

    def picture(self, which: str) -> bytes:
        """Return the last ortho as PNG, or the reference on the same grid."""
        grid = reduced_grid(grid_of(self._file("ortho")), _SIDE)
        if which == "ortho":
            return preview_png(self._file("ortho"), side=_SIDE)
        pixels = np.zeros((1, grid.height, grid.width), dtype=np.float32)
        valid = np.zeros(pixels.shape, dtype=bool)
        for reference in [sheet.reference for sheet in self._session.sheets]:
            # GDAL uses overviews for the lower resolution and averages the rest.
            part, good = Regridded(reference.path, grid, resampling="average").read(0, 0, grid.width, grid.height)
            fresh = good.all(axis=0) & ~valid[0]
            pixels[0, fresh] = part.mean(axis=0)[fresh]
            valid[0] |= fresh
        return shaded_png(pixels, valid[0])

    # -- the work ----------------------------------------------------------------------------------------------------

    def _make(self, number: int) -> None:
        try:
            result = self._session.ortho(self._advance, number)
        except OrthoError as error:
            self._tell({"state": "failed", "share": 0.0, "error": f"{error.message} ({error.remedy})"})
        except Exception as error:  # otherwise the page would wait forever
            self._tell({"state": "failed", "share": 0.0, "error": f"{type(error).__name__}: {error}"})
            raise
        else:
            headline = result.document["report"]["headline"]
            with self._lock:
                self._files = dict(result.files)
            self._tell(
                {
                    "state": "done",
                    "share": 1.0,
                    "figure": headline["figure"],
                    "what": headline["what"],
                    "files": [str(path) for path in result.files.values()],
                }
            )

    def _advance(self, stage: str, share: float) -> None:
        self._tell({"state": "running", "stage": stage, "share": float(share)})

    def _tell(self, progress: dict[str, Any]) -> None:
        with self._lock:
            self._told = {"number": self._told["number"], **progress}

    def _file(self, name: str) -> Path:
        with self._lock:
            if name not in self._files:
                raise InputError("no ortho was made yet", field="ortho", remedy="press Make ortho first")
            return self._files[name]
