"""`ortho stack` by several workers: processes, parts of a job array, dask, a bucket; killed at any moment."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from osgeo import gdal
from rasters import Rasters
from servers import moto_server, serving
from test_dates import ortho
from test_raw import delivered

from ortho_pipeline.batch import freshness
from ortho_pipeline.batch.records import FileState, RunRecord
from ortho_pipeline.batch.stack.command import match_part, stack
from ortho_pipeline.batch.stack.dates import dated_orthos
from ortho_pipeline.batch.stack.recorded import FileSet, recorded_in
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import whole_or_nothing
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions, StackOptions, SurfaceOptions
from ortho_pipeline.stores.objects import Objects

gdal.UseExceptions()
SETTINGS: dict[str, Any] = {
    "match": MatchOptions(points=120),
    "surface": SurfaceOptions(height=50.0),
    "output": OutputOptions(resampling="cubic", threads=1, format="GTiff"),
}
WORDS = ["--match-points", "120", "--height", "50", "--threads", "1"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """A raw scene and three orthos, and what one process makes of them."""
    folder = tmp_path_factory.mktemp("workers")
    delivered(folder / "in")
    for path in Rasters(side=240, dates=4, error=4.0, interval=50.0).write(folder / "more")[2:]:
        path.rename(folder / "in" / path.name)
    stack([folder / "in"], folder / "out", **SETTINGS)
    return folder, contents(folder / "out")


def contents(folder: Path) -> dict[str, bytes]:
    """Return all outputs without records of their making, which have dates."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and "record" not in path.name]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths if not path.name.endswith(".lock")}


def test_two_processes_make_the_same(made: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    stack([made[0] / "in"], tmp_path / "out", executor="processes", workers=2, **SETTINGS)
    assert contents(tmp_path / "out") == made[1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--executor", "dask"], "--scheduler: dask needs the address"),
        (["--executor", "processes", "--scheduler", "tcp://127.0.0.1:1"], "only dask has a scheduler"),
        (["--shard", "auto"], "the environment describes no job array"),
        (["--shard", "3/2"], "'3/2' is not K/N"),
    ],
)
def test_workers_that_cannot_be_are_refused(
    made: tuple[Path, dict[str, bytes]], tmp_path: Path, words: list[str], said: str
) -> None:
    result = CliRunner().invoke(cli, ["stack", str(made[0] / "in"), "-o", str(tmp_path / "out"), *WORDS, *words])
    assert result.exit_code == 2
    assert said in result.output


def test_an_array_of_jobs_makes_the_same(made: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    for number in (2, 3, 1):
        said = match_part([made[0] / "in"], tmp_path / "out", (number, 3), **SETTINGS)
        assert said.document["pairs"] == 2
        assert not (tmp_path / "out" / "stack.json").exists()
    result = stack([made[0] / "in"], tmp_path / "out", **SETTINGS)
    assert "6 (6 from an earlier run)" in result.summary
    assert contents(tmp_path / "out") == made[1]
    with pytest.raises(InputError, match="no part 4 of 3"):
        match_part([made[0] / "in"], tmp_path / "out", (4, 3), **SETTINGS)


@pytest.mark.slow
def test_dask_makes_the_same(made: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        stack([made[0] / "in"], tmp_path / "out", scheduler=cluster.scheduler_address, **SETTINGS)
    assert contents(tmp_path / "out") == made[1]


def killed(out: Path, images: Path, seconds: float, *words: str) -> None:
    """Begin a run, and kill it after some time if it has not ended."""
    command = [sys.executable, "-m", "ortho_pipeline", "stack", str(images), "-o", str(out), *WORDS, *words]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        running.wait(seconds)
    except subprocess.TimeoutExpired:
        os.kill(running.pid, signal.SIGKILL)
        running.wait()


@pytest.mark.slow
def test_a_run_that_is_killed_at_any_moment_resumes(made: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    drawn = random.Random(4)
    for words in ([], ["--workers", "2"], []):
        killed(tmp_path / "out", made[0] / "in", drawn.uniform(1.5, 5.0), *words)
    stack([made[0] / "in"], tmp_path / "out", **SETTINGS)
    assert contents(tmp_path / "out") == made[1]


# -- object storage and servers ----------------------------------------------------------------------------------------


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket, for us and for GDAL."""
    with moto_server("stacks") as (host, port):
        at = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_S3_ENDPOINT": f"{host}:{port}", "AWS_HTTPS": "NO",
              "AWS_VIRTUAL_HOSTING": "FALSE", "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test",
              "AWS_REGION": "us-east-1"}  # fmt: skip
        for name, value in at.items():
            monkeypatch.setenv(name, value)
        yield "s3://stacks/run"


FAR: dict[str, Any] = {**SETTINGS, "scene": SceneOptions(allow_network=True)}


def test_a_bucket_gets_complete_files(made: tuple[Path, dict[str, bytes]], bucket: str, tmp_path: Path) -> None:
    match_part([made[0] / "in"], bucket, (1, 2), **FAR)
    result = stack([made[0] / "in"], bucket, **FAR)
    assert "6 (3 from an earlier run)" in result.summary
    assert result.files["json"] == f"{bucket}/stack.json"
    store = Objects(bucket, allow_network=True)
    assert fetched(store, tmp_path / "a") == made[1]
    for name in (f"{name}_delivery.json" for name in ("stack", f"aligned/{result.dates[0].name}")):
        for file in json.loads(store.read(name, 1 << 20)[0])["files"]:
            folder = Objects(f"{bucket}/{name}".rpartition("/")[0], allow_network=True)
            assert folder.read(file["name"], file["bytes"])[1].sha256 == file["sha256"]
    cube = pytest.importorskip("xarray") and result.to_xarray(chunks=100)
    assert cube.isel(band=0, y=120, x=120).compute().shape == (4,)
    # Nothing is made again, and a damaged ortho is.
    before = dict.fromkeys(store.names())
    stack([made[0] / "in"], bucket, **FAR)
    store.put(f"aligned/{result.dates[1].name}_aligned.tif", b"damaged")
    again = stack([made[0] / "in"], bucket, **FAR)
    assert "6 (6 from an earlier run)" in again.summary
    assert dict.fromkeys(store.names()) == before
    assert fetched(store, tmp_path / "b") == made[1]
    # An ortho that is no longer part of the stack goes.
    *paths, last = (one.path for one in result.dates)
    stack(paths, bucket, **FAR)
    left = [name for name, _ in store.names() if name.startswith("aligned/")]
    assert [name for name in left if Path(last).stem in name] == []
    assert len(left) == 4 * len(paths)


def fetched(store: Objects, folder: Path) -> dict[str, bytes]:
    """Return the outputs in a store, without records."""
    for name, size in store.names():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        store.fetch(name, folder / name, size)
    found = contents(folder)
    return {name: data for name, data in found.items() if not name.endswith("_delivery.json")}


def test_images_by_url_give_the_same(made: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    """A raw scene with its RPC and finished orthos, by a list and one by one."""
    with serving(made[0] / "in") as server:
        images = [f"{server.address}/{path.name}" for path in sorted((made[0] / "in").glob("*.tif"))]
        with pytest.raises(InputError, match="off by default"):
            stack(images, tmp_path / "out", **SETTINGS)
        (tmp_path / "list.csv").write_text("\n".join(["file", *images]))
        stack([tmp_path / "list.csv"], tmp_path / "out", **FAR)
    found = contents(tmp_path / "out")
    same = [name for name in made[1] if name.endswith(".tif") or name.startswith("pairs")]
    assert len(same) == 11
    assert {name: found[name] for name in same} == {name: made[1][name] for name in same}


@pytest.mark.slow
def test_a_folder_of_a_bucket_is_a_stack(made: tuple[Path, dict[str, bytes]], bucket: str) -> None:
    images = Objects("s3://stacks/in", allow_network=True)
    for path in (made[0] / "in").iterdir():
        images.put(path.name, path)
    result = stack(["s3://stacks/in/"], bucket, StackOptions(corrections_only=True), **FAR)
    store = Objects(bucket, allow_network=True)
    names = {path.name for path in (made[0] / "in").glob("*.tif")}
    for name, output in result.orthos.items():
        text = store.read(output.removeprefix(f"{bucket}/"), 1 << 20)[0].decode()
        assert f"/vsis3/stacks/in/{name}.tif" in text
        names.remove(f"{name}.tif")
    assert not names
    with pytest.raises(InputError, match="cannot refer to an image on this machine"):
        stack([made[0] / "in"], bucket, StackOptions(corrections_only=True), **FAR)


def test_a_folder_of_items_in_a_bucket_is_their_images(bucket: str, tmp_path: Path) -> None:
    store = Objects("s3://stacks", allow_network=True)
    names = {"relative": "../data/relative/B04.tif", "absolute": "s3://stacks/data/absolute/B04.tif"}
    for day, (name, href) in enumerate(names.items(), start=1):
        store.put(f"data/{name}/B04.tif", ortho(tmp_path / f"{name}.tif"))
        item: dict[str, Any] = {"type": "Feature", "stac_version": "1.0.0", "id": name}
        item["properties"] = {"datetime": f"2024-05-0{day}T00:00:00Z"}
        item["assets"] = {"B04": {"href": href}, "B08": {"href": "none.tif"}}
        store.put(f"every/{name}.json", json.dumps(item).encode())
        item["assets"] = {"B04": {"href": href}}
        store.put(f"items/{name}.json", json.dumps(item).encode())
    store.put("items/collection.json", b'{"type": "Collection", "stac_version": "1.0.0"}')
    for given in ("items/", "items", "items/*.json", "every/*.json#B04"):
        found = dated_orthos([f"s3://stacks/{given}"], options=SceneOptions(allow_network=True))
        assert [(one.name, one.time.day) for one in found] == [("relative_B04", 1), ("absolute_B04", 2)]
    with pytest.raises(InputError, match="several assets could be the image"):
        dated_orthos(["s3://stacks/every/"], options=SceneOptions(allow_network=True))


@pytest.mark.slow
def test_items_in_a_bucket_are_those_of_a_folder(made: tuple[Path, dict[str, bytes]], bucket: str) -> None:
    output = OutputOptions(resampling="cubic", threads=1, format="GTiff", stac=True)
    stack([made[0] / "in"], made[0] / "items", **{**SETTINGS, "output": output})
    result = stack([made[0] / "in"], bucket, **{**FAR, "output": output})
    assert result.files["stac"] == f"{bucket}/aligned/catalog.json"
    aligned = Objects(f"{bucket}/aligned", allow_network=True)
    names = [path.name for path in (made[0] / "items" / "aligned").glob("*_stac.json")]
    assert len(names) == 4
    for name in (*names, "catalog.json"):
        assert aligned.read(name, 1 << 20)[0] == (made[0] / "items" / "aligned" / name).read_bytes()
    stack([made[0] / "in"], bucket, **FAR)
    assert not any("stac" in name or "catalog" in name for name, _ in aligned.names())


def test_workers_with_other_software_are_refused(
    made: tuple[Path, dict[str, bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(freshness, "versions", lambda: {"gdal": "1.0"})
    with pytest.raises(InputError, match=r"different software versions: gdal 1\.0 instead of"):
        stack([made[0] / "in"], tmp_path / "out", **SETTINGS)
    assert not list(tmp_path.rglob("*.record.json"))


def test_a_worker_with_another_working_folder_reads_and_writes_the_same_files(
    made: tuple[Path, dict[str, bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Elsewhere(ThreadPoolExecutor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            with contextlib.chdir(tmp_path):
                future = super().submit(fn, *args, **kwargs)
                wait([future])
            return future

    monkeypatch.chdir(made[0])
    with Elsewhere(1) as pool:
        part = match_part(["in"], "elsewhere", (6, 6), executor=pool, **SETTINGS)
    assert part.document["matched"] == 1
    assert (made[0] / "elsewhere" / "pairs").is_dir()
    assert not list(tmp_path.iterdir())


def test_a_worker_without_the_folders_makes_nothing(tmp_path: Path) -> None:
    """Otherwise it would write into a folder of its own, and record that images cannot be matched."""
    state = FileState(role="image", path=str(tmp_path / "a.tif"), bytes=1, mtime_ns=0, sha256="0" * 64)
    pair = FileSet("pair", (state,), {}, {"matches": "pair.json"}, lambda folder: None, may_fail=True)
    with pytest.raises(InputError, match=r"a\.tif: this worker does not have this input"):
        pair.made(tmp_path)
    with pytest.raises(InputError, match="does not have the output folder of the run"):
        recorded_in(tmp_path / "out", "pairs", False, False).make(pair)
    # Not every store gives its objects tags.
    far = replace(pair, inputs=(state.replaced(path="s3://stacks/a.tif"),), files={})
    assert far.made(tmp_path).status == "done"
    assert not list(tmp_path.iterdir())


def test_a_record_is_that_of_a_set_only_with_its_outputs(tmp_path: Path) -> None:
    """Others can write into a shared folder, and a pair of far images may have failed by a denied access."""
    near = FileSet("pair", (), {}, {"matches": "pair.json"}, lambda folder: None, may_fail=True)
    failed = RunRecord(name="pair", key=near.key, status="failed", error={"message": "cannot match"})
    assert near.is_in(failed)
    assert not near.is_in(failed.replaced(status="done"))
    assert not near.is_in(failed.replaced(name="../pair"))
    state = FileState(role="image", path="s3://bucket/a.tif", bytes=1, mtime_ns=0, sha256="0" * 64, tag="1")
    far = replace(near, inputs=(state,))
    assert not far.is_in(failed.replaced(key=far.key, inputs=far.inputs))


def test_a_full_disk_is_not_recorded_as_a_pair_that_cannot_be_matched(tmp_path: Path) -> None:
    def full(folder: Path) -> None:
        with whole_or_nothing(folder / "pair.json"):
            raise OSError(errno.ENOSPC, "No space left on device")

    def unmatched(folder: Path) -> None:
        raise InputError("no match")

    pair = FileSet("pair", (), {}, {"matches": "pair.json"}, full, may_fail=True)
    with pytest.raises(InputError, match="No space left"):
        pair.made(tmp_path)
    assert replace(pair, write=unmatched).made(tmp_path).status == "failed"
