"""`ortho verify`: the accuracy of orthos whose displacement is known, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from click.testing import CliRunner, Result
from landscape import field_of
from osgeo import gdal
from pairs import BENT, CORNER, SHIFTED, Look, Pair
from scipy.ndimage import map_coordinates

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control.matching import match_scene
from ortho_pipeline.commands.orthos import measuring
from ortho_pipeline.commands.orthos.datums import datum_of
from ortho_pipeline.commands.orthos.masks import ClassMask
from ortho_pipeline.commands.orthos.measuring import measure_ortho
from ortho_pipeline.commands.orthos.requirement import Requirement
from ortho_pipeline.commands.orthos.statistics import Accuracy
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import reading, sha256
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.options import MatchOptions, SurfaceOptions

gdal.UseExceptions()
#: Where a test is not about the accuracy of many matches.
FEW = "--match-points", "100"


def run(*words: Any) -> Result:
    return CliRunner().invoke(cli, list(map(str, words)))


def truth(pair: Pair, cells: list[dict[str, Any]]) -> np.ndarray:
    return pair.on_the_ground(np.array([one["image"] for one in cells]))


@pytest.fixture(scope="module")
def verified(bent: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("verified")
    words = "--require", "ce90<30", "--require", "bias<1", "--json", "-o", folder
    done = run("verify", bent[0], "--reference", bent[1], "--reference-sigma", "2", *words)
    assert done.exit_code == 4, done.output
    return json.loads(done.stdout), folder


def test_the_accuracy_is_that_of_the_truth(verified):
    document, _ = verified
    true = truth(BENT, document["field"]["cells"])
    relative = document["relative"]
    pixel = document["pixel_m"]
    values = {
        "bias_m": np.hypot(*true.mean(axis=0)),
        "rmse_m": np.sqrt((true**2).sum(axis=1).mean()),
        "ce90_m": np.quantile(np.hypot(*true.T), 0.9),
    }
    for name, value in values.items():
        assert abs(relative[name]["value"] - value) < 0.03, name
        assert relative[name]["low"] <= relative[name]["value"] <= relative[name]["high"]
        np.testing.assert_allclose(relative[name]["value"] / pixel, relative[name.replace("_m", "_px")]["value"])
    found = np.array([[one["east_m"], one["north_m"]] for one in document["field"]["cells"]])
    assert np.abs(found - true).max() < 0.25
    assert document["matches"]["tested_share"] > 0.9


def test_the_error_of_the_reference_is_part_of_the_absolute_accuracy(verified):
    document, _ = verified
    relative, absolute = document["relative"]["bias_east_m"], document["absolute"]["bias_east_m"]
    np.testing.assert_allclose((absolute["high"] - absolute["low"]) / (2 * 1.96 * 2.0), 1.0, atol=0.1)
    assert relative["high"] - relative["low"] < 0.1


def test_its_causes_are_named(verified):
    document, _ = verified
    codes = [one["code"] for one in document["causes"]]
    assert "shift" in codes
    assert "smooth" in codes


def test_it_writes_page_numbers_and_displacements(verified):
    document, folder = verified
    page = (folder / "ortho_verify.html").read_text()
    assert "90 % of the tested area is within" in page
    assert "<svg" in page
    numbers = json.loads((folder / "ortho_verify.json").read_text())
    assert numbers["relative"] == document["relative"]
    made = numbers["provenance"]
    assert " verify " in made["command"]
    assert [one["role"] for one in made["inputs"]] == ["image", "reference"]
    assert [made["command"].split()[2] in page, made["inputs"][1]["sha256"] in page] == [True, True]
    places = json.loads((folder / "ortho_displacements.geojson").read_text())["features"]
    assert len(places) == document["matches"]["kept"]
    to_map = ground_transform("EPSG:4979", "EPSG:32735")
    one = places[0]
    x, y, _ = to_map([[*one["geometry"]["coordinates"], 0.0]])[0]
    column, row = one["properties"]["column"], one["properties"]["row"]
    off = (CORNER[0] + column * BENT.ortho.gsd - x, CORNER[1] - row * BENT.ortho.gsd - y)
    np.testing.assert_allclose(off, [one["properties"]["east_m"], one["properties"]["north_m"]], rtol=0.01, atol=0.02)


def test_the_stac_fields_are_valid_and_say_what_the_accuracy_is_relative_to(verified, shifted):
    stac = verified[0]["stac"]
    np.testing.assert_allclose(
        stac["properties"]["accuracy:geometric_rmse"], verified[0]["absolute"]["rmse_m"]["value"], atol=1e-4
    )
    (uri,) = stac["stac_extensions"]
    schema = Path(__file__).parents[1] / "data" / "stac" / uri.removeprefix("https://stac-extensions.github.io/")
    item = {"type": "Feature", "stac_extensions": [uri], "properties": stac["properties"], "assets": {}}
    jsonschema.validate(item, json.loads(schema.read_text()))
    done = run("verify", shifted[0], "--reference", shifted[1], "--json", *FEW)
    document = json.loads(done.stdout)
    # A displacement between two orthos is no accuracy on the ground.
    assert document["stac"]["stac_extensions"] == []
    assert not any(name.startswith("accuracy:") for name in document["stac"]["properties"])
    assert document["stac"]["properties"]["ortho:accuracy_from"] == "reference"


def test_the_terminal_says_first_what_the_ortho_is_and_last_where_the_report_is(shifted, tmp_path):
    done = run("verify", shifted[0], "--reference", shifted[1], "-o", tmp_path, *FEW)
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["ortho", "area", "accuracy"]
    assert lines[-1] == f"Report: {tmp_path / 'ortho_verify.html'}"
    page = (tmp_path / "ortho_verify.html").read_text()
    for text in ("<dt>Acquired</dt>", "<dt>Processed</dt>", "<dt>Area</dt>", "<dt>Place</dt>"):
        assert text in page


def test_requirements_are_judged_by_the_upper_limit(verified):
    document, _ = verified
    assert [one["met"] for one in document["requirements"]] == [True, False]
    part = {"relative": {"ce90_m": {"value": 4.9, "low": 4.5, "high": 5.2}}, "absolute": None}
    assert not Requirement.parse("ce90<5").judged(part)["met"]
    assert Requirement.parse("ce90<=5.3m").judged(part)["met"]
    with pytest.raises(InputError, match="not known"):
        Requirement.parse("absolute.ce90<5").judged(part)


@pytest.mark.parametrize("text", ["ce95<5", "ce90>5", "ce90<0", "ce90<five", "ce90<1e", ""])
def test_what_is_no_requirement_is_refused(text):
    with pytest.raises(InputError, match="not a requirement"):
        Requirement.parse(text)


def test_another_place_is_refused(tmp_path):
    ortho, reference = Pair(side=300, seed=9, elsewhere=True).write(tmp_path)
    done = run("verify", ortho, "--reference", reference, "--json")
    assert done.exit_code == 2
    assert "remedy" in json.loads(done.stdout)["error"]


def test_a_bent_ortho_is_matched_again_unless_the_caller_wants_one_matching(bent, monkeypatch):
    """A stack averages matches in cells: places that bend or move need no second matching."""
    calls: list[float] = []

    def counted(view: Any, again: MatchOptions, *more: Any, **named: Any) -> Any:
        calls.append(again.search or 0.0)
        return match_scene(view, again, *more, **named)

    monkeypatch.setattr(measuring, "match_scene", counted)
    match = MatchOptions(reference=(str(bent[1]),), points=150)
    measured = measure_ortho(bent[0], match, rounds=0)
    assert len(calls) == 1
    assert measured.matched is measured.searched
    calls.clear()
    measure_ortho(bent[0], match)
    assert len(calls) > 1
    assert calls[1] < calls[0]


@pytest.mark.slow
def test_an_ortho_upside_down_is_refused_unless_it_is_searched(shifted, tmp_path):
    turned = tmp_path / "turned.tif"
    source = gdal.Open(str(shifted[0]))
    made = gdal.GetDriverByName("GTiff").CreateCopy(str(turned), source)
    made.GetRasterBand(1).WriteArray(source.ReadAsArray()[::-1, ::-1].copy())
    made = None
    assert run("verify", turned, "--reference", shifted[1], "--json", *FEW).exit_code == 2
    done = run("verify", turned, "--reference", shifted[1], "--search-rotation", "180", "--json", *FEW)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["relative"]["rmse_px"]["value"] > 100


def test_a_displacement_beyond_the_search_is_refused(shifted):
    done = run("verify", shifted[0], "--reference", shifted[1], "--search", "2.2", "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == 2 or abs(found["relative"]["bias_m"]["value"] - np.hypot(*SHIFTED.shift)) < 0.05


def test_clouds_are_masked_by_their_classes(tmp_path):
    pair = Pair(side=400, seed=2, ortho=Look(clouds=0.4), shift=(4.0, 2.0))
    ortho, reference = pair.write(tmp_path)
    classes = tmp_path / "scl.tif"
    pixels = gdal.Open(str(ortho)).ReadAsArray()
    made = gdal.GetDriverByName("GTiff").Create(str(classes), 400, 400, 1)
    made.SetProjection(gdal.Open(str(ortho)).GetProjection())
    made.SetGeoTransform(gdal.Open(str(ortho)).GetGeoTransform())
    made.GetRasterBand(1).WriteArray(np.where(pixels > 2400, 9, 4).astype(np.uint8))
    made = None
    result = verify(ortho, match=MatchOptions(reference=[str(reference)]), masks=[f"{classes}=3,8-10"])
    bias = result.document["relative"]
    np.testing.assert_allclose(
        [bias["bias_east_m"]["value"], bias["bias_north_m"]["value"]], pair.shift, atol=0.06, rtol=2e-3
    )
    assert result.document["matches"]["tried"] < 300
    with pytest.raises(InputError, match="not a list of mask classes"):
        verify(ortho, match=MatchOptions(reference=[str(reference)]), masks=[f"{classes}=clouds"])


@pytest.mark.parametrize("warped", [{"xRes": 20, "yRes": 20}, {"dstSRS": "EPSG:4326"}], ids=["coarser", "degrees"])
def test_a_mask_may_have_another_grid(shifted, tmp_path, warped):
    ortho, reference = shifted
    source = gdal.Open(str(ortho))
    same = gdal.GetDriverByName("MEM").Create("", source.RasterXSize, source.RasterYSize, 1)
    same.SetProjection(source.GetProjection())
    same.SetGeoTransform(source.GetGeoTransform())
    classes = np.full((source.RasterYSize, source.RasterXSize), 4, np.uint8)
    classes[:, :100] = 9
    same.GetRasterBand(1).WriteArray(classes)
    gdal.Warp(str(tmp_path / "scl.tif"), same, resampleAlg="nearest", **warped)
    match = MatchOptions(reference=[str(reference)], points=100)
    measured = measure_ortho(ortho, match, masks=[ClassMask.parse(f"{tmp_path / 'scl.tif'}=9")])
    assert measured.image[:, 0].min() > 95
    assert len(measured.image) > 20


def test_a_folder_gives_one_table(shifted, tmp_path):
    folder = tmp_path / "orthos"
    folder.mkdir()
    shutil.copy(shifted[0], folder / "a.tif")
    (folder / "b.tif").write_bytes(b"no raster")
    done = run("verify", folder, "--reference", shifted[1], "-o", tmp_path / "out", "--require", "ce90<4", *FEW)
    # An ortho that could not be compared meets no requirement, although the other one does.
    assert done.exit_code == 4, done.output
    table = json.loads((tmp_path / "out" / "verify.json").read_text())
    assert [Path(row["ortho"]).name for row in table["orthos"]] == ["a.tif", "b.tif"]
    assert table["failed"] == 1
    assert "error" in table["orthos"][1]
    page = (tmp_path / "out" / "verify.html").read_text()
    assert "a.tif" in page
    assert (tmp_path / "out" / "a_verify.html").exists()
    made, own = table["provenance"], json.loads((tmp_path / "out" / "a_verify.json").read_text())["provenance"]
    assert (made["command"], made["software"]) == (own["command"], own["software"])
    assert made["inputs"] == own["inputs"][1:]
    assert [one["path"] for one in made["inputs"]] == [str(shifted[1])]
    assert [" verify " in page, made["inputs"][0]["sha256"] in page] == [True, True]


def test_a_folder_with_orthos_that_cannot_be_compared_has_the_exit_codes_of_a_run(shifted, tmp_path):
    (tmp_path / "b.tif").write_bytes(b"no raster")
    assert run("verify", tmp_path, "--reference", shifted[1], "--require", "ce90<4").exit_code == 4
    assert run("verify", tmp_path, "--reference", shifted[1]).exit_code == 1
    shutil.copy(shifted[0], tmp_path / "a.tif")
    assert run("verify", tmp_path, "--reference", shifted[1], *FEW).exit_code == 3


def test_a_folder_reads_what_its_orthos_have_in_common_once_for_checksums(shifted, tmp_path, monkeypatch):
    folder, read = tmp_path / "orthos", []
    folder.mkdir()
    for name in ("a.tif", "b.tif"):
        shutil.copy(shifted[0], folder / name)

    def counted(path, stop=None):
        read.append(Path(path))
        return sha256(path, stop)

    monkeypatch.setattr(reading, "sha256", counted)
    table = verify(folder, match=MatchOptions(reference=[str(shifted[1])], points=100)).document
    assert table["failed"] == 0
    assert sorted(read) == sorted([folder / "a.tif", folder / "b.tif", shifted[1]])


def test_points_alone_say_how_accurate_an_ortho_is(shifted, tmp_path):
    random = np.random.default_rng(1)
    image = random.uniform(20, 300, (40, 2))
    error = random.normal((1.5, -0.5), 0.4, (40, 2))
    ground = CORNER + image * (1, -1) - error
    rows = [
        f"p{k},{c:.4f},{r:.4f},{x:.4f},{y:.4f}" for k, ((c, r), (x, y)) in enumerate(zip(image, ground, strict=True))
    ]
    points = tmp_path / "points.csv"
    points.write_text("id,col,row,x,y\n" + "\n".join(rows))
    words = "--points-crs", "EPSG:32735", "--json"
    done = run("verify", shifted[0], "--gcps", points, *words)
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    found = document["points"]
    assert found["count"] == 40
    scale = document["pixel_m"]
    np.testing.assert_allclose(found["bias_east_m"]["value"], error[:, 0].mean() * scale, rtol=0.01)
    np.testing.assert_allclose(found["rmse_m"]["value"], np.sqrt((error**2).sum(axis=1).mean()) * scale, rtol=0.01)
    assert "ASPRS 2023 class" in document["asprs"]
    assert "Indicative" not in document["asprs"]
    assert run("verify", shifted[0], "--gcps", points, *words, "-o", tmp_path / "out").exit_code == 0
    page = next((tmp_path / "out").glob("*_verify.html")).read_text()
    assert "At points" in page
    assert "Relative to the reference" not in page
    few = tmp_path / "few.csv"
    few.write_text("id,col,row,x,y\n" + "\n".join(rows[:3]))
    assert run("verify", shifted[0], "--gcps", few, *words).exit_code == 2


def test_map_coordinates_in_place_of_pixels_are_an_error(shifted, tmp_path):
    ground = CORNER + np.random.default_rng(1).uniform(20, 300, (5, 2)) * (1, -1)
    points = tmp_path / "points.csv"
    rows = [f"p{k},{x:.2f},{-y:.2f},{x:.2f},{y:.2f}" for k, (x, y) in enumerate(ground)]
    points.write_text("id,col,row,x,y\n" + "\n".join(rows))
    done = run("verify", shifted[0], "--gcps", points, "--points-crs", "EPSG:32735")
    assert done.exit_code == 2
    assert "give columns and rows of the ortho, not map coordinates" in " ".join(done.output.split())


def test_points_measured_in_the_raw_scene_do_not_test_its_ortho(tiny, tmp_path):
    """The sample scene had errors of 490 m, with an ASPRS class."""
    points = "--gcps", tiny.gcps, "--points-crs", "EPSG:4979"
    made = run("rectify", tiny.image, *points, "--height", 500, "-o", tmp_path / "out")
    assert made.exit_code == 0, made.output
    ortho = next((tmp_path / "out").glob("*_ortho.tif"))
    refused = run("verify", ortho, *points)
    assert refused.exit_code == 2
    assert "measured in the raw scene, not in the ortho" in refused.stderr
    next((tmp_path / "out").glob("*_report.json")).write_text("{}")
    assert "measured in the raw scene" not in run("verify", ortho, *points).output


def test_nothing_to_compare_with_is_an_error(shifted):
    done = run("verify", shifted[0])
    assert done.exit_code == 2
    assert "--reference" in done.output
    assert "--gcps" in done.output


@pytest.mark.slow
def test_intervals_of_points_cover_the_truth():
    random = np.random.default_rng(7)
    covered = {"bias_east": 0, "rmse": 0, "ce90": 0}
    mean, root = np.array([0.8, -0.3]), np.array([[0.5, 0.0], [0.2, 0.4]])
    length = np.hypot(*(mean + random.standard_normal((1_000_000, 2)) @ root.T).T)
    true = {"bias_east": 0.8, "rmse": np.sqrt((length**2).mean()), "ce90": np.quantile(length, 0.9)}
    for _ in range(200):
        found = Accuracy.of_points(mean + random.standard_normal((25, 2)) @ root.T)
        for name, value in true.items():
            one = getattr(found, name)
            covered[name] += one.low <= value <= one.high
    assert all(180 <= count <= 198 for count in covered.values()), covered


def test_displacements_by_wrong_heights_are_named(tmp_path):
    hills = np.random.default_rng(3)
    heights = 300.0 + 15.0 * field_of(hills, 256, 60.0)[:200, :200]
    dem = tmp_path / "dem.tif"
    made = gdal.GetDriverByName("GTiff").Create(str(dem), 200, 200, 1, gdal.GDT_Float32)
    made.SetProjection(parse_crs("EPSG:32735").to_wkt())
    made.SetGeoTransform((CORNER[0], 2.0, 0.0, CORNER[1], 0.0, -2.0))
    made.GetRasterBand(1).WriteArray(heights)
    made = None

    class Leaning(Pair):
        """Seen 6 degrees off vertical from the west, on ground that was taken to be flat at 280 m."""

        def displacement(self):
            def at(image):
                where = [image[:, 1] / 2 - 0.5, image[:, 0] / 2 - 0.5]
                above = map_coordinates(heights, where, order=1, mode="nearest") - 280.0
                return np.column_stack([0.1 * above, np.zeros(len(image))])

            return at

    ortho, reference = Leaning(side=400, seed=6).write(tmp_path / "leaning")
    options = SurfaceOptions(dem=str(dem), vertical="ellipsoid")
    result = verify(ortho, match=MatchOptions(reference=[str(reference)], points=200), surface=options)
    found = result.document["heights"]
    assert found["significant"]
    np.testing.assert_allclose(found["rate_m_per_m"], 0.1, atol=0.015)
    np.testing.assert_allclose(found["azimuth_deg"], 90.0, atol=8.0)
    np.testing.assert_allclose(found["zero_height_m"], 280.0, atol=5.0)
    assert result.document["causes"][0]["code"] == "heights"
    assert "° off vertical" in result.document["causes"][0]["text"]


def test_a_datum_that_explains_a_shift_is_named():
    # WGS84 coordinates in Germany that were labelled as of ED50.
    there = ground_transform("EPSG:4230", "EPSG:25832")([[9.0, 50.0, 0.0]])[0]
    here = ground_transform("EPSG:4258", "EPSG:25832")([[9.0, 50.0, 0.0]])[0]
    crs = parse_crs("EPSG:25832")
    assert datum_of(crs, here, (here - there)[:2], 0.5) == "ED50"
    assert datum_of(crs, here, np.array([40.0, -55.0]), 0.5) is None
    assert datum_of(crs, here, np.array([2.0, 1.0]), 0.5) is None
    # WGS 72 is known to 2 m there, and differs by (13.7, 3.8): 5.1 m away.
    turkey = np.array([531000.0, 4123000.0])
    assert datum_of(parse_crs("EPSG:32636"), turkey, np.array([15.1, 8.7]), 0.2) is None
    assert datum_of(parse_crs("EPSG:32636"), turkey, np.array([14.0, 4.0]), 0.2) == "WGS 72"
    # PROJ has several transformations from Cape to WGS 84, and chooses one at the place.
    there = ground_transform("EPSG:4222", "EPSG:32735")([[27.0, -26.0, 0.0]])[0]
    here = ground_transform("EPSG:4326", "EPSG:32735")([[27.0, -26.0, 0.0]])[0]
    assert datum_of(parse_crs("EPSG:32735"), here, (here - there)[:2], 0.5) == "Cape"
    # In the other direction it is WGS 84 itself, not one of its realisations.
    there = ground_transform("EPSG:4326", "EPSG:22235")([[27.0, -26.0, 0.0]])[0]
    here = ground_transform("EPSG:4222", "EPSG:22235")([[27.0, -26.0, 0.0]])[0]
    assert datum_of(parse_crs("EPSG:22235"), here, (here - there)[:2], 0.5) == "WGS 84"


def test_a_damaged_ortho_is_not_an_error_of_the_reference(bent, tmp_path):
    whole = bent[0].read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[: len(whole) // 2])
    done = run("verify", tmp_path / "cut.tif", "--reference", bent[1], "-o", tmp_path / "out")
    assert "cut.tif: the pixels cannot be read" in done.output
