"""Workers that are processes, killed by the system at any moment: the others finish, and every scene is there once."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from osgeo import gdal
from servers import moto_server

from ortho_pipeline.batch.plan import STATE
from ortho_pipeline.stores.objects import Objects

PATIENCE = 2.0
FILE = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {format: GTiff, resolution: 20}
scenes:
  - images: raw/*.tif
"""


class Nursery:
    """The process that forks workers."""

    def __init__(self, file: Path) -> None:
        self._file, self._count = file, 0
        script = Path(__file__).with_name("nursery.py")
        pipe = subprocess.PIPE
        self.process = subprocess.Popen([sys.executable, str(script)], stdin=pipe, stdout=pipe, text=True)

    def fork(self, address: str, shard: tuple[int, int] | None) -> tuple[int, Path]:
        """Begin a worker; return its process, and where it says what it made."""
        self._count += 1
        said = self._file.with_name(f"said{self._count}.json")
        given = {"file": str(self._file), "address": address, "shard": shard, "patience": PATIENCE, "said": str(said)}
        return int(self._ask(f"fork {json.dumps(given)}")), said

    def wait(self, process: int) -> int:
        """Return how a worker ended."""
        return int(self._ask(f"wait {process}"))

    def _ask(self, line: str) -> str:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline()


@pytest.fixture
def nursery(tiny: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Nursery]:
    """A bucket, a pipeline file of three scenes, and what forks workers that make them."""
    (tiny.folder / "raw").mkdir()
    for name in "abc":
        gdal.Translate(str(tiny.folder / "raw" / f"{name}.tif"), str(tiny.image))
    (tiny.folder / "p.yaml").write_text(FILE)
    with moto_server("kills") as (host, port):
        at = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_REGION": "us-east-1"}
        for name, value in (at | dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "test")).items():
            monkeypatch.setenv(name, value)
        made = Nursery(tiny.folder / "p.yaml")
        try:
            yield made
        finally:
            assert made.process.stdin is not None
            made.process.stdin.close()
            made.process.wait()


def check(address: str) -> None:
    """Hold what is in the store against its records: all scenes, whole, and nothing else."""
    store = Objects(address, allow_network=True)
    there = {name for name, _ in store.names()}
    expected = set()
    for name in "abc":
        result = json.loads(store.read(f"{STATE}/{name}.result.json", 1 << 20)[0])
        assert result["status"] == "done"
        record = json.loads(store.read(f"{name}/{name}_delivery.json", 1 << 20)[0])
        for one in record["files"]:
            data = store.read(f"{name}/{one['name']}", 1 << 30)[0]
            assert hashlib.sha256(data).hexdigest() == one["sha256"]
        expected |= {f"{name}/{one['name']}" for one in record["files"]} | {f"{name}/{name}_delivery.json"}
        expected |= {f"{STATE}/{name}.result.json", f"{STATE}/{name}.lease.json"}
    assert there == expected


def killed(nursery: Nursery, address: str, moment: float) -> bool:
    """Kill one of two workers at a moment; return whether it was still at work."""
    victim, _ = nursery.fork(address, (1, 2))
    other, said = nursery.fork(address, (2, 2))
    time.sleep(moment)
    with contextlib.suppress(ProcessLookupError):
        os.kill(victim, signal.SIGKILL)
    at_work = nursery.wait(victim) == signal.SIGKILL
    assert nursery.wait(other) == 0
    assert set(json.loads(said.read_text())) == set("abc")
    check(address)
    return at_work


@pytest.mark.slow
def test_two_runs_on_one_bucket_make_every_scene_once(nursery: Nursery) -> None:
    """Two runs of all scenes, begun together, neither of a part."""
    workers = [nursery.fork("s3://kills/both", None) for _ in range(2)]
    assert [nursery.wait(process) for process, _ in workers] == [0, 0]
    said = [json.loads(path.read_text()) for _, path in workers]
    made = Counter(name for one in said for name, status in one.items() if status == "done")
    assert made == dict.fromkeys("abc", 1)
    check("s3://kills/both")


@pytest.mark.slow
def test_a_hundred_workers_are_killed(nursery: Nursery) -> None:
    for address in ("s3://kills/first", "s3://kills/whole"):  # the first pair loads what the others find loaded
        begin = time.monotonic()
        pair = [nursery.fork(address, (number, 2))[0] for number in (1, 2)]
        assert [nursery.wait(process) for process in pair] == [0, 0]
    whole = time.monotonic() - begin
    chance = random.Random(20)
    at_work = sum(killed(nursery, f"s3://kills/{number}", chance.uniform(0.0, 0.9 * whole)) for number in range(100))
    print(f"{at_work} of 100 were at work")
    assert at_work > 80
