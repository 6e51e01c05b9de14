"""`ortho run`: a strict file, paths that stay inside, each scene made once, the same bytes whatever happens."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.batch import config as batch_config
from ortho_pipeline.batch import freshness
from ortho_pipeline.batch import plan as batch_plan
from ortho_pipeline.batch import runner as batch
from ortho_pipeline.batch.executors import InGroups, Processes, WorkerDied, _Spawning, completed
from ortho_pipeline.batch.records import RunRecord, locked
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.files import Outputs
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions, options_of

ROOT = Path(__file__).resolve().parent.parent.parent
FILE = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {crs: "EPSG:32734", resolution: 5}
scenes:
  - images: raw/*.tif
"""


@dataclasses.dataclass
class Block:
    """A folder with a DEM, some small scenes of one terrain, and a pipeline file."""

    folder: Path
    tiny: Any

    @property
    def file(self) -> Path:
        return self.folder / "pipeline.yaml"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def write(self, text: str = FILE) -> Path:
        self.file.write_text(text)
        return self.file

    def scene(self, name: str, shift: int = 0) -> Path:
        """Write a 96 x 80 window of the tiny scene that begins at column and row `shift`."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        model = dataclasses.replace(
            self.tiny.model, col_off=self.tiny.model.col_off - shift, row_off=self.tiny.model.row_off - shift
        )
        pixels = gdal.Open(str(self.tiny.image)).ReadAsArray(shift, shift, 96, 80)
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), 96, 80, 1, gdal.GDT_UInt16)
        dataset.SetMetadata(rpc_metadata(model), "RPC")
        dataset.WriteArray(pixels)
        dataset = None
        return path

    def run(self, **options: Any) -> dict[str, str]:
        """Run in this process and return the state of each scene."""
        return states(batch.run(self.file, executor=options.pop("executor", "sequential"), **options))

    def digests(self) -> dict[str, str]:
        """Return the checksum of every output of every scene."""
        files = sorted(path for path in self.out.rglob("*") if path.is_file() and ".run" not in path.parts)
        return {
            str(path.relative_to(self.out)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
            if path.name not in ("run.jsonl", "run.json")
        }


def states(result: batch.BatchResult) -> dict[str, str]:
    return {scene.name: scene.status for scene in result.scenes}


def ortho(*arguments: Any) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture
def block(tiny: Any, tmp_path: Path) -> Block:
    """Make a block of three scenes."""
    made = Block(tmp_path / "block", tiny)
    made.folder.mkdir()
    for number in range(3):
        made.scene(f"raw/s{number}.tif", 20 * number)
    (made.folder / "dem.tif").write_bytes(tiny.dem.read_bytes())
    made.write()
    return made


# -- the file --------------------------------------------------------------------------------------------------------


def test_the_published_schema_is_current():
    assert json.loads((ROOT / "docs" / "run.schema.json").read_text()) == batch_config.schema()
    assert json.loads(ortho("run", "--schema").stdout) == batch_config.schema()


@pytest.mark.parametrize(
    ("settings", "options", "not_in_the_file"),
    [
        (batch_config.SceneSettings, SceneOptions, {"allow_network", "roots"}),
        (batch_config.PointSettings, PointOptions, set()),
        (batch_config.SurfaceSettings, SurfaceOptions, set()),
        (batch_config.OutputSettings, OutputOptions, {"memory", "threads"}),
    ],
)
def test_the_file_has_the_options_of_rectify(settings, options, not_in_the_file):
    assert set(settings.model_fields) == {field.name for field in dataclasses.fields(options)} - not_in_the_file
    values = {name: field.default for name, field in settings.model_fields.items()}
    assert options(**values) == options()
    # What an editor shows is the help of the command line.
    described = settings.model_json_schema()["properties"]
    for name, option in options_of(options).items():
        assert name in not_in_the_file or option.help in described[name].get("description", "")


@pytest.mark.parametrize(
    ("text", "field", "message"),
    [
        ("scenes:\n  - images: a\n    points: {gcp: x}\n", "line 3, scenes[0].points.gcp", "did you mean 'gcps'"),
        ("scenes:\n  - images: a\n    dem: b\n", "line 3, scenes[0].dem", "'dem' belongs in 'surface'"),
        (
            "scenes:\n  - images: a\n    dem: b\n    outptu: {}\n",
            "line 3, scenes[0].dem",
            "did you mean 'output' instead of 'outptu'?",
        ),
        ("scenes:\n  - images: a\n    crs: b\n", "line 3, scenes[0].crs", "'crs' belongs in 'points' or 'output'"),
        ("crs: b\nscenes:\n  - images: a\n", "line 1, crs", "in 'points' or 'output' of 'defaults' or of a scene"),
        ("surface: {}\nscenes:\n  - images: a\n", "line 1, surface", "'surface' belongs in 'defaults' or in a scene"),
        ("output: {}\nscenes:\n  - images: a\n", "line 1, output", "the properties of orthos belong in 'output' of"),
        ("scenes:\n  - images: a\n    zzz: b\n", "line 3, scenes[0].zzz", "use one of scene, points, surface"),
        ("scenes:\n  - images: a\nscenes:\n  - images: b\n", "line 3, scenes", "duplicate key, already in line 1"),
        ("scenes:\n  - images: a\n    output: {resolution: 1, resolution: 2}", "line 3", "duplicate key"),
        ("scenes: []\n", "line 1, scenes", "at least 1"),
        ("scenes:\n  - name: x\n", "line 2, scenes[0]", "either 'image'"),
        ("scenes:\n  - {image: a, images: b}\n", "line 2, scenes[0]", "either 'image'"),
        ("scenes:\n  - image: a\n    surface: {height: 1e400}\n", "line 3, scenes[0].surface.height", "finite"),
        ("scenes:\n  - image: a\n    surface: {height: .nan}\n", "line 3, scenes[0].surface.height", "finite"),
        ("scenes:\n  - image: a\n    surface:\n      height: 1,5\n", "line 4", "valid number"),
        ("scenes:\n  - image: a\n    surface:\n      height: '15'\n", "line 4", "valid number"),
        ("scenes:\n  - image: a\n    output:\n      extent: [1, 2, 3]\n", "line 4", "at least 4"),
        ("x: &a [1]\ny: *a\n", "line 2", "aliases are not supported"),
        ("scenes:\n  - images: */*.tif\n", "line 2", "quote text"),
        ("x: !!python/object/apply:os.system [ls]\n", "line 1, x", "tag"),
        ("a: [1, 2\n", "line", "not YAML"),
        ("[" * 100_000, "line 1", "nest"),  # by libyaml or by the reader
        ("[" + "1," * 400_000 + "]", None, "too many"),
        ("", None, "empty"),
        ("a: \x00", None, "not YAML"),
        ("x: " + "1" * 5000, "line 1, x", "not a number"),
        ("x" * 5_000_001, None, "5 MB"),
        ("- 1\n- 2\n", "line 1", "dictionary"),
        ("? [1]\n: 2\n", "line 1", "key is not a word"),
    ],
)
def test_a_wrong_file_is_an_error_that_says_where(tmp_path, text, field, message, calls):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught, calls:
        batch_config.read_config(path)
    # Each letter is looked at a few times, none for every other one.
    assert calls.count < 5000 + 5 * len(text)
    assert caught.value.file == str(path)
    assert message in str(caught.value)
    assert caught.value.remedy or "nest" in message
    assert field is None or (caught.value.field or "").startswith(field)


def test_a_file_that_is_not_there_or_not_utf8(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        batch_config.read_config(tmp_path / "none.yaml")
    (tmp_path / "p.yaml").write_bytes(b"scenes: \xff\xfe\x01")
    with pytest.raises(InputError, match="not YAML"):
        batch_config.read_config(tmp_path / "p.yaml")
    (tmp_path / "p.yaml").write_bytes("scenes:\n  - image: ä.tif\n".encode("utf-16"))
    assert batch_config.read_config(tmp_path / "p.yaml").scenes[0].image == "ä.tif"


def test_the_examples_of_the_guide_are_right(tmp_path):
    guide = "".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in ("run.md", "mosaic.md"))
    examples = re.findall(r"```yaml\n(.*?)```", guide, re.DOTALL)
    assert len(examples) >= 3
    for example in examples:
        (tmp_path / "p.yaml").write_text(example)
        batch_config.read_config(tmp_path / "p.yaml")
    options = {name for option in cli.get_command(click.Context(cli), "run").params for name in option.opts}
    for line in re.findall(r"ortho run [^`\n]*", guide):
        assert set(re.findall(r"--[a-z-]+", line)) <= options | {"--wrap"}, line


def test_words_stay_words(tmp_path):
    (tmp_path / "p.yaml").write_text(
        "scenes:\n  - image: a\n    name: 2024-01-01\n    points: {check: no, select: 1:30}\n"
        "    surface: {height: 1e2}\n"
    )
    entry = batch_config.read_config(tmp_path / "p.yaml").scenes[0]
    assert (entry.name, entry.points.check, entry.points.select) == ("2024-01-01", "no", "1:30")
    assert entry.surface.height == 100.0


# -- the plan --------------------------------------------------------------------------------------------------------


def test_later_entries_override_field_by_field(block):
    block.write(
        FILE.replace("vertical: ellipsoid", "vertical: ellipsoid, fill: nearest")
        + "    output: {creation_options: {LEVEL: 9}, resolution: 4}\n"
        + "  - image: raw/s1.tif\n    name: special\n"
        + "    output: {resampling: cubic, creation_options: {COMPRESS: ZSTD}}\n    surface: {dem: null, height: 1}\n"
    )
    jobs = {job.name: job for job in batch_plan.plan(block.file).jobs}
    assert list(jobs) == ["s0", "special", "s2"]
    special = jobs["special"]
    assert special.request.surface == SurfaceOptions(None, "ellipsoid", fill="nearest", height=1.0)
    assert (special.request.output.resampling, special.request.output.resolution, special.request.output.crs) == (
        "cubic",
        4.0,
        "EPSG:32734",
    )
    assert special.request.output.creation_options == {"LEVEL": "9", "COMPRESS": "ZSTD"}
    assert jobs["s0"].request.surface.dem == str(block.folder / "dem.tif")
    assert jobs["s0"].request.output.resampling == "bilinear"


def test_placeholders_and_exclusions(block):
    block.write(
        FILE + "    exclude: raw/s2*\n    points: {gcps: 'points/{folder}/{stem}.csv'}\n    name: '{folder}_{stem}'\n"
    )
    jobs = batch_plan.plan(block.file).jobs
    assert [job.name for job in jobs] == ["raw_s0", "raw_s1"]
    assert jobs[1].request.points.gcps == str(block.folder / "points" / "raw" / "s1.csv")
    block.write(FILE + "    name: '{stem.__class__}{sensor}'\n")
    with pytest.raises(InputError, match=r"unknown placeholder \{sensor\}"):
        batch_plan.plan(block.file)


def test_brackets_in_names_are_no_pattern_for_image(block):
    block.scene("raw [x]/süd s[0].tif")
    block.write(FILE.replace("images: raw/*.tif", "image: raw [x]/süd s[0].tif"))
    assert [job.name for job in batch_plan.plan(block.file).jobs] == ["süd s[0]"]
    assert block.run() == {"süd s[0]": "done"}
    assert block.run() == {"süd s[0]": "unchanged"}


@pytest.mark.parametrize(
    "change",
    [
        ("raw/*.tif", "../*.tif"),
        ("raw/*.tif", "/etc/host*"),
        ("dem: dem.tif", "dem: ../tiny/dem.tif"),
        ("images: raw/*.tif", "images: raw/*.tif\n    points: {gcps: ../gcps.csv}"),
        ("images: raw/*.tif", "images: raw/*.tif\n    scene: {rpc: /etc/passwd}"),
        ("images: raw/*.tif", "images: raw/*.tif\n    scene: {sensor_options: {camera: ../camera.json}}"),
        ("images: raw/*.tif", "images: linked/*.tif"),
        ("images: raw/*.tif", "image: /vsicurl/http://host/a.tif"),
        ("images: raw/*.tif", "image: http://host/a.tif"),
        ("vertical: ellipsoid", "vertical: ../geoid.gtx"),
        ("defaults:", "output: ../out\ndefaults:"),
    ],
)
def test_paths_stay_inside_of_the_root(block, change):
    (block.folder.parent / "outside.tif").write_bytes(b"")
    elsewhere = block.folder.parent / "elsewhere"
    elsewhere.mkdir()
    block.scene(str(elsewhere / "x.tif"))
    (block.folder / "linked").symlink_to(elsewhere)
    block.write(FILE.replace(*change))
    with pytest.raises(InputError, match=r"outside the root folder|not the path of a local file|network access is off"):
        batch_plan.plan(block.file)


def test_the_user_widens_the_root_and_the_file_only_narrows_it(block):
    """Who wrote the file is not who says what it may read."""
    widened = FILE.replace("dem: dem.tif", "dem: ../tiny/dem.tif")
    for root in ("", "root: ..\n", "root: /\n"):
        block.write(root + widened)
        with pytest.raises(InputError, match="outside the root folder") as caught:
            batch_plan.plan(block.file)
        assert "`root=" in (caught.value.remedy or "")
    block.write("root: /\n" + widened)
    with pytest.raises(InputError, match="outside the root folder"):
        batch_plan.plan(block.file, block.folder.parent)
    for root in ("", "root: ..\n"):
        block.write(root + widened)
        assert batch_plan.plan(block.file, block.folder.parent).jobs[0].request.surface.dem == str(block.tiny.dem)
    block.write("root: raw\n" + FILE)
    with pytest.raises(InputError, match="outside the root folder"):
        batch_plan.plan(block.file)


@pytest.mark.parametrize("where", ["s0", "s0/s0_ortho.tif", "s0/s0_report.json", ".run", ".run/s0.json", "run.jsonl",
                                   "run.json"])  # fmt: skip
def test_a_run_writes_through_no_link_in_its_output_folder(block, where):
    elsewhere = block.folder.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ".0123456789ab.x.part").write_text("somebody else's")
    target = elsewhere / "precious"
    if "." in where[1:]:
        target.write_text("precious")
    else:
        target.mkdir()
    path = block.folder / "out" / where
    path.parent.mkdir(parents=True)
    path.symlink_to(target)
    before = {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()}
    try:
        outcome = batch.run(block.file, executor="sequential").scenes[0].error
        said = "" if outcome is None else outcome["message"]
    except InputError as error:
        said = error.message
    assert "this is a symbolic link" in said
    assert {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()} == before
    assert target.is_file() or not list(target.iterdir())


def test_a_file_of_the_current_folder_is_not_meant(block, tmp_path, monkeypatch):
    here = tmp_path / "here"
    here.mkdir()
    (here / "camera.json").write_text("{}")
    monkeypatch.chdir(here)
    block.write(FILE + "    scene: {sensor_options: {camera: camera.json, band: 2, all: true}}\n")
    with pytest.raises(InputError, match="relative to the pipeline file"):
        batch_plan.plan(block.file)
    (block.folder / "camera.json").write_text("{}")
    options = batch_plan.plan(block.file).jobs[0].request.scene.sensor_options
    assert options == {"camera": str(block.folder / "camera.json"), "band": "2", "all": "true"}


def test_images_in_the_output_folder_are_not_said_to_be_missing(block):
    block.write("output: raw\n" + FILE)
    with pytest.raises(InputError, match="only files in the output folder match 'raw") as caught:
        batch_plan.plan(block.file)
    assert str(caught.value.remedy) == "choose another output folder"


def test_a_finished_ortho_is_a_scene_if_the_file_says_so(block):
    block.write(FILE + "    scene: {ortho: true, crop_offset: [3, 4]}\n")
    scene = batch_plan.plan(block.file).jobs[0].request.scene
    assert scene.ortho
    assert tuple(scene.crop_offset) == (3, 4)


@pytest.mark.parametrize("record", ["one.json", "mosaic/record.json"])
def test_what_a_killed_run_left_beside_a_record_goes_though_the_scene_is_unchanged(block, record):
    """Killed between the rename of the record and the removal of its lock, as a run was by `make faults`."""
    (block.folder / "raw").mkdir(exist_ok=True)
    for path in (block.folder / "raw").iterdir():
        path.unlink()
    block.scene("raw/one.tif")
    block.write(f"mosaic: {{format: VRT}}\n{FILE}")
    assert block.run() == {"one": "done"}
    state = block.out / ".run"
    left = Outputs((state / record).parent, Path(record).name)
    left.lock_path.touch()
    assert block.run() == {"one": "unchanged"}
    assert not list(state.rglob(".*.part"))


def test_outputs_are_no_scenes(block):
    block.write(FILE.replace("raw/*.tif", "'**/s*.tif'"))
    assert set(block.run()) == {"s0", "s1", "s2"}
    assert set(block.run().values()) == {"unchanged"}


def test_two_scenes_of_one_stem_do_not_meet(block):
    block.scene("more/S0.tif")
    block.write(FILE.replace("raw/*.tif", "'[rm]*/*.tif'"))
    with pytest.raises(InputError, match=r"have the same scene name 'S?s?0'.*\n.*folder"):
        batch_plan.plan(block.file)
    block.write(FILE.replace("raw/*.tif", "'[rm]*/*.tif'") + "    name: '{folder}_{stem}'\n")
    assert block.run() == {"more_S0": "done", "raw_s0": "done", "raw_s1": "done", "raw_s2": "done"}


@pytest.mark.parametrize("name", ["..", ".x", "a/b", "", "run.json", "x" * 200, " a", "a\\b", "mosaic.tif"])
def test_names_are_names_of_folders(block, name):
    block.write(FILE.replace("images: raw/*.tif", f"image: raw/s0.tif\n    name: {json.dumps(name)}"))
    with pytest.raises(InputError, match=r"name|file of the run"):
        batch_plan.plan(block.file)


def test_a_pattern_without_match_and_outputs_among_inputs(block):
    block.write(FILE.replace("raw/*.tif", "row/*.tif"))
    with pytest.raises(InputError, match="no file matches") as caught:
        batch_plan.plan(block.file)
    assert caught.value.field == "scenes[0].images"
    block.write("output: .\n" + FILE)
    with pytest.raises(InputError, match="cannot be the folder of the pipeline file"):
        batch_plan.plan(block.file)


def test_parts_are_a_partition(block):
    planned = batch_plan.plan(block.file)
    parts = [planned.chosen(shard=(k, 2)) for k in (1, 2)]
    assert sorted(job.name for part in parts for job in part) == ["s0", "s1", "s2"]
    assert [job.name for job in planned.chosen(only=["s2", "s0", "s2"])] == ["s2", "s0"]
    for given in ({"only": ["s9"]}, {"shard": (3, 2)}):
        with pytest.raises(InputError, match=r"s9|part 3"):
            planned.chosen(**given)


# -- once and again --------------------------------------------------------------------------------------------------


def test_everything_once(block):
    assert block.run() == dict.fromkeys(("s0", "s1", "s2"), "done")
    assert {"s1_ortho.tif", "s1_model.json", "s1_report.json"} <= {path.name for path in (block.out / "s1").iterdir()}
    before = block.digests()
    times = {path: path.stat().st_mtime_ns for path in block.out.rglob("*ortho.tif")}
    assert block.run() == dict.fromkeys(("s0", "s1", "s2"), "unchanged")
    assert block.run(checksums=True) == dict.fromkeys(("s0", "s1", "s2"), "unchanged")
    assert block.digests() == before
    assert times == {path: path.stat().st_mtime_ns for path in block.out.rglob("*ortho.tif")}
    assert [scene["state"] for scene in batch.list_scenes(block.file)] == ["done"] * 3
    # Another file in their folder changes nothing, one that belongs to an image does.
    (block.folder / "raw" / "notes.txt").write_text("cloudy")
    assert [scene["state"] for scene in batch.list_scenes(block.file)] == ["done"] * 3
    (block.folder / "raw" / "s1.tif.aux.xml").write_text("<PAMDataset/>")
    assert [scene["state"] for scene in batch.list_scenes(block.file)] == ["done", "changed", "done"]


def _touch(block: Block) -> None:
    os.utime(block.folder / "raw" / "s1.tif", (1, 1))


def _rewrite(block: Block) -> None:
    block.scene("raw/s1.tif", 21)


def _new_side_car(block: Block) -> None:
    (block.folder / "raw" / "s1_RPC.TXT").write_bytes((block.out / "s1" / "s1_RPC.TXT").read_bytes())


def _delete_output(block: Block) -> None:
    (block.out / "s1" / "s1_model.json").unlink()


def _modify_output(block: Block) -> None:
    with (block.out / "s1" / "s1_ortho.tif").open("ab") as file:
        file.write(b"x")


def _delete_record(block: Block) -> None:
    (block.out / ".run" / "s1.json").unlink()


def _damage_record(block: Block) -> None:
    (block.out / ".run" / "s1.json").write_text("{")


def _configure(block: Block) -> None:
    block.write(FILE + "  - image: raw/s1.tif\n    output: {resampling: cubic}\n")


def _other_order(block: Block) -> None:
    block.write(FILE.replace("dem: dem.tif, vertical: ellipsoid", "vertical: ellipsoid, dem: ./dem.tif"))


@pytest.mark.parametrize(
    ("change", "state"),
    [
        (_touch, "unchanged"),
        (_other_order, "unchanged"),
        (_rewrite, "done"),
        (_new_side_car, "done"),
        (_delete_output, "done"),
        (_modify_output, "done"),
        (_delete_record, "done"),
        (_damage_record, "done"),
        (_configure, "done"),
    ],
)
def test_only_what_has_changed_is_made_again(block, change: Callable[[Block], None], state):
    block.run()
    before = block.digests()
    change(block)
    assert block.run() == {"s0": "unchanged", "s1": state, "s2": "unchanged"}
    if change in (_touch, _delete_output, _modify_output, _delete_record, _damage_record):
        assert block.digests() == before
    assert block.run() == dict.fromkeys(("s0", "s1", "s2"), "unchanged")


def test_the_dem_concerns_all_scenes_and_other_software_too(block, monkeypatch):
    block.run()
    block.tiny.write_dem(block.folder / "dem.tif", share=0.99)
    assert block.run() == dict.fromkeys(("s0", "s1", "s2"), "done")
    newer = {**versions(), "gdal": "99.0"}
    monkeypatch.setattr(batch_plan, "versions", lambda: newer)
    monkeypatch.setattr(freshness, "versions", lambda: newer)
    assert block.run() == dict.fromkeys(("s0", "s1", "s2"), "done")


def test_a_worker_with_other_software_refuses(block, monkeypatch):
    job = batch_plan.plan(block.file).jobs[0]
    monkeypatch.setattr(freshness, "versions", lambda: {**job.versions, "gdal": "1.0"})
    outcome = batch.make_scene(job)
    assert outcome.status == "failed"
    assert "gdal 1.0 instead of" in outcome.error["message"]


@pytest.mark.parametrize("unreadable", [False, True])
def test_a_worker_with_an_output_folder_of_its_own_makes_nothing(block, unreadable):
    """A folder of another machine at the same path: here the folder is moved away while the worker works."""

    class Elsewhere(ThreadPoolExecutor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            block.out.rename(block.folder / "shared")
            if unreadable:
                block.out.symlink_to("x" * 300)
            future = super().submit(fn, *args, **kwargs)
            wait([future])
            block.out.unlink(missing_ok=True)
            (block.folder / "shared").rename(block.out)
            return future

    with Elsewhere(1) as pool:
        result = batch.run(block.file, executor=pool)
    assert states(result) == {"s0": "failed", "s1": "failed", "s2": "failed"}
    assert "does not have the output folder of the run" in result.scenes[0].error["message"]


def test_checksums_see_what_dates_hide(block):
    block.run()
    path = block.out / "s1" / "s1_report.html"
    stat, text = path.stat(), path.read_bytes()
    path.write_bytes(b"x" + text[1:])
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert block.run()["s1"] == "unchanged"
    assert block.run(checksums=True) == {"s0": "unchanged", "s1": "done", "s2": "unchanged"}
    assert path.read_bytes() == text


def test_checksums_see_inputs_that_this_process_has_read_before(block):
    block.run()
    path = block.folder / "raw" / "s1.tif"
    stat, data = path.stat(), bytearray(path.read_bytes())
    data[-1] ^= 255
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert block.run()["s1"] == "unchanged"
    assert block.run(checksums=True) == {"s0": "unchanged", "s1": "done", "s2": "unchanged"}


def test_outputs_that_no_longer_belong_are_removed(block):
    block.tiny.write(block.folder / "gcps.csv", block.tiny.points(12, noise=0.1))
    block.write(FILE + "    points: {gcps: gcps.csv, crs: 'EPSG:4979', vertical: ellipsoid, correction: none}\n")
    assert set(block.run().values()) == {"done"}
    assert (block.out / "s0" / "s0_residuals.geojson").exists()
    (block.out / "s0" / "mine.txt").write_text("kept")
    block.write()
    assert set(block.run().values()) == {"done"}
    assert not (block.out / "s0" / "s0_residuals.geojson").exists()
    assert (block.out / "s0" / "mine.txt").exists()


def test_what_an_earlier_run_wrote_is_removed_also_after_a_crash(block, monkeypatch):
    block.tiny.write(block.folder / "gcps.csv", block.tiny.points(12, noise=0.1))
    block.write(FILE + "    points: {gcps: gcps.csv, crs: 'EPSG:4979', vertical: ellipsoid, correction: none}\n")
    block.run(only=["s0"])
    block.write()
    with monkeypatch.context() as patched:
        patched.setattr(batch.commands, "rectify", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            block.run(only=["s0"])
    assert batch.list_scenes(block.file)[0]["state"] == "started"
    assert block.run(only=["s0"]) == {"s0": "done"}
    assert not (block.out / "s0" / "s0_residuals.geojson").exists()


def test_an_input_that_changes_meanwhile_is_no_success(block, monkeypatch):
    rectify = batch.commands.rectify

    def slow(*given: Any, **options: Any) -> Any:
        result = rectify(*given, **options)
        block.scene("raw/s0.tif", 33)
        return result

    monkeypatch.setattr(batch.commands, "rectify", slow)
    outcome = batch.run(block.file, executor="sequential", only=["s0"]).scenes[0]
    assert outcome.error["message"] == "this file changed during the run"
    monkeypatch.undo()
    assert block.run(only=["s0"]) == {"s0": "done"}


def test_a_record_does_not_reach_outside_of_its_folder(block):
    block.run()
    path = block.out / ".run" / "s0.json"
    document = json.loads(path.read_text())
    document["outputs"][0]["path"] = "../../raw/s0.tif"
    path.write_text(json.dumps(document))
    assert RunRecord.at(path) is None
    assert block.run()["s0"] == "done"
    assert (block.folder / "raw" / "s0.tif").exists()


# -- failures --------------------------------------------------------------------------------------------------------


def test_a_failing_scene_does_not_stop_the_others(block):
    good = (block.folder / "raw" / "s1.tif").read_bytes()
    (block.folder / "raw" / "s1.tif").write_bytes(b"no image")
    done = ortho("run", block.file, "--executor", "sequential")
    assert done.exit_code == 3
    assert "2 done, 0 unchanged, 1 failed" in done.stdout
    assert "GDAL cannot open this" in done.stdout
    assert "Remedy" in done.stdout
    again = ortho("run", block.file, "--executor", "sequential", "--json")
    assert again.exit_code == 3
    document = json.loads(again.stdout)
    assert document["counts"] == {"done": 0, "unchanged": 2, "failed": 1}
    assert document["scenes"][1]["error"]["kind"] == "InputError"
    assert json.loads((block.out / "run.json").read_text())["counts"] == document["counts"]
    (block.folder / "raw" / "s1.tif").write_bytes(good)
    assert block.run() == {"s0": "unchanged", "s1": "done", "s2": "unchanged"}
    events = [json.loads(line) for line in (block.out / "run.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events[:5]] == ["run started", "scene", "scene", "scene", "run finished"]
    assert [event["status"] for event in events if event["event"] == "scene"][:3] == ["done", "failed", "done"]


def test_a_folder_name_that_is_not_utf8_fails_its_scene_and_not_the_page_of_the_run(block):
    folder = block.folder / os.fsdecode(b"raw/\xff")
    folder.mkdir()
    for number in (1, 2):
        os.rename(block.folder / f"raw/s{number}.tif", folder / f"s{number}.tif")
    block.write(FILE.replace("raw/*", "raw/**/*"))
    done = ortho("run", block.file, "--executor", "sequential")
    assert (done.exit_code, "not UTF-8" in done.output) == (3, True), done.output
    assert "raw/\\udcff/s2.tif" in (block.out / "index.html").read_text()


def test_all_failed_and_missing_images_and_wrong_files(block):
    block.write(FILE.replace("images: raw/*.tif", "image: raw/none.tif"))
    done = ortho("run", block.file, "--executor", "sequential")
    assert done.exit_code == 1
    assert "there is no such file" in done.stdout
    block.write("scenes: 1\n")
    wrong = ortho("run", block.file, "--json")
    assert wrong.exit_code == 2
    assert json.loads(wrong.stdout)["error"]["field"] == "line 1, scenes"
    assert ortho("run").exit_code == 2


def test_an_unexpected_error_keeps_its_trace(block, monkeypatch):
    def burst(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(batch.commands, "rectify", burst)
    result = batch.run(block.file, executor="sequential", only=["s0"])
    assert result.scenes[0].error["message"] == "of all things"
    assert "ZeroDivisionError" in result.scenes[0].error["trace"]
    assert [scene["state"] for scene in batch.list_scenes(block.file)] == ["failed", "new", "new"]


def test_a_disk_that_cannot_be_written(block):
    block.out.write_text("a file where the folder should be")
    with pytest.raises(InputError, match="cannot write here"):
        batch.run(block.file, executor="sequential")


def test_one_run_at_a_time_but_parts_together(block):
    with locked(block.out / ".run" / "run.lock", owner="somebody"):
        done = ortho("run", block.file, "--executor", "sequential")
        assert done.exit_code == 2
        assert f"somebody (process {os.getpid()}" in done.stderr
        with pytest.raises(InputError, match="is using this output folder"):
            block.run(shard=(1, 2))
    with locked(block.out / ".run" / "run.lock", shared=True):
        assert block.run(shard=(1, 2)) == {"s0": "done", "s2": "done"}
        with pytest.raises(InputError, match="is using this output folder"):
            block.run()
    assert not (block.out / "run.json").exists()
    assert block.run() == {"s0": "unchanged", "s1": "done", "s2": "unchanged"}


# -- executors -------------------------------------------------------------------------------------------------------


def test_the_executor_changes_nothing(block):
    assert set(block.run().values()) == {"done"}
    one = block.digests()
    subprocess.run(["rm", "-r", block.out], check=True)
    assert set(block.run(executor="processes", workers=2).values()) == {"done"}
    assert block.digests() == one
    subprocess.run(["rm", "-r", block.out], check=True)
    with ThreadPoolExecutor(2) as pool:
        assert set(block.run(executor=pool).values()) == {"done"}
        assert pool.submit(int, 1).result() == 1
    assert block.digests() == one
    with pytest.raises(InputError, match="no executor"):
        block.run(executor="nonsense")
    with pytest.raises(InputError, match="address of its scheduler"):
        block.run(executor="dask")
    with pytest.raises(InputError, match="only dask has a scheduler"):
        block.run(executor="sequential", scheduler="tcp://host:1")


def test_a_process_that_dies_takes_only_its_own_job_along():
    budget = "__import__('os').environ['OMP_NUM_THREADS']"
    jobs = ["1 + 1", "__import__('os')._exit(1)", budget, "2 * 2"]
    ended = dict(completed(Processes(2, 3), eval, jobs))
    assert isinstance(ended.pop(jobs[1]).exception(), WorkerDied)
    assert {job: future.result() for job, future in ended.items()} == {"1 + 1": 2, "2 * 2": 4, budget: "3"}


def test_a_process_that_was_never_started_needs_no_end():
    crew = Processes(1, 1)
    _Spawning(crew._spawned).Process(target=print)
    assert crew.stop() == []


def test_a_script_that_runs_again_in_each_worker_is_told_so(tmp_path):
    """The remedy was more memory, or one worker, which did not help either."""
    script = tmp_path / "script.py"
    script.write_text(
        "from ortho_pipeline.batch.executors import Processes, completed\n"
        "print([future.exception() for _, future in completed(Processes(1, 1), eval, ['1'])])\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "call the function only under `if __name__ == '__main__':`" in done.stderr


def test_a_scene_of_which_others_have_the_lock_is_made_once(block):
    job = batch_plan.plan(block.file).jobs[0]
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(batch.make_scene, [job, job]))
    assert sorted(outcome.status for outcome in outcomes) == ["done", "unchanged"]


def test_a_scene_whose_maker_died_before_it_said_so_is_done(block):
    job = dataclasses.replace(batch_plan.plan(block.file).jobs[0], run="this run")
    first, again = batch.make_scene(job), batch.make_scene(job)
    assert (first.status, again.status) == ("done", "done")
    assert (again.seconds, again.files) == (first.seconds, first.files)
    later = batch.make_scene(dataclasses.replace(job, run="another"))
    assert later.status == "unchanged"


# -- interruptions ---------------------------------------------------------------------------------------------------


def _started(block: Block, *options: str) -> subprocess.Popen[bytes]:
    """Start `ortho run` and wait until it has made a scene."""
    command = [sys.executable, "-m", "ortho_pipeline", "run", str(block.file), *options]
    log = block.out / "run.jsonl"
    before = log.read_text() if log.exists() else ""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)
    deadline = time.monotonic() + 60
    while not (log.exists() and '"done"' in log.read_text()[len(before) :]):
        assert process.poll() is None, process.stderr.read().decode() if process.stderr else ""
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process


def test_an_interrupted_run_goes_on_and_ends_with_the_same_bytes(block):
    for number in range(3, 12):
        block.scene(f"raw/s{number}.tif", 7 * number)
    done: set[str] = set()
    for kind, code in ((signal.SIGINT, 130), (signal.SIGKILL, -9)):
        process = _started(block, "--executor", "processes", "--workers", "2")
        if kind == signal.SIGINT:
            os.killpg(process.pid, kind)  # as a terminal does
        else:
            process.kill()
        assert process.wait(30) == code
        assert process.stderr is not None
        process.stderr.close()
        before, done = done, {path.stem for path in (block.out / ".run").glob("s*.json")}
        assert before < done
        assert 0 < len(done) < 12
    after = block.run()
    assert {name for name, state in after.items() if state == "unchanged"} >= done
    assert set(after.values()) == {"done", "unchanged"}
    assert not [path for path in block.out.rglob("*") if ".part" in path.name]
    resumed = block.digests()
    subprocess.run(["rm", "-r", block.out], check=True)
    block.run()
    assert block.digests() == resumed


@pytest.mark.parametrize("crew", [Processes(1, 1), InGroups(ThreadPoolExecutor(1)), ThreadPoolExecutor(1)])
def test_the_thread_that_a_signal_interrupts_calls_no_pool(crew):
    called = set()

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call" and "concurrent" in frame.f_code.co_filename:
            called.add(frame.f_code.co_name)

    sys.setprofile(note)
    try:
        assert len(list(completed(crew, abs, range(20)))) == 20
        pairs = completed(crew, abs, range(1000))
        next(pairs)
        pairs.close()  # as an interrupt does
    finally:
        sys.setprofile(None)
    assert "set_result" in called
    assert not called & {"submit", "wait", "cancel", "shutdown"}


def test_processes_that_are_ended_remove_their_temporary_files(tmp_path):
    """Ctrl-C left a folder with hidden files for each scene that was under way."""
    writing = (
        "import time; from ortho_pipeline.files import whole_or_nothing\n"
        f"with whole_or_nothing({str(tmp_path / 'out' / 'ortho.tif')!r}): time.sleep(30)"
    )
    waiting = (
        f"import pathlib, time\nwhile not any(pathlib.Path({str(tmp_path)!r}).rglob('*.part.tif')): time.sleep(0.01)"
    )
    pairs = completed(Processes(2, 1), exec, [writing, waiting])
    assert next(pairs)[0] == waiting
    pairs.close()  # as an interrupt does
    assert list(tmp_path.iterdir()) == []


def test_processes_that_do_not_end_are_killed(monkeypatch):
    """A signal does not reach a job within a call of compiled code, and the run would wait for the end of this call."""
    monkeypatch.setattr("ortho_pipeline.batch.executors._LEAVE", 0.1)
    crew = Processes(1, 1)
    pairs = completed(crew, exec, ["pass", "sum(range(10**10))"])
    next(pairs)
    processes = list(crew._spawned)
    time.sleep(0.1)
    pairs.close()  # as an interrupt does
    until = time.monotonic() + 10
    for process in processes:
        # A thread of the pool may wait for it at the same moment.
        while process.is_alive() and time.monotonic() < until:
            time.sleep(0.02)
        assert not process.is_alive()


def test_what_a_killed_process_left_is_removed(block):
    begun = (
        "import os, sys; from ortho_pipeline.files import *\n"
        "with together(sys.argv[1], 's0'), whole_or_nothing(sys.argv[1] + '/s0_ortho.tif') as path:\n"
        "    path.write_bytes(bytes(10)); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", begun, str(block.out / "s0")], check=False)
    left = list((block.out / "s0").iterdir())
    assert left
    block.run()
    assert not [path for path in left if path.exists()]
