"""What a reader sees of a matching: the map, the histograms and the gallery, and that they say what the numbers say."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from defusedxml import ElementTree
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain
from osgeo import gdal

from ortho_pipeline.commands.control.matching import Matched
from ortho_pipeline.commands.control.search import Search
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.matching import REASONS, Matches
from ortho_pipeline.imaging.matching.search import Level
from ortho_pipeline.imaging.matching.weights import Components
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.options import MatchOptions
from ortho_pipeline.points import Points
from ortho_pipeline.report import document as reports
from ortho_pipeline.report.gallery.chips import gallery
from ortho_pipeline.report.gallery.plots import residuals_by_axis
from ortho_pipeline.report.plots import plots
from ortho_pipeline.report.records import SceneReport

SCHEMA = json.loads((Path(__file__).resolve().parents[2] / "docs" / "report.schema.json").read_text())
CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)
BIAS = np.array([6.3, -4.1])
HOSTILE = '<script>alert("x")</script>'
SIDE = 20
#: Of rejected matches; the first two were never measured, the third cannot have a score.
WHY = ["weak", "ambiguous", "not measured", "contradicts", "contradicts", "hidden"]


@dataclasses.dataclass
class Case:
    """A matching of known numbers, the adjustment to it, and its report."""

    matches: Matches
    fit: Fit
    report: SceneReport


def control(count: int, *, blunder: float = 0.0) -> Points:
    """Return `count` matches, a fifth of them held out; the first is off by `blunder` px."""
    made = simulate_points(CAMERA, TERRAIN, control=count - count // 5, check=count // 5, seed=5).measured
    image = made.image + BIAS
    image[0, 0] += blunder
    return dataclasses.replace(
        made, image=image, ids=tuple(f"m{k}" for k in range(count)), groups=np.arange(count) // 4
    )  # fmt: skip


def matches_of(points: Points, rejected: int = 6) -> Matches:
    """Return the matches that became these points, and some that did not, in another order."""
    rng = np.random.default_rng(7)
    kept, total = len(points), len(points) + rejected
    image = np.concatenate([points.image, rng.uniform(0, 1000, (rejected, 2))])
    reason = np.array([""] * kept + [WHY[k % len(WHY)] for k in range(rejected)], dtype="<U12")
    score = rng.uniform(0.3, 0.9, total)
    lost = np.flatnonzero(reason == "not measured")
    # One that is no number, and the others as the matcher has them.
    score[lost], score[lost[:1]] = 0.0, np.nan
    scene, target = (rng.normal(500, 90, (total, SIDE, SIDE)).astype(np.float32) for _ in range(2))
    target[np.isin(reason, ["weak", "ambiguous"])] = np.nan
    found = rng.normal(0, 0.5, (total, 2))
    found[np.isnan(target).all(axis=(1, 2)) | (reason == "not measured")] = np.nan
    order = np.argsort(image[:, 1])
    return Matches(
        image[order], rng.normal(0, 1, (total, 2)), score[order], reason[order], np.arange(total)[order],
        scene[order], target[order], found[order], np.full((total, 3), np.nan), 2, (Level(4, 8, 60, 50, (3.0, -2.0)),),
        Components(2.0, 1.5, 0.1), points,
    )  # fmt: skip


def case(count: int = 40, rejected: int = 6, *, reference: str = "ortho.tif", **more: Any) -> Case:
    points = more.pop("points", None) or control(count, **more)
    matches = matches_of(points, rejected)
    matched = Matched(
        matches, (reference,), MatchOptions(reference=(reference,)), Search(60.0, "as asked for"), (1000, 1000), 0.8
    )
    done = fit(ImageCorrection(CAMERA, "shift", (500.0, 500.0), np.zeros(6)), points, name="camera+shift")
    scene = Scene("simulated", "folder/scene.tif", 1000, 1000, {"camera": CAMERA}, "from a seed", {})
    return Case(matches, done, reports.build_report(scene=scene, fit=done, matching=matched.tested_by(done)))


@pytest.fixture(scope="module")
def plain() -> Case:
    return case()


def page_of(one: Case, folder: Path, *, chips: bool = True) -> str:
    reports.write_report_html(one.report, folder / "page.html", matches=one.matches if chips else None)
    return (folder / "page.html").read_text()


def test_every_candidate_is_in_the_json_and_the_counts_agree(plain: Case) -> None:
    document = json.loads(json.dumps(plain.report.to_json(), allow_nan=False))
    jsonschema.validate(document, SCHEMA, cls=jsonschema.Draft202012Validator)
    matching = document["matching"]
    assert len(matching["candidates"]) == matching["tried"] == 46
    kept = [one for one in matching["candidates"] if one["reason"] is None]
    assert len(kept) == matching["kept"] == 40
    assert {one["id"] for one in kept} == {one["id"] for one in document["adjustment"]["points"]}
    for reason, count in matching["reasons"].items():
        assert sum(one["reason"] == reason for one in matching["candidates"]) == count
    # What could not be measured has no score: null, not NaN.
    assert [one["score"] for one in matching["candidates"] if one["reason"] == "not measured"] == [None]
    assert SceneReport.read(document).to_json() == document


def test_the_map_shows_each_match_once_where_it_is(plain: Case) -> None:
    root = ElementTree.fromstring(plots(plain.report)["matches"].svg())
    svg = "{http://www.w3.org/2000/svg}"
    dots = [one for one in root.iter(f"{svg}circle") if one.get("class") == "control-head"]
    squares = [one for one in root.iter(f"{svg}rect") if one.get("class") == "check-head"]
    # One more of each in the legend.
    assert (len(dots) - 1, len(squares) - 1) == (32, 8)
    places = np.array([[float(one.get(axis)) for axis in ("cx", "cy")] for one in dots[:-1]])
    image = np.array([
        one.image for one in plain.report.adjustment.points if one.role == "control"
    ])  # fmt: skip
    places, image = (part[np.argsort(part[:, 1])] for part in (places, image))
    scale = (places[-1] - places[0]) / (image[-1] - image[0])
    assert scale[0] == pytest.approx(scale[1], rel=0.01)
    np.testing.assert_allclose(places - places[0], (image - image[0]) * scale[1], atol=0.15)
    texts = [one.text or "" for one in root.iter(f"{svg}text")]
    for reason in WHY:
        assert f"{WHY.count(reason)} {REASONS[reason]}" in texts
    # Fields have as many as were kept in each.
    kept = [int(title.text.split()[0]) for title in root.iter(f"{svg}title") if title.text.endswith("kept")]
    assert sum(kept) == 40


def test_fields_without_matches_are_not_shaded(plain: Case) -> None:
    coverage = plain.report.matching.coverage
    svg = plots(plain.report)["matches"].svg()
    shades = [float(value) for value in re.findall(r'class="plus"[^>]*fill-opacity="([\d.]+)"', svg)]
    counts = np.array(coverage.kept).ravel()
    np.testing.assert_allclose(shades, 0.3 * counts / counts.max(), atol=6e-4)


def test_histograms_are_along_and_across_the_line_of_sight(plain: Case) -> None:
    names, found = residuals_by_axis(plain.report)
    assert names == ("along the line of sight", "across the line of sight")
    # Along: the direction in which the model moves a point that is raised, by differences.
    ground, metre = plain.fit.points.ground, np.array([0.0, 0.0, 1.0])
    up = plain.fit.model.ground_to_image(ground + metre) - plain.fit.model.ground_to_image(ground - metre)
    axis = up / np.linalg.norm(up, axis=1, keepdims=True)
    along = (plain.fit.residuals * axis).sum(axis=1)
    np.testing.assert_allclose(sorted(vector[0] for _, vector in found), sorted(along), atol=1e-6)
    svg = plots(plain.report)["match_histograms"].svg()
    for part in svg.split("across the line of sight, px</text>"):
        # A bar of control and one of check on top of it say the same.
        bars = set(re.findall(r"<title>(\S+ to \S+) px: (\d+) control, (\d+) check", part))
        assert [sum(int(bar[k]) for bar in bars) for k in (1, 2)] == [32, 8]


def test_straight_down_the_histograms_are_of_columns_and_rows(plain: Case, tmp_path: Path) -> None:
    points = [one.replaced(view_residual=None) for one in plain.report.adjustment.points]
    adjustment = plain.report.adjustment.replaced(points=tuple(points))
    down = Case(plain.matches, plain.fit, plain.report.replaced(adjustment=adjustment))
    names, found = residuals_by_axis(down.report)
    assert names == ("column", "row")
    np.testing.assert_allclose(
        sorted(vector for _, vector in found), sorted(map(tuple, plain.fit.residuals.tolist())), atol=1e-12
    )
    assert "in columns and rows: the view is straight down" in page_of(down, tmp_path)
    assert "straight down, and no height" not in page_of(plain, tmp_path)


def test_the_gallery_shows_the_worst_first_and_their_own_chips(plain: Case) -> None:
    found = gallery(plain.report, plain.matches)
    lengths = np.sort(np.hypot(*plain.fit.residuals.T))[::-1]
    np.testing.assert_allclose([tile.residual for tile in found.worst], lengths[:24])
    assert (found.kept, found.tried_rejected) == (40, 6)
    # Chips that the reference never showed cannot be shown; what has no score comes last.
    assert [tile.reason for tile in found.rejected][-1] == REASONS["not measured"]
    assert (found.rejected[-1].score, found.rejected[-1].found) == (None, None)
    scores = [tile.score for tile in found.rejected[:-1]]
    assert len(scores) == 3
    assert scores == sorted(scores, reverse=True)
    pixels = decoded(found.picture)
    assert found.size == (pixels.shape[2], pixels.shape[1])
    ids = dict(zip([f"m{cell}" for cell in plain.matches.cell], range(46), strict=True))
    for tile in (*found.worst, *found.rejected):
        index = ids[tile.id]
        for (left, top), chips in ((tile.scene, plain.matches.scene), (tile.reference, plain.matches.target)):
            grey = pixels[0, top : top + SIDE, left : left + SIDE].astype(float)
            chip = chips[index].astype(float)
            low, high = np.percentile(chip, [2, 98])
            np.testing.assert_allclose(grey, 255 * np.clip((chip - low) / (high - low), 0, 1), atol=1.01)
        if tile.found is not None:
            np.testing.assert_allclose(tile.found, SIDE / 2 + plain.matches.found[index])


def decoded(picture: str) -> np.ndarray:
    gdal.FileFromMemBuffer("/vsimem/gallery.png", base64.b64decode(picture))
    try:
        return gdal.Open("/vsimem/gallery.png").ReadAsArray()
    finally:
        gdal.Unlink("/vsimem/gallery.png")


def test_what_a_chip_does_not_show_is_transparent(plain: Case) -> None:
    target = plain.matches.target.copy()
    target[:, :, :5] = np.nan
    found = gallery(plain.report, dataclasses.replace(plain.matches, target=target))
    left, top = found.worst[0].reference
    alpha = decoded(found.picture)[1, top : top + SIDE, left : left + SIDE]
    assert (alpha[:, :5] == 0).all()
    assert (alpha[:, 5:] == 255).all()


def test_what_the_adjustment_left_out_is_said(tmp_path: Path) -> None:
    one = case(blunder=40.0)
    out = [point.id for point in one.report.adjustment.points if point.kind == "out"]
    assert out == ["m0"]
    worst = gallery(one.report, one.matches).worst[0]
    assert (worst.id, worst.kind) == ("m0", "rejected by the adjustment")
    page = page_of(one, tmp_path)
    assert "1 rejected by the adjustment" in page
    # It has no part in the histograms, and does not shorten the vectors of the others.
    assert len(residuals_by_axis(one.report)[1]) == 39


def test_names_of_files_and_points_are_text(tmp_path: Path) -> None:
    points = control(40)
    points = dataclasses.replace(points, ids=(HOSTILE, *points.ids[1:]))
    one = case(points=points, reference=f"{HOSTILE}.tif", rejected=3)
    page = page_of(one, tmp_path)
    assert page.count("<script") == 1
    assert "&lt;script&gt;" in page


def test_the_page_needs_nothing_and_stays_small(tmp_path: Path) -> None:
    one = case(500, 100)
    page = page_of(one, tmp_path)
    assert len(page) < 1_000_000
    assert re.findall(r'(?:src|href)="(?!#)([^,"]*)', page) == ["data:image/png;base64"]
    assert "url(" not in page
    assert page.count("<script") == 1
    # Each chip has words for those who do not see it.
    assert page.count('aria-label="Scene at m') == page.count('aria-label="Reference at m') == 32
    assert "24 of 500 matches: those with the largest residuals" in page
    assert "8 of 100 rejected" in page


def test_a_report_that_is_read_again_draws_the_same(plain: Case, tmp_path: Path) -> None:
    reports.write_report_json(plain.report, tmp_path / "report.json")
    again = plots(reports.read_report(tmp_path / "report.json"))
    for name in ("matches", "match_histograms"):
        assert again[name].svg() == plots(plain.report)[name].svg()
    assert {"matches", "match_histograms"} <= set(reports.write_plots(plain.report, tmp_path, "scene"))


def test_without_chips_the_page_has_the_plots_alone(plain: Case, tmp_path: Path) -> None:
    page = page_of(plain, tmp_path, chips=False)
    assert 'data-plot="matches"' in page
    assert "largest residuals" not in page


def test_without_a_matching_there_is_nothing_of_it(plain: Case, tmp_path: Path) -> None:
    bare = Case(plain.matches, plain.fit, plain.report.replaced(matching=None))
    assert not {"matches", "match_histograms"} & set(plots(bare.report))
    page = page_of(bare, tmp_path)
    assert "<h2>Matching</h2>" not in page
    assert 'class="chips"' not in page


def test_two_of_a_name_keep_their_own_residuals(plain: Case) -> None:
    # Beside points of a file called m0, m1, ... matches are renamed; the gallery names them as the tables do.
    points = tuple(one.replaced(id=f"m{one.id}") for one in plain.report.adjustment.points)
    adjustment = plain.report.adjustment.replaced(points=points)
    renamed = gallery(plain.report.replaced(adjustment=adjustment), plain.matches)
    first = gallery(plain.report, plain.matches)
    assert [f"m{tile.id}" for tile in first.worst] == [tile.id for tile in renamed.worst]
    assert [tile.residual for tile in first.worst] == [tile.residual for tile in renamed.worst]
