"""What control covers of an image, and which sides are named as empty."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.options import PointOptions, SurfaceOptions
from ortho_pipeline.points.control_hull import COVERED, control_hull, empty_parts, outside_of_hull, uncovered

SIZE = (1000, 800)


def grid(columns: int, rows: int, box: tuple[float, float, float, float] = (0, 0, 1, 1)) -> np.ndarray:
    """Return points in the middles of the cells that divide a box of the image (parts of its size)."""
    x = box[0] + (np.arange(columns) + 0.5) / columns * (box[2] - box[0])
    y = box[1] + (np.arange(rows) + 0.5) / rows * (box[3] - box[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) * SIZE


@pytest.mark.parametrize("n", [1, 2, 3, 5, 10])
def test_an_even_grid_covers_the_image_whatever_its_number(n):
    share, empty = empty_parts(grid(n, n), SIZE)
    # Only the rounded corners of the margin are missing: (1 - pi / 4) of a cell's area.
    assert share == pytest.approx(1 - (1 - np.pi / 4) / n**2, abs=2e-3)  # the circle is a polygon
    assert not uncovered(grid(n, n), SIZE)
    assert len(empty) == 4


@pytest.mark.parametrize(
    ("box", "empty"),
    [
        ((0, 0, 0.4, 1), "right"),
        ((0.6, 0, 1, 1), "left"),
        ((0, 0, 1, 0.4), "bottom"),
        ((0, 0.6, 1, 1), "top"),
        ((0.4, 0.4, 0.6, 0.6), "all around"),
        ((0, 0.4, 1, 0.6), "top and bottom"),
    ],
)
def test_the_empty_side_is_named(box, empty):
    (said,) = uncovered(grid(5, 5, box), SIZE)
    assert f"empty: {empty}." in said
    assert "add points there" in said


def test_a_missing_corner_is_named_and_not_warned_of():
    points = grid(6, 6)
    inside = (points < np.array(SIZE) * 0.7).all(axis=1)
    share, empty = empty_parts(points[~inside], SIZE)
    assert "top left" in empty
    assert COVERED < share < 0.95


def test_the_hull_is_that_of_the_report():
    found = control_hull(np.array([(0, 0), (500, 0), (500, 800), (0, 800.0)]), SIZE)
    assert (found.share, found.n) == (0.5, 4)
    assert control_hull(np.zeros((2, 2)), SIZE) is None
    assert control_hull(np.array([(0, 0), (1, 1), (2, 2.0)]), SIZE).outline == ()


def left_half(tiny, tmp_path):
    lines = tiny.gcps.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    columns = lines[at].split(",")
    kept = [line for line in lines[at + 1 :] if float(line.split(",")[columns.index("col")]) < 0.5 * tiny.width]
    path = tmp_path / "left.csv"
    path.write_text("\n".join([*lines[: at + 1], *kept]) + "\n")
    return PointOptions(gcps=path, crs="EPSG:4979", vertical="ellipsoid")


def test_fit_rectify_and_compare_say_so(tiny, tmp_path):
    points = left_half(tiny, tmp_path)
    assert any("empty: right." in text for text in commands.fit(tiny.image, points).warnings)
    made = commands.rectify(tiny.image, tmp_path, points=points, surface=SurfaceOptions(height=0.0))
    assert any("empty: right." in text for text in json.loads(made.files["report"].read_text())["warnings"])
    notes = commands.compare(tiny.image, points, models="rpc,rpc+shift").to_json()["warnings"]
    assert any("empty: right." in text for text in notes)
    order = [
        "compare",
        str(tiny.image),
        "--gcps",
        str(points.gcps),
        "--points-crs",
        "EPSG:4979",
        "--models",
        "rpc+shift",
    ]
    done = CliRunner().invoke(cli, [*order, "--points-vertical", "ellipsoid"])
    assert done.exit_code == 0, done.output
    assert "empty: right." in done.output
    # Nothing is adjusted: nothing is extrapolated.
    plain = PointOptions(gcps=points.gcps, crs="EPSG:4979", vertical="ellipsoid", correction="none")
    assert not any("empty:" in text for text in commands.fit(tiny.image, plain).warnings)
    everywhere = PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid")
    assert not any("empty:" in text for text in commands.fit(tiny.image, everywhere).warnings)


def test_points_are_outside_if_they_are_farther_than_half_the_spacing_from_the_hull():
    # Four points on 100 x 100 px have a spacing of 50 px, so the hull is widened by 25 px, round at its corners.
    control = np.array([(0.0, 0.0), (100, 0), (100, 100), (0, 100)])
    places = np.array([(50.0, 50), (124, 50), (126, 50), (50, -24), (50, -26), (117, 117), (118, 118)])
    assert outside_of_hull(control, places).tolist() == [False, False, True, False, True, False, True]
    assert outside_of_hull(control, np.zeros((0, 2))).shape == (0,)
    assert outside_of_hull(np.zeros((0, 2)), places).tolist() == [False] * 7


def test_the_hull_counts_inside_the_image_only():
    beyond = control_hull(np.array([(-500.0, 0.0), (500, 0), (500, 800), (-500, 800)]), SIZE)
    assert beyond.share == pytest.approx(0.5)
    assert set(beyond.outline) == {(-500.0, 0.0), (500.0, 0.0), (500.0, 800.0), (-500.0, 800.0)}
    triangle = control_hull(np.array([(0.0, 0.0), (1000, 0), (0, 800)]), SIZE)
    assert (triangle.share, triangle.n, len(triangle.outline)) == (pytest.approx(0.5), 3, 3)


def test_without_points_everything_is_empty():
    assert empty_parts(np.zeros((0, 2)), (100, 80)) == (0.0, ("everywhere",))
    assert control_hull(np.array([[1.0, 2.0], [3.0, 4.0]]), (100, 80)) is None
    line = control_hull(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), (100, 80))
    assert (line.share, line.n, line.outline) == (0.0, 3, ())
    assert not outside_of_hull(np.zeros((0, 2)), np.ones((3, 2))).any()
