"""Models for other programs: RPC of any model, control points, geolocation arrays, each read again by GDAL."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.heights.opening import open_surface
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.export import FORMATS, Export
from ortho_pipeline.exchange.gcp import write_geolocation
from ortho_pipeline.exchange.rpc import export_rpc, read_rpc
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.options import PointOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.surface.flat import FlatSurface

REAL_RPCS = (
    "gdal/gcore/data/md_ov_rpc.txt",
    "shareloc/rpc/RPC_PHR1B_P_201308051042194_SEN_690908101-001.XML",
)


def points_of(tiny: Any, **more: Any) -> PointOptions:
    return PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid", **more)


def fitted(tiny: Any) -> Any:
    return commands.fit(tiny.image, points_of(tiny)).fit.model


def ground_to_image(path: Path, ground: np.ndarray, *options: str) -> np.ndarray:
    """Map with GDAL's own transformer, which answers in pixel and line from the outer corner."""
    dataset = gdal.Open(str(path))
    transformer = gdal.Transformer(dataset, None, list(options))
    found, good = transformer.TransformPoints(1, [tuple(row) for row in ground.tolist()])
    assert all(good)
    return np.array(found)[:, :2]


GROUND = np.array([[20.004, -30.003, 500.0], [19.996, -29.997, 500.0], [20.0, -30.0, 500.0]])


# -- cameras from first principles, without anything of the package ----------------------------------------------------

A, E2 = 6378137.0, 6.69437999014e-3


def ecef(ground: Any) -> np.ndarray:
    """Return geocentric metres of (lon, lat in degrees, ellipsoidal height) after the textbook."""
    lon, lat, h = np.radians(ground[:, 0]), np.radians(ground[:, 1]), ground[:, 2]
    n = A / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    return np.stack(
        [(n + h) * np.cos(lat) * np.cos(lon), (n + h) * np.cos(lat) * np.sin(lon), (n * (1 - E2) + h) * np.sin(lat)],
        axis=1,
    )


def local_axes(lon: float, lat: float) -> np.ndarray:
    """Return the unit vectors east, north, up as rows."""
    lam, phi = np.radians([lon, lat])
    return np.array(
        [
            [-np.sin(lam), np.cos(lam), 0],
            [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)],
            [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)],
        ]
    )


@dataclass(frozen=True, eq=False)
class TestCamera(SensorModel):
    """What both share: a scene of 30 x 30 km with heights 0 to 1500 m, seen from 650 km, 25 degrees off nadir."""

    __test__ = False
    lon: float = 30.0
    lat: float = 38.0
    size: int = 12_000

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([self.lon, self.lat, 750.0]), np.array([0.171, 0.135, 750.0])

    def rays(self, ground: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the ground relative to the camera's middle position, and the camera's axes as rows."""
        axes = local_axes(self.lon, self.lat)
        centre = ecef(np.array([[self.lon, self.lat, 750.0]]))[0]
        off = np.radians(25.0)
        towards = axes.T @ np.array([np.sin(off) * 0.8, np.sin(off) * 0.6, np.cos(off)])
        camera = centre + 650e3 * towards
        z = -towards
        x = np.cross(axes[1], -z)
        x /= np.linalg.norm(x)
        return ecef(np.asarray(ground, dtype=float)) - camera, np.stack([x, np.cross(z, x), z])


class FrameCamera(TestCamera):
    """Central projection."""

    kind = "test-frame"

    def ground_to_image(self, ground: Any) -> np.ndarray:
        offset, axes = self.rays(ground)
        seen = offset @ axes.T
        return self.size / 2 + 260_000.0 * seen[:, :2] / seen[:, 2:]


class Scanner(TestCamera):
    """A line scanner that flies a circle at 7.5 km/s with a slow turn of its attitude."""

    kind = "test-scanner"

    def ground_to_image(self, ground: Any) -> np.ndarray:
        offset, axes = self.rays(ground)
        start = offset @ axes.T
        radius, speed, line_time = 7.03e6, 7500.0, 30_000.0 / 7500.0 / 12_000
        t = np.zeros(len(start))
        for _ in range(8):
            across, along, depth = self.seen(start, t, radius, speed)
            step = 0.01
            _, ahead, depth_ahead = self.seen(start, t + step, radius, speed)
            slope = (ahead / depth_ahead - along / depth) / step
            t = t - along / depth / slope
        across, _, depth = self.seen(start, t, radius, speed)
        return np.stack([self.size / 2 + 260_000.0 * across / depth, self.size / 2 + t / line_time], axis=1)

    def seen(self, start: np.ndarray, t: np.ndarray, radius: float, speed: float) -> tuple[np.ndarray, ...]:
        """Return ground in the axes of the scanner at time t: it moves along y on a circle whose centre lies at +z."""
        angle = speed * t / radius
        x, y, z = start[:, 0], start[:, 1], start[:, 2] - radius
        y, z = y * np.cos(angle) + z * np.sin(angle), -y * np.sin(angle) + z * np.cos(angle) + radius
        yaw, pitch = 2e-3 * t / 2.0, 1e-3 * (t / 2.0) ** 2
        x, y = x + yaw * y, y - yaw * x
        return x, y + pitch * z, z


# -- RPC -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [FrameCamera(), Scanner()], ids=["frame", "scanner"])
def test_rpc_stands_for_any_camera_over_30_km_and_1500_m(camera):
    exported = export_rpc(camera)
    centre, half = camera.domain
    ground = centre + half * np.random.default_rng(7).uniform(-1, 1, (5000, 3))
    error = np.abs(exported.rpc.ground_to_image(ground) - camera.ground_to_image(ground)).max()
    assert error <= 0.001
    assert error <= 2 * exported.max_error_px


@pytest.mark.realdata
@pytest.mark.parametrize("name", REAL_RPCS)
def test_rpc_stands_for_a_vendors_rpc(real, name):
    from ortho_pipeline.exchange.rpc_fit import fit_rpc

    path = next(real.rglob(Path(name).name))
    model = read_rpc(path)
    centre, half = model.domain
    box = (centre[0] - half[0], centre[1] - half[1], centre[0] + half[0], centre[1] + half[1])
    exported = fit_rpc(model, box, model.height_range)
    ground = centre + half * np.random.default_rng(1).uniform(-1, 1, (5000, 3))
    assert np.abs(exported.rpc.ground_to_image(ground) - model.ground_to_image(ground)).max() <= 1e-4


@pytest.mark.parametrize("family", ["affine3d", "dlt", "poly2"])
def test_a_model_from_points_alone_is_exported_as_rpc(tiny, tmp_path, family):
    points = points_of(tiny, fit_model=family, model_crs="utm")
    result = commands.export(tiny.image, tmp_path / "out", formats=["rpc-txt"], points=points)
    assert result.document["max_error_px"] < 0.02
    model = commands.fit(tiny.image, points).fit.model
    written = read_rpc(result.files["rpc-txt"])
    from ortho_pipeline.geodesy.crs import ground_transform

    ground = ground_transform("EPSG:4979", model.crs)(GROUND)
    np.testing.assert_allclose(written.ground_to_image(GROUND), model.ground_to_image(ground), rtol=0, atol=0.02)


# -- every format, through GDAL --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["vrt", "tag"])
def test_gdal_maps_with_the_exported_rpc(tiny, tmp_path, name):
    path = commands.export(tiny.image, tmp_path / "out", formats=[name], points=points_of(tiny)).files[name]
    expected = fitted(tiny).ground_to_image(GROUND)
    np.testing.assert_allclose(ground_to_image(path, GROUND, "METHOD=RPC"), expected, atol=1e-6)


def test_an_old_xml_that_would_override_the_tag_is_refused(tiny, tmp_path):
    out = tmp_path / "out"
    commands.export(tiny.image, out, formats=["tag", "rpc-xml"])
    with pytest.raises(InputError, match="would override the tag") as caught:
        commands.export(tiny.image, out, formats=["tag"], points=points_of(tiny))
    assert caught.value.file.endswith("tiny_rpc.xml")
    path = commands.export(tiny.image, out, formats=["tag", "rpc-xml"], points=points_of(tiny)).files["tag"]
    expected = fitted(tiny).ground_to_image(GROUND)
    np.testing.assert_allclose(ground_to_image(path, GROUND, "METHOD=RPC"), expected, atol=1e-6)


@pytest.mark.parametrize("name", ["rpc-txt", "rpb"])
def test_gdal_maps_with_an_exported_side_car(tiny, tmp_path, name):
    out = tmp_path / "out"
    commands.export(tiny.image, out, formats=[name], points=points_of(tiny))
    gdal.GetDriverByName("GTiff").Create(str(out / "tiny.tif"), tiny.width, tiny.height, 1)
    expected = fitted(tiny).ground_to_image(GROUND)
    np.testing.assert_allclose(ground_to_image(out / "tiny.tif", GROUND, "METHOD=RPC"), expected, atol=1e-6)


@pytest.mark.parametrize("name", ["gcp", "gcp-tag"])
def test_measured_points_are_gcps_that_gdal_fits_to(tiny, tmp_path, name):
    path = commands.export(tiny.image, tmp_path / "out", formats=[name], points=points_of(tiny)).files[name]
    dataset = gdal.Open(str(path))
    assert not dataset.GetMetadata("RPC")
    rows = tiny.points(12)
    found = [(p.GCPPixel, p.GCPLine, p.GCPX, p.GCPY, p.GCPZ) for p in dataset.GetGCPs()]
    np.testing.assert_allclose(found, [row[1:] for row in rows], atol=1e-4)
    assert dataset.GetGCPSpatialRef().GetAuthorityCode(None) == "4326"
    # A plane fitted to points on rough ground: near, not exact.
    found = ground_to_image(path, GROUND, "METHOD=GCP_POLYNOMIAL", "MAX_GCP_ORDER=1")
    np.testing.assert_allclose(found, fitted(tiny).ground_to_image(GROUND), atol=10)
    np.testing.assert_array_equal(dataset.ReadAsArray(), gdal.Open(str(tiny.image)).ReadAsArray())


@pytest.mark.parametrize("name", ["gcp", "gcp-tag"])
def test_a_gross_error_is_no_gcp_and_check_points_are_none(tiny, tmp_path, name):
    rows = [list(row) for row in tiny.points(14)]
    rows[4][1] += 60.0
    tiny.write(tiny.gcps, rows)
    points = points_of(tiny, check="ids:p12,p13")
    assert [name for name, _ in commands.fit(tiny.image, points).fit.rejected] == ["p4"]
    result = commands.export(tiny.image, tmp_path / "out", formats=[name], points=points)
    found = [(p.GCPPixel, p.GCPLine) for p in gdal.Open(str(result.files[name])).GetGCPs()]
    np.testing.assert_allclose(found, [row[1:3] for k, row in enumerate(rows) if k not in (4, 12, 13)], atol=1e-4)
    assert result.document["gcps"]["n"] == 11
    assert [one["id"] for one in result.document["gcps"]["left_out"]] == ["p4"]
    assert "Left out: p4 (gross error" in result.summary


def test_without_points_a_grid_of_gcps_stands_for_the_model(tiny, tmp_path):
    surface = SurfaceOptions(height=500.0)
    result = commands.export(tiny.image, tmp_path / "out", formats=["gcp"], surface=surface)
    assert result.document["gcps"]["n"] == 121
    assert "500 m" in result.summary
    found = ground_to_image(result.files["gcp"], GROUND, "METHOD=GCP_POLYNOMIAL", "MAX_GCP_ORDER=2")
    np.testing.assert_allclose(found, tiny.model.ground_to_image(GROUND), atol=0.01)


@pytest.mark.parametrize("with_dem", [False, True])
def test_geolocation_arrays_map_as_the_model(tiny, tmp_path, with_dem):
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid") if with_dem else SurfaceOptions(height=500.0)
    result = commands.export(
        tiny.image, tmp_path / "out", formats=["geolocation"], points=points_of(tiny), surface=surface
    )
    assert result.document["geolocation"]["max_error_px"] < 0.05
    path = result.files["geolocation"]
    transformer = gdal.Transformer(gdal.Open(str(path)), None, ["METHOD=GEOLOC_ARRAY"])
    image = [(40.25, 60.75), (200.0, 150.0), (333.3, 222.2)]
    found, good = transformer.TransformPoints(0, [(*pixel, 0.0) for pixel in image])
    assert all(good)
    model = fitted(tiny)
    if with_dem:
        from ortho_pipeline.surface.rays import meet_surface

        expected = meet_surface(model, image, open_surface(surface))
    else:
        expected = model.image_to_ground(image, 500.0)
    # A pixel is about 5e-5 degrees.
    np.testing.assert_allclose(np.array(found)[:, :2], expected[:, :2], atol=5e-5 * 0.05)
    back, good = transformer.TransformPoints(1, [tuple(row) for row in found])
    assert all(good)
    np.testing.assert_allclose(np.array(back)[:, :2], image, atol=0.3)


@dataclass(frozen=True, eq=False)
class Bent(SensorModel):
    """Longitudes are a quadratic of the column: 1e-5 degrees per pixel at the first, 1.5 times as much at 1000."""

    kind = "bent"
    a: float = 1e-5
    b: float = 2.5e-9

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([20.0064, -30.0025, 500.0]), np.array([0.0064, 0.0026, 100.0])

    def ground_to_image(self, ground: Any) -> np.ndarray:
        lon, lat, _ = np.asarray(ground, dtype=float).T
        columns = (np.sqrt(self.a**2 + 4 * self.b * (lon - 20.0)) - self.a) / (2 * self.b)
        return np.stack([columns, (-30.0 - lat) / self.a], axis=1)


def test_the_error_between_samples_of_geolocation_arrays_is_the_largest(tmp_path):
    """Samples every 4 pixels: in the middle a straight line is off by 4 b degrees, most pixels where they are small."""
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "image.tif"), 1024, 512, 1)
    worst = write_geolocation(made, Bent(), (1024, 512), None, tmp_path / "g.vrt")
    assert worst == pytest.approx(4 * Bent.b / (Bent.a + 2 * Bent.b * 2), rel=0.01)
    told = gdal.Open(str(tmp_path / "g.vrt")).GetMetadata("GEOLOCATION")
    assert [told[f"{name}_STEP"] for name in ("PIXEL", "LINE")] == ["4", "4"]
    arrays = gdal.Open(told["X_DATASET"]).ReadAsArray()
    assert arrays.shape == (2, 129, 257)
    columns = np.arange(257) * 4.0
    np.testing.assert_allclose(arrays[0, 7], 20.0 + Bent.a * columns + Bent.b * columns**2, atol=1e-12)
    np.testing.assert_allclose(arrays[1, :, 9], -30.0 - Bent.a * 4 * np.arange(129), atol=1e-12)


def test_the_summary_tells_what_each_file_is_and_how_well_it_fits(tiny, tmp_path):
    nothing = Points.of(np.zeros((0, 2)), np.zeros((0, 3)), "EPSG:4979")
    size, image = (tiny.width, tiny.height), gdal.Open(str(tiny.image))
    export = Export(image, tiny.model, size, FlatSurface(700.0), nothing)
    assert export.summary("rpc", "a.tif", []).splitlines() == ["Model rpc of a.tif"]
    for name in ("gcp", "geolocation", "rpb"):
        export.write(FORMATS[name], tmp_path / f"a{FORMATS[name].ending}")
    head, rpc, gcps, arrays = export.summary("rpc", "a.tif", [FORMATS["gcp"], FORMATS["rpb"]]).splitlines()
    assert (head, rpc) == ("Model rpc of a.tif", "RPC: exact")
    assert gcps == "Control points: 121, a grid at 700 m above the ellipsoid"
    worst = f"{export.document['geolocation']['max_error_px']:.2g}"
    assert arrays == f"Geolocation: the model at 700 m above the ellipsoid, {worst} px off between its samples"
    # Without a surface the points are at the height in the middle of the model.
    plain = Export(image, tiny.model, size, None, nothing, [("p4", "gross error")])
    plain.write(FORMATS["gcp"], tmp_path / "b_gcp.vrt")
    middle = f"at {tiny.model.reference_height:.0f} m above the ellipsoid"
    assert plain.summary("rpc", "a.tif", []).splitlines()[1:] == [f"Control points: 121, a grid {middle}"]


def test_the_summary_tells_how_far_off_a_fitted_rpc_is(tmp_path):
    camera = FrameCamera()
    export = Export(gdal.GetDriverByName("MEM").Create("", 9, 9), camera, (9, 9), None, None)
    worst = export.rpc.max_error_px
    assert 0 < worst < 0.001
    _, line = export.summary("frame", "a.tif", []).splitlines()
    assert line.startswith("RPC: refitted, at most ")
    assert float(line.split()[4]) == pytest.approx(worst, rel=0.06)


@pytest.mark.parametrize(("size", "step"), [((1022, 510), 4), ((100, 513), 3), ((257, 100), 2), ((256, 33), 1)])
def test_geolocation_arrays_reach_the_last_pixel_with_at_most_257_samples(tmp_path, size, step):
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "image.tif"), *size, 1)
    write_geolocation(made, Bent(), size, None, tmp_path / "g.vrt")
    told = gdal.Open(str(tmp_path / "g.vrt")).GetMetadata("GEOLOCATION")
    assert [told[f"{name}_STEP"] for name in ("PIXEL", "LINE")] == [str(step)] * 2
    arrays = gdal.Open(told["X_DATASET"])
    for count, side in zip((arrays.RasterXSize, arrays.RasterYSize), size, strict=True):
        assert count <= 257
        assert (count - 2) * step < side <= (count - 1) * step


# -- command line ----------------------------------------------------------------------------------------------------


def test_every_format_from_the_command_line(tiny, tmp_path):
    arguments = [tiny.image, "--gcps", tiny.gcps, "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]
    arguments += ["-o", tmp_path / "out", "--height", "500", "--json"]
    formats = ["--format", "rpc-txt,rpb", "--format", "tag", "--format", "vrt,geom,rpc-xml,gcp,gcp-tag,geolocation"]
    done = CliRunner().invoke(cli, ["export", *map(str, arguments), *formats])
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    assert set(document["files"]) == set(FORMATS)
    assert all(Path(path).stat().st_size for path in document["files"].values())
    assert document["exact"] is True


@pytest.mark.parametrize("name", ["vrt", "tag", "gcp", "gcp-tag", "geolocation"])
def test_what_stands_for_the_model_is_not_beside_a_geotransform(tiny, tmp_path, name):
    # A product on a plane looks like a map: gdalwarp would take its geotransform, and so would a GeoTIFF.
    gdal.Open(str(tiny.image), gdal.GA_Update).SetGeoTransform((500000.0, 1.0, 0.0, 6000000.0, 0.0, -1.0))
    surface = SurfaceOptions(height=500.0)
    path = commands.export(tiny.image, tmp_path / "out", formats=[name], surface=surface).files[name]
    dataset = gdal.Open(str(path))
    assert dataset.GetGeoTransform(can_return_null=True) is None
    assert bool(dataset.GetGCPs()) == (name in ("gcp", "gcp-tag"))
    np.testing.assert_array_equal(dataset.ReadAsArray(), gdal.Open(str(tiny.image)).ReadAsArray())


def test_an_export_keeps_dates_and_no_position_of_a_photo(tiny, tmp_path):
    xmp = ['<x:xmpmeta xmlns:x="adobe:ns:meta/"/>']
    image = gdal.Open(str(tiny.image), gdal.GA_Update)
    image.SetMetadata(xmp, "xml:XMP")
    image.SetMetadata({"firstLineTime": "2024-05-01T10:00:00Z"}, "IMD")
    image = None
    path = commands.export(tiny.image, tmp_path / "out", formats=["vrt"]).files["vrt"]
    dataset = gdal.Open(str(path))
    assert not dataset.GetMetadata("xml:XMP")
    assert dataset.GetMetadata("IMD") == {"firstLineTime": "2024-05-01T10:00:00Z"}


def test_an_unknown_format_is_refused(tiny, tmp_path):
    with pytest.raises(InputError, match="unknown format shp") as caught:
        commands.export(tiny.image, tmp_path / "out", formats=["rpb", "shp"])
    assert "geolocation" in str(caught.value.remedy)
    assert not (tmp_path / "out").exists()
