"""The raster of accuracy as `rectify` makes it: what it rests on, what it says where something is not known."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.report.document import read_report

OUTPUT = OutputOptions(resolution=10.0, crs="EPSG:32634", accuracy_raster=True, layer_step=4)


def rectified(tiny, folder, *, points=None, sigma=4.0, scene=SceneOptions(), output=OUTPUT):
    return commands.rectify(
        tiny.image, folder, scene=scene, output=output,
        points=points or PointOptions(), surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid", sigma=sigma),
    )  # fmt: skip


def ce90(result) -> np.ndarray:
    return gdal.Open(str(result.files["accuracy"])).ReadAsArray()[3]


@pytest.fixture
def points(tiny):
    return PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid", correction="affine")


def test_the_layer_stands_beside_the_ortho_and_the_report_says_what_dominates(tiny, points, tmp_path):
    result = rectified(
        tiny, tmp_path / "out", points=points,
        output=dataclasses.replace(OUTPUT, stac=True, acquired="2020-01-01T00:00:00Z"),
    )  # fmt: skip
    ortho, layer = (gdal.Open(str(result.files[name])) for name in ("ortho", "accuracy"))
    assert layer.RasterXSize == -(-ortho.RasterXSize // 4)
    assert layer.GetGeoTransform()[0] == ortho.GetGeoTransform()[0]
    assert layer.GetMetadataItem("LAYOUT", "IMAGE_STRUCTURE") == "COG"
    report = read_report(result.files["report"])
    found = report.accuracy
    assert found is not None
    assert sum(found.shares.values()) == pytest.approx(1.0)
    assert max(found.shares, key=found.shares.__getitem__) in ("points", "heights")
    assert found.unknown == ()
    assert report.headline.notes[0] == found.statement
    assert f"{found.ce90_m:.2f} m" in found.statement
    assert "Accuracy of each place" in result.files["html"].read_text()
    stops = result.files["accuracy_style"].read_text()
    assert 'band="4"' in stops
    item = json.loads(result.files["stac"].read_text())
    assert item["assets"]["accuracy"]["href"] == "./tiny_accuracy.tif"
    # What the ortho shows has an accuracy: the two masks agree but for the pixels at the rim.
    shown = ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    middle = shown[2::4, 2::4]
    known = np.isfinite(layer.ReadAsArray()[3])[: middle.shape[0], : middle.shape[1]]
    assert (middle != known).mean() < 0.05


def test_a_point_without_redundancy_has_its_own_accuracy(tiny, tmp_path):
    """One point and a shift: 0.5 px of 4.8 m on either axis, from the points or from the model file."""
    tiny.write(tiny.gcps, [(*row, 0.5) for row in tiny.points(1)], header="id,col,row,x,y,h,sigma_image")
    point = PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid", correction="shift")
    first = rectified(tiny, tmp_path / "first", points=point, sigma=0.01)
    again = rectified(tiny, tmp_path / "again", scene=SceneOptions(model=first.files["model"]), sigma=0.01)
    for result in (first, again):
        found = ce90(result)
        np.testing.assert_allclose(found[np.isfinite(found)], 0.5 * 4.8 * math.sqrt(2 * math.log(10)), rtol=0.02)


def test_a_model_file_knows_how_good_its_parameters_were(tiny, points, tmp_path):
    first = rectified(tiny, tmp_path / "first", points=points)
    again = rectified(tiny, tmp_path / "again", scene=SceneOptions(model=first.files["model"]))
    np.testing.assert_allclose(ce90(again), ce90(first), rtol=1e-3)


def test_what_a_vendor_states_stands_for_a_model_that_nobody_adjusted(tiny, tmp_path):
    stated = write_rpc(tiny, tmp_path, err_bias=6.0, err_rand=2.5)
    result = rectified(tiny, tmp_path / "out", scene=stated, sigma=0.01)
    # 6.5 m on either axis on level ground; slopes of up to 0.067 change it by up to 2.4 %, as rays lean by 0.36.
    made, level = ce90(result)[np.isfinite(ce90(result))], 6.5 * math.sqrt(2 * math.log(10))
    np.testing.assert_allclose(made, level, rtol=0.025)
    np.testing.assert_allclose(made.mean(), level, rtol=2e-3)
    found = read_report(result.files["report"]).accuracy
    assert max(found.shares, key=found.shares.__getitem__) == "model"
    assert any("vendor" in one for one in found.assumptions)


def write_rpc(tiny, folder, **errors) -> SceneOptions:
    write_rpc_txt(dataclasses.replace(tiny.model, **errors), folder / "stated_RPC.TXT")
    return SceneOptions(rpc=str(folder / "stated_RPC.TXT"))


def test_a_layer_that_knows_only_a_part_says_so(tiny, points, tmp_path):
    only_heights = rectified(tiny, tmp_path / "heights", scene=write_rpc(tiny, tmp_path, err_bias=-1.0))
    only_model = rectified(tiny, tmp_path / "model", points=points, sigma=None)
    for result, missing in ((only_heights, "model"), (only_model, "heights")):
        report = read_report(result.files["report"])
        assert report.accuracy.unknown == (missing,)
        assert "at least" in report.accuracy.statement
        assert [one for one in result.document["report"]["notices"] if one["code"] == "accuracy-in-part"]
        assert gdal.Open(str(result.files["accuracy"])).GetMetadataItem("UNKNOWN") == missing
    assert report.accuracy.shares["heights"] == 0.0


def test_nothing_known_is_refused_before_the_first_pixel(tiny, tmp_path):
    with pytest.raises(InputError) as caught:
        rectified(tiny, tmp_path / "out", sigma=None)
    assert caught.value.field == "output.accuracy_raster"
    assert not list((tmp_path / "out").glob("*_ortho.tif"))
    with pytest.raises(InputError):
        commands.check(tiny.image, surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), output=OUTPUT)


def test_a_run_without_the_layer_removes_that_of_an_earlier_one(tiny, points, tmp_path):
    first = rectified(tiny, tmp_path / "out", points=points)
    assert first.files["accuracy"].exists()
    rectified(tiny, tmp_path / "out", points=points, output=dataclasses.replace(OUTPUT, accuracy_raster=False))
    assert not first.files["accuracy"].exists()
    assert not first.files["accuracy_style"].exists()


@pytest.mark.parametrize("count", [2, 4])
def test_few_points_do_not_enlarge_the_error_of_their_reference(tiny, tmp_path, count):
    """Exact points whose reference is accurate to 5 m: 5 m on either axis, whatever their number tells of sigma0."""
    header = "id,col,row,x,y,h,sigma_image,sigma_common"
    tiny.write(tiny.gcps, [(*row, 0.01, 5.0) for row in tiny.points(count)], header=header)
    point = PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid", correction="shift")
    first = rectified(tiny, tmp_path / "first", points=point, sigma=0.01)
    again = rectified(tiny, tmp_path / "again", scene=SceneOptions(model=first.files["model"]), sigma=0.01)
    for result in (first, again):
        found = ce90(result)
        np.testing.assert_allclose(found[np.isfinite(found)], 5.0 * math.sqrt(2 * math.log(10)), rtol=0.03)
