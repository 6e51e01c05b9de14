"""IKONOS Geo against real metadata and real vendor RPCs of the same products."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import ortho_ikonos
import pyproj
import pytest
from osgeo import gdal, osr

from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.exchange.rpc import read_rpc
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models import RPC, MapPlane
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.testing import check_sensor

pytestmark = pytest.mark.realdata

SENSOR = next(iter(ortho_ikonos.ortho_sensors()))
UTM = "EPSG:32631"
PLANE, UPPER_LEFT = 85.9509811401441, (445950.21, 5417803.74)
BLOSSEVILLE = "otb/IKONOS_BLOSSEVILLE_ROI_1000_100.geom"


def sparse(path: Path, size: tuple[int, int], corner: tuple[float, float] | None = None, pixel: float = 1.0) -> Path:
    """Write an image of this size that has no pixels, and of metadata only where it lies."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, 1, gdal.GDT_Byte, ["SPARSE_OK=TRUE", "TILED=YES"])
    if corner is not None:
        utm = osr.SpatialReference()
        utm.ImportFromEPSG(int(UTM[5:]))
        dataset.SetSpatialRef(utm)
        dataset.SetGeoTransform((corner[0], pixel, 0.0, corner[1], 0.0, -pixel))
    dataset.FlushCache()
    return path


@pytest.fixture
def delivery(real, tmp_path):
    """Lay the real side-cars about images of the size that the metadata state, under the vendor's names."""
    data = real / "gdal" / "gcore" / "data"
    corner = (UPPER_LEFT[0] - 0.5, UPPER_LEFT[1] + 0.5)
    image = sparse(tmp_path / "po_0000000_rgb_0010000.tif", (50, 50), corner)
    shutil.copyfile(data / "md_ge_metadata.txt", tmp_path / "po_0000000_metadata.txt")
    shutil.copyfile(data / "md_ge_rgb_0010000_rpc.txt", tmp_path / "po_0000000_rgb_0010000_rpc.txt")
    return image


def with_angles(image: Path, azimuth: float, elevation: float) -> None:
    """Give the shortened metadata what was taken out of them."""
    path = image.with_name("po_0000000_metadata.txt")
    angles = f"Nominal Collection Azimuth: {azimuth} degrees\nNominal Collection Elevation: {elevation} degrees\n"
    path.write_text(path.read_text().replace("Acquisition Date/Time", f"{angles}Acquisition Date/Time"))


def test_the_real_metadata_open_through_the_plugin(delivery):
    scene = check_sensor(SENSOR, delivery)
    assert list(scene.models) == ["rpc"]
    assert scene.model_source.endswith("po_0000000_rgb_0010000_rpc.txt")
    assert scene.facts["product_image"] == "001"
    assert scene.facts["cloud_cover_percent"] == 6
    assert scene.facts["bits_per_pixel"] == 8
    assert scene.facts["components"] == 2
    assert scene.facts["reference_height_m"] == pytest.approx(PLANE, abs=1e-9)
    assert scene.facts["geo_model_lacks"] == ["Nominal Collection Azimuth", "Nominal Collection Elevation"]
    assert not scene.warnings


def test_the_upper_left_map_coordinates_are_the_centre_of_the_first_pixel(delivery):
    rpc = open_scene(delivery).model
    places = [[*UPPER_LEFT, PLANE], [UPPER_LEFT[0] + 1000, UPPER_LEFT[1] - 1000, PLANE]]
    seen = rpc.ground_to_image(ground_transform(UTM, rpc.crs)(places))
    np.testing.assert_allclose(seen[0], [0.5, 0.5], atol=0.005)
    np.testing.assert_allclose(seen[1] - seen[0], [1000, 1000], atol=0.005)


def test_on_the_plane_the_metadata_say_what_the_real_rpc_says(delivery):
    with_angles(delivery, 349.2, 72.1)  # which do not matter on the plane
    scene = open_scene(delivery)
    geo, rpc = scene.models["geo"], scene.models["rpc"]
    assert isinstance(geo, MapPlane)
    columns, rows = np.meshgrid(np.linspace(0, 4644, 12), np.linspace(0, 7508, 12))
    image = np.column_stack([columns.ravel(), rows.ravel()])
    seen = rpc.ground_to_image(ground_transform(UTM, rpc.crs)(geo.image_to_ground(image, PLANE)))
    np.testing.assert_allclose(seen, image, atol=0.01)


@pytest.mark.parametrize("name", ["otb/ikonos/ikonos-1.geom", "otb/ikonos/ikonos-2.geom", BLOSSEVILLE,
                                  "rpcm/rpc_IKONOS.txt"])  # fmt: skip
def test_real_rpcs_of_ikonos_open(delivery, real, name):
    scene = open_scene(delivery, SceneOptions(rpc=str(real / name)))
    assert scene.sensor == "ikonos"
    assert scene.model_source == str(real / name)
    image = np.array([[100.0, 200.0], [2000.0, 3000.0]])
    ground = scene.model.image_to_ground(image, scene.model.reference_height)
    np.testing.assert_allclose(scene.model.ground_to_image(ground), image, atol=1e-6)


# -- the plane against a real RPC --------------------------------------------------------------------------------------


@pytest.fixture
def blosseville(real, tmp_path) -> Any:
    """Return the scene of a real order, its metadata written of what the delivery is known to say, and its real RPC.

    Angles are the vendor's; Reference Height and upper left map coordinates, which are not handed down, are those at
    which the vendor's RPC is the map itself (both cameras give the same, to a millimetre).
    """
    rpc, support = read_rpc(real / BLOSSEVILLE), (real / "otb/ikonos/ikonos-1.geom").read_text()
    azimuth, elevation = (
        float(re.search(rf"nominal_collection_{name}_angle:\s*(\S+)", support)[1]) for name in ("azimuth", "elevation")
    )
    plane, corner = plane_of(rpc)
    image = sparse(tmp_path / "po_2619900_pan_0000000.tif", (14668, 18560), corner)
    (tmp_path / "po_2619900_metadata.txt").write_text(
        f"""==============================================================
Product Order Metadata

Product Line: Geo
Processing Level: Standard Geometrically Corrected
Sensor Name: IKONOS-2
Map Projection: Universal Transverse Mercator
   UTM Specific Parameters
      Hemisphere: N
      Zone Number: 31
Datum: WGS84
==============================================================
Source Image Metadata

Source Image ID: 2005062110530000000000000000
Product Image ID: 000
Nominal Collection Azimuth: {azimuth} degrees
Nominal Collection Elevation: {elevation} degrees
==============================================================
Product Component Metadata

Component ID: 0000000
Product Image ID: 000
Component Map Coordinates (in Map Units)
   UL Map X (Easting): {corner[0] + 0.5!r} meters
   UL Map Y (Northing): {corner[1] - 0.5!r} meters
Pixel Size X: 1.0000000000 meters
Pixel Size Y: 1.0000000000 meters
Reference Height: {plane!r} meters
==============================================================
"""
    )
    return open_scene(image), rpc


def plane_of(rpc: RPC) -> tuple[float, tuple[float, float]]:
    """Return the height at which a column is one metre of the map, and the map position of the first corner there."""
    to_map = ground_transform(rpc.crs, UTM)
    ends = np.array([[0.0, rpc.row_off], [2 * rpc.col_off, rpc.row_off]])

    def stretch(height: float) -> float:
        first, last = to_map(rpc.image_to_ground(ends, height))
        return float((last - first)[0] / np.ptp(ends[:, 0])) - 1.0

    low, high = rpc.h_off - 20, rpc.h_off + 20
    height = low - stretch(low) * (high - low) / (stretch(high) - stretch(low))
    x, y, _ = to_map(rpc.image_to_ground(np.zeros((1, 2)), height))[0].tolist()
    return height, (x, y)


def relief(model: Any, image: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return by how many metres of the map each line of sight moves for 100 m of height."""
    to_map = ground_transform(model.crs, UTM)
    moved = to_map(model.image_to_ground(image, high)) - to_map(model.image_to_ground(image, low))
    return 100 * moved[:, :2] / (high - low)


def test_relief_from_the_real_angles_is_that_of_the_real_rpc(blosseville):
    """The page docs/engineering/block-adjustment.md reports these numbers."""
    scene, rpc = blosseville
    geo = scene.model
    assert isinstance(geo, MapPlane)
    columns, rows = np.meshgrid(np.linspace(0, scene.width, 9), np.linspace(0, scene.height, 9))
    image = np.column_stack([columns.ravel(), rows.ravel()])
    real = relief(rpc, image, -30.0, 250.0)
    apart = relief(geo, image, -30.0, 250.0) - real
    middle, rms = np.hypot(*apart[40]), math.sqrt((apart**2).sum(axis=1).mean())
    worst = np.hypot(*apart.T).max()
    turning = math.sqrt(((apart - apart.mean(axis=0)) ** 2).sum(axis=1).mean())
    print(
        f"relief of geo and of the RPC apart: middle {middle:.2f}, rms {rms:.2f}, worst {worst:.2f} px per 100 m; "
        f"with the best direction rms {turning:.2f}"
    )
    # 59.7 px per 100 m in all. The nominal elevation is 0.2 degrees off, and over 15 x 19 km the line of sight turns.
    assert np.hypot(*real[40]) == pytest.approx(59.7, abs=0.3)
    assert middle < 0.6
    assert rms < 1.1
    assert worst < 2.2
    assert turning < 0.95
    # From grid north, or towards the satellite, it would be several times as far off.
    lon, lat = ground_transform(UTM, "EPSG:4979")([[*geo.corners[0, :2], 0.0]])[0, :2]
    turn = math.radians(pyproj.Proj(UTM).get_factors(lon, lat).meridian_convergence)
    by_grid = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ geo.relief
    assert np.hypot(*(-100 * by_grid - real[40])) > 3 * middle
    assert np.hypot(*(100 * np.array(geo.relief) - real[40])) > 100


def test_on_its_plane_the_second_scene_agrees_too(blosseville):
    scene, rpc = blosseville
    image = np.array([[0.0, 0.0], [14668.0, 0.0], [7000.0, 9000.0], [14668.0, 18560.0]])
    ground = ground_transform(UTM, rpc.crs)(scene.model.image_to_ground(image, scene.model.plane))
    np.testing.assert_allclose(rpc.ground_to_image(ground), image, atol=0.01)


def test_colour_and_panchromatic_images_share_a_corner(real):
    """What the factor of 4 between their pixels is taken from."""
    pan, colour = (plane_of(read_rpc(real / BLOSSEVILLE)), read_rpc(real / "otb/ikonos/ikonos-1.geom"))
    place = ground_transform(colour.crs, UTM)(colour.image_to_ground(np.zeros((1, 2)), pan[0]))[0]
    np.testing.assert_allclose(place[:2], pan[1], atol=0.002)


def test_points_bring_the_plane_onto_the_real_rpc(blosseville):
    """One point takes the bias of the plane out; more also the error of the nominal direction."""
    from ortho_pipeline.estimation.fit import fit
    from ortho_pipeline.points import Points

    scene, rpc = blosseville
    rng = np.random.default_rng(2)
    image = rng.uniform([500, 500], [14000, 18000], (12, 2))
    ground = rpc.image_to_ground(image, rng.uniform(0, 220, 12))
    table = Points(
        ids=tuple(map(str, range(12))), image=image, ground=ground, roles=np.full(12, "control"),
        sigma_image=np.full(12, 0.5), sigma_ground=np.zeros((12, 3)), crs=pyproj.CRS("EPSG:4326"), source="the RPC",
    )  # fmt: skip
    before = fit(scene.model, table.with_ground(ground), robust=False, priors=scene.priors)
    raw, left = (np.sqrt((part**2).sum(axis=1).mean()) for part in (before.raw_residuals, before.residuals))
    print(f"geo against the RPC at 12 points over 220 m of heights: {raw:.2f} px, adjusted {left:.2f} px")
    assert raw < 1.5
    assert left < 0.9
    assert left < raw
