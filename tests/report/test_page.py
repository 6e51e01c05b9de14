"""The first screen: residuals over the ortho, chips of the points, what to do about notices, and the verdict."""

from __future__ import annotations

import base64
import dataclasses
import functools
import itertools
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain
from osgeo import gdal

from ortho_pipeline.display.drawing import Drawing
from ortho_pipeline.display.numbers import class_size
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.report import document as report
from ortho_pipeline.report.gallery.points import SIDE, point_chips
from ortho_pipeline.report.map_scale import judge
from ortho_pipeline.report.page import locator
from ortho_pipeline.report.page.advice import WORDS, advised, signals
from ortho_pipeline.report.page.locator import place_of, plot_locator
from ortho_pipeline.report.page.ortho_map import degrees, plot_ortho
from ortho_pipeline.report.plots import plot_residuals
from ortho_pipeline.report.records import UNKNOWN, MapScaleRecord, SceneReport
from ortho_pipeline.report.wording import NO_SCALE, few_check_points, fitness, scale_rules, verdict

ROOT = Path(__file__).resolve().parent.parent.parent
CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)


@functools.cache
def measured(control: int = 12, check: int = 6, **noise: float) -> Points:
    return simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5, **noise).measured


@functools.cache
def adjusted(points: Points, correction: str) -> Fit:
    return fit(ImageCorrection(CAMERA, correction, (500.0, 500.0), np.zeros(6)), points)


def made(points: Points, crs: str = "EPSG:32636", correction: str = "shift") -> SceneReport:
    """Return the report of a scene whose ortho lies in a CRS."""
    result = adjusted(points, correction)
    scene = Scene("simulated", "scene.tif", 1000, 1000, {"camera": result.model}, "from a seed", {})
    x, y = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*points.ground[:, :2].T)
    margin = 0.1 * (max(x) - min(x)) or 100.0
    cell = (max(x) - min(x) + 2 * margin) / 1200
    extent = (min(x) - margin, min(y) - margin, max(x) + margin, max(y) + margin)
    grid = Grid.of_extent(pyproj.CRS(crs), extent, (cell, cell))
    return report.build_report(scene=scene, fit=result, grid=grid, warnings=result.warnings)


def onto(made_: SceneReport, drawing: Drawing, lon_lat: np.ndarray) -> np.ndarray:
    """Return pixels of the drawing of longitudes and latitudes, by PROJ and the extent of the ortho."""
    left, bottom, right, top = made_.ortho.extent
    to = pyproj.Transformer.from_crs("EPSG:4326", made_.ortho.crs, always_xy=True)
    x, y = to.transform(*lon_lat.T)
    return np.column_stack([(x - left) / (right - left) * drawing.width, (top - y) / (top - bottom) * drawing.height])


# Of the last the axes are turned by 33 degrees against north there.
@pytest.mark.parametrize("crs", ["EPSG:32636", "EPSG:4326", "EPSG:3995"])
def test_vectors_lead_from_where_a_point_belongs_to_where_the_ortho_shows_it(crs):
    points = measured(check=1, sigma_image=1e-6, sigma_ground=0.0)
    index = int(np.flatnonzero(points.check)[0])
    image = points.image.copy()
    image[index] += (30.0, 10.0)
    shown = CAMERA.image_to_ground(image[index : index + 1], points.ground[index, 2])
    said = made(dataclasses.replace(points, image=image), crs)
    drawing = plot_ortho(said)
    start, end = onto(said, drawing, np.vstack([points.ground[index, :2], shown[0, :2]]))
    opened = next(k for k, (what, given) in enumerate(drawing.items) if what == "open" and given["key"] == index)
    (x1, y1), (x2, y2) = next(given["xy"] for what, given in drawing.items[opened:] if what == "line")
    assert (x1, y1) == pytest.approx(tuple(start), abs=0.2)
    assert math.atan2(y2 - y1, x2 - x1) == pytest.approx(math.atan2(*(end - start)[::-1]), abs=0.01)
    # The longest of all is a tenth of the longer side.
    assert math.hypot(x2 - x1, y2 - y1) == pytest.approx(72.0, abs=0.1)


def test_graticule_scale_bar_and_north_are_those_of_the_map():
    said = made(measured())
    drawing = plot_ortho(said)
    texts = [given for what, given in drawing.items if what == "text"]
    lines = [given["lines"][0] for what, given in drawing.items if what == "path" and given["kind"] == "graticule"]
    east = next(given for given in texts if given["text"].endswith("E"))
    d, m, s = re.fullmatch(r"(\d+)°(?:(\d+)′)?(?:(\d+)″)? E", east["text"]).groups(default="0")
    lon = int(d) + int(m) / 60 + int(s) / 3600
    lats = [point.lon_lat[1] for point in said.adjustment.points]
    truth = onto(said, drawing, np.array([[lon, min(lats)], [lon, max(lats)]]))
    line = min((np.array(one) for one in lines), key=lambda one: abs(one[0, 0] - truth[0, 0]))
    line = line[np.argsort(line[:, 1])]
    assert np.interp(truth[:, 1], *line.T[::-1]) == pytest.approx(truth[:, 0], abs=0.3)
    bar = next(given["lines"][0] for what, given in drawing.items if what == "path" and given["kind"] == "rule")
    label = next(given["text"] for given in texts if re.fullmatch(r"[\d.]+ k?m", given["text"]))
    metres = float(label.split()[0]) * (1000 if label.endswith("km") else 1)
    left, _, right, _ = said.ortho.extent
    # UTM shows lengths too short by up to four in ten thousand.
    assert (bar[-1][0] - bar[0][0]) / drawing.width * (right - left) == pytest.approx(metres, rel=1e-3)


def test_degrees_are_written_as_far_as_they_are_not_zero():
    assert degrees(33.35, "EW") == "33°21′ E"
    assert degrees(-0.5 / 60, "NS") == "0°00′30″ S"
    assert degrees(-12.0, "EW") == "12° W"


def test_the_place_of_a_fit_is_the_middle_of_the_image():
    """It was the middle of the points, which may be in one corner."""
    said = made(measured())
    in_corner = tuple(one for one in said.adjustment.points if max(one.image) < 600)
    said = said.replaced(ortho=None, adjustment=said.adjustment.replaced(points=in_corner))
    middle = CAMERA.image_to_ground(np.array([said.scene.size]) / 2, CAMERA.reference_height)
    np.testing.assert_allclose(place_of(said), middle[0, :2], atol=2e-4)


def test_the_place_of_a_fit_beyond_the_antimeridian_is_on_the_map():
    """An RPC near it counts on: the page said 181° E, and its mark was off the map."""
    model: Any = SimpleNamespace(
        crs="EPSG:4979", reference_height=5.0, image_to_ground=lambda image, height: np.array([[181.0, -17.0, height]])
    )
    scene: Any = SimpleNamespace(path="a.tif", width=9, height=9, sensor="rpc", model_source="a", facts={})
    seen = dict.fromkeys(("ground_pixel_m", "lean_m_per_m", "lean_azimuth_deg"))
    assert report._scene(scene, seen, model).middle_lon_lat == (-179.0, -17.0)


def test_locator_finds_land_where_there_is_land():
    drawing = plot_locator(place_of(made(measured())))
    (land,) = (given["lines"] for what, given in drawing.items if what == "path" and given["kind"] == "land")
    (mark,) = (given for what, given in drawing.items if what == "circle")
    from shapely.geometry import Point, Polygon

    assert any(Polygon(ring).buffer(0).contains(Point(mark["x"], mark["y"])) for ring in land)  # Anatolia
    pacific = Point((-140 + 180) * 300 / 360, 84 * 300 / 360)
    assert not any(Polygon(ring).buffer(0).contains(pacific) for ring in land)


# -- chips -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noise(tmp_path_factory) -> RasterSource:
    """A scene of noise, which no compression makes smaller."""
    path = tmp_path_factory.mktemp("noise") / "scene.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 1000, 1000, 1)
    dataset.GetRasterBand(1).WriteArray(np.random.default_rng(1).integers(1, 255, (1000, 1000)).astype(np.uint8))
    del dataset
    return RasterSource(path)


def test_chips_show_the_pixels_about_a_point(noise, tmp_path):
    points = measured()
    image = points.image.copy()
    image[2] += (100.0, 0.0)
    said = made(dataclasses.replace(points, image=image))
    found = point_chips(said, noise)
    assert [chip.index for chip in found.chips] == list(range(18))
    one = found.chips[0]
    window = np.floor(image[0]).astype(int) - SIDE // 2
    assert one.measured == pytest.approx(tuple(image[0] - window))
    assert np.subtract(one.measured, one.predicted) == pytest.approx(said.adjustment.points[0].residual)
    gross = found.chips[2]
    assert gross.factor == 7  # 100 px are within three quarters of half a chip
    assert all(0 < value < SIDE for value in (*gross.measured, *gross.predicted))
    (tmp_path / "sheet.png").write_bytes(base64.b64decode(found.picture))
    sheet = gdal.Open(str(tmp_path / "sheet.png")).ReadAsArray()[0]
    chip = sheet[one.corner[1] : one.corner[1] + SIDE, one.corner[0] : one.corner[0] + SIDE].astype(float)
    truth = noise.read(*(int(value) for value in window), SIDE, SIDE)[0].astype(float)
    inside = (chip > 0) & (chip < 255)
    assert np.corrcoef(chip[inside], truth[inside])[0, 1] > 0.999


def test_page_of_a_hundred_points_is_below_three_megabytes(noise, tmp_path):
    """Of noise in three bands, which is larger than any image."""
    said = made(measured(control=70, check=30))
    colours = tmp_path / "ortho.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(colours), 900, 900, 3)
    dataset.WriteArray(np.random.default_rng(2).integers(1, 255, (3, 900, 900)).astype(np.uint8))
    del dataset
    report.write_report_html(said, tmp_path / "r.html", ortho=colours, pixels=noise)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert page.count('<li data-point="') == 100
    assert len(page.encode()) < 3_000_000


def test_page_without_pixels_to_read_is_made_all_the_same(noise, tmp_path, monkeypatch):
    from ortho_pipeline.errors import InputError

    def refuse(*window: int) -> np.ndarray:
        raise InputError("a block cannot be read")

    monkeypatch.setattr(noise, "read", refuse)
    assert point_chips(made(measured()), noise) is None


# -- words -----------------------------------------------------------------------------------------------------------


def test_every_notice_has_a_light_and_something_to_do():
    listed = re.findall(r"^\| `([a-z0-9-]+)` \|", (ROOT / "docs" / "notices.md").read_text(encoding="utf-8"), re.M)
    unknown = advised("a-code-of-tomorrow")
    assert [code for code in listed if advised(code) == unknown and code != "from-sensor"] == []
    assert all(advised(code)[1].endswith(".") for code in listed)


def test_the_gravest_notice_comes_first():
    codes = ("crop-noted", "few-check-points", "heights-disagree")
    found = signals([], [{"code": code, "text": f"it is {code}"} for code in codes])
    assert [one.level for one in found] == list(WORDS)
    assert signals(["as of old"], [])[0].text == "As of old"


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (
            measured(control=10, check=30),
            r"^Good enough for maps at 1:[\d,]+\. The (error|pixel size) \([\d.]+ m\) sets ",
        ),
        (measured(), r"^Good enough for maps at 1:[\d,]+\. The "),
        (measured(check=0), r"^Good enough for maps at 1:"),
        (measured().select(np.arange(18) < 1), r"^No map scale: there are no check points"),
    ],
)
def test_verdict_says_the_scale_and_what_sets_its_limit(points, said):
    text = verdict(made(points))
    assert re.search(said, text)
    assert text.count(". ") <= 1
    assert text.endswith(".")


@pytest.mark.parametrize("wrong", [1, 3])
def test_verdict_leads_with_check_points_that_contradict_the_control(tmp_path, wrong):
    points = measured()
    image = points.image.copy()
    names = []
    for index, by in zip(np.flatnonzero(points.check)[:wrong], ((14.0, 0.0), (0.0, -11.0), (-8.0, 0.0)), strict=False):
        image[index] += by
        names.append(points.ids[index])
    said = made(dataclasses.replace(points, image=image))
    verb = "contradicts" if wrong == 1 else "contradict"
    text = f"{wrong} of 6 check points {verb} the control points ({', '.join(names)})"
    assert (said.headline.figure, said.headline.what, said.map_scale) == (UNKNOWN, text, None)
    assert verdict(said) == NO_SCALE
    # The light is that of the verdict, and one notice says it, not one of all and one of each.
    shown = signals(said.warnings, said.notices)
    assert [one.level for one in shown][:1] == ["stop"]
    assert sum("contradict" in one.text for one in shown) == 1
    assert "Probably wrong" not in "".join(said.headline.notes)
    assert f"accuracy  unknown: {text}" in report.summary_text(said)
    assert f"map scale {NO_SCALE}" in report.summary_text(said)
    report.write_report_html(said, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Good enough for maps" not in page
    assert "Map scales" not in page
    # Next to the figure, with what it is without them; in the picture in rings; what to do is of these points.
    assert said.adjustment.notices[0]["rest"] == pytest.approx(0.5, abs=0.5)
    assert re.search(rf'class="unsettled">Not settled: 0\.\d+ px \(0\.\d+ m\) without {", ".join(names)}<', page)
    assert page.count('class="doubted"') == wrong
    assert ("Their errors differ" if wrong == 3 else f"Measure {names[0]} again") in page


def test_a_scale_says_what_sets_its_limit():
    found = judge(np.full((30, 2), 10.0), "check", None)
    record = MapScaleRecord(**found.to_json())
    assert fitness(record, " in plan") == (
        "Good enough for maps at 1:100,000 in plan. The error (14 m) sets this limit."
    )
    coarse = MapScaleRecord(**judge(np.full((30, 2), 1e5), "check", None).to_json())
    assert fitness(coarse) == "Not good enough for a usual map scale: the error (140,000 m) is too large."
    rows = {rule: (here, result) for rule, _, here, result in scale_rules(record)}
    assert rows["RMSE in plan"] == ("14.1 m", "1:100,000")
    # 14.142 m is 1415 cm: what is rounded is no better than it was.
    assert rows["ASPRS 2023, horizontal class"] == ("14.14 m", "14.2 m")
    assert "pixels" not in " ".join(rows).lower()


def test_a_scale_that_pixels_limit_names_the_pixel_and_what_the_error_would_allow():
    found = judge(np.full((6, 2), 0.339), "check", 2.53, survey=0.14)
    record = MapScaleRecord(**found.to_json())
    assert fitness(record) == (
        "Good enough for maps at 1:25,000. The pixel size (2.5 m) sets this limit; "
        "the error (0.48 m) alone would allow 1:2,000."
    )
    assert found.statement.startswith("1:25,000 (limited by the pixel size). Indicative: 6 check points;")
    rows = {rule: (here, result) for rule, _, here, result in scale_rules(record)}
    assert rows["RMSE in plan"] == ("0.48 m", "1:2,000")
    assert rows["Pixel size"] == ("2.5 m", "1:25,000")
    assert rows["ASPRS 2023, horizontal class"] == (
        "0.48 m, check points themselves 0.14 m", "50 cm (a claim needs 30 check points)",
    )  # fmt: skip


def test_a_class_has_centimetres_up_to_a_metre_and_three_digits_above():
    sizes = [class_size(one) for one in (1, 51, 99, 100, 101, 999, 1438, 1797, 9991, 12345, 123456)]
    assert sizes == [
        "1 cm", "51 cm", "99 cm", "1.00 m", "1.01 m", "9.99 m", "14.4 m", "18.0 m", "100 m", "124 m", "1240 m",
    ]  # fmt: skip


def test_places_of_points_are_in_the_json(tmp_path):
    points = measured()
    report.write_report_json(made(points), tmp_path / "r.json")
    found = json.loads((tmp_path / "r.json").read_text())["adjustment"]["points"]
    assert [one["lon_lat"] for one in found] == pytest.approx(points.ground[:, :2], abs=1e-9)


def test_a_scene_that_nothing_tests_is_not_said_to_be_fine(tmp_path):
    tested = made(measured())
    head = tested.headline.replaced(figure=UNKNOWN)
    empty = tested.replaced(headline=head, warnings=(), notices=())
    report.write_report_html(empty, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "No warnings" not in page
    assert '<li class="look">' in page
    assert "No point tests the accuracy of this result." in page
    assert [one.text for one in signals((), [{"code": "no-redundancy", "text": "none left"}], tested=False)] == [
        "None left"
    ]


def test_the_legend_of_the_map_has_what_was_left_out(tmp_path):
    points = measured()
    image = points.image.copy()
    image[np.flatnonzero(points.control)[3]] += (30.0, 0.0)
    for name, given, told in (("wrong", dataclasses.replace(points, image=image), 1), ("good", points, 0)):
        report.write_report_html(made(given), tmp_path / f"{name}.html", ortho=b"a picture")
        assert (tmp_path / f"{name}.html").read_text(encoding="utf-8").count("× left out") == told


def test_the_legend_of_the_map_and_the_notices_have_no_check_points_where_there_are_none(tmp_path):
    for checks in (6, 0):
        path = tmp_path / f"{checks}.html"
        report.write_report_html(made(measured(check=checks)), path, ortho=b"a picture")
        legend = re.findall(r'<span class="legend">(.*?)</span>\.', path.read_text(encoding="utf-8"))[0]
        assert re.findall(r'class="dot (\w+)"', legend) == ["control", "check"][: 1 + bool(checks)]
    assert few_check_points(0) == "there are no check points; ASPRS 2023 asks for 30"


def test_the_map_of_the_world_is_whole_at_the_antimeridian():
    """No outline runs around the world, and what is land and sea there are as atlases have them."""
    rings = json.loads((Path(locator.__file__).parent / "land.json").read_text(encoding="ascii"))
    assert max(abs(a[0] - b[0]) for ring in rings for a, b in itertools.pairwise(ring)) < 600
    land = shapely.union_all([shapely.Polygon(np.array(ring) / 10).buffer(0) for ring in rings])
    dry = {"Chukotka": (-173.0, 66.6), "Yakutia": (130.0, 66.0), "Alaska": (-150.0, 68.0), "Chad": (18.0, 14.0),
           "Anadyr": (176.0, 66.0), "Queensland": (145.0, -20.0)}  # fmt: skip
    wet = {"Norwegian Sea": (0.0, 68.0), "Baffin Bay": (-65.0, 73.0), "Coral Sea": (155.0, -17.0), "Pacific":
           (-120.0, -17.0), "Atlantic": (-20.0, -17.0), "Laptev Sea": (120.0, 76.0)}  # fmt: skip
    assert {name for name, place in dry.items() if not land.contains(shapely.Point(place))} == set()
    assert {name for name, place in wet.items() if land.contains(shapely.Point(place))} == set()


@pytest.mark.parametrize("index", [0, 7])
def test_the_north_arrow_covers_no_point_and_names_stay_on_the_map(index):
    """The ortho is cut so that a point lies where the arrow stands first, and then at the upper edge."""
    said = made(measured())
    to = pyproj.Transformer.from_crs("EPSG:4326", said.ortho.crs, always_xy=True)
    x, y = to.transform(*said.adjustment.points[index].lon_lat)
    for down in (40.0, 2.0):
        side = 4000.0
        right, top = x + 26.0 * side / 720.0, y + down * side / 720.0
        grid = said.ortho.replaced(extent=(right - side, top - side, right, top))
        drawing = plot_ortho(said.replaced(ortho=grid))
        (north,) = [item for kind, item in drawing.items if kind == "text" and item["text"] == "N"]
        names = {point.id for point in said.adjustment.points}
        for kind, item in drawing.items:
            if kind == "circle" and item["kind"] == "halo" and 0 < item["x"] < 720 and 0 < item["y"] < 720:
                assert math.hypot(item["x"] - north["x"], item["y"] - north["y"] - 26.0) > 30.0
            if kind == "text" and item["text"] in names:
                assert 10.0 < item["y"] < drawing.height


def test_names_do_not_cover_each_other():
    """The second of two near points has its name on the other side, the third has none."""
    drawing = Drawing(400.0, 100.0, "", "")
    for k in range(3):
        drawing.caption(200.0 + k, 50.0 + k, f"point {k}", 9, left=False)
    drawing.caption(200.0, 75.0, "below", 9, left=False)
    drawing.caption(395.0, 52.0, "edge", 9, left=False)
    assert [(one["text"], one["anchor"]) for _, one in drawing.items] == [
        ("point 0", "start"), ("point 1", "end"), ("below", "start"), ("edge", "end")
    ]  # fmt: skip


@pytest.mark.parametrize("corner", [(0.0, 0.0), (1.0, 1.0)])
def test_arrows_at_the_edge_of_the_image_are_not_cut_off(corner):
    said = made(measured())
    first, *others = said.adjustment.points
    out = first.replaced(image=tuple(np.multiply(corner, said.scene.size).tolist()), residual=tuple(
        (40.0 * np.subtract(corner, 0.5)).tolist()))  # fmt: skip
    said = said.replaced(adjustment=said.adjustment.replaced(points=(out, *others)))
    drawing = plot_residuals(said)
    heads = [one["lines"] for what, one in drawing.items if what == "path" and one["kind"].endswith("-head")]
    places = np.array([place for lines in heads for line in lines for place in line])
    assert heads
    assert (places > 0).all()
    assert (places < (drawing.width, drawing.height)).all()


def test_long_names_are_not_cut_off_and_points_off_the_map_have_none():
    said = made(measured())
    left, bottom, right, top = said.ortho.extent
    names = [f"road-junction-{k:03d}" for k in range(len(said.adjustment.points))]
    points = tuple(one.replaced(id=name) for one, name in zip(said.adjustment.points, names, strict=True))
    said = said.replaced(adjustment=said.adjustment.replaced(points=points))
    west = said.replaced(ortho=said.ortho.replaced(extent=(left, bottom, (left + right) / 2, top)))
    for drawing in (plot_residuals(said), plot_ortho(said), plot_ortho(west)):
        shown = [given for what, given in drawing.items if what == "text" and given["text"] in names]
        for given in shown:
            size = 7.0 * len(given["text"])
            assert given["x"] >= size if given["anchor"] == "end" else given["x"] + size <= drawing.width
    assert 0 < len(shown) < len(names)
