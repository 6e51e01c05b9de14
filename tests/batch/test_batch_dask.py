"""`ortho run` on a real dask cluster of two worker processes: the same bytes, also when a worker is killed."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import shutil
import signal
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline.batch import executors
from ortho_pipeline.batch import runner as batch
from ortho_pipeline.batch.executors import InGroups, WorkerDied, completed, crew_of
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.exchange.rpc import rpc_metadata

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
SCALE = Path(__file__).resolve().parents[2] / "docs" / "scale.md"

FILE = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {resolution: 5}
scenes:
  - images: raw/*.tif
"""
SCENES = 12


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Start a scheduler and two worker processes, which a nanny starts again when they die."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
    ) as made:
        yield made


@pytest.fixture
def folder(tiny: Any, tmp_path: Path) -> Path:
    """Make a pipeline file and small scenes."""
    made = tmp_path / "block"
    (made / "raw").mkdir(parents=True)
    (made / "dem.tif").write_bytes(tiny.dem.read_bytes())
    (made / "p.yaml").write_text(FILE)
    pixels = gdal.Open(str(tiny.image)).ReadAsArray()
    for number in range(SCENES):
        at = 15 * number
        model = dataclasses.replace(tiny.model, col_off=tiny.model.col_off - at, row_off=tiny.model.row_off - at)
        path = made / "raw" / f"s{number}.tif"
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), 96, 80, 1, gdal.GDT_UInt16)
        dataset.SetMetadata(rpc_metadata(model), "RPC")
        dataset.WriteArray(pixels[at : at + 80, at : at + 96])
        dataset = None
    return made


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in (folder / "out").glob("s*/*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.slow
def test_a_killed_worker_loses_nothing_and_nothing_is_done_twice(folder, cluster):
    address = cluster.scheduler_address
    with ThreadPoolExecutor(1) as pool, distributed.Client(address, set_as_default=False) as client:
        running = pool.submit(batch.run, folder / "p.yaml", executor="dask", scheduler=address)
        deadline = time.monotonic() + 60
        while len(list((folder / "out").glob(".run/s*.json"))) < 2:
            assert not running.done()
            assert time.monotonic() < deadline
            time.sleep(0.005)
        victim, pid = next(iter(client.run(os.getpid).items()))
        os.kill(pid, signal.SIGKILL)
        made = {path: path.stat().st_mtime_ns for path in (folder / "out").glob(".run/s*.json")}
        result = running.result(60)
        assert victim not in client.scheduler_info()["workers"]
    assert len(made) < SCENES
    assert [scene.status for scene in result.scenes] == ["done"] * SCENES
    assert {path: path.stat().st_mtime_ns for path in made} == made
    events = [json.loads(line) for line in (folder / "out" / "run.jsonl").read_text().splitlines()]
    assert sorted(event["name"] for event in events if event["event"] == "scene") == sorted(
        f"s{number}" for number in range(SCENES)
    )
    assert not list((folder / "out").rglob("*.part*"))
    dask = digests(folder)
    assert len(dask) == SCENES * 6
    shutil.rmtree(folder / "out")
    batch.run(folder / "p.yaml", executor="sequential")
    assert digests(folder) == dask


def test_on_the_command_line(folder, cluster):
    (folder / "raw" / "s3.tif").write_bytes(b"no image")
    run = ["run", str(folder / "p.yaml"), "--scheduler", cluster.scheduler_address]
    first = CliRunner().invoke(cli, run)
    assert (first.exit_code, f"{SCENES - 1} done, 0 unchanged, 1 failed" in first.stdout) == (3, True), first.output
    (folder / "raw" / "s3.tif").unlink()
    again = CliRunner().invoke(cli, run)
    assert (again.exit_code, f"{SCENES - 1} unchanged, 0 failed" in again.stdout) == (0, True), again.output


def test_no_scheduler(folder, monkeypatch):
    monkeypatch.setattr(executors, "_PATIENCE", "0.2s")
    with pytest.raises(InputError, match="cannot connect to the dask scheduler"):
        batch.run(folder / "p.yaml", executor="dask", scheduler="tcp://127.0.0.1:1")


def test_the_settings_for_small_scenes_are_some_that_dask_knows() -> None:
    """What docs/scale.md advises is measured by benchmarks/batch.py; a key of another name would change nothing."""
    (told,) = re.findall(r"```yaml\n(distributed:.*?)```", SCALE.read_text(encoding="utf-8"), flags=re.DOTALL)
    advised = yaml.safe_load(told)["distributed"]
    for name in ("worker.profile.enabled", "admin.tick.interval", "admin.system-monitor.interval"):
        value = advised
        for part in name.split("."):
            value = value[part]
        # A value of the kind of dask's own, and a shorter pause than that after which a loop counts as hanging.
        assert isinstance(value, type(dask.config.get(f"distributed.{name}"))), name
    assert advised["nanny"]["pre-spawn-environ"].keys() >= {"MALLOC_TRIM_THRESHOLD_", "OMP_NUM_THREADS"}
    parse_timedelta = dask.utils.parse_timedelta
    limit = dask.config.get("distributed.admin.tick.limit")
    assert parse_timedelta(advised["admin"]["tick"]["interval"]) < parse_timedelta(limit)
    assert sum(len(values) for values in advised.values()) == 4, "a setting that is not looked for above"


class Counting(ThreadPoolExecutor):
    """A pool that notes what it is given, and loses a task as dask does whose worker dies."""

    def __init__(self, lost: int = -1) -> None:
        super().__init__(1)
        self.tasks: list[tuple[Any, ...]] = []
        self.done: list[tuple[Any, ...]] = []
        self.lost = lost

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.tasks.append(args)
        if self.lost in args[0][1]:
            gone: Future[Any] = Future()
            gone.set_exception(BrokenExecutor())
            return gone
        return super().submit(self._noted, fn, *args)

    def _noted(self, fn: Any, given: tuple[Any, Any]) -> Any:
        seconds, done = fn(given)
        self.done.append(given[1][: len(done)])
        return seconds, done


def one_over(number: int) -> float:
    return 1 / (number - 100)


def test_short_jobs_travel_together_and_each_has_its_own_result() -> None:
    with Counting() as pool:
        found = dict(completed(InGroups(pool), one_over, range(3000)))
        assert len(found) == 3000
        assert isinstance(found.pop(100).exception(), ZeroDivisionError)
        assert all(future.result() == one_over(job) for job, future in found.items())
        assert len(pool.tasks) < 60  # the first alone, the others up to 64 together


def test_nothing_is_handed_over_by_the_time_that_a_cold_worker_takes() -> None:
    """The first job of a worker loads what all need: the second one tells how many travel together."""
    cold = iter([0.3])
    with Counting() as pool:
        found = dict(completed(InGroups(pool), lambda _: time.sleep(next(cold, 0.001)), range(600)))
    assert len(found) == 600
    assert len(pool.tasks) < 30


def test_long_jobs_behind_short_ones_do_not_wait_in_one_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes that are there already are seen in milliseconds; behind them may stand those that take minutes."""
    monkeypatch.setattr(executors, "_TOGETHER", 0.02)
    with Counting() as pool:
        found = dict(completed(InGroups(pool), lambda job: time.sleep(0.005 * (job >= 1000)), range(1064)))
    assert len(found) == 1064
    # A group ends with the job in which twice its time is over; 64 jobs travelled together before.
    assert max(sum(job >= 1000 for job in jobs) for jobs in pool.done) <= 2 * 0.02 / 0.005 + 1


def test_the_last_jobs_are_shared_out_among_all_workers() -> None:
    with Counting() as pool:
        found = dict(completed(InGroups(pool, slots=8), float, range(200)))
    assert len(found) == 200
    assert max(len(jobs) for jobs in pool.done) <= 200 / 16 + 1


def test_of_a_group_that_is_lost_only_the_job_that_loses_it_has_failed() -> None:
    with Counting(lost=2000) as pool:
        found = dict(completed(InGroups(pool), float, range(3000)))
        assert isinstance(found.pop(2000).exception(), WorkerDied)
        assert sorted(future.result() for future in found.values()) == [
            float(job) for job in range(3000) if job != 2000
        ]


class Ended(Executor):
    """Cancels its work, as dask does when its scheduler ends."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        cancelled: Future[Any] = Future()
        cancelled.cancel()
        cancelled.set_running_or_notify_cancel()
        return cancelled


@pytest.mark.parametrize("crew", [InGroups(Ended()), Ended()])
def test_a_scheduler_that_ends_is_an_error_with_a_remedy(crew: Any) -> None:
    with pytest.raises(OrthoError, match="its scheduler ends") as caught:
        list(completed(crew, float, range(3)))
    assert "run again" in str(caught.value.remedy)


def test_a_scheduler_without_workers_is_said(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    class Client(contextlib.nullcontext[None]):
        def nthreads(self) -> dict[str, int]:
            return {}

    monkeypatch.setattr(executors, "dask_executor", lambda scheduler: (Client(), Ended()))
    with crew_of("dask", None, None, "tcp://host:8786", 1):
        assert "tcp://host:8786 has no workers" in caplog.text
