"""Whole jobs of the commands, and the traps in which programs of this kind go wrong silently."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

import ortho_pipeline
from ortho_pipeline import commands, host
from ortho_pipeline.commands import inputs, results
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import CoverageError, DatumError, DegeneratePoints, InputError, PluginError
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.exchange.rpc import export_rpc, read_rpc, rpc_metadata, write_rpc_txt
from ortho_pipeline.models import KINDS
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions

CRS = "EPSG:4979"


def points_of(tiny: Any, path: Path | None = None, **options: Any) -> PointOptions:
    return PointOptions(gcps=path or tiny.gcps, crs=CRS, vertical="ellipsoid", **options)


def dem_of(tiny: Any, **options: Any) -> SurfaceOptions:
    return SurfaceOptions(**{"dem": tiny.dem, "vertical": "ellipsoid", **options})


def rectify(tiny: Any, folder: Path, **options: Any) -> results.Result:
    given = {"points": points_of(tiny), "surface": dem_of(tiny), **options}
    return commands.rectify(tiny.image, folder, **given)


def valid(path: Path) -> np.ndarray:
    """Return the mask of an ortho; the dataset has to outlive its bands."""
    dataset = gdal.Open(str(path))
    return dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0


# -- the whole job ---------------------------------------------------------------------------------------------------


def test_rectify_writes_everything_and_finds_the_bias(tiny, tmp_path):
    result = rectify(tiny, tmp_path / "out")
    assert {path.name for path in result.files.values()} == {
        "tiny_ortho.tif", "tiny_model.json", "tiny_RPC.TXT", "tiny.vrt", "tiny_residuals.geojson", "tiny_residuals.qml",
        "tiny_report.json", "tiny_report.html",
    }  # fmt: skip
    assert all(path.stat().st_size > 0 for path in result.files.values())
    saved = read_model_file(result.files["model"])
    np.testing.assert_allclose(saved.model.params, tiny.bias, atol=0.15)
    assert saved.size == (tiny.width, tiny.height)
    json.loads(result.files["report"].read_text())
    assert len(result.summary.splitlines()) <= 40


def test_the_ortho_has_no_sensor_model_and_a_grid_of_whole_pixels(tiny, tmp_path):
    ortho = gdal.Open(str(rectify(tiny, tmp_path / "out").files["ortho"]))
    assert not ortho.GetMetadata("RPC")
    left, dx, _, top, _, dy = ortho.GetGeoTransform()
    assert dx == pytest.approx(4.8)
    assert left / dx == pytest.approx(round(left / dx), abs=1e-6)
    assert top / dy == pytest.approx(round(top / dy), abs=1e-6)
    assert "34S" in ortho.GetProjection()


def test_a_bright_pixel_lands_on_its_ground_point(tiny, tmp_path):
    flat = SurfaceOptions(height=500.0)
    image = gdal.Open(str(tiny.image), gdal.GA_Update)
    pixels = np.full((tiny.height, tiny.width), 100, dtype=np.uint16)
    pixels[120, 210] = 60000
    image.WriteArray(pixels)
    image = None
    output = OutputOptions(resolution=1.0, resampling="nearest")
    result = rectify(tiny, tmp_path / "out", points=PointOptions(), surface=flat, output=output)
    ortho = gdal.Open(str(result.files["ortho"]))
    rows, columns = np.nonzero(ortho.ReadAsArray() == 60000)
    left, dx, _, top, _, dy = ortho.GetGeoTransform()
    found = np.array([left + dx * (columns.mean() + 0.5), top + dy * (rows.mean() + 0.5)])
    truth = tiny.model.image_to_ground([[210.5, 120.5]], 500.0)
    expected = ortho_pipeline.geodesy.crs.ground_transform(CRS, "EPSG:32734")(truth)[0, :2]
    np.testing.assert_allclose(found, expected, atol=0.05 * 4.8 + 0.25)


def test_without_points_the_model_stays_as_delivered(tiny, tmp_path):
    result = rectify(tiny, tmp_path / "out", points=PointOptions())
    assert "residuals" not in result.files
    model = ortho_pipeline.load_model(result.files["model"])
    ground = [[20.001, -30.001, 480.0]]
    np.testing.assert_array_equal(model.ground_to_image(ground), tiny.model.ground_to_image(ground))


def test_the_saved_model_gives_the_same_ortho(tiny, tmp_path):
    first = rectify(tiny, tmp_path / "first")
    scene = SceneOptions(model=first.files["model"])
    again = rectify(tiny, tmp_path / "again", scene=scene, points=PointOptions())
    one, other = (gdal.Open(str(result.files["ortho"])).ReadAsArray() for result in (first, again))
    np.testing.assert_array_equal(one, other)
    with pytest.raises(InputError, match="twice"):
        rectify(tiny, tmp_path / "x", scene=scene, points=points_of(tiny, correction="shift"))


def test_a_saved_model_of_another_image_is_refused(tiny, tmp_path):
    model = rectify(tiny, tmp_path / "out").files["model"]
    other = tmp_path / "other.tif"
    gdal.Translate(str(other), str(tiny.image), srcWin=[0, 0, 100, 100])
    with pytest.raises(InputError, match="400 x 300"):
        commands.rectify(other, tmp_path / "x", scene=SceneOptions(model=model), surface=dem_of(tiny))


def test_both_engines_agree(tiny, tmp_path):
    grid = {"resolution": 4.8, "format": "GTiff"}
    ours, theirs = (
        gdal.Open(
            str(rectify(tiny, tmp_path / engine, output=OutputOptions(engine=engine, **grid)).files["ortho"])
        ).ReadAsArray().astype(int)
        for engine in ("ortho", "gdal")
    )  # fmt: skip
    inside = (ours > 0) & (theirs > 0)
    assert inside.mean() > 0.7
    assert (np.abs(ours - theirs)[inside] <= 1).mean() > 0.999


def test_the_engine_of_gdal_reports_how_far_its_rpc_is_off_the_model(tiny, tmp_path):
    """A model of the map has no exact RPC: the one that stands in is fitted."""
    output = OutputOptions(engine="gdal", format="GTiff")
    result = rectify(
        tiny, tmp_path / "gdal", points=points_of(tiny, fit_model="affine3d", model_crs="utm"), output=output
    )
    found = json.loads(result.files["report"].read_text())["warp"]["max_error_px"]
    model = read_model_file(result.files["model"]).model
    exported = export_rpc(model)
    assert not exported.exact
    # Not less than over the RPC's whole box, nor than what GDAL's transformer is off at the ortho.
    assert exported.max_error_px <= found < exported.max_error_px + 1e-3
    assert found > 0
    assert "GDAL's RPC transformer" in result.summary


def test_export_writes_every_format_exactly(tiny, tmp_path):
    result = commands.export(tiny.image, tmp_path / "out", points=points_of(tiny))
    assert result.document["exact"]
    fitted = commands.fit(tiny.image, points_of(tiny)).fit.model
    ground = np.array([[20.004, -30.003, 430.0], [19.996, -29.997, 610.0]])
    for name in ("rpc-txt", "rpb", "tag", "vrt"):
        if name == "vrt":
            domain = gdal.Open(str(result.files[name])).GetMetadata("RPC")
            assert float(domain["SAMP_OFF"].split()[0]) == pytest.approx(tiny.model.col_off - 0.5 + 3, abs=0.2)
            continue
        written = read_rpc(result.files[name])
        np.testing.assert_allclose(written.ground_to_image(ground), fitted.ground_to_image(ground), rtol=0, atol=1e-6)


# -- traps -----------------------------------------------------------------------------------------------------------


def test_an_old_side_car_that_would_attach_to_the_ortho_is_refused(tiny, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    stale = out / "tiny_ortho_RPC.TXT"
    stale.write_text("LINE_OFF: 1\n")
    with pytest.raises(InputError, match="sidecar file") as caught:
        rectify(tiny, out)
    assert caught.value.file == str(stale)


def test_a_dem_of_half_the_scene_is_refused_and_never_changes_the_grid(tiny, tmp_path):
    half = tiny.write_dem(tmp_path / "half.tif", share=0.5)
    with pytest.raises(CoverageError, match=r"covers (4|5)\d\.\d %"):
        rectify(tiny, tmp_path / "out", surface=dem_of(tiny, dem=half))
    whole = gdal.Open(str(rectify(tiny, tmp_path / "whole").files["ortho"]))
    masked = rectify(tiny, tmp_path / "masked", surface=dem_of(tiny, dem=half, fill="mask"))
    ortho = gdal.Open(str(masked.files["ortho"]))
    assert ortho.GetGeoTransform()[1] == whole.GetGeoTransform()[1]
    assert ortho.RasterXSize >= whole.RasterXSize
    assert ortho.RasterXSize - whole.RasterXSize < 0.2 * whole.RasterXSize


@pytest.mark.parametrize("fill", ["nearest", "500"])
def test_a_filled_dem_covers_all(tiny, tmp_path, fill):
    half = tiny.write_dem(tmp_path / "half.tif", share=0.5)
    result = rectify(tiny, tmp_path / "out", surface=dem_of(tiny, dem=half, fill=fill))
    assert valid(result.files["ortho"]).mean() > 0.7


def test_a_dem_of_unknown_datum_is_refused(tiny, tmp_path):
    with pytest.raises(DatumError, match="does not state its height datum"):
        rectify(tiny, tmp_path / "out", surface=SurfaceOptions(dem=tiny.dem))


def test_heights_have_no_default(tiny, tmp_path):
    with pytest.raises(InputError) as caught:
        rectify(tiny, tmp_path / "out", surface=SurfaceOptions())
    assert caught.value.field == "surface.dem"
    assert "`surface.height=METRES`" in str(caught.value.remedy)
    assert not (tmp_path / "out").exists()


SWAPPED = {
    "latitude before longitude": ([0, 1, 2, 4, 3, 5], (1, 1, 1, 1, 1), "ground x and y"),
    "row before column": ([0, 2, 1, 3, 4, 5], (1, 1, 1, 1, 1), "column and row"),
    "both": ([0, 2, 1, 4, 3, 5], (1, 1, 1, 1, 1), "x and y, and column and row"),
    "rows negative": ([0, 1, 2, 3, 4, 5], (1, -1, 1, 1, 1), "rows are negative"),
    "southern latitudes positive": ([0, 1, 2, 3, 4, 5], (1, 1, 1, -1, 1), "sign of y"),
    "western longitudes": ([0, 1, 2, 3, 4, 5], (1, 1, -1, 1, 1), "sign of x"),
}


@pytest.mark.parametrize("case", SWAPPED)
def test_swapped_coordinates_are_named(tiny, case):
    order, signs, message = SWAPPED[case]
    rows = [(row[0], *(np.array(row[1:]) * signs).tolist()) for row in tiny.points(8)]
    path = tiny.write(tiny.folder / "swapped.csv", [tuple(row[i] for i in order) for row in rows])
    with pytest.raises(InputError, match=message):
        commands.fit(tiny.image, points_of(tiny, path))


def test_rows_from_the_bottom_are_named(tiny):
    rows = [(name, col, tiny.height - row, *ground) for name, col, row, *ground in tiny.points(8, noise=0.0)]
    path = tiny.write(tiny.folder / "bottom.csv", rows)
    with pytest.raises(InputError, match="from the bottom"):
        commands.fit(tiny.image, points_of(tiny, path))


def test_points_of_another_place_are_refused(tiny):
    rows = [(name, col, row, lon + 5, lat, h) for name, col, row, lon, lat, h in tiny.points(8)]
    with pytest.raises(InputError, match="outside the model's domain"):
        commands.fit(tiny.image, points_of(tiny, tiny.write(tiny.folder / "far.csv", rows)))


def test_no_redundancy_is_said(tiny):
    path = tiny.write(tiny.folder / "one.csv", tiny.points(1))
    result = commands.fit(tiny.image, points_of(tiny, path))
    document = result.to_json()
    assert document["redundancy"] == 0
    assert document["sigma0"] is None
    assert any("no redundancy" in warning for warning in document["warnings"])


def test_few_check_points_are_said(tiny):
    document = commands.fit(tiny.image, points_of(tiny, check="every:3")).to_json()
    assert any("30" in warning for warning in document["warnings"])
    assert document["rmse"]["check"]["n"] == 4
    assert not any(point["used"] for point in document["points"] if point["role"] == "check")


def test_a_gross_error_is_named_and_not_averaged_in(tiny, tmp_path):
    rows = tiny.points(12)
    rows[4] = (rows[4][0], rows[4][1] + 30.0, *rows[4][2:])
    path = tiny.write(tiny.folder / "blunder.csv", rows)
    result = rectify(tiny, tmp_path / "out", points=points_of(tiny, path))
    report = result.files["report"].read_text()
    assert "p4" in result.summary
    assert '"p4"' in report
    np.testing.assert_allclose(ortho_pipeline.load_model(result.files["model"]).params, tiny.bias, atol=0.15)


def test_too_many_gross_errors_are_an_error(tiny):
    rows = tiny.points(9)
    random = np.random.default_rng(1)
    for i in range(4):
        name, col, row, *ground = rows[i]
        rows[i] = (name, col + random.uniform(-40, 40), row + random.uniform(-40, 40), *ground)
    with pytest.raises(DegeneratePoints, match="4 of 9"):
        commands.fit(tiny.image, points_of(tiny, tiny.write(tiny.folder / "bad.csv", rows)))


def test_the_same_id_twice_is_an_error(tiny):
    rows = tiny.points(5)
    with pytest.raises(InputError, match="p0"):
        commands.fit(tiny.image, points_of(tiny, tiny.write(tiny.folder / "twice.csv", [*rows, rows[0]])))


def test_points_outside_of_the_image_are_used_and_named(tiny):
    ground = np.array([[20.0115, -30.0, 500.0]])
    image = tiny.model.ground_to_image(ground)[0] + tiny.bias
    rows = [*tiny.points(6), ("beyond", *image.tolist(), *ground[0].tolist())]
    result = commands.fit(tiny.image, points_of(tiny, tiny.write(tiny.folder / "beyond.csv", rows)))
    assert result.fit.used.all()
    assert any("beyond" in warning for warning in result.warnings)


@pytest.mark.parametrize("where", ["same folder", "reads what it writes"])
def test_nothing_is_read_and_written(tiny, tmp_path, where):
    if where == "same folder":
        folder, image = tiny.folder, tiny.image
    else:
        folder = tmp_path / "out"
        image = tiny.image.rename(folder.parent / "tiny.vrt.tif")
        folder = folder.parent
    with pytest.raises(InputError, match=r"attach to the source|both input and output"):
        commands.rectify(image, folder, surface=dem_of(tiny), points=points_of(tiny))


def test_points_cannot_be_an_output(tiny, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    gcps = tiny.gcps.rename(out / "tiny_residuals.geojson")
    with pytest.raises(InputError, match="both input and output"):
        rectify(tiny, out, points=points_of(tiny, gcps))


def test_names_with_blanks_accents_and_links(tiny, tmp_path):
    folder = tmp_path / "été à Zürich 日本"
    folder.mkdir()
    image = folder / "scène 1.tif"
    image.symlink_to(tiny.image)
    result = commands.rectify(image, folder / "sortie", surface=dem_of(tiny), points=points_of(tiny))
    assert result.files["ortho"].name == "scène 1_ortho.tif"
    assert gdal.Open(str(result.files["vrt"])).GetMetadata("RPC")


def test_a_folder_that_cannot_be_written_is_said(tiny, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(InputError, match="write"):
        rectify(tiny, blocked / "out")


def test_points_without_heights_take_them_from_the_dem(tiny):
    rows = [(name, col, row, lon, lat) for name, col, row, lon, lat, _ in tiny.points(6, noise=0)]
    heights = ortho_pipeline.open_dem(tiny.dem, ortho_pipeline.Vertical("ellipsoid")).heights(
        np.array([row[3:5] for row in rows]), "EPSG:4326"
    )
    ground = np.column_stack([np.array([row[3:5] for row in rows]), heights])
    image = tiny.model.ground_to_image(ground) + tiny.bias
    lines = ["#CRS: EPSG:4326", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    lines += [f"{g[0]},{g[1]},{i[0]},{-i[1]},1,0,0,0" for g, i in zip(ground, image, strict=True)]
    path = tiny.folder / "gcps.points"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="have no height"):
        commands.fit(tiny.image, PointOptions(gcps=path))
    result = commands.fit(tiny.image, PointOptions(gcps=path), surface=dem_of(tiny))
    np.testing.assert_allclose(result.fit.values, tiny.bias, atol=1e-3)


# -- the real QuickBird scene ----------------------------------------------------------------------------------------


def quickbird(real: Path, **options: Any) -> dict[str, Any]:
    folder = real / "orthority"
    surface = SurfaceOptions(**{"dem": folder / "ngi" / "dem.tif", "vertical": "egm96", **options})
    return {"points": PointOptions(gcps=folder / "rpc" / "gcps.geojson"), "surface": surface}


@pytest.mark.realdata
def test_quickbird_from_end_to_end(real, tmp_path):
    image = real / "orthority" / "rpc" / "qb2_basic1b.tif"
    output = OutputOptions(crs="EPSG:32735")
    result = commands.rectify(image, tmp_path / "out", output=output, **quickbird(real))
    fit = commands.fit(image, quickbird(real)["points"]).to_json()
    assert fit["raw_bias"]["col"] == pytest.approx(-3.0, abs=0.15)
    assert fit["raw_bias"]["row"] == pytest.approx(-2.1, abs=0.15)
    assert fit["rmse"]["control"]["total"] <= 0.15
    assert fit["rmse"]["loo"]["total"] <= 0.2
    assert len(fit["points"]) == 5
    assert not fit["rejected"]
    assert valid(result.files["ortho"]).mean() > 0.5


@pytest.mark.realdata
def test_quickbird_without_the_geoid_is_refused(real, tmp_path):
    image = real / "orthority" / "rpc" / "qb2_basic1b.tif"
    with pytest.raises(DatumError) as caught:
        commands.rectify(image, tmp_path / "out", **quickbird(real, vertical=None))
    text = str(caught.value)
    assert "EGM2008" in text
    assert "us_nga_egm08_25.tif" in text
    assert "surface.vertical" in text


@pytest.mark.realdata
def test_quickbird_finds_a_blunder_among_five_points(real, tmp_path):
    given = json.loads((real / "orthority" / "rpc" / "gcps.geojson").read_text())
    given["features"][2]["properties"]["ji"][0] += 200.0
    path = tmp_path / "blunder.geojson"
    path.write_text(json.dumps(given))
    image = real / "orthority" / "rpc" / "qb2_basic1b.tif"
    options = quickbird(real) | {"points": PointOptions(gcps=path)}
    result = commands.rectify(image, tmp_path / "out", output=OutputOptions(crs="EPSG:32735"), **options)
    fit = commands.fit(image, options["points"]).to_json()
    assert len(fit["rejected"]) == 1
    name = fit["rejected"][0]["id"]
    assert [point["id"] for point in fit["points"] if not point["used"]] == [name]
    assert name in result.summary
    assert name in result.files["report"].read_text()
    assert name in result.files["html"].read_text()
    assert fit["rmse"]["control"]["total"] <= 0.15
    assert fit["parameters"]["col_shift"]["value"] == pytest.approx(-3.0, abs=0.2)


# -- heights of the whole scene --------------------------------------------------------------------------------------


def test_a_void_between_the_rays_is_reported_with_its_share(tiny, tmp_path):
    fine = tiny.folder / "fine.tif"
    gdal.Translate(str(fine), str(tiny.dem), xRes=5, yRes=5, resampleAlg="bilinear")
    dem = gdal.Open(str(fine), gdal.GA_Update)
    heights = dem.ReadAsArray()
    heights[394, 396] = -32768
    dem.GetRasterBand(1).SetNoDataValue(-32768)
    dem.WriteArray(heights)
    dem = None
    report = rectify(tiny, tmp_path / "out", surface=dem_of(tiny, dem=fine)).document["report"]
    found = [text for text in report["warnings"] if "(1 sample without a height inside it)" in text]
    assert len(found) == 1
    # The scene has 1.92 x 1.44 km, a sample 5 x 5 m.
    assert 1 - report["surface"]["coverage"] == pytest.approx(25 / (1920 * 1440), rel=0.1)
    assert "100 % of the scene" not in (tmp_path / "out" / "tiny_report.html").read_text()
    filled = rectify(tiny, tmp_path / "filled", surface=dem_of(tiny, dem=fine, fill="nearest")).document["report"]
    assert any("was filled" in text for text in filled["warnings"])


def moved(tiny, tmp_path, lon):
    """Return the tiny scene at another longitude."""
    image = tmp_path / "far.tif"
    gdal.Translate(str(image), str(tiny.image))
    dataset = gdal.Open(str(image), gdal.GA_Update)
    dataset.SetMetadata(rpc_metadata(tiny.model._replace(lon_off=lon)), "RPC")
    dataset = None
    return image


def global_dem(tmp_path, west, rise=0.0):
    """Return the surface of a DEM of the whole Earth, 500 m high and rising with the latitude."""
    world = tmp_path / "world.tif"
    dem = gdal.GetDriverByName("GTiff").Create(str(world), 720, 360, 1, gdal.GDT_Float32)
    dem.SetGeoTransform((west, 0.5, 0, 90, 0, -0.5))
    dem.SetProjection("EPSG:4326")
    dem.WriteArray(np.tile(500.0 + rise * np.arange(360)[:, None], 720))
    dem = None
    return SurfaceOptions(dem=world, vertical="ellipsoid")


@pytest.mark.parametrize("lon", [179.995, -179.995])
def test_a_scene_at_the_antimeridian_with_a_global_dem(tiny, tmp_path, lon):
    image, surface = moved(tiny, tmp_path, lon), global_dem(tmp_path, -180)
    result = commands.rectify(image, tmp_path / "out", surface=surface)
    assert result.document["report"]["surface"]["coverage"] == 1.0
    flat = commands.rectify(image, tmp_path / "flat", surface=SurfaceOptions(height=500.0))
    one, other = (gdal.Open(str(made.files["ortho"])) for made in (result, flat))
    assert one.GetGeoTransform() == other.GetGeoTransform()
    np.testing.assert_array_equal(one.ReadAsArray(), other.ReadAsArray())
    # With an RPC and this DEM, GDAL itself would lose one side without a word.
    gdals = commands.rectify(image, tmp_path / "gdal", surface=surface, output=OutputOptions(engine="gdal"))
    assert gdals.document["report"]["warp"]["transformer"] == "GEOLOC_ARRAY"
    theirs, ours = (gdal.Open(str(made.files["ortho"])).ReadAsArray() for made in (gdals, result))
    np.testing.assert_array_equal(theirs > 0, ours > 0)
    assert np.abs(theirs.astype(int) - ours).max() <= 1


def test_gdal_s_engine_over_the_seam_of_a_global_dem(tiny, tmp_path):
    image, surface = moved(tiny, tmp_path, 0.0), global_dem(tmp_path, 0, rise=3.0)
    pixels = {}
    for engine in ("ortho", "gdal"):
        result = commands.rectify(image, tmp_path / engine, surface=surface, output=OutputOptions(engine=engine))
        made = gdal.Open(str(result.files["ortho"]))
        pixels[engine] = made.ReadAsArray().astype(float)
    assert (pixels["ortho"] > 0).mean() > 0.7
    np.testing.assert_array_equal(pixels["ortho"] > 0, pixels["gdal"] > 0)
    assert np.abs(pixels["ortho"] - pixels["gdal"]).max() <= 3
    # The heights that were handed to GDAL in its own memory are gone.
    assert not [name for name in gdal.ReadDir("/vsimem/") or () if "ortho_dem" in name]


def test_provenance_has_the_checksum_of_every_input_and_the_command(tiny, tmp_path):
    side_car = tiny.folder / "tiny_RPC.TXT"
    write_rpc_txt(tiny.model, side_car)
    result = rectify(tiny, tmp_path / "out", command="ortho rectify tiny.tif")
    given = result.document["report"]["provenance"]
    assert given["command"] == "ortho rectify tiny.tif"
    found = {Path(one["path"]): one for one in given["inputs"]}
    for path, role in ((tiny.image, "image"), (side_car, "image"), (tiny.dem, "DEM"), (tiny.gcps, "points")):
        assert found[path]["role"] == role
        assert found[path]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert found[path]["bytes"] == path.stat().st_size
        assert found[path]["sha256"] in result.files["html"].read_text()
    assert given["options"]["surface"]["vertical"] == "ellipsoid"
    # An option of later versions changes nothing in the files of a job that does not use it.
    assert "like" not in given["options"]["output"]
    assert given["options"]["output"]["extent"] is None


def test_model_files_may_name_model_families_of_plugins(tiny, tmp_path, monkeypatch):
    called, discover, read = [], host.Host.discover, inputs.read_model_file

    def families_are_known(path):
        assert called
        return read(path)

    monkeypatch.setattr(host.Host, "discover", lambda: called.append(1) or discover())
    monkeypatch.setattr(inputs, "read_model_file", families_are_known)
    path = tmp_path / "m_model.json"
    ortho_pipeline.save_model(tiny.model, path)
    called.clear()
    assert open_scene(tiny.image, SceneOptions(model=path)).sensor == "model file"


def test_a_model_of_another_place_is_a_warning(tiny):
    """A shift fits exactly, and nothing else said that the delivered model is four images away."""
    rows = [(name, col + 4 * tiny.width, *others) for name, col, *others in tiny.points(12)]
    moved = tiny.write(tiny.folder / "moved.csv", rows)
    (warning,) = [text for text in commands.fit(tiny.image, points_of(tiny, moved)).warnings if "image sizes" in text]
    assert warning.startswith("the delivered model is 4.01 image sizes away from the points. ")
    assert not [text for text in commands.fit(tiny.image, points_of(tiny)).warnings if "image sizes" in text]
    family = commands.fit(tiny.image, points_of(tiny, moved, fit_model="affine3d")).warnings
    assert not [text for text in family if "image sizes" in text]


def test_a_model_that_could_not_be_read_again_is_not_written(tiny, tmp_path, monkeypatch):
    monkeypatch.delitem(KINDS, "rpc")
    with pytest.raises(PluginError, match=r"m_model\.json: .*cannot be read again.*'rpc'(.|\n)*ortho_models"):
        ortho_pipeline.save_model(tiny.model, tmp_path / "m_model.json")
    assert not list(tmp_path.glob("*.json"))
