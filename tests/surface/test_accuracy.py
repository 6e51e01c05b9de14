"""A DEM against check heights: what was put into a DEM is found, by slope, in any CRS and height datum."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal, osr

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.surface.accuracy import DemAccuracy, HeightErrors, check_dem, read_check_heights, slopes_at, summary
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem

UTM = "EPSG:32634"
WEST, NORTH, STEP, SIDE = 500_000.0, 4_000_000.0, 10.0, 300
#: Slopes (degrees) of the three strips of the terrain, each a third of its width.
STRIPS = (2.0, 15.0, 35.0)


def terrain(x):
    """Return heights over x: three planes, one after the other, that rise eastwards."""
    along = x - WEST
    third = SIDE * STEP / 3
    return 100.0 + sum(
        np.tan(np.radians(slope)) * np.clip(along - k * third, 0, third) for k, slope in enumerate(STRIPS)
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A DEM 1.5 m too high that lies 4 m too far east, above EGM96, and 600 check points with 0.1 m of noise."""
    folder = tmp_path_factory.mktemp("dem")
    random = np.random.default_rng(5)
    x = WEST + STEP * (np.arange(SIDE) + 0.5)
    heights = np.tile(terrain(x - 4.0) + 1.5, (SIDE, 1)).astype(np.float32)
    dataset = gdal.GetDriverByName("GTiff").Create(str(folder / "dem.tif"), SIDE, SIDE, 1, gdal.GDT_Float32)
    dataset.SetGeoTransform((WEST, STEP, 0, NORTH, 0, -STEP))
    system = osr.SpatialReference()
    system.ImportFromEPSG(32634)
    dataset.SetSpatialRef(system)
    dataset.WriteArray(heights)
    dataset = None
    east = random.uniform(WEST + 100, WEST + SIDE * STEP - 100, 600)
    north = random.uniform(NORTH - SIDE * STEP + 100, NORTH - 100, 600)
    measured = terrain(east) + random.normal(0, 0.1, 600)
    lines = ["#vertical: egm96", f"#CRS: {UTM}", "id,x,y,h"]
    lines += [f"c{k},{a:.3f},{b:.3f},{h:.3f}" for k, (a, b, h) in enumerate(zip(east, north, measured, strict=True))]
    (folder / "heights.csv").write_text("\n".join(lines) + "\n")
    return folder


def opened(made, **options):
    return open_dem(made / "dem.tif", Vertical.parse("egm96"), **options)


def test_the_error_of_each_class_of_slope_is_found(made):
    """A shift of 4 m in plan is 4 m times the tangent of the slope in height, in addition to the bias of 1.5 m."""
    ground, crs, ids = read_check_heights(made / "heights.csv")
    found = check_dem(opened(made), ground, crs, ids)
    assert found.overall.count == 600
    expected = {(0.0, 5.0): 2.0, (10.0, 20.0): 15.0, (30.0, None): 35.0}
    seen = {(low, high): errors for low, high, errors in found.by_slope() if errors.count > 20}
    assert set(seen) == set(expected)
    for limits, slope in expected.items():
        errors, bias = seen[limits], 1.5 - 4.0 * np.tan(np.radians(slope))
        # 200 points of 0.1 m: the median is known to 0.01 m; the geoid of both is the same within a millimetre.
        assert errors.median == pytest.approx(bias, abs=0.03)
        assert errors.nmad == pytest.approx(0.1, rel=0.25)
        assert errors.le90 == pytest.approx(abs(bias) + 1.2816 * 0.1, abs=0.05)


def test_statistics_are_by_their_definitions():
    """The sizes count, not the signs: of 100 differences ten are beyond LE90, and the worst is one below zero."""
    differences = np.random.default_rng(3).permutation(np.r_[-np.arange(1.0, 51.0) * 2, np.arange(50.0)])
    found = HeightErrors.of(differences)
    assert found.largest == -100.0
    assert (np.abs(differences) > found.le90).sum() == 10
    assert found.mean == pytest.approx(-1325 / 100)
    assert found.rmse**2 == pytest.approx((4 * 42925 + 40425) / 100)
    assert (differences < found.median).sum() == (differences > found.median).sum() == 50
    # 1.4826 times the median distance is the standard deviation of normal errors, whatever their mean.
    normal = HeightErrors.of(np.random.default_rng(4).normal(7.0, 2.0, 20_000))
    assert normal.nmad == pytest.approx(2.0, rel=0.03)


def test_what_is_far_from_the_median_is_gross_whatever_the_bias_is():
    """Farther than five NMAD; the NMAD is 1.4826 times 0.5 m here, and the DEM is 20 m too high."""
    usual = 20.0 + np.linspace(-1, 1, 101)
    differences = np.r_[usual, 20.0 + np.array([3.6, -3.6, 3.9, -3.9]), np.nan]
    ids = [f"p{k}" for k in range(len(differences))]
    found = DemAccuracy(ids, differences, np.zeros(len(ids)))
    assert found.overall.nmad == pytest.approx(1.4826 * 0.52, abs=0.02)
    assert found.gross() == ["p103", "p104"]
    assert DemAccuracy(ids[:2], np.array([0.0, 9.0]), np.zeros(2)).gross() == []


@pytest.mark.parametrize(("count", "given"), [(1, ()), (2, ()), (3, ("nmad",)), (9, ("nmad",)), (10, ("nmad", "le90"))])
def test_few_differences_have_few_statistics(count, given):
    found = HeightErrors.of(np.arange(1.0, count + 1))
    assert (found.count, found.mean, found.largest) == (count, (count + 1) / 2, count)
    assert tuple(name for name in ("nmad", "le90") if getattr(found, name) is not None) == given


def test_classes_of_slope_begin_at_their_lower_limit():
    slopes = np.array([0.0, 4.9, 5.0, 9.9, 10.0, 20.0, 29.9, 30.0, 80.0, 5.0, np.nan])
    differences = np.r_[np.ones(9), np.nan, 1.0]
    rows = DemAccuracy([str(k) for k in range(11)], differences, slopes).by_slope()
    limits = [(low, high, errors.count) for low, high, errors in rows]
    assert limits == [(0.0, 5.0, 2), (5.0, 10.0, 2), (10.0, 20.0, 1), (20.0, 30.0, 2), (30.0, None, 2)]


@pytest.mark.parametrize("towards", [0.0, 35.0, 90.0, 200.0])
def test_a_plane_has_its_slope_whichever_way_it_rises(tmp_path, towards):
    """A quarter: the tangent of the slope."""
    east, north = np.sin(np.radians(towards)), np.cos(np.radians(towards))
    x, y = np.meshgrid(10.0 * np.arange(60), -10.0 * np.arange(60))
    write_dem(tmp_path / "dem.tif", 900 + 0.25 * (east * x + north * y), (WEST, NORTH), 10.0, UTM)
    place = np.array([[WEST + 300.0, NORTH - 300.0, 0.0], [WEST + 100.0, NORTH - 450.0, 0.0]])
    lonlat = ground_transform(parse_crs(UTM), "EPSG:4979")(place)[:, :2]
    found = slopes_at(open_dem(tmp_path / "dem.tif", "ellipsoid"), lonlat)
    np.testing.assert_allclose(found, np.degrees(np.arctan(0.25)), atol=0.01)


def test_the_summary_counts_what_has_no_height():
    errors = DemAccuracy(["a", "b", "c"], np.array([1.0, np.nan, -2.0]), np.array([3.0, 3.0, 40.0]))
    lines = summary(errors.to_json()).splitlines()
    assert "without a height in the DEM, or of their own: 1" in lines
    assert [line.split()[:2] for line in lines[1:4]] == [["0-5°", "1"], ["over", "30°"], ["all", "2"]]
    assert lines[3].split()[2:] == ["-0.50", "1.58", "-0.50", "-", "-", "-2.00"]
    whole = summary(DemAccuracy(["a"], np.ones(1), np.ones(1)).to_json())
    assert "without a height" not in whole
    assert "without a slope" not in whole


def test_the_summary_counts_what_has_no_slope():
    """Otherwise the rows of slopes have fewer points than that of all."""
    text = summary(DemAccuracy(["a", "b", "c"], np.array([1.0, 2.0, -2.0]), np.array([3.0, np.nan, 40.0])).to_json())
    assert "so without a slope: 1 (only in the row of all)" in text


def test_slopes_are_those_of_the_terrain(made):
    surface = opened(made)
    lonlat, _, _ = read_check_heights(made / "heights.csv")
    degrees = slopes_at(surface, ground_transform(parse_crs(UTM), "EPSG:4979")(lonlat)[:, :2])
    third = SIDE * STEP / 3
    for k, slope in enumerate(STRIPS):
        inside = np.abs(lonlat[:, 0] - WEST - (k + 0.5) * third) < third / 2 - 3 * STEP
        np.testing.assert_allclose(degrees[inside], slope, atol=0.05)


def test_another_datum_of_the_points_is_undone(made, tmp_path):
    text = (made / "heights.csv").read_text().splitlines()
    ground, _, _ = read_check_heights(made / "heights.csv")
    rows = [line.rsplit(",", 1)[0] + f",{h:.3f}" for line, h in zip(text[3:], ground[:, 2], strict=True)]
    path = tmp_path / "ellipsoidal.csv"
    path.write_text("\n".join(["#vertical: ellipsoid", *text[1:3], *rows]))
    again, crs, ids = read_check_heights(path)
    one, other = check_dem(opened(made), ground, crs, ids), check_dem(opened(made), again, crs, ids)
    np.testing.assert_allclose(one.differences, other.differences, atol=2e-3)


def test_a_point_without_a_height_is_counted_and_not_compared(made, tmp_path):
    """GeoJSON needs no heights; those that it has are ellipsoidal."""
    lonlat = ground_transform(parse_crs(UTM), "EPSG:4979")([[WEST + 300, NORTH - 500, 0], [WEST + 400, NORTH - 500, 0]])
    places = [[*lonlat[0, :2], 140.0], lonlat[1, :2].tolist()]
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": {"id": f"c{k}"}}
        for k, place in enumerate(places)
    ]
    (tmp_path / "heights.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    ground, crs, ids = read_check_heights(tmp_path / "heights.geojson")
    assert ids == ("c0", "c1")
    found = check_dem(opened(made), ground, crs, ids)
    assert (found.overall.count, found.to_json()["without_height"]) == (1, 1)
    expected = opened(made).heights(lonlat[:1, :2], "EPSG:4979")[0] - 140.0
    np.testing.assert_allclose(found.differences, [expected, np.nan], atol=1e-6)


def test_gross_errors_and_points_off_the_dem_are_told(made, tmp_path):
    path = tmp_path / "points.csv"
    more = [f"wild,{WEST + 500},{NORTH - 500},999", f"away,{WEST - 9000},{NORTH - 500},100"]
    head = (made / "heights.csv").read_text().splitlines()[:60]
    path.write_text("\n".join([*head, *more]) + "\n")
    done = CliRunner().invoke(
        cli, ["dem-check", str(made / "dem.tif"), "--points", str(path), "--dem-vertical", "egm96", "--json"]
    )
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["gross"] == ["wild"]
    assert document["without_height"] == 1
    assert document["overall"]["count"] == 58
    text = CliRunner().invoke(
        cli, ["dem-check", str(made / "dem.tif"), "--points", str(path), "--dem-vertical", "egm96"]
    )
    assert "far from all others (they count all the same): wild" in text.stdout


def test_gcps_of_an_image_are_check_heights_too(tiny):
    datums = ["--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid", "--dem-vertical", "ellipsoid"]
    done = CliRunner().invoke(cli, ["dem-check", str(tiny.dem), "--points", str(tiny.gcps), *datums, "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["overall"]["count"] == 12


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("id,x,y\na,1,2\n", "no column h"),
        ("id,x,y,h\na,500100,3999900,\n", "not a number"),
    ],
)
def test_points_without_heights_are_refused(tmp_path, rows, said):
    path = tmp_path / "p.csv"
    path.write_text(rows)
    with pytest.raises(InputError, match=said):
        read_check_heights(path, UTM, "ellipsoid")


def test_a_datum_is_never_guessed(made):
    done = CliRunner().invoke(cli, ["dem-check", str(made / "dem.tif"), "--points", str(made / "heights.csv")])
    assert done.exit_code == 2
    assert "--dem-vertical" in done.output + done.stderr
