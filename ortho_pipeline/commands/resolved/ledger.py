"""The files that a result was made from: one list for its record, for changes meanwhile, and for the next run."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import pyproj

from ortho_pipeline import host
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.exchange.rpc import files_of
from ortho_pipeline.files import sha256, states
from ortho_pipeline.files.json.values import software_version
from ortho_pipeline.files.locations import Location
from ortho_pipeline.files.traffic import bytes_read
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster import source as raster
from ortho_pipeline.runtime.compiled import COMPILER
from ortho_pipeline.runtime.process_limits import thread_pool
from ortho_pipeline.surface.base import Surface

#: Roles of files that have pixels, and of those among them whose side-cars are entered too.
RASTERS = ("image", "DEM", "DEM accuracy", "reference", "other ortho")
_ATTACHING = ("image", "DEM", "DEM accuracy", "reference", "other ortho", "grid")
#: The order of a record, by role; files that open a scene have roles of their sensor's and follow its image.
_ORDER = {
    "image": 0,
    "metadata": 2,
    "points": 3,
    "DEM": 4,
    "geoid": 5,
    "DEM accuracy": 6,
    "reference": 7,
    "other ortho": 8,
    "grid": 9,
}
#: Options that a record holds only if given, so that other records keep their bytes.
_IF_GIVEN = ("like", "reference_bands", "search_rotation")
#: Size, time of change and inode of files.
State = Mapping[str, tuple[int, int, int]]


@dataclass(frozen=True)
class Ledger:
    """The files that were read, and how they were when the work began.

    Parameters
    ----------
    roles : mapping of Path to str
        Every file and its role, side-cars and sources of a VRT included. Of what is in an archive, the archive.
    begun : mapping
        From `files.states`.
    far : tuple of str
        Addresses of the files on other machines that a request names, and of their side-cars. Not of the sources of a
        VRT: they may be thousands.
    """

    roles: Mapping[Path, str] = field(default_factory=dict)
    begun: State = field(default_factory=dict)
    far: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, request: Request, scene: Scene | None = None, surface: Surface | None = None, begun: State | None = None
    ) -> Ledger:
        """Return the files of a request, and the files that the scene and the surface were read from.

        Parameters
        ----------
        begun : mapping, optional
            States of the named files when the work began; without, the current states.
        """
        found: dict[Path, str] = {}
        far: set[str] = set()

        def enter(role: str, paths: Iterable[str | os.PathLike[str] | None], *, attached: bool = False) -> None:
            for name in (name for name in paths if name is not None):
                place = Location(name)
                path = place.archive or Path(name)
                if path.is_file():
                    found.setdefault(path, role)
                if place.is_far:
                    far.add(place.url)
                    attached = attached and not place.endswith(".vrt")
                if attached:
                    files = _files_of(name, request.scene)
                    enter(role, (file for file in files if place.is_far or not Location(file).is_far))

        for role, path in request.files:
            enter(role, [path], attached=role in _ATTACHING and not (role == "DEM" and Location(path).is_collection))
        addresses = tuple(sorted(name for name in far if Location(name).is_address))
        if scene is not None:
            enter("image", [scene.path, *scene.rasters])
            if scene.path != Path(request.image):
                enter("image", _files_of(scene.path, request.scene))
            enter("metadata", [*scene.sources, scene.model_source])
        if surface is not None:
            # Of heights that were found: what led to them, and the files.
            enter("DEM", surface.provenance.get("documents", ()))
            read = (cell for cell in surface.files if Path(cell) not in found and not Location(cell).is_far)
            enter("DEM", read, attached=True)
        roles = dict(sorted(found.items(), key=lambda entry: _ORDER.get(entry[1], 1)))
        return cls(roles, {**states(roles), **(begun or {})}, addresses)

    def joined(self, *others: Ledger) -> Ledger:
        """Return the files of several ledgers as one; the first ledger of a file decides its role."""
        roles, begun = dict(self.roles), dict(self.begun)
        for other in others:
            for path, role in other.roles.items():
                roles.setdefault(path, role)
            begun = {**other.begun, **begun}
        return Ledger(roles, begun)

    def require_unchanged(self) -> None:
        """Refuse a result whose inputs changed during the run, because its parts may come from different versions.

        Raises
        ------
        InputError
            With the file.
        """
        now = states(self.begun)
        for path, state in self.begun.items():
            if now.get(path) != state:
                raise InputError("this file changed during the run", file=path, remedy="run again")

    def hashed(self, digest: Callable[..., str] = sha256, stop: threading.Event | None = None) -> list[dict[str, Any]]:
        """Return role, path, bytes and SHA-256 of each file.

        Parameters
        ----------
        digest : callable (path, stop) -> str
            May know checksums that were taken before.
        """
        return [
            {"role": role, "path": str(path), "bytes": path.stat().st_size, "sha256": digest(path, stop)}
            for path, role in self.roles.items()
        ]

    @contextlib.contextmanager
    def hashed_beside(self, digest: Callable[..., str]) -> Iterator[Future[list[dict[str, Any]]]]:
        """Take the checksums in a thread while the block runs; an error in the block does not wait for them.

        The thread ends with the block, whatever happens, and never calls GDAL: the interpreter cannot exit while a
        thread is inside of a GDAL function (its binding's destructor takes the lock of the interpreter, and the process
        aborts).
        """
        stop = threading.Event()
        with thread_pool(1, "checksums") as pool:
            future = pool.submit(self.hashed, digest, stop)
            try:
                yield future
            finally:
                stop.set()


def _files_of(path: str | os.PathLike[str], scene: SceneOptions) -> list[str]:
    """Return the files of a raster by GDAL, and those of VRTs among them."""
    found: dict[str, None] = {}
    left = [os.fspath(path)]
    while left:
        try:
            files = files_of(raster.open_dataset(left.pop(), **scene.access))
        except OrthoError:
            continue
        left += [file for file in files if file not in found and file.lower().endswith(".vrt")]
        found |= dict.fromkeys(files)
    return list(found)


@functools.cache
def versions() -> dict[str, Any]:
    """Return the software that results depend on."""
    packages = ("ortho-pipeline", "numpy", "scipy", COMPILER)
    return {
        **{name: metadata.version(name) for name in packages},
        "gdal": raster.gdal.VersionInfo("RELEASE_NAME"),
        "proj": pyproj.proj_version_str,
        "plugins": sorted(f"{origin.plugin} ({origin})" for origin in host.Host.discover().plugins()),
    }


def software() -> dict[str, str]:
    """Return the versions that a report names."""
    return {
        "ortho-pipeline": software_version(),
        "gdal": raster.gdal.VersionInfo("RELEASE_NAME"),
        "proj": pyproj.proj_version_str,
    }


def provenance(
    request: Request,
    scene: Scene,
    surface: Surface | None,
    inputs: list[dict[str, Any]],
    command: str | None,
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the record that reproduces a result: files with checksums, options, versions, the command.

    Parameters
    ----------
    inputs : list
        From `Ledger.hashed`.
    settings : mapping of str to dataclass
        The groups of options that the result depends on besides its points, by name (`Request.asked`).
    """
    return {
        "command": command,
        "inputs": inputs,
        "image": {"path": str(scene.path), "size": [scene.width, scene.height]},
        "sensor": scene.sensor,
        "model_source": scene.model_source,
        "points": None if request.points.gcps is None else as_asked(request.points),
        "surface": None if surface is None else dict(surface.provenance),
        "options": {name: as_asked(value) for name, value in settings.items()},
        "software": software(),
    }


def read_since(before: int) -> dict[str, Any]:
    """Return how much was read over the network since `before` (`bytes_read`), for the provenance; nothing if none."""
    read = bytes_read() - before
    return {"network_bytes": read} if read else {}


def as_asked(options: Any) -> dict[str, Any]:
    """Return a group of options as JSON values, without the budget of the machine, on which no result depends."""
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    left_out = {"memory", "threads", *(key for key in _IF_GIVEN if values.get(key) is None)}
    return {key: _text_of(value) for key, value in values.items() if key not in left_out}


def _text_of(value: Any) -> Any:
    """Return points and paths as text, anything else as it is."""
    if isinstance(value, tuple):
        return tuple(map(_text_of, value))
    return str(value) if isinstance(value, Points) else os.fspath(value) if isinstance(value, os.PathLike) else value
