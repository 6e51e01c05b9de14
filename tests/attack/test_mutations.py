"""Damaged files are read soundly or refused with file, field and remedy (docs/engineering/reliability.md)."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fuzz import Attack, Tally
from mutate import mutant
from osgeo import gdal
from readers import BY_NAME, READERS
from real_seeds import FILES, real_seeds

from ortho_pipeline.batch import plan as batch_plan
from ortho_pipeline.batch.records import FileState, RunRecord
from ortho_pipeline.errors import InputError, completed, reads
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.exchange.rpc_files import size_of_image
from ortho_pipeline.files import parse_json
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.host.unread import unread
from ortho_pipeline.report.stac import acquisition_time
from ortho_pipeline.stores.stac.item import Asset

#: Mutants of each reader, those of the default run first; fewer where a file takes more than some milliseconds.
FEW, MANY = 25, 5000
DEAR = {
    "project": 1,
    "cartosat-met": 8,
    "frame-table": 15,
    "frame-camera": 20,
    "crs-wkt": 15,
    "image": 15,
    "journal": 15,
    "dimap-lists": 20,
    "dimap-polynomials": 20,
    "maxar-isd": 15,
    "enmap-metadata": 20,
    "dimap-bundle": 20,
    "geolocation": 20,
    "csm-line-scanner": 20,
    "asp-aster": 20,
    "spot-metadata": 15,
    "spot-detectors": 15,
    "bilsat-survey": 20,
    "points-geojson": 30,
}


def attacked(name: str, folder: Path, count: int, first: int = 0, real: Path | None = None) -> Tally:
    """Return what became of the mutants of a reader, of its own seed or of a real file."""
    one = Attack(BY_NAME[name], folder, real)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        one.check_seed()
        for number in range(first, first + count):
            one.judge(number)
    return one.tally


@pytest.mark.parametrize("name", BY_NAME)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    tally = attacked(name, tmp_path, DEAR.get(name, FEW))
    assert tally.sound, tally.faults
    assert tally.accepted + tally.refused == tally.mutants


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_NAME)
def test_thousands_of_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    tally = attacked(name, tmp_path, 300 if name == "project" else MANY, first=DEAR.get(name, FEW))
    assert tally.sound, tally.faults


@pytest.mark.realdata
@pytest.mark.parametrize("name", FILES)
def test_damaged_real_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    seeds = [path for reader, path in real_seeds() if reader == name]
    assert seeds
    for number, real in enumerate(seeds):
        (tmp_path / str(number)).mkdir()
        tally = attacked(name, tmp_path / str(number), 5 if name in DEAR else 10, real=real)
        assert tally.sound, (real.name, tally.faults)


def test_mutants_are_the_same_on_every_machine() -> None:
    import random

    data = b"key = 1.5\nother = 2\n"
    assert [mutant(data, "text", random.Random(7)) for _ in range(3)] == [mutant(data, "text", random.Random(7))] * 3
    assert len({mutant(data, "text", random.Random(seed)) for seed in range(50)}) > 30
    assert len(READERS) == len(BY_NAME)


# -- what the attack found -------------------------------------------------------------------------------------------


def test_a_refusal_gets_what_it_does_not_say_itself() -> None:
    @reads("copy it again", field="header")
    def read(path: str, error: InputError) -> None:
        raise error

    with pytest.raises(InputError) as caught:
        read("a.txt", InputError("wrong"))
    assert (caught.value.file, caught.value.field, caught.value.remedy) == ("a.txt", "header", "copy it again")
    with pytest.raises(InputError) as caught:
        read("a.txt", InputError("wrong", file="b.txt", field="line 3", remedy="other"))
    assert (caught.value.file, caught.value.field, caught.value.remedy) == ("b.txt", "line 3", "other")
    with pytest.raises(InputError) as caught, completed(remedy="this"):
        raise InputError("wrong")
    assert (caught.value.file, caught.value.remedy) == (None, "this")


@pytest.mark.parametrize("text", ["1e400", "-1e999", "NaN", "Infinity", "9" * 400, "[" * 5000, '{"a": 1, "a": 2}', '"'])
def test_json_has_finite_numbers(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_json(text, "a.json", "write it again", unique=True)
    assert (caught.value.file, caught.value.remedy) == ("a.json", "write it again")


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("dem", 46246), ("csm-line-scanner", 11712), ("maxar-isd", 4167), ("maxar-isd", 8174),
        ("geolocation", 604757), ("image", 1026), ("image", 1046), ("orbview3-label", 1001), ("vrt", 2000781),
        ("opensfm", 2000063),
        ("frame-table", 2000278), ("bilsat-survey", 2000041), ("cartosat-met", 2000539),
        ("model-frame", 577), ("model-pushbroom", 4978), ("model-pushbroom", 5370), ("model-pushbroom", 6137),
    ],
)  # fmt: skip
def test_what_was_found_stays_mended(name: str, number: int, tmp_path: Path) -> None:
    assert attacked(name, tmp_path, 1, first=number).sound


def test_line_of_broken_json() -> None:
    with pytest.raises(InputError) as caught:
        parse_json(b'{\n"a": 1,\n]', "a.json", "write it again")
    assert caught.value.field == "line 3"


@pytest.mark.parametrize(
    ("field", "value"),
    [("width", 10**300), ("focal_length", 1e308), ("pitch_x", "x"), ("k1", [1]), ("x0", None)],
)
def test_a_camera_that_is_none(tmp_path: Path, field: str, value: object) -> None:
    document = json.loads(BY_NAME["model-frame"].seed(tmp_path))
    document["model"]["interior"][field] = value
    path = tmp_path / "m_model.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        read_model_file(path)
    assert caught.value.file == str(path)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("outputs", 0, "path"), 5), (("outputs", 0, "path"), "a" * 300), (("outputs", 0, "path"), "\0"),
        (("outputs", 0, "mtime_ns"), "soon"), (("inputs", 0), None), (("facts",), [1]), (("outputs",), {}),
        (("seconds",), [[]]), (("key",), None),
    ],
)  # fmt: skip
def test_a_damaged_record_is_none_and_stops_nothing(tmp_path: Path, place: tuple, value: object) -> None:
    document = json.loads(BY_NAME["run-record"].seed(tmp_path))
    node = document
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = value
    path = tmp_path / "one.json"
    path.write_text(json.dumps(document))
    record = RunRecord.at(path)
    assert record is None or not record.intact(tmp_path, checksums=True)


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    state = FileState.of("ortho", tmp_path / "a", name="a")
    record = RunRecord(
        name="one", key="k", status="done", inputs=(state,), outputs=(state,), siblings="s", seconds=1.5, facts={},
        run="run",
    )  # fmt: skip
    record.write(tmp_path / "one.json")
    assert RunRecord.at(tmp_path / "one.json") == record


@pytest.mark.parametrize(
    ("images", "said"),
    [
        ("/".join(["**"] * 8) + "/*.tif", "too complex a pattern"),
        ("../../**/*.tif", "outside the root folder"),
        ("/**/*.tif", "outside the root folder"),
        ("a" * 300 + "/*.tif", "not the path"),
        ("b" * 5000, "too complex a pattern"),
    ],
)
def test_patterns_that_would_not_end_are_refused(tmp_path: Path, images: str, said: str) -> None:
    (tmp_path / "one.tif").touch()
    file = tmp_path / "run.yaml"
    file.write_text(json.dumps({"scenes": [{"images": images}]}))
    with pytest.raises(InputError, match=said) as caught:
        batch_plan.plan(file)
    assert caught.value.field == "scenes[0].images"


@pytest.mark.parametrize("field", ["rpc", "model"])
def test_a_name_longer_than_a_file_system_takes(tmp_path: Path, field: str) -> None:
    (tmp_path / "one.tif").touch()
    file = tmp_path / "run.yaml"
    file.write_text(json.dumps({"scenes": [{"image": "one.tif", "scene": {field: "a" * 300}}]}))
    with pytest.raises(InputError, match="not the path of a file") as caught:
        batch_plan.plan(file)
    assert caught.value.remedy


def test_the_end_of_time_is_no_time_of_acquisition() -> None:
    with pytest.raises(InputError, match="not a time of acquisition"):
        acquisition_time({}, "9999-12-31T23:59:59-14:00")


def _crs_of(text: str, folder: Path) -> None:
    with pytest.raises(InputError, match="is not a coordinate system"):
        parse_crs(text)


def _geom_of(text: str, folder: Path) -> None:
    (folder / "scene.geom").write_text(text)
    assert size_of_image(folder / "scene.geom") is None


def _table_beside(text: str, folder: Path) -> None:
    (folder / "notes.txt").write_text(text)
    dataset = gdal.GetDriverByName("GTiff").Create(str(folder / "scene.tif"), 4, 4)
    assert unread(dataset) is None


def _asset_name(text: str, folder: Path) -> None:
    assert not Asset("a", text, (), "").is_rpc


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (_crs_of, " " * 90_000 + "\x01"),
        (_crs_of, "\t" * 90_000 + "\x01"),
        (_geom_of, "\n" * 100_000 + "x"),
        (_table_beside, "\n" * 100_000 + "x"),
        (_asset_name, "rpc" * 30_000 + "x"),
    ],
    ids=["blank CRS", "CRS of tabs", "geom", "table", "asset"],
)
def test_a_long_text_takes_no_longer_than_its_length(
    read: Callable[[str, Path], None], text: str, tmp_path: Path
) -> None:
    begin = time.process_time()
    read(text, tmp_path)
    # Linear: milliseconds. A pattern that tries every beginning of a run takes many seconds.
    assert time.process_time() - begin < 1
