"""`ortho stack` on rasters of known truth: corrections, outputs, resuming, and identical results."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest
from osgeo import gdal
from rasters import Rasters

from ortho_pipeline.batch.stack import matching, writing
from ortho_pipeline.batch.stack.command import stack
from ortho_pipeline.batch.stack.result import summary
from ortho_pipeline.commands.orthos.measuring import measure_ortho
from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.files import Outputs
from ortho_pipeline.options import MatchOptions, OutputOptions, StackOptions
from ortho_pipeline.report.stack.page import write_page
from ortho_pipeline.report.stack.records import StackRecord

gdal.UseExceptions()
ROOT = Path(__file__).resolve().parent.parent.parent
RASTERS = Rasters(side=240, dates=4, error=4.0)
#: Few matches, so that tests are fast.
MATCH = MatchOptions(points=120)


def run(given: Any, folder: Path, options: StackOptions = StackOptions(), **more: Any) -> Any:
    settings = {"match": MATCH, "output": OutputOptions(resampling="cubic", threads=1, format="GTiff"), **more}
    return stack(given, folder, options, **settings)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[list[Path], Path]:
    folder = tmp_path_factory.mktemp("stack")
    paths = RASTERS.write(folder / "in")
    run([folder / "in"], folder / "out")
    return paths, folder / "out"


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "record" not in path.name and path.name != ".lock"
    }


@pytest.fixture
def counted(monkeypatch) -> list[tuple[str, str]]:
    """Pairs that are matched."""
    found: list[tuple[str, str]] = []

    def matched(image: Any, match: MatchOptions, **more: Any) -> Any:
        found.append((Path(image.path).name, Path(match.reference[0]).name))
        return measure_ortho(image, match, **more)

    monkeypatch.setattr(matching, "measure_ortho", matched)
    return found


def test_corrections_are_the_errors(made):
    document = json.loads((made[1] / "stack.json").read_text())
    record = StackRecord.read(document)
    assert record.to_json() == document
    schema = json.loads((ROOT / "docs" / "stack.schema.json").read_text())
    jsonschema.validate(document, schema, cls=jsonschema.Draft202012Validator)
    true = RASTERS.shifts() - RASTERS.shifts().mean(axis=0)
    np.testing.assert_allclose([one.shift_px for one in record.dates], true, atol=0.03)
    assert all(max(one.sigma_px) < 0.05 for one in record.dates)
    assert [one.status for one in record.pairs] == ["accepted"] * 6
    assert record.closure_after.loops == 4
    assert "largest 0.00 px" not in summary(record)
    page = (made[1] / "stack.html").read_text()
    interval = 1.96 * max(max(one.sigma_px) for one in record.dates)
    stated = re.search(r"4 dates agree with the mean of all dates within (0\.\d+) px", page)
    assert stated is not None
    assert float(stated.group(1)) == pytest.approx(interval, rel=0.05)
    assert "Nothing here tests the absolute position." in page
    assert 'data-plot="timeline"' in page


@pytest.mark.parametrize("wrong", [0.0, 5.8])
def test_pairs_of_three_dates_that_contradict_each_other_are_told(made, tmp_path, monkeypatch, wrong):
    """One loop does not tell which of its three pairs is wrong."""

    def displaced(path: Path) -> matching.EdgeMatches:
        found = reads(path)
        if {found.first, found.second} == {one.name for one in record.dates[1:3]}:
            found = found.model_copy(update={"shown": tuple((x + wrong, y) for x, y in found.shown)})
        return found

    reads, record = matching.read_matches, StackRecord.read(json.loads((made[1] / "stack.json").read_text()))
    monkeypatch.setattr(matching, "read_matches", displaced)
    shutil.copytree(made[1], tmp_path / "out")
    document = run(made[0][:3], tmp_path / "out").document
    assert [one["code"] for one in document["notices"]] == (["stack-pairs-disagree"] if wrong else [])
    # Each of the three pairs has a third of the contradiction.
    true = RASTERS.shifts()[:3] - RASTERS.shifts()[:3].mean(axis=0)
    error = np.array([one["shift_px"] for one in document["dates"]]) - true
    sigma = np.array([one["sigma_px"] for one in document["dates"]])
    assert np.abs(error[:, 0]).max() == pytest.approx(wrong / 3, abs=0.05)
    assert (np.abs(error) < 3 * sigma).all()


def test_matches_of_a_pair_share_an_error(made):
    """As `ortho verify` has it: 0.002 px of a chip, and 6 % of the noise of a match."""
    pairs = [json.loads(path.read_text()) for path in (made[1] / "pairs").glob("*.json") if "record" not in path.name]
    assert len(pairs) == 6
    for pair in pairs:
        noise = np.median(pair["sigma_px"])
        assert pair["alike_px"] == pytest.approx(np.hypot(0.002, 0.06 * noise), rel=1e-6)


def test_the_page_tells_what_affine_corrections_are_at_the_corners(made, tmp_path):
    record = StackRecord.read(json.loads((made[1] / "stack.json").read_text()))
    one, *rest = record.dates
    # Of shifts alone, a corner is like the middle.
    assert [one.corner_sigma_px for one in record.dates] == pytest.approx([max(one.sigma_px) for one in record.dates])
    write_page(record, tmp_path / "shifts.html")
    assert "corner, px" not in (tmp_path / "shifts.html").read_text()
    sloped = one.replaced(correction="affine", sigma_px=(0.01, 0.02), corner_px=1.234, corner_sigma_px=0.1)
    write_page(record.replaced(dates=(sloped, *rest)), tmp_path / "affine.html")
    page = (tmp_path / "affine.html").read_text()
    assert re.search(
        r"agree with the mean of all dates within 0\.0\d+ px at the middle and 0\.2 px at the corners", page
    )
    assert '<td class="n">1.23 ± 0.10</td>' in page


def test_the_record_names_the_options_that_differ_from_their_defaults(made):
    record = StackRecord.read(json.loads((made[1] / "stack.json").read_text()))
    options = {"match": {"points": 120}, "output": {"resampling": "cubic", "format": "GTiff"}}
    assert record.provenance["options"] == options
    assert record.provenance["software"]["gdal"] == gdal.VersionInfo("RELEASE_NAME")
    assert "options · match · points" in (made[1] / "stack.html").read_text()


def test_aligned_orthos_agree_in_their_pixels(made):
    images = [gdal.Open(str(path)) for path in sorted((made[1] / "aligned").glob("*.tif"))]
    assert len({image.GetGeoTransform() for image in images}) == 1
    inner = [image.ReadAsArray()[12:-12, 12:-12].astype(float) for image in images]
    for other in inner[1:]:
        assert np.corrcoef(inner[0].ravel(), other.ravel())[0, 1] > 0.97


def test_a_second_run_matches_nothing_and_writes_the_same(made, counted):
    before = contents(made[1])
    run([made[0][0].parent], made[1])
    assert counted == []
    assert contents(made[1]) == before


def test_the_cube_is_the_aligned_orthos(made):
    pytest.importorskip("xarray")
    result = run([made[0][0].parent], made[1])
    assert list(result.orthos) == [path.stem for path in made[0]]
    cube = result.to_xarray(chunks=100)
    assert cube.dims == ("time", "band", "y", "x")
    assert [one.time[:10] for one in result.dates] == [str(time)[:10] for time in cube.time.values]
    np.testing.assert_array_equal(cube.east_m, [one.east_north_m[0] for one in result.dates])
    part = cube[1:3, :, 90:110].compute()
    files = [gdal.Open(str(path)) for path in list(result.orthos.values())[1:3]]
    np.testing.assert_array_equal(part.values[:, 0], [file.ReadAsArray(0, 90, cube.sizes["x"], 20) for file in files])
    masks = [file.GetRasterBand(1).GetMaskBand().ReadAsArray(0, 90, cube.sizes["x"], 20) > 0 for file in files]
    np.testing.assert_array_equal(part.valid.values, masks)
    west, dx, *_ = files[0].GetGeoTransform()
    assert cube.x.values[0] == west + dx / 2


def test_each_date_has_an_item_with_its_sigma(made):
    output = OutputOptions(resampling="cubic", threads=1, format="GTiff", stac=True)
    result = run([made[0][0].parent], made[1], output=output)
    catalog = json.loads(result.files["stac"].read_text())
    links = [link["href"] for link in catalog["links"] if link["rel"] == "item"]
    assert links == [f"./{path.stem}_stac.json" for path in made[0]]
    for link, one in zip(links, result.dates, strict=True):
        item = json.loads((made[1] / "aligned" / link).read_text())
        assert item["properties"]["ortho:stack_sigma"] == pytest.approx(one.sigma_m, abs=1e-4)
        assert item["properties"]["datetime"][:10] == one.time[:10]
        assert (made[1] / "aligned" / item["assets"]["ortho"]["href"]).samefile(result.orthos[one.name])
    with pytest.raises(InputError, match="items need aligned orthos"):
        run([made[0][0].parent], made[1], StackOptions(corrections_only=True), output=output)
    run([made[0][0].parent], made[1])
    assert list(made[1].rglob("*_stac.json")) == []


def test_neither_order_nor_threads_change_a_byte(made, tmp_path):
    output = OutputOptions(resampling="cubic", threads=2, format="GTiff")
    run(made[0][::-1], tmp_path / "out", output=output)
    assert contents(tmp_path / "out") == contents(made[1])


def test_a_date_that_is_added_is_matched_alone(made, tmp_path, counted):
    run(made[0][:3], tmp_path / "out")
    first = len(counted)
    run(made[0], tmp_path / "out")
    assert first == 3
    assert all(made[0][3].name in pair for pair in counted[first:])
    assert len(counted) == 6
    assert contents(tmp_path / "out") == contents(made[1])


def test_an_ortho_of_a_killed_run_goes_if_its_date_is_left_out(made, tmp_path):
    """The record of an ortho comes after it: a run that was killed in between has left an ortho without a record."""
    shutil.copytree(made[1], tmp_path / "out")
    aligned, last = tmp_path / "out" / "aligned", made[0][3].stem
    for name in (f"{last}.record.json", f"{last}_model.json"):
        (aligned / name).unlink()
    (aligned / "mine_aligned.tif").write_text("of a user")
    run(made[0][:3], tmp_path / "out")
    assert not list(aligned.glob(f"{last}*"))
    assert (aligned / "mine_aligned.tif").exists()
    assert len(list(aligned.glob("*_aligned.tif"))) == 4


def test_pairs_whose_names_join_to_the_same_text_keep_their_own_matches(made, tmp_path, counted):
    (tmp_path / "in").mkdir()
    for path, name in zip(made[0], ("z", "y__z", "x", "x__y"), strict=True):
        (tmp_path / "in" / f"{name}.tif").write_bytes(path.read_bytes())
    record = run([tmp_path / "in"], tmp_path / "out").record
    assert [one.status for one in record.pairs] == ["accepted"] * 6
    counted.clear()
    run([tmp_path / "in"], tmp_path / "out")
    assert not counted


def test_pairs_of_long_names_have_names_that_file_systems_take():
    names = [f"{'é' * 60}_{number}" for number in range(3)]
    pairs = {
        matching._name_of(SimpleNamespace(name=one), SimpleNamespace(name=other)) for one, other in pairwise(names)
    }
    assert len(pairs) == 2
    assert max(len(f"{pair}.record.json".encode()) for pair in pairs) < 256


def test_a_changed_ortho_is_matched_again(made, tmp_path, counted):
    folder = tmp_path / "in"
    folder.mkdir()
    for path in made[0][:3]:
        (folder / path.name).write_bytes(path.read_bytes())
    run([folder], tmp_path / "out")
    image = gdal.OpenEx(str(folder / made[0][1].name), gdal.OF_UPDATE | gdal.OF_RASTER)
    image.GetRasterBand(1).WriteArray(image.ReadAsArray() + 1)
    image = None
    counted.clear()
    run([folder], tmp_path / "out")
    assert len(counted) == 2
    assert all(made[0][1].name in pair for pair in counted)


def test_a_changed_source_or_side_car_is_matched_again(made, tmp_path, counted):
    folder, source = tmp_path / "in", tmp_path / "in" / "sources" / "source.tif"
    source.parent.mkdir(parents=True)
    shutil.copy(made[0][0], folder)
    shutil.copy(made[0][1], source)
    # The date is a VRT of a VRT.
    gdal.BuildVRT(str(source.with_suffix(".vrt")), [str(source)])
    gdal.BuildVRT(str(folder / "b.vrt"), [str(source.with_suffix(".vrt"))])
    (folder / "list.csv").write_text(f"file,date\n{made[0][0].name},2020-01-01\nb.vrt,2020-02-01\n")
    run([folder / "list.csv"], tmp_path / "out")
    run([folder / "list.csv"], tmp_path / "out")
    assert len(counted) == 1
    shutil.copy(made[0][2], source)
    changed = run([folder / "list.csv"], tmp_path / "out")
    assert len(counted) == 2
    true = np.diff(RASTERS.shifts()[[0, 2]], axis=0)[0]
    np.testing.assert_allclose(np.subtract(*(one.shift_px for one in changed.dates[::-1])), true, atol=0.05)
    image = gdal.Open(str(folder / made[0][0].name))
    gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", "NO")
    image.CreateMaskBand(gdal.GMF_PER_DATASET)
    gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", None)
    mask = np.full((image.RasterYSize, image.RasterXSize), 255, np.uint8)
    mask[:40] = 0
    image.GetRasterBand(1).GetMaskBand().WriteArray(mask)
    image = None
    assert (folder / f"{made[0][0].name}.msk").exists()
    run([folder / "list.csv"], tmp_path / "out")
    assert len(counted) == 3
    aligned = gdal.Open(str(tmp_path / "out" / "aligned" / f"{made[0][0].stem}_aligned.tif"))
    assert not aligned.GetRasterBand(1).GetMaskBand().ReadAsArray()[:30].any()


def test_orthos_that_are_no_part_of_the_result_go(made, tmp_path):
    output = OutputOptions(resampling="cubic", threads=1, format="GTiff", stac=True)
    run(made[0], tmp_path / "out", output=output)
    # A record that others wrote does not choose what is removed.
    mine, record = tmp_path / "out" / "aligned" / "mine.tif", next((tmp_path / "out" / "aligned").glob("*.record.json"))
    mine.write_text("of the user")
    mine.with_name("x.record.json").write_text(re.sub(r"\w+_aligned\.tif", "mine.tif", record.read_text()))
    run(made[0][:3], tmp_path / "out")
    assert mine.read_text() == "of the user"
    mine.unlink()
    endings = "_aligned.tif", "_model.json", ".record.json"
    left = {path.name for path in (tmp_path / "out" / "aligned").iterdir() if path.is_file()}
    assert left == {f"{path.stem}{ending}" for path in made[0][:3] for ending in endings}


def test_images_that_the_stack_would_replace_or_remove_are_refused(made, tmp_path):
    shutil.copytree(made[1], tmp_path / "out")
    before = contents(tmp_path / "out")
    aligned = sorted((tmp_path / "out" / "aligned").glob("*.tif"))
    (tmp_path / "link.tif").symlink_to(aligned[1])
    reference = {"match": MatchOptions(points=120, reference=[str(aligned[0])])}
    for given, options, more, field in (
        ([tmp_path / "out" / "aligned"], StackOptions(), {}, "orthos"),
        ([made[0][0], tmp_path / "link.tif"], StackOptions(), {}, "orthos"),
        (made[0], StackOptions(datum="reference"), reference, "match.reference"),
    ):
        with pytest.raises(InputError, match="this image is an output of the stack in the same folder") as error:
            run(given, tmp_path / "out", options, **more)
        assert error.value.field == field
    assert contents(tmp_path / "out") == before


def test_a_killed_run_resumes_to_the_same_result(made, tmp_path):
    words = ["stack", str(made[0][0].parent), "-o", str(tmp_path / "out"), "--match-points", "120", "--threads", "1"]
    killed = subprocess.Popen([sys.executable, "-m", "ortho_pipeline", *words], stderr=subprocess.DEVNULL)
    end = time.monotonic() + 120
    while time.monotonic() < end and killed.poll() is None:
        if len(list((tmp_path / "out").glob("pairs/*.record.json"))) >= 2:
            break
        time.sleep(0.01)
    with contextlib.suppress(ProcessLookupError):
        os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert not (tmp_path / "out" / "stack.json").exists()
    run([made[0][0].parent], tmp_path / "out")
    assert contents(tmp_path / "out") == contents(made[1])


def test_a_lock_of_a_run_that_was_killed_after_its_last_rename_goes(made, tmp_path):
    shutil.copytree(made[1], tmp_path / "out")
    before = contents(tmp_path / "out")
    for path in (tmp_path / "out" / "pairs").glob("*.json"):
        Outputs(path.parent, path.name).lock_path.touch()
    assert list((tmp_path / "out").rglob("*.part"))
    run([made[0][0].parent], tmp_path / "out")
    assert contents(tmp_path / "out") == before


def test_documents_go_before_the_orthos_are_made_again(made, tmp_path, monkeypatch):
    shutil.copytree(made[1], tmp_path / "out")
    write, written = writing.write_resampled, []

    def killed(*arguments: Any) -> None:
        if written:
            raise KeyboardInterrupt
        written.append(write(*arguments))

    monkeypatch.setattr(writing, "write_resampled", killed)
    with pytest.raises(KeyboardInterrupt):
        run([made[0][0].parent], tmp_path / "out", StackOptions(datum=made[0][1].stem))
    # One ortho is that of the new datum, and the others are those of the old one.
    assert not {"stack.json", "stack.html"} & set(os.listdir(tmp_path / "out"))


def test_corrections_only_keep_the_pixels(made, tmp_path):
    options = StackOptions(corrections_only=True, datum=f"scene_{RASTERS.days()[0]:%Y%m%d}")
    resampled = tmp_path / "out" / "aligned" / f"{made[0][1].stem}_aligned.tif"
    resampled.parent.mkdir(parents=True)
    resampled.write_text("of an earlier run")
    result = run(made[0][:2], tmp_path / "out", options)
    assert not resampled.exists()
    source = gdal.Open(str(made[0][1]))
    moved = gdal.Open(str(tmp_path / "out" / result.document["dates"][1]["output"]))
    np.testing.assert_array_equal(moved.ReadAsArray(), source.ReadAsArray())
    apart = np.subtract(source.GetGeoTransform(), moved.GetGeoTransform())[[0, 3]]
    true = (RASTERS.shifts()[1] - RASTERS.shifts()[0]) * (1, -1)
    np.testing.assert_allclose(apart, true, atol=0.03)
    with pytest.raises(InputError, match="aligned orthos on one grid"):
        result.to_xarray()


def test_a_stack_in_which_no_date_can_be_corrected_is_refused(made, tmp_path):
    # The reference shows another place.
    gdal.Translate(str(tmp_path / "far.tif"), str(made[0][0]), outputBounds=[612_000, 7_123_000, 612_240, 7_122_760])
    match = MatchOptions(points=120, reference=[str(tmp_path / "far.tif")])
    with pytest.raises(InputError, match="no accepted pair connects a date with the datum: the reference"):
        run(made[0][:2], tmp_path / "out", StackOptions(datum="reference"), match=match)
    assert not (tmp_path / "out" / "aligned").exists()


def test_a_datum_that_is_no_date_and_another_crs_are_refused(made, tmp_path):
    with pytest.raises(InputError, match="no ortho is of 1999-01-01"):
        run(made[0], tmp_path / "out", StackOptions(datum="1999-01-01"))
    with pytest.raises(InputError, match="'median' is neither a date nor the name of an image") as caught:
        run(made[0], tmp_path / "out", StackOptions(datum="median"))
    assert caught.value.field == "stack.datum"
    (tmp_path / "list.csv").write_text("file,date\n" + "".join(f"{path},2020-01-01\n" for path in made[0][:2]))
    with pytest.raises(InputError, match="2 images are of 2020-01-01: scene_") as caught:
        run([tmp_path / "list.csv"], tmp_path / "out", StackOptions(datum="2020-01-01"))
    assert made[0][0].stem in str(caught.value.remedy)
    with pytest.raises(InputError, match="no reference"):
        run(made[0], tmp_path / "out", StackOptions(datum="reference"))
    reference = StackOptions(datum="reference")
    match = MatchOptions(points=120, reference=[str(made[0][0])])
    shutil.copy(made[0][1], tmp_path / "Reference.tif")
    # Its pairs would have the names of those with the reference.
    with pytest.raises(InputError, match="an image is called Reference"):
        run([*made[0][2:], tmp_path / "Reference.tif"], tmp_path / "out", reference, match=match)
    two = MatchOptions(points=120, reference=[str(path) for path in made[0][:2]])
    with pytest.raises(InputError, match="a stack has one reference, not 2"):
        run(made[0][2:], tmp_path / "out", reference, match=two)
    other = tmp_path / "other_20210101.tif"
    gdal.Warp(str(other), str(made[0][0]), dstSRS="EPSG:32734")
    with pytest.raises(CrsError, match="another CRS"):
        run([made[0][0], other], tmp_path / "out")
    gdal.Warp(str(tmp_path / "other.tif"), str(made[0][0]), dstSRS="EPSG:4269")
    match = MatchOptions(points=120, reference=[str(tmp_path / "other.tif")])
    with pytest.raises(CrsError, match="no transformation from 'WGS 84 / UTM zone 35S' to 'NAD83'") as caught:
        run(made[0], tmp_path / "out", reference, match=match)
    assert caught.value.file == str(tmp_path / "other.tif")
    # This is known before anything is matched.
    assert not (tmp_path / "out").exists()
