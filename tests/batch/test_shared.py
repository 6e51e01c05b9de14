"""Many workers of one run: parts from their environment, leases in a store of objects, takeover after a death."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import random
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from osgeo import gdal
from servers import moto_server, on_a_faulty_way, serving

from ortho_pipeline.batch import runner
from ortho_pipeline.batch.executors import Sequential
from ortho_pipeline.batch.plan import STATE, Job, Plan, plan
from ortho_pipeline.batch.records import FileState, RunRecord, key_of
from ortho_pipeline.batch.results import Outcome
from ortho_pipeline.batch.shared.arrays import part_of_array
from ortho_pipeline.batch.shared.leases import Leases
from ortho_pipeline.batch.shared.run import SharedFolder, run_shared, summary_of
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError, error_document
from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.stores import objects
from ortho_pipeline.stores.objects import Objects

gdal.UseExceptions()


@pytest.fixture(scope="module")
def moto() -> Iterator[tuple[str, int]]:
    with moto_server("runs") as address:
        yield address


@pytest.fixture
def store(moto: tuple[str, int], monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """A folder of objects for this test."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{moto[0]}:{moto[1]}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    quick = {"init_backoff": timedelta(milliseconds=2), "max_backoff": timedelta(milliseconds=20), "base": 2}
    monkeypatch.setattr(
        objects, "RETRIES", {"max_retries": 6, "retry_timeout": timedelta(seconds=10), "backoff": quick}
    )
    return f"s3://runs/{abs(hash(request.node.name))}"


# -- parts -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "part"),
    [
        ({"AWS_BATCH_JOB_ARRAY_INDEX": "0", "AWS_BATCH_JOB_ARRAY_SIZE": "4"}, (1, 4)),
        ({"AWS_BATCH_JOB_ARRAY_INDEX": "3", "ORTHO_SHARDS": "4"}, (4, 4)),
        ({"JOB_COMPLETION_INDEX": "1", "ORTHO_SHARDS": "2"}, (2, 2)),
        ({"SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_COUNT": "16"}, (1, 16)),
        (
            {
                "SLURM_ARRAY_TASK_ID": "20", "SLURM_ARRAY_TASK_MIN": "10", "SLURM_ARRAY_TASK_STEP": "5",
                "SLURM_ARRAY_TASK_COUNT": "3",
            },
            (3, 3),
        ),
    ],
)  # fmt: skip
def test_an_array_of_jobs_says_which_part_it_is(environment: dict[str, str], part: tuple[int, int]) -> None:
    assert part_of_array(environment) == part


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({}, "no job array"),
        ({"JOB_COMPLETION_INDEX": "0", "SLURM_ARRAY_TASK_ID": "0"}, "several"),
        ({"JOB_COMPLETION_INDEX": "0"}, "not how many"),
        ({"JOB_COMPLETION_INDEX": "2", "ORTHO_SHARDS": "2"}, "does not fit 2 workers"),
        ({"JOB_COMPLETION_INDEX": "-1", "ORTHO_SHARDS": "2"}, "not a valid number"),
        ({"SLURM_ARRAY_TASK_ID": "12", "SLURM_ARRAY_TASK_STEP": "5", "SLURM_ARRAY_TASK_COUNT": "4"}, "does not fit"),
    ],
)  # fmt: skip
def test_an_environment_that_does_not_say_it_is_refused(environment: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        part_of_array(environment)
    assert caught.value.remedy


def test_parts_of_all_workers_are_all_scenes_once() -> None:
    jobs = tuple(Job(f"s{k}", Request(Path(f"s{k}.tif")), Path("out"), {}) for k in range(23))
    planned = Plan(Path("p.yaml"), Path("out"), jobs, {})
    parts = (part_of_array({"JOB_COMPLETION_INDEX": str(k), "ORTHO_SHARDS": "5"}) for k in range(5))
    made = [job.name for part in parts for job in planned.chosen(shard=part)]
    assert sorted(made) == sorted(job.name for job in jobs)


#: What a worker says of a scene that failed.
RESULT = RunRecord(name="s", key="", status="failed", error=error_document(InputError("no heights")))


# -- leases ------------------------------------------------------------------------------------------------------------


class Dies(BaseException):
    """A worker that is killed: nothing of it runs any more."""


def make(made: list[str], seconds: float, dying: random.Random | None, job: Job) -> Outcome:
    """Stand for the work on a scene: write an output, sometimes die before or after."""
    if dying is not None and dying.random() < 0.3:
        raise Dies
    time.sleep(seconds)
    job.folder.mkdir(parents=True)
    (job.folder / f"{job.name}_ortho.tif").write_text(job.name)
    if dying is not None and dying.random() < 0.3:
        raise Dies
    made.append(job.name)
    done_record(job).write(job.record)
    return Outcome(job.name, "done", seconds, {"ortho": str(job.folder / f"{job.name}_ortho.tif")})


def done_record(job: Job) -> RunRecord:
    """Return what a run writes of a scene without inputs."""
    job.record.parent.mkdir(exist_ok=True)
    for role in ("report", "html"):
        (job.folder / role).write_text(role)
    names = {"ortho": f"{job.name}_ortho.tif", "report": "report", "html": "html"}
    outputs = tuple(FileState.of(role, job.folder / name, name=name) for role, name in names.items())
    facts = {"sensor": "rpc", "model": "rpc", "headline": {}, "lean_m_per_m": 0.1, "rmse_px": {}, "rmse_m": {},
             "rmse_points": {}, "ortho": {}, "warnings": [], "notices": []}  # fmt: skip
    return RunRecord(
        name=job.name, key=key_of((), job.configuration, job.versions), status="done", outputs=outputs, facts=facts
    )


def work_together(address: str, count: int, scenes: int, patience: float, dying: int | None = None) -> Counter[str]:
    """Let some workers make the scenes of one plan at once, each beginning with its own; return how often each was."""
    jobs = tuple(Job(f"s{k:03}", Request(Path(f"s{k}.tif")), Path("out"), {}) for k in range(scenes))
    planned = Plan(Path("p.yaml"), Path("out"), jobs, {})
    made: list[str] = []
    where = SharedFolder(address, allow_network=True, patience=patience)

    def worker(part: int, random_or_none: random.Random | None) -> None:
        work = functools.partial(make, made, 0.01, random_or_none)
        try:
            run_shared(planned, planned.chosen(shard=(part + 1, count)), where, Sequential(), work)
        except Dies:
            return

    # The last worker never dies, and cleans up after the others.
    mortal = [None if dying is None or k == count - 1 else random.Random(dying + k) for k in range(count)]
    threads = [threading.Thread(target=worker, args=(k, mortal[k])) for k in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert not any(thread.is_alive() for thread in threads)
    store = Objects(address, allow_network=True)
    for job in jobs:
        assert store.read(f"{job.name}/{job.name}_ortho.tif", 100)[0] == job.name.encode()
        assert store.exists(f"{job.name}/{job.name}_delivery.json")
    summary = summary_of(planned, where)
    assert [one.status for one in summary.scenes] == ["unchanged"] * scenes
    return Counter(made)


def test_two_workers_at_once_make_every_scene_once(store: str) -> None:
    assert work_together(store, count=3, scenes=8, patience=4.0) == {f"s{k:03}": 1 for k in range(8)}


def test_scenes_of_workers_that_died_are_taken_over(store: str) -> None:
    assert set(work_together(store, count=3, scenes=5, patience=0.4, dying=1)) == {f"s{k:03}" for k in range(5)}


@pytest.mark.slow
def test_a_hundred_deaths(store: str) -> None:
    for seed in range(100):
        found = work_together(f"{store}/{seed}", count=3, scenes=4, patience=0.4, dying=1000 * seed)
        assert set(found) == {f"s{k:03}" for k in range(4)}


def test_a_lease_that_was_taken_over_ends_nothing(store: str) -> None:
    """A worker that was silent for too long finds out before it writes a result."""
    first, second = (Leases(store, allow_network=True) for _ in range(2))
    lease = first.take("s")
    seen = second.take("s")
    assert isinstance(seen, str)
    taken = second.take("s", seen)
    assert not isinstance(taken, str)
    with pytest.raises(Exception, match="taken over"):
        lease.finish(RESULT)
    assert first.result("s") is None
    taken.finish(RESULT)
    assert first.result("s") == RESULT
    assert first.finished() == {"s"}


def test_leases_hold_on_a_faulty_way(store: str, moto: tuple[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer that is lost after the write was done is no conflict with oneself."""
    with on_a_faulty_way(moto, 3, share=0.25) as way:
        way.KINDS = ("answer lost", "503", "cut", "429")
        monkeypatch.setenv("AWS_ENDPOINT_URL", way.address)
        taken = [Leases(store, allow_network=True).take(f"s{k}") for k in range(12)]
        assert not [one for one in taken if isinstance(one, str)]
        for one in taken:
            one.renew()
            one.finish(RESULT)
        assert way.met["answer lost"] > 0
        assert len(Leases(store, allow_network=True).finished()) == 12


# -- the command -------------------------------------------------------------------------------------------------------

FILE = """
output: out
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {format: GTiff}
scenes:
  - images: raw/*.tif
"""


def test_the_command_delivers_to_a_store_and_collects(store: str, tiny: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = tiny.folder / "raw"
    raw.mkdir()
    for number in range(2):
        gdal.Translate(str(raw / f"s{number}.tif"), str(tiny.image))
    file = tiny.folder / "p.yaml"
    file.write_text(FILE)
    monkeypatch.setenv("JOB_COMPLETION_INDEX", "0")
    monkeypatch.setenv("ORTHO_SHARDS", "2")
    common = ["run", str(file), "-o", store, "--executor", "sequential", "--json"]
    refused = CliRunner().invoke(cli, common)
    assert refused.exit_code == 2
    assert "--allow-network" in refused.stderr
    done = CliRunner().invoke(cli, [*common, "--allow-network", "--shard", "auto"])
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["counts"]["done"] == 2, "the other worker never came"
    again = CliRunner().invoke(cli, [*common, "--allow-network"])
    assert json.loads(again.stdout)["counts"] == {"done": 0, "unchanged": 2, "failed": 0}
    summary = CliRunner().invoke(cli, [*common, "--allow-network", "--summary"])
    files = [one["files"]["ortho"] for one in json.loads(summary.stdout)["scenes"]]
    assert files == [f"{store}/s{k}/s{k}_ortho.tif" for k in range(2)]
    names = {name for name, _ in Objects(store, allow_network=True).names()}
    only = CliRunner().invoke(cli, [*common, "--allow-network", "--only", "s1", "-o", f"{store}/only"])
    assert [one["name"] for one in json.loads(only.stdout)["scenes"]] == ["s1"]
    assert not [name for name, _ in Objects(f"{store}/only", allow_network=True).names() if "s0" in name]
    assert {"run.json", f"{STATE}/s0.result.json", "s1/s1_report.json"} <= names
    assert not (tiny.folder / "out").exists()


@pytest.fixture
def bucket_run(store: str, tiny: Any) -> Any:
    """Return what runs one scene into a store and says how it ended."""
    raw = tiny.folder / "raw"
    raw.mkdir()
    gdal.Translate(str(raw / "s0.tif"), str(tiny.image))
    file = tiny.folder / "p.yaml"
    file.write_text(
        FILE.replace("GTiff}", "GTiff, resolution: 40}")
        + f"    points: {{gcps: {tiny.gcps.name}, crs: 'EPSG:4979', vertical: ellipsoid}}\n"
    )

    def run(*more: str) -> tuple[str, int]:
        done = CliRunner().invoke(
            cli, ["run", str(file), "-o", store, "--executor", "sequential", "--json", "--allow-network", *more]
        )
        assert done.stdout, done.stderr
        (scene,) = json.loads(done.stdout)["scenes"]
        return scene["status"], done.exit_code

    assert run() == ("done", 0)
    assert run() == ("unchanged", 0)
    return run


def test_a_run_in_a_store_notices_what_changed(bucket_run: Any, store: str, tiny: Any) -> None:
    """Twelve kinds of change, each to one output, one input, the settings or the record."""
    objects = Objects(store, allow_network=True)
    result = f"{STATE}/s0.result.json"
    whole = objects.read(result, 10**6)[0]
    ortho = objects.read("s0/s0_ortho.tif", 10**8)[0]
    file, image = tiny.folder / "p.yaml", tiny.folder / "raw" / "s0.tif"

    def raised() -> None:
        dem = gdal.Open(str(tiny.folder / "dem.tif"), gdal.GA_Update)
        dem.GetRasterBand(1).WriteArray(dem.ReadAsArray() + 3)

    def tampered(**fields: Any) -> None:
        objects.put(result, json.dumps({**json.loads(whole), **fields}).encode())

    changes: dict[str, Any] = {
        "output deleted": lambda: objects.delete("s0/s0_ortho.tif"),
        "output replaced by as many bytes": lambda: objects.put("s0/s0_ortho.tif", bytes(len(ortho))),
        "report deleted": lambda: objects.delete("s0/s0_report.json"),
        "DEM raised": raised,
        "image changed": lambda: gdal.Open(str(image), gdal.GA_Update).WriteRaster(0, 0, 1, 1, b"\0\0"),
        "points changed": lambda: tiny.write(tiny.gcps, tiny.points(11)),
        "a model next to the image": lambda: (image.parent / "s0_notes.txt").write_text("new"),
        "settings changed": lambda: file.write_text(file.read_text().replace("resolution: 40", "resolution: 20")),
        "empty record": lambda: objects.put(result, b"{}"),
        "record that is no JSON": lambda: objects.put(result, b"\xff{"),
        "record without outputs": lambda: tampered(outputs=[]),
        "record of another scene": lambda: tampered(name="s1"),
    }
    assert len(changes) == 12
    for what, change in changes.items():
        change()
        if "record" not in what:
            assert bucket_run("--summary")[0] == "missing", what
        assert bucket_run() == ("done", 0), what
    assert bucket_run("--checksums") == ("unchanged", 0)
    assert bucket_run("--summary") == ("unchanged", 0)


def _scene(**fields: Any) -> bytes:
    given = {"document": "ortho-pipeline scene record", "schema_version": 1, "name": "s0", "key": "", "status": "done"}
    return json.dumps({**given, **fields}).encode()


_OUTSIDE = {"role": "ortho", "path": "../x", "bytes": 1, "mtime_ns": 1, "sha256": ""}
HOSTILE = [
    b"", b"null", b"[]", b"{", b'{"document": 1}', b"[" * 100_000, b'{"a":' * 20_000 + b"1" + b"}" * 20_000,
    _scene(status=7), _scene(facts={"lean_m_per_m": "x"}), _scene(status="failed", error={}),
    _scene(status="failed", error={"message": ["\u001b"]}), _scene(outputs=[_OUTSIDE]), _scene(inputs=[{"path": None}]),
    _scene().replace(b'"key"', b'"seconds": 1e999, "key"'), _scene(inputs={}),
    _scene(outputs=[_OUTSIDE | {"path": ".."}]),
]  # fmt: skip


@pytest.mark.parametrize("data", HOSTILE, ids=range(len(HOSTILE)))
def test_a_record_that_cannot_be_read_is_none(data: bytes, tmp_path: Path, caplog: Any) -> None:
    assert RunRecord.parse(data) is None
    (tmp_path / "record.json").write_bytes(data)
    assert RunRecord.at(tmp_path / "record.json") is None
    assert caplog.text.count("cannot read this record") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "environments",
    [
        [{"AWS_BATCH_JOB_ARRAY_INDEX": str(k), "AWS_BATCH_JOB_ARRAY_SIZE": "2"} for k in range(2)],
        [{"JOB_COMPLETION_INDEX": str(k), "ORTHO_SHARDS": "2"} for k in range(2)],
        [{"SLURM_ARRAY_TASK_ID": str(k), "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_COUNT": "2"} for k in (1, 2)],
    ],
    ids=["AWS Batch", "Kubernetes", "Slurm"],
)
def test_both_workers_of_an_array_are_processes_that_make_all_scenes_once(
    environments: list[dict[str, str]], store: str, tiny: Any
) -> None:
    """`ortho run --shard auto` as each kind of array starts it, both at once."""
    raw = tiny.folder / "raw"
    raw.mkdir()
    for number in range(4):
        gdal.Translate(str(raw / f"s{number}.tif"), str(tiny.image))
    (tiny.folder / "p.yaml").write_text(FILE)
    command = [sys.executable, "-m", "ortho_pipeline", "run", str(tiny.folder / "p.yaml"), "-o", store]
    options = ["--allow-network", "--executor", "sequential", "--json", "--shard", "auto"]
    workers = [
        subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True, env={**os.environ, **environment})
        for environment in environments
    ]
    said = [json.loads(worker.communicate(timeout=120)[0])["scenes"] for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0]
    made = Counter(scene["name"] for scenes in said for scene in scenes if scene["status"] == "done")
    assert made == {f"s{k}": 1 for k in range(4)}
    assert all({scene["status"] for scene in scenes} <= {"done", "unchanged"} for scenes in said)


def test_a_pipeline_file_in_a_store_names_images_there(store: str, tiny: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """File, images by a pattern, points and heights lie in a bucket; a STAC item stands for one of the images."""
    for name, value in {"AWS_HTTPS": "NO", "AWS_VIRTUAL_HOSTING": "FALSE"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("AWS_S3_ENDPOINT", os.environ["AWS_ENDPOINT_URL"].removeprefix("http://"))
    objects_in = Objects(f"{store}/in", allow_network=True)
    objects_in.put("dem.tif", tiny.dem)
    objects_in.put("raw/2024/a.tif", tiny.image)
    objects_in.put("raw/2024/deep/b.tif", tiny.image)
    objects_in.put("raw/note.txt", b"no image")
    for name in ("a", "b"):
        objects_in.put(f"gcps/{name}.csv", tiny.gcps)
    asset = {"href": "../raw/2024/a.tif", "roles": ["data"], "type": "image/tiff"}
    item = {"type": "Feature", "stac_version": "1.0.0", "id": "c", "assets": {"image": asset}}
    objects_in.put("items/c.json", json.dumps(item).encode())
    objects_in.put("pipeline.yaml", FAR.encode())
    address = f"{store}/in/pipeline.yaml"
    with pytest.raises(InputError, match="network access is off"):
        plan(address)
    with pytest.raises(InputError, match="needs an output in object storage"):
        runner.run(address, allow_network=True)
    command = ["run", address, "-o", f"{store}/out", "--allow-network", "--executor", "sequential", "--json"]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, done.stderr + done.stdout
    made = {one["name"]: one for one in json.loads(done.stdout)["scenes"]}
    assert {name: one["status"] for name, one in made.items()} == {"a": "done", "b": "done", "c": "done"}
    assert made["b"]["files"]["ortho"] == f"{store}/out/b/b_ortho.tif"
    assert made["a"]["facts"]["rmse_px"]["control"] is not None
    assert made["c"]["facts"]["rmse_px"]["control"] is None
    again = CliRunner().invoke(cli, command)
    assert json.loads(again.stdout)["counts"] == {"done": 0, "unchanged": 3, "failed": 0}
    # Another image of that name is another scene.
    objects_in.put("raw/2024/a.tif", tiny.image.read_bytes() + b"more")
    gdal.VSICurlClearCache()
    again = CliRunner().invoke(cli, command)
    assert json.loads(again.stdout)["counts"]["done"] == 1


FAR = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {format: GTiff}
scenes:
  - images: raw/**/*.tif
    points: {gcps: "gcps/{stem}.csv", crs: "EPSG:4326", vertical: ellipsoid}
  - image: items/c.json
"""


@pytest.mark.parametrize("name", ["/etc/passwd", "../up.tif", "file:///etc/passwd", "/vsicurl/http://h/a.tif"])
def test_a_file_elsewhere_leads_to_nothing_on_this_machine(name: str, tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(f"scenes:\n  - image: {name}\n    surface: {{height: 5}}\n")
    with serving(tmp_path) as public, pytest.raises(InputError) as caught:
        plan(f"{public.address}/p.yaml", allow_network=True)
    assert caught.value.field == "scenes[0].image"


def test_a_file_on_this_machine_may_name_addresses_if_that_is_allowed(tiny: Any) -> None:
    file = tiny.folder / "p.yaml"
    with serving(tiny.folder) as public:
        file.write_text(
            f"scenes:\n  - image: {public.address}/{tiny.image.name}\n"
            f"    surface: {{dem: {public.address}/dem.tif, vertical: ellipsoid}}\n    output: {{format: GTiff}}\n"
        )
        with pytest.raises(InputError, match="network access is off") as caught:
            plan(file)
        assert caught.value.field == "scenes[0].image"
        made = runner.run(file, allow_network=True, executor="sequential")
        assert [one.status for one in made.scenes] == ["done"]
        again = runner.run(file, allow_network=True, executor="sequential")
        assert [one.status for one in again.scenes] == ["unchanged"]
        file.write_text(
            file.read_text()
            .replace(f"{public.address}/{tiny.image.name}", f"{public.address}/*.tif")
            .replace("image:", "images:")
        )
        with pytest.raises(InputError, match="cannot search a web server"):
            plan(file, allow_network=True)


def test_a_changed_side_car_of_an_image_behind_a_url_is_noticed(tiny: Any) -> None:
    folder, file = tiny.folder / "web", tiny.folder / "p.yaml"
    folder.mkdir()
    plain = gdal.GetDriverByName("GTiff").Create(str(folder / "plain.tif"), tiny.width, tiny.height, 1, gdal.GDT_UInt16)
    plain.WriteArray(gdal.Open(str(tiny.image)).ReadAsArray())
    plain = None
    write_rpc_txt(tiny.model, folder / "plain_RPC.TXT")
    with serving(folder) as public:
        file.write_text(
            f"scenes:\n  - image: {public.address}/plain.tif\n    surface: {{height: 500}}\n"
            "    output: {format: GTiff, resolution: 40}\n"
        )

        def run() -> list[str]:
            return [one.status for one in runner.run(file, allow_network=True, executor="sequential").scenes]

        assert run() == ["done"]
        assert run() == ["unchanged"]
        write_rpc_txt(dataclasses.replace(tiny.model, col_off=tiny.model.col_off + 7), folder / "plain_RPC.TXT")
        assert runner.list_scenes(plan(file, allow_network=True))[0]["state"] == "changed"
        assert run() == ["done"]
        assert runner.list_scenes(plan(file, allow_network=True))[0]["state"] == "done"


def test_items_of_a_local_pipeline_file_are_their_images(tiny: Any) -> None:
    asset = {"href": tiny.image.name, "roles": ["data"], "type": "image/tiff"}
    item = {"type": "Feature", "stac_version": "1.0.0", "id": "c", "assets": {"image": asset}}
    (tiny.folder / "one.json").write_text(json.dumps(item))
    file = tiny.folder / "p.yaml"
    file.write_text("scenes:\n  - image: one.json\n    surface: {height: 500}\n    output: {format: GTiff}\n")
    assert plan(file).jobs[0].image == tiny.image
    assert [one.status for one in runner.run(file, executor="sequential").scenes] == ["done"]
    assert [one.status for one in runner.run(file, executor="sequential").scenes] == ["unchanged"]
