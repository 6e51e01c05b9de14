"""State that commands keep between runs, as `readers.py` reads it: somebody else may have written every byte of it."""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import seeds
from obstore.store import MemoryStore
from ortho_measure.block.session import open_block_session
from ortho_measure.journal import Journal
from ortho_measure.project import JOURNAL, Project
from ortho_measure.session import open_session

from ortho_pipeline import commands
from ortho_pipeline.batch.records import RunRecord
from ortho_pipeline.batch.shared.leases import Lease, Leases, lease_document
from ortho_pipeline.files import together
from ortho_pipeline.files.whole import Outputs
from ortho_pipeline.options import MatchOptions, SurfaceOptions
from ortho_pipeline.stores import local_cache, objects

_COUNT = itertools.count()


# -- outputs of a killed command -------------------------------------------------------------------------------------


def renames(folder: Path) -> bytes:
    """Write what a command leaves that is killed between its renames; return its journal."""
    place = Outputs(folder / "out", "scene")
    return json.dumps({
        "renames": [[f"{place.prefix}{number}.part.tif", f"scene_{number}.tif"] for number in range(3)],
        "obsolete": ["scene_RPC.TXT"],
    }).encode()  # fmt: skip


def read_renames(path: Path) -> list[float]:
    """Let the next command complete what is listed; nothing next to the folder may change, and nothing stay."""
    folder = path.parent / "out"
    folder.mkdir()
    place = Outputs(folder, "scene")
    outside = path.parent / "scene_RPC.TXT"
    outside.write_text("outside")
    for name in ("scene_RPC.TXT", "scene_0.tif", f"{place.prefix}0.part.tif", f"{place.prefix}1.part.tif"):
        (folder / name).write_text(name)
    (folder / "folder").mkdir()
    shutil.copyfile(path, place.journal)
    place.lock_path.touch()
    try:
        with together(folder, "scene"):
            pass
        assert not [name for name in os.listdir(folder) if name.startswith(place.prefix)]
        assert outside.read_text() == "outside"
        assert (folder / "folder").is_dir()
    finally:
        shutil.rmtree(folder)
    return []


# -- cached downloads ------------------------------------------------------------------------------

_ADDRESS = "https://example.org/cells/N37E033.tif"


@contextlib.contextmanager
def _cache(folder: Path) -> Iterator[Path]:
    with mock.patch.dict(os.environ, {local_cache.FOLDER: str(folder)}):
        yield folder


def _fetched(path: Path) -> objects.Content:
    path.write_bytes(b"heights")
    return objects.Content(7, hashlib.sha256(b"heights").hexdigest(), (), None)


def kept_record(folder: Path) -> bytes:
    """Return the record of a file that is kept."""
    with _cache(folder / "cache"):
        found = local_cache.kept("dem", _ADDRESS, _fetched)
    return found.with_name(f"{found.name}.json").read_bytes()


def read_kept_record(path: Path) -> list[Any]:
    """Look at what is kept, and use it: a record that cannot be understood means that the file is fetched again."""
    with _cache(path.parent / f"cache{next(_COUNT)}") as folder:
        file = local_cache.kept("dem", _ADDRESS, _fetched)
        shutil.copyfile(path, file.with_name(f"{file.name}.json"))
        local_cache._agreed.clear()  # as in another process
        listed = commands.kept_files(verify=True)
        assert local_cache.kept("dem", _ADDRESS, _fetched).read_bytes() == b"heights"
        json.dumps(listed, ensure_ascii=False).encode()
        commands.forget_kept_files()
        shutil.rmtree(folder)
    return [listed]


# -- a shared run ----------------------------------------------------------------------------------------------------


def _leases() -> tuple[MemoryStore, Leases]:
    store = MemoryStore()
    with mock.patch.object(objects, "_store_of", return_value=store):
        return store, Leases("s3://bucket/.run", allow_network=True)


def lease(folder: Path) -> bytes:
    """Return what a worker writes that makes a scene."""
    return lease_document("machine 17 0123456789abcdef", 3)


def read_lease(path: Path) -> list[float]:
    """Find the lease of another worker, wait for it, and take it over."""
    store, leases = _leases()
    store.put("one.lease.json", path.read_bytes())
    seen = leases.take("one")
    assert isinstance(seen, str)
    taken = leases.take("one", seen)
    assert isinstance(taken, Lease)
    taken.renew()
    return []


def read_result(path: Path) -> list[Any]:
    """Read the result of a scene that somebody else has written."""
    store, leases = _leases()
    store.put("one.result.json", path.read_bytes())
    found = leases.result("one")
    assert leases.finished() == {"one"}
    return [] if found is None else [found.seconds, found.facts, RunRecord.parse(found.text().encode()) == found]


# -- projects of `ortho measure` -------------------------------------------------------------------------------------


@functools.cache
def _opened(several: bool) -> Project:
    """Open a project once: what stays of it is the scene, its heights and its options."""
    folder = seeds.SAMPLE
    place = Path(os.environ.get("TMPDIR", "/tmp")) / f"opened{os.getpid()}.geojson"
    surface = SurfaceOptions(dem=(folder / ("cartosat/dem.tif" if several else "dem.tif")))
    try:
        if several:
            images = [folder / "cartosat" / name for name in ("BANDF.tif", "BANDA.tif")]
            return open_block_session(images, place, surface=surface)
        match = MatchOptions(reference=(str(folder / "reference.tif"),))
        return open_session(folder / "scene.tif", place, surface=surface, match=match)
    finally:
        place.with_name(place.name + JOURNAL).unlink(missing_ok=True)


def _again(several: bool, output: Path) -> Project:
    """Open the project as another process would, from its journal."""
    known = _opened(several)
    again = copy.copy(known)
    Project.__init__(again, output, known.surface, known.views, known.sheets)
    again._begin()
    return again


_GROUNDS = ([33.345, 37.247, 850.0], [33.352, 37.252, 900.0], [33.348, 37.255, 880.0], [33.355, 37.245, 860.0])


def _actions(several: bool) -> list[dict[str, Any]]:
    """Return what a person did: points put, moved, left out, undone."""
    known = _opened(several)
    places = [known.places_of(number) for number in range(len(known.views))]
    grounds = _GROUNDS if not several else [one.ground_about([[30.0 * k, 20.0 * k]], [10.0])[0].tolist()
                                            for one in places[:1] for k in (1, 2, 3, 4)]  # fmt: skip
    done: list[dict[str, Any]] = []
    for number, ground in enumerate(grounds):
        images = [one.image_of(np.array([ground]))[0].round(2).tolist() for one in places]
        measured = {"image": images[0], "sigma_image": 0.4, "how": "matched", "score": 0.9}
        if several:
            labels = known.images.labels  # type: ignore[attr-defined]
            measured = {"rays": {label: {"image": image, "covariance": [0.1, 0.2, 0.05]}
                                 for label, image in zip(labels, images, strict=True)}}  # fmt: skip
        role = ("control", "control", "check", "control")[number]
        mark = {"id": f"P{number}", "ground": ground, "ground_from": "typed", "role": role, "sigma_xy": 0.3,
                "sigma_h": 0.5, "group": None, "off": False, "note": "", **measured}  # fmt: skip
        done.append({"do": "put", "mark": mark, "at": "2026-01-01T00:00:00.000Z"})
    correct = {"do": "correct", "correction": "shift", "at": "2026-01-01T00:00:01.000Z"}
    return [*done, correct, {"do": "remove", "id": "P3"}, {"do": "undo"}, {"do": "undo"}, {"do": "redo"}]


def journal(several: bool, folder: Path) -> bytes:
    """Return the actions of a journal; its lines carry checksums, which `read_journal` makes of what it is given."""
    project = _again(several, folder / "seed.geojson")
    for action in _actions(several):
        project.act({key: value for key, value in action.items() if key != "at"})
    actions = project.journal.actions
    project.journal.close()
    return json.dumps(actions).encode()


def read_journal(path: Path) -> list[Any]:
    """Open a project whose journal holds these actions, twice: what opens has to open again, with the same points.

    The adjustment, which takes a hundred times as long as this, is left to `read_project`.
    """
    with mock.patch.object(type(_opened(False)), "_solve"):
        return _opened_twice(False, path, lambda project: project.marks.by_id)


def read_project(path: Path) -> list[Any]:
    """Open such a project of two images, with its adjustment and all that is shown of it."""

    def shown(project: Project) -> Any:
        state = project.state()
        json.dumps(state, allow_nan=False, ensure_ascii=False).encode()
        return state["marks"]

    return _opened_twice(True, path, shown)


def _opened_twice(several: bool, path: Path, look: Callable[[Project], Any]) -> list[Any]:
    output = path.with_name("read.geojson")
    place = output.with_name(output.name + JOURNAL)
    for left in path.parent.glob("read.geojson*"):
        left.unlink()
    data = path.read_bytes()
    try:
        actions = json.loads(data)
        assert isinstance(actions, list)
        with contextlib.closing(Journal(place)) as written:
            for action in actions:
                written.append(action)
    except (ValueError, TypeError, AssertionError, RecursionError):
        place.write_bytes(data)  # no checksum can be made of it
    seen = []
    for _ in range(2):
        project = _again(several, output)
        try:
            seen.append(look(project))
        finally:
            project.journal.close()
    assert seen[0] == seen[1]
    return []
