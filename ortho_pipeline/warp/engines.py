"""The engines of the warp behind one protocol, and the way from a name to one."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Protocol

from ortho_pipeline.errors import InputError
from ortho_pipeline.warp import gdal_engine, lattice_engine
from ortho_pipeline.warp.job import WarpJob, WarpRecord
from ortho_pipeline.warp.quality.hiding import Hiding


class Engine(Protocol):
    """What makes orthos; each engine is a module with these names.

    Attributes
    ----------
    tile_maker : callable (job), optional
        Makes single tiles of an ortho. None where the engine only makes files.
    """

    @property
    def tile_maker(self) -> Callable[[WarpJob], lattice_engine.TileMaker] | None: ...

    def rectify(self, job: WarpJob, path: str | os.PathLike[str] | Hiding) -> WarpRecord:
        """Write an ortho; what the engine cannot do is an `InputError`."""


#: Engines by the name on the command line.
_ENGINES: dict[str, Engine] = {"ortho": lattice_engine, "gdal": gdal_engine}


def engine_of(name: str) -> Engine:
    """Return the engine of a name.

    Raises
    ------
    InputError
        If none has that name.
    """
    if name not in _ENGINES:
        raise InputError(f"unknown engine {name!r}", field="output.engine", remedy=" or ".join(_ENGINES))
    return _ENGINES[name]
