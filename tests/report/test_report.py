"""The report: its numbers, its words, and a page that needs nothing else and believes nobody."""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import html
import json
import re
import struct
import subprocess
import sys
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from defusedxml import ElementTree
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain
from osgeo import gdal

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points
from ortho_pipeline.report import document as report
from ortho_pipeline.report.page import behaviour
from ortho_pipeline.report.records import SceneReport
from ortho_pipeline.report.wording import few_check_points

CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)
BIAS = np.array([6.3, -4.1])
HOSTILE = '<script>alert("x")</script>'


@functools.cache
def points(control: int = 12, check: int = 6, **noise: float) -> Points:
    made = simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5, **noise).measured
    return dataclasses.replace(made, image=made.image + BIAS)


@functools.cache
def adjusted(measured: Points, correction: str = "shift") -> Fit:
    return fit(ImageCorrection(CAMERA, correction, (500.0, 500.0), np.zeros(6)), measured, name=f"camera+{correction}")


def as_delivered(measured: Points) -> Fit:
    """What the points say about the camera when nothing is adjusted."""
    predicted = CAMERA.ground_to_image(measured.ground)
    residuals = measured.image - predicted
    return Fit(
        model=ImageCorrection(CAMERA, "none", (500.0, 500.0), np.zeros(6)),
        model_name="camera",
        covariance=np.zeros((0, 0)),
        points=measured,
        used=measured.control,
        predicted=predicted,
        residuals=residuals,
        loo_residuals=residuals,
        raw_residuals=residuals,
        redundancy=2 * int(measured.control.sum()),
        sigma0=None,
    )


def no_points() -> Points:
    return points().select(np.zeros(18, dtype=bool))


def document(result: Fit, **more: Any) -> SceneReport:
    model = result.model
    scene = Scene("simulated", "folder/scene.tif", 1000, 1000, {"camera": model}, "from a seed", {"sun": float("nan")})
    return report.build_report(scene=scene, fit=result, **more)


def renamed(measured: Points, index: int, name: str) -> Points:
    ids = list(measured.ids)
    ids[index] = name
    return dataclasses.replace(measured, ids=tuple(ids))


class FakeSurface:
    """The terrain, lower or higher by a constant."""

    provenance: dict[str, Any] = {"path": "dem.tif", "crs": "WGS 84", "vertical_label": "EGM96", "fill": "error"}  # noqa: RUF012
    sigma = None

    def __init__(self, offset: float) -> None:
        self.offset = offset

    def above(self, ground: np.ndarray, crs: Any) -> np.ndarray:
        return ground[:, 2] - TERRAIN(ground[:, 0], ground[:, 1]) - self.offset

    def coverage(self, xy: np.ndarray, crs: Any) -> float:
        return 1.0


# -- numbers ---------------------------------------------------------------------------------------------------------


def test_report_is_json_without_nan(tmp_path):
    made = document(
        adjusted(points()),
        warnings=[Notice("from-sensor", "look here")],
        provenance={"image": {"path": "scene.tif", "size": [1000, 1000]}},
    )
    report.write_report_json(made, tmp_path / "r.json")
    again = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert again == made.to_json()
    assert again["schema_version"] == 1
    assert again["scene"]["facts"] == {"sun": None}
    assert again["warnings"] == ["look here"]
    assert again["notices"] == again["adjustment"]["notices"] == [{"code": "from-sensor", "text": "look here"}]


def test_raw_bias_is_measured_minus_delivered():
    raw = document(adjusted(points())).adjustment.raw_bias
    assert (raw.col, raw.row) == pytest.approx(BIAS, abs=0.2)


def test_metres_are_pixels_times_their_size():
    made = document(adjusted(points()))
    assert made.scene.ground_pixel_m == pytest.approx([2.5, 2.5], rel=0.02)
    for which in ("control", "check", "loo"):
        pixels, metres = getattr(made.adjustment.rmse, which), getattr(made.rmse_m, which)
        assert metres.n == pixels.n
        assert metres.total == pytest.approx(2.5 * pixels.total, rel=0.1)


def test_metres_say_where_the_ortho_shows_the_point():
    """A point measured one pixel to the east is shown one pixel to the east."""
    measured = points(check=1, sigma_image=1e-6, sigma_ground=0.0)
    index = int(np.flatnonzero(measured.check)[0])
    image = measured.image.copy()
    image[index] += (1.0, 0.0)
    result = adjusted(dataclasses.replace(measured, image=image))
    shown = CAMERA.image_to_ground(image[index : index + 1] - BIAS, measured.ground[index, 2])
    east, north = (TERRAIN.xy(*shown.T[:2]) - TERRAIN.xy(*measured.ground[index : index + 1, :2].T))[0]
    said = document(result).adjustment.points[index].residual_m
    # The map is turned against north by the convergence of meridians, 0.2 degrees there.
    assert said == pytest.approx((east, north), abs=0.02)


def test_relief_displacement_is_that_of_the_camera():
    scene = document(adjusted(points())).scene
    low, high = (TERRAIN.xy(*CAMERA.image_to_ground([[500.0, 500.0]], h).T[:2])[0] for h in (1100.0, 1000.0))
    east, north = (high - low) / 100
    assert scene.lean_m_per_m == pytest.approx(np.hypot(east, north), rel=0.01)
    assert scene.lean_azimuth_deg == pytest.approx(np.degrees(np.arctan2(east, north)) % 360, abs=1.0)


def test_residuals_geojson_is_flat_and_in_lon_lat():
    measured = points()
    image = measured.image.copy()
    image[3] += (50.0, 20.0)
    result = adjusted(dataclasses.replace(measured, image=image))
    features = report.residuals_geojson(result)["features"]
    json.dumps(features, allow_nan=False)
    assert len(features) == 18
    for i, feature in enumerate(features):
        assert feature["geometry"]["coordinates"] == pytest.approx(measured.ground[i].tolist(), abs=1e-9)
        said = feature["properties"]
        assert not any(isinstance(value, list | dict) for value in said.values())
        assert (said["res_col"], said["res_row"]) == pytest.approx(result.residuals[i])
    assert features[3]["properties"]["rejected"]
    assert features[3]["properties"]["loo_col"] is None
    assert features[3]["properties"]["length_m"] == pytest.approx(2.5 * np.hypot(50, 20), rel=0.05)


# -- words -----------------------------------------------------------------------------------------------------------


def test_headline_prefers_check_points():
    head = document(adjusted(points())).headline
    assert re.fullmatch(r"0\.\d\d px", head.figure)
    assert head.metres.endswith(" m")
    assert "6 check points" in head.what
    assert any("30 check points" in note for note in head.notes)


def test_headline_with_enough_check_points_makes_no_excuse():
    head = document(adjusted(points(control=10, check=30))).headline
    assert not any("ewer than" in note for note in head.notes)


def test_headline_without_check_points_leaves_one_out():
    made = document(adjusted(points(check=0)))
    assert "left out in turn" in made.headline.what
    assert made.headline.figure == f"{made.adjustment.rmse.loo.total:.2f} px"


def test_headline_without_redundancy_gives_no_figure():
    head = document(adjusted(points(control=1, check=0))).headline
    assert head.figure == "Accuracy unknown"
    assert any(note.startswith("No redundancy") for note in head.notes)


def test_headline_without_points_says_so():
    made = document(as_delivered(no_points()))
    assert made.headline.figure == "Accuracy unknown"
    assert "no points" in made.headline.what
    assert "accuracy  unknown: there are no points" in report.summary_text(made)
    assert report.plots(made) == {}


def test_headline_of_a_model_as_delivered():
    head = document(as_delivered(points(check=0))).headline
    assert float(head.figure.removesuffix(" px")) == pytest.approx(np.hypot(*BIAS), abs=0.2)
    assert "as delivered" in head.what


@pytest.mark.parametrize(("offset", "warned"), [(33.6, True), (0.0, False), (-33.6, True)])
def test_other_height_datum_of_the_points_is_seen(offset, warned):
    made = document(adjusted(points()), surface=FakeSurface(offset), coverage=1.0)
    assert made.heights.median_m == pytest.approx(-offset, abs=0.2)
    found = [text for text in made.warnings if "datum" in text]
    assert bool(found) is warned
    if warned:
        assert ("below" if offset > 0 else "above") in found[0]
        assert "13.7 m" in found[0]


def test_summary_fits_a_screen():
    measured = points()
    image = measured.image.copy()
    image[3] += (50.0, 20.0)
    made = document(
        adjusted(dataclasses.replace(measured, image=image)),
        surface=FakeSurface(0.0),
        coverage=0.9996,
        warnings=[Notice("from-sensor", "Mind it")],
    )
    text = report.summary_text(made)
    assert len(text.splitlines()) <= 24
    for part in ("scene.tif", "raw bias", "column +6.3", measured.ids[3], "99.9 % of the scene", "Mind it"):
        assert part in text


def test_what_is_left_out_is_not_known_by_these_words(tmp_path):
    """A model that was left out was taken for a point that was, and not said; so was what a plugin says of nodata."""
    said = "the rigorous model in DIM_1.XML is not used: it is for 10 x 10 pixels"
    point = Notice("left-out", "point G3 was left out: gross error")
    made = document(adjusted(points()), warnings=[Notice("rigorous-left-out", said), point])
    text = report.summary_text(made)
    assert f"Note: {said[0].upper()}{said[1:]}" in text
    assert text.count("oint G3 was left out") == 1


def test_a_single_check_point_is_named_once(tmp_path):
    """The plural alone was recognised."""
    few = few_check_points(1)
    made = document(adjusted(points(check=1)), warnings=[few])
    text = report.summary_text(made)
    assert text.count("fewer than the 30") == 1
    assert "Fewer than 30" not in text
    report.write_report_html(made, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert page.lower().count("fewer than the 30") == 1
    assert "Fewer than 30" not in page.replace(made.map_scale.statement, "")


# -- page ------------------------------------------------------------------------------------------------------------


class Loads(HTMLParser):
    """Collects whatever a page could load or run."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.found += [value or "" for name, value in attrs if name in {"src", "href", "xlink:href", "srcset", "data"}]


@pytest.fixture
def page(tmp_path) -> str:
    measured = renamed(renamed(points(), 3, HOSTILE), 1, "O'Hara & <b>Söhne</b>")
    image = measured.image.copy()
    image[3] += (50.0, 20.0)
    made = document(
        adjusted(dataclasses.replace(measured, image=image)),
        surface=FakeSurface(0.0),
        coverage=1.0,
        provenance={
            "command": HOSTILE,
            "inputs": [{"role": "image", "path": HOSTILE, "bytes": 1, "sha256": "ab" * 32}],
        },
        warnings=[Notice("left-out", f"{HOSTILE} was left out")],
    )
    png = report.preview_png(_raster(tmp_path / "ortho.tif"))
    report.write_report_html(made, tmp_path / "r.html", ortho=png)
    return (tmp_path / "r.html").read_text(encoding="utf-8")


def _raster(path: Any, bands: int = 1) -> str:
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 300, 200, bands, gdal.GDT_UInt16)
    values = np.add.outer(np.arange(200), np.arange(300)).astype(np.uint16)
    for k in range(bands):
        dataset.GetRasterBand(k + 1).WriteArray(values)
        dataset.GetRasterBand(k + 1).SetNoDataValue(0)
    del dataset
    return str(path)


def test_page_needs_nothing_else(page):
    loads = Loads()
    loads.feed(page)
    assert all(value.startswith("data:image/png;base64,") for value in loads.found)
    assert len(loads.found) == 1
    assert not {"link", "iframe", "object"} & set(loads.tags)
    # One script, which the policy names by its digest: no other can run, and nothing can be loaded.
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert script == behaviour.script()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = html.unescape(re.findall(r'Security-Policy" content="([^"]*)"', page)[0])
    assert f"script-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "@import" not in page
    assert "url(" not in page
    # The name of the SVG vocabulary is not loaded by anything.
    assert set(re.findall(r"https?://[^\"'\s]*", page)) == {"http://www.w3.org/2000/svg"}


def test_page_escapes_what_others_wrote(page):
    assert page.count("<script") == 1
    assert "&lt;script&gt;" in page
    assert "<b>S" not in page
    assert "O&#39;Hara &amp; &lt;b&gt;" in page


def test_page_has_the_numbers(page):
    for text in (
        "6 check points",
        "+6.3",
        "gross error",
        "ab" * 32,
        "redundancy 20",
        "col_shift",
        "100 % of the scene",
    ):
        assert text in page
    assert not re.search(r"\bnan\b", page, re.IGNORECASE)
    assert "None" not in page


def test_page_without_optional_parts(tmp_path):
    made = document(as_delivered(no_points()))
    report.write_report_html(made, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Accuracy unknown" in page
    assert re.findall(r"data-plot=\"(\w+)", page) == ["locator"]
    assert "<img" not in page


def drawn_residuals(made: SceneReport) -> str:
    return report.plots(made)["residuals"].svg()


# -- figures ---------------------------------------------------------------------------------------------------------


def test_plot_tells_the_points_apart_and_has_a_scale():
    measured = points()
    image = measured.image.copy()
    image[3] += (200.0, 0.0)
    result = adjusted(dataclasses.replace(measured, image=image))
    drawn = drawn_residuals(document(result))
    assert drawn.count("<circle") == 11 + 1  # the legend has one of each
    assert drawn.count('<rect class="check"') == 6 + 1
    assert drawn.count('<path class="out"') == 1 + 1
    assert re.search(r">0\.\d+ px</text>", drawn)
    for name in measured.ids:
        assert f">{name}</text>" in drawn


def test_plot_keeps_points_outside_of_the_image_in_view():
    measured = points(check=0, sigma_image=0.1)
    ground = CAMERA.image_to_ground([[-400.0, 1500.0]], 900.0)
    image = measured.image.copy()
    image[0] = BIAS + np.array([-400.0, 1500.0])
    moved = measured.ground.copy()
    moved[0] = ground[0]
    drawn = drawn_residuals(document(adjusted(dataclasses.replace(measured, image=image, ground=moved))))
    view = re.search(r'viewBox="0 0 (\d+) (\d+)"', drawn)
    assert view
    width, height = map(float, view.groups())
    for cx, cy in re.findall(r'cx="([-\d.]+)" cy="([-\d.]+)"', drawn):
        assert 0 < float(cx) < width
        assert 0 < float(cy) < height


def test_plot_of_a_perfect_point_has_no_arrow():
    made = document(adjusted(points(control=1, check=0)))
    exact = made.adjustment.points[0].replaced(residual=(0.0, 0.0))
    adjustment = made.adjustment.replaced(points=(exact,))
    assert "<line" not in drawn_residuals(made.replaced(adjustment=adjustment))


def test_plots_of_a_whole_report_as_svg_and_png(tmp_path):
    made = document(adjusted(points(), "affine"))
    report.write_report_json(made, tmp_path / "scene_report.json")
    again = report.read_report(tmp_path / "scene_report.json")
    assert again == made
    for kind in ("svg", "png"):
        files = report.write_plots(again, tmp_path / "plots", "scene_report", kind)
        assert set(files) == {"residuals", "directions", "heights", "correlation", "neighbours", "relative"}
    for path in (tmp_path / "plots").glob("*.svg"):
        text = path.read_text(encoding="utf-8")
        assert "var(" not in text
        ElementTree.fromstring(text)
    for path in (tmp_path / "plots").glob("*.png"):
        assert gdal.Open(str(path)).ReadAsArray()[0].std() > 1


def test_a_report_that_is_none_is_refused(tmp_path):
    for text in ("[]", "{", '{"document": "ortho-pipeline report", "schema_version": 99}'):
        (tmp_path / "r.json").write_text(text)
        with pytest.raises(InputError):
            report.read_report(tmp_path / "r.json")
    with pytest.raises(InputError, match="cannot be read"):
        report.read_report(tmp_path / "absent.json")


@pytest.mark.parametrize(
    ("section", "name", "value", "said"),
    [
        ("scene", "size", None, "scene.size"),
        ("scene", "size", "large", "scene.size"),
        ("headline", "surplus", 1, "headline.surplus"),
        ("rmse_m", "check", {"x": 1.0}, "rmse_m.check.y"),
    ],
)
def test_a_damaged_report_is_refused_by_the_name_of_the_member(tmp_path, section, name, value, said):
    damaged = document(adjusted(points())).to_json()
    damaged[section] |= {name: value}
    (tmp_path / "r.json").write_text(json.dumps(damaged))
    with pytest.raises(InputError, match="damaged") as refused:
        report.read_report(tmp_path / "r.json")
    assert (refused.value.file, refused.value.field) == (str(tmp_path / "r.json"), said)


def test_a_point_that_does_not_project_is_not_drawn():
    """A residual of nulls was taken for one."""
    made = document(adjusted(points()))
    lost = made.adjustment.points[0].replaced(residual=(None, None), view_residual=None)
    adjustment = made.adjustment.replaced(points=(lost, *made.adjustment.points[1:]))
    drawn = report.plots(made.replaced(adjustment=adjustment))
    assert lost.id not in drawn["residuals"].svg()
    assert {"directions", "heights"} <= set(drawn)


def test_a_wrong_height_shows_along_the_view_and_not_across():
    measured = points(sigma_image=0.01, sigma_ground=0.0)
    index = int(np.flatnonzero(measured.check)[0])
    ground = measured.ground.copy()
    ground[index, 2] += 20.0
    made = document(adjusted(dataclasses.replace(measured, ground=ground)))
    along, across = made.adjustment.points[index].view_residual
    # 20 m of height at tan(20 degrees), in pixels of 2.5 m; the point is believed too high, so it is measured short.
    assert along == pytest.approx(-20 * 0.41 / 2.5, rel=0.05)
    assert across == pytest.approx(0.0, abs=0.1)
    assert made.view_rmse.check.along > 5 * made.view_rmse.check.across


def test_hull_of_the_control_points_is_a_share_of_the_image():
    measured = points(control=4, check=0, sigma_image=0.01)
    corners = np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 500.0], [0.0, 500.0]])
    ground = CAMERA.image_to_ground(corners, 1000.0)
    moved = dataclasses.replace(measured, image=corners, ground=ground)
    hull = document(adjusted(moved, "none")).control_hull
    assert hull.share == pytest.approx(0.5)
    assert hull.n == len(hull.outline) == 4
    assert document(adjusted(points(control=2, check=0))).control_hull is None


def test_style_of_the_residuals_is_qgis_xml():
    made = document(adjusted(points()))
    root = ElementTree.fromstring(report.residuals_style(made).split("\n", 1)[1])
    assert [rule.get("label") for rule in root.iter("rule")] == ["control", "check", "left out", "tie"]
    fields = {prop.get("v") for prop in root.iter("prop") if prop.get("k") in ("x_attribute", "y_attribute")}
    features = report.residuals_geojson(adjusted(points()))["features"]
    assert fields == {"east_m", "north_m"}
    assert fields <= set(features[0]["properties"])


def test_arrows_of_the_style_are_scaled_by_points_that_have_one():
    # A gross error of 60 px is drawn as a cross without an arrow: it must not shrink those of the others.
    measured = points()
    index = int(np.flatnonzero(measured.control)[2])
    image = measured.image.copy()
    image[index] += (60.0, 0.0)
    wrong = document(adjusted(dataclasses.replace(measured, image=image)))
    assert [one.id for one in wrong.adjustment.rejected] == [measured.ids[index]]

    def scale(made: SceneReport) -> float:
        root = ElementTree.fromstring(report.residuals_style(made).split("\n", 1)[1])
        return {float(prop.get("v") or 0) for prop in root.iter("prop") if prop.get("k") == "scale"}.pop()

    assert scale(wrong) == pytest.approx(scale(document(adjusted(measured))), rel=0.5)


def test_a_wrong_check_point_is_said_everywhere_and_counts(tmp_path):
    measured = points()
    index = int(np.flatnonzero(measured.check)[1])
    image = measured.image.copy()
    image[index] += (7.0, 0.0)
    result = adjusted(dataclasses.replace(measured, image=image))
    name = measured.ids[index]
    made = document(result)
    good = document(adjusted(measured)).adjustment.rmse.check
    (one,) = made.adjustment.outlying
    assert (one.id, one.role) == (name, "check")
    assert made.adjustment.rmse.check.n == 6
    assert made.adjustment.rmse.check.total > 2.5
    assert made.adjustment.rmse_of_agreeing_checks.total == pytest.approx(good.total, rel=0.3)
    note = next(text for text in made.headline.notes if name in text)
    assert "at 5 check points" in note
    assert note in report.summary_text(made)
    report.write_report_html(made, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert note in page
    assert page.count("<strong>outlying</strong>") == 1
    doubts = {f["properties"]["id"]: f["properties"]["outlying"] for f in report.residuals_geojson(result)["features"]}
    assert [key for key, value in doubts.items() if value] == [name]


@pytest.mark.parametrize("hole", [True, False])
@pytest.mark.parametrize(("bands", "colours"), [(1, 1), (2, 1), (3, 3), (4, 3)])
def test_preview_is_a_png_with_transparent_nodata(tmp_path, bands, colours, hole):
    path = _raster(tmp_path / "o.tif", bands)
    if hole:
        dataset = gdal.Open(str(path), gdal.GA_Update)
        dataset.WriteArray(np.zeros((bands, 9, 9), dtype=dataset.ReadAsArray(0, 0, 1, 1).dtype))
        del dataset
    png = report.preview_png(path, side=100)
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    assert struct.unpack(">II", png[16:24]) == (100, 67)
    assert png[25] == (2 if colours == 3 else 0) + (4 if hole else 0)  # as the format says: colour, alpha
    gdal.FileFromMemBuffer("/vsimem/preview.png", png)
    decoded = gdal.Open("/vsimem/preview.png").ReadAsArray().reshape(colours + hole, 67, 100)
    assert decoded[0, -1, -1] == 255
    if hole:
        assert (decoded[-1, 0, 0], decoded[-1, 10, 10]) == (0, 255)
    gdal.Unlink("/vsimem/preview.png")
    assert not [name for name in gdal.ReadDir("/vsimem/") or () if name.startswith("ortho_png")]


def test_preview_of_an_empty_ortho(tmp_path):
    path = str(tmp_path / "empty.tif")
    dataset = gdal.GetDriverByName("GTiff").Create(path, 5, 4, 1, gdal.GDT_Float32)
    dataset.GetRasterBand(1).Fill(float("nan"))
    dataset.GetRasterBand(1).SetNoDataValue(float("nan"))
    del dataset
    png = report.preview_png(path)
    gdal.FileFromMemBuffer("/vsimem/preview.png", png)
    assert not gdal.Open("/vsimem/preview.png").ReadAsArray().any()
    gdal.Unlink("/vsimem/preview.png")


def test_import_is_light():
    code = "import sys, ortho_pipeline.report.document; print(int('matplotlib' in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"


def test_one_control_point_has_no_scatter_and_check_points_still_test_it(tmp_path):
    measured = points()
    alone = measured.select(measured.check | (np.arange(len(measured)) == int(np.flatnonzero(measured.control)[0])))
    made = document(adjusted(alone))
    assert (made.adjustment.redundancy, made.adjustment.raw_bias.n, made.adjustment.rmse.check.n) == (0, 1, 6)
    report.write_report_html(made, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Redundancy 0: the control points do not test the model" in page
    assert "The model as delivered was off by" in page
    assert "scatter of measured minus predicted" not in page
    assert "nothing is tested" not in page
