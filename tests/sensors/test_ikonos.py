"""IKONOS Geo: metadata, the plane at Reference Height, bands and components of an order, what GDAL makes of it."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import ortho_ikonos
import pytest
from ortho_ikonos.metadata import read_header, read_metadata
from osgeo import gdal, osr

from ortho_pipeline import commands
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.model_file import load_model
from ortho_pipeline.exchange.rpc import export_rpc, read_rpc, write_rpb, write_rpc_txt
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.host import Host
from ortho_pipeline.models import ImageCorrection, MapPlane, Pieces
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.testing import check_sensor, check_sensor_model

UTM = "EPSG:32639"
CORNER, SIZE, PLANE = (535000.0, 3957000.0), (400, 300), 1300.0
AZIMUTH, ELEVATION = 126.9937, 67.33891
HEIGHTS = (1200.0, 1400.0)
RULE = "=" * 62
SENSOR = next(iter(ortho_ikonos.ortho_sensors()))


def component_text(number: str, corner: tuple[float, float], image: str = "000", pixel: float = 1.0) -> str:
    return f"""Component ID: {number}
Product Image ID: {image}
Country Code: IR
Component Geographic Corner Coordinates
   Number of Coordinates: 4
   Coordinate: 1
      Latitude: 35.7500000 degrees
      Longitude: 51.3500000 degrees
   Coordinate: 2
      Latitude: 35.7600000 degrees
      Longitude: 51.3600000 degrees
Component Map Coordinates (in Map Units)
   UL Map X (Easting): {corner[0] + pixel / 2:.2f} meters
   UL Map Y (Northing): {corner[1] - pixel / 2:.2f} meters
Pixel Size X: {pixel:.10f} meters
Pixel Size Y: {pixel:.10f} meters
Product Order Map Units: meters
Columns: {SIZE[0]} pixels
Rows: {SIZE[1]} pixels
Reference Height: {PLANE:.10f} meters
Percent Component Cloud Cover: 0
"""


def metadata_text(*components: str) -> str:
    components = components or (component_text("0000000", CORNER),)
    return f"""{RULE}
Version Number: 2.2
{RULE}====

Product Order Metadata

Creation Date: 05/25/01
Product Order Number: 39001
Customer Project Name: TEHRAN
Sensor Name: IKONOS-2
Product Line: Geo
Processing Level: Standard Geometrically Corrected
Image Type: PAN
Map Projection: Universal Transverse Mercator
   UTM Specific Parameters
      Hemisphere: N
      Zone Number: 39
Datum: WGS84
Product Order Map Units: meters
File Format: GeoTIFF
   TIFF Tiled: No
   Bits per Pixel per Band: 11 bits per pixel

{RULE}

Source Image Metadata

Number of Source Images: 1

Source Image ID: 2001052507012340000011600000
Product Image ID: 000
Sensor: IKONOS-2
Acquired Nominal GSD
   Pan Cross Scan: 0.93 meters
   MS Cross Scan: 3.72 meters
Scan Azimuth: 180.05 degrees
Nominal Collection Azimuth: {AZIMUTH} degrees
Nominal Collection Elevation: {ELEVATION} degrees
Sun Angle Azimuth: 120.1234 degrees
Sun Angle Elevation: 65.1234 degrees
Acquisition Date/Time: 2001-05-25 07:01 GMT
Percent Cloud Cover: 999

{RULE}

Product Space Metadata

Number of Image Components: {len(components)}
   X Components: {len(components)}
Pixel Size X: 1.0000000000 meters
Pixel Size Y: 1.0000000000 meters
Columns: 400 pixels
Rows: 300 pixels
Reference Height: {PLANE:.10f} meters

{RULE}

Product Component Metadata

Number of Components: {len(components)}

{("-" * 62 + chr(10)).join(components)}
{RULE}
"""


def plane(**changes: Any) -> MapPlane:
    made = MapPlane.from_view(
        UTM, CORNER, (1.0, 1.0), SIZE, PLANE, math.radians(AZIMUTH), math.radians(ELEVATION), HEIGHTS
    )
    return replace(made, **changes)


def ramps() -> np.ndarray:
    """Return two bands whose values are column and row: an ortho of them says where each pixel came from."""
    row, column = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    return np.stack([column, row]).astype(np.float32)


def write_image(path: Path, pixels: np.ndarray, corner=CORNER, pixel: float = 1.0, driver: str = "GTiff") -> Path:
    kind = {"f": gdal.GDT_Float32, "u": gdal.GDT_UInt16}[pixels.dtype.kind]
    dataset = gdal.GetDriverByName(driver).Create(str(path), *pixels.shape[:0:-1], len(pixels), kind)
    utm = osr.SpatialReference()
    utm.ImportFromEPSG(32639)
    if driver == "GTiff":
        dataset.SetSpatialRef(utm)
        dataset.SetGeoTransform((corner[0], pixel, 0.0, corner[1], 0.0, -pixel))
    dataset.WriteArray(pixels)
    dataset.FlushCache()
    return path


def write_order(folder: Path, *, rpc: bool = False, text: str | None = None) -> Path:
    """Write one pan component and its metadata; return the image."""
    folder.mkdir(exist_ok=True)
    image = write_image(folder / "po_39001_pan_0000000.tif", ramps())
    (folder / "po_39001_metadata.txt").write_text(text or metadata_text())
    if rpc:
        write_rpc_txt(export_rpc(plane()).rpc, folder / "po_39001_pan_0000000_rpc.txt")
    return image


def open_order(image: Path, **options: str) -> Any:
    return open_scene(image, SceneOptions(sensor_options=options))


# -- metadata --------------------------------------------------------------------------------------------------------


def test_metadata_are_read_by_section_and_linked(tmp_path):
    path = tmp_path / "po_1_metadata.txt"
    path.write_text(metadata_text(component_text("0000000", CORNER), component_text("0010000", (536000, 3957000))))
    read = read_metadata(path)
    assert (read.crs, read.order, read.bits) == (UTM, "39001", 11)
    assert (read.product_line, read.level) == ("Geo", "Standard Geometrically Corrected")
    second = read.component("0010000")
    assert second.placement.upper_left == (536000.5, 3956999.5)
    assert second.placement.size == SIZE
    assert second.placement.reference_height == PLANE
    source = read.source_of(second)
    assert (source.azimuth, source.elevation, source.scan_azimuth) == (AZIMUTH, ELEVATION, 180.05)
    assert (source.sun_azimuth, source.sun_elevation) == (120.1234, 65.1234)
    assert source.acquired == "2001-05-25T07:01Z"
    assert not read.notes


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("   ", "\t"),
        lambda text: text.replace("TEHRAN", "Téhéran: المدينة"),
        lambda text: text.replace(RULE, "=" * 40),
        lambda text: text.replace("Component ID", "Tile ID"),
        lambda text: text.replace("Scan Azimuth: 180.05 degrees\n", ""),
        lambda text: text.replace("Sensor: IKONOS-2\n", "Sensor: IKONOS-2\nSensor: IKONOS-2\n"),
        lambda text: f"{RULE}\nCompany Information\n   Address\n      Thornton\n   Hours: Monday, 7:00\n{text}",
        lambda text: text.replace(" meters", "").replace(" degrees", ""),
    ],
)
def test_variants_of_the_file_say_the_same(tmp_path, change):
    path = tmp_path / "po_1_metadata.txt"
    path.write_bytes(change(metadata_text()).encode())
    read = read_metadata(path)
    component = read.component("0000000")
    assert component.placement.upper_left == (535000.5, 3956999.5)
    assert read.source_of(component).azimuth == AZIMUTH


def test_names_in_another_encoding_do_not_matter(tmp_path):
    path = tmp_path / "po_1_metadata.txt"
    path.write_bytes(metadata_text().replace("TEHRAN", "Téhéran").encode("latin-1"))
    assert read_metadata(path).crs == UTM


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("Product Order Metadata", "Other Metadata", "Product Order Metadata"),
        ("Source Image Metadata", "Other Metadata", "Source Image Metadata"),
        ("Product Component Metadata", "Source Image Metadata", "Source Image Metadata"),
        ("Number of Components: 1", "Number of Components: 2", "Number of Components"),
        ("Number of Source Images: 1", "Number of Source Images: 1.5", "Number of Source Images"),
        ("Product Image ID: 000\nSensor", "Sensor", "Product Image ID"),
        ("67.33891 degrees", "67,33891 degrees", "Nominal Collection Elevation"),
        ("67.33891 degrees", "97.3 degrees", "Nominal Collection Elevation"),
        ("67.33891 degrees", "nan degrees", "Nominal Collection Elevation"),
        ("67.33891 degrees", "1e999 degrees", "Nominal Collection Elevation"),
        ("126.9937 degrees", "2.2164 radians", "Nominal Collection Azimuth"),
        ("535000.50 meters", "1755245.41 feet", "UL Map X"),
        ("   UL Map Y (Northing): 3956999.50 meters\n", "", "UL Map X, UL Map Y"),
        ("UL Map X (Easting): 535000.50 meters", "UL Map X (Easting): 535000.50 meters\n   UL Map X (Easting): 1",
         "UL Map X"),
        ("Zone Number: 39", "Zone Number: 61", "UTM Specific Parameters"),
        ("      Hemisphere: N\n", "", "UTM Specific Parameters"),
        ("Columns: 400 pixels\nRows: 300 pixels\nReference", "Columns: 400 pixels\nReference", "Columns, Rows"),
        ("Customer", f"{'x' * 20_000}\nCustomer", "line 9"),
        ("Customer", "\0Customer", "metadata"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path, old, new, field):
    path = tmp_path / "po_1_metadata.txt"
    text = metadata_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_metadata(path)
    assert field in (caught.value.field or "")
    assert caught.value.file == str(path)
    assert caught.value.remedy


def test_broken_links_and_unknown_components_are_named(tmp_path):
    path = tmp_path / "po_1_metadata.txt"
    path.write_text(metadata_text(component_text("0000000", CORNER, image="007")))
    read = read_metadata(path)
    with pytest.raises(InputError, match="product image 007, which no source image has"):
        read.source_of(read.component("0000000"))
    with pytest.raises(InputError, match="no component is called 0010000"):
        read.component("0010000")


def test_a_file_cut_anywhere_is_an_error_or_says_so(tmp_path):
    path, text = tmp_path / "po_1_metadata.txt", metadata_text()
    whole = read_metadata_of(path, text)
    for end in range(0, len(text) - 70, 7):
        try:
            notes = read_metadata_of(path, text[:end]).notes
        except InputError as error:
            notes = (str(error),)
        assert notes, f"cut after {end} of {len(text)} characters"
    assert not whole.notes


def read_metadata_of(path: Path, text: str) -> Any:
    path.write_text(text)
    return read_metadata(path)


def test_mutations_raise_nothing_but_typed_errors(tmp_path):
    image, rng = write_order(tmp_path / "order"), random.Random(6)
    path, lines = image.with_name("po_39001_metadata.txt"), metadata_text().splitlines()
    refused = 0
    for _ in range(300):
        changed = list(lines)
        for _ in range(rng.choice((1, 1, 3))):
            at = rng.randrange(len(changed))
            what = rng.randrange(6)
            if what == 0:
                del changed[at]
            elif what == 1:
                changed.insert(at, changed[rng.randrange(len(changed))])
            elif what == 2:
                changed[at] = changed[at][: rng.randrange(len(changed[at]) + 1)]
            elif what == 3:
                junk = rng.choice(("nan", "-1e400", "", "١٢٣", "1_000", "0x10", "true", "﷽" * 50, "-", "9" * 400, "::"))
                changed[at] = f"{changed[at].partition(':')[0]}: {junk}"
            elif what == 4:
                changed[at] = "      " + changed[at]
            else:
                changed[at] = "".join(rng.sample(changed[at], len(changed[at])))
        path.write_text("\n".join(changed) + "\n")
        try:
            scene = SENSOR.open_scene(gdal.Open(str(image)))
        except InputError:
            refused += 1
        else:
            middle = scene.model.ground_to_image([[535200.0, 3956850.0, PLANE]])
            assert np.isfinite(middle).all()
    assert 30 < refused < 290


@pytest.mark.parametrize("data", [b"x" * 10_000_000, b"\xff\xfe" + b"a\0" * 100, bytes(1000), b"", b"=" * 5000])
def test_odd_files_are_refused_soon(tmp_path, data, calls):
    path = tmp_path / "po_1_metadata.txt"
    path.write_bytes(data)
    with pytest.raises(InputError), calls:
        read_metadata(path)
    # Nothing is done for every line of 10 MB.
    assert calls.count < 1000
    with pytest.raises(InputError, match="cannot be read"):
        read_metadata(tmp_path / "absent.txt")


# -- the plane at Reference Height -----------------------------------------------------------------------------------


def box_of(model: MapPlane, count: int = 200) -> np.ndarray:
    centre, half = model.domain
    return centre + half * np.random.default_rng(1).uniform(-1, 1, (count, 3))


@pytest.mark.parametrize("changes", [{}, {"shift": (12.0, -7.0), "pixel": (4.0, 3.5)}, {"relief": (0.0, 0.0)}])
def test_contract(changes):
    model = plane(**changes)
    check_sensor_model(model, box_of(model))


def test_the_first_pixel_is_centred_on_the_upper_left_map_coordinates():
    at = [[CORNER[0] + 0.5, CORNER[1] - 0.5, PLANE], [CORNER[0] + 100.5, CORNER[1] - 200.5, PLANE]]
    np.testing.assert_allclose(plane().ground_to_image(at), [[0.5, 0.5], [100.5, 200.5]], atol=1e-9)


@pytest.mark.parametrize(("azimuth", "elevation"), [(AZIMUTH, ELEVATION), (301.0, 72.0), (10.0, 89.0)])
@pytest.mark.parametrize("corner", [(535000.0, 3957000.0), (730000.0, 6600000.0)])
def test_relief_lies_on_the_line_to_the_satellite(azimuth, elevation, corner):
    """From the middle of the scene on the plane upwards to the satellite, in ECEF."""
    model = MapPlane.from_view(
        UTM, corner, (1.0, 1.0), SIZE, PLANE, math.radians(azimuth), math.radians(elevation), (0.0, 3000.0)
    )
    place = ground_transform(UTM, "EPSG:4979")([[corner[0] + 200.0, corner[1] - 150.0, PLANE]])
    lon, lat = np.radians(place[0, :2])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    a, e = math.radians(azimuth), math.radians(elevation)
    towards = math.cos(e) * (math.sin(a) * east + math.cos(a) * np.cross(up, east)) + math.sin(e) * up
    for along in (100.0, -100.0, 500.0):
        seen = ground_transform("EPSG:4978", UTM)(geocentric(place) + along * towards)
        found = model.image_to_ground([[200.0, 150.0]], seen[0, 2])
        # The Earth falls away below a straight line, and the projection is not quite straight.
        np.testing.assert_allclose(found, seen, atol=1e-3)


def seen_from(azimuth: float, elevation: float) -> MapPlane:
    angles = math.radians(azimuth), math.radians(elevation)
    return MapPlane.from_view(UTM, CORNER, (1.0, 1.0), SIZE, PLANE, *angles, HEIGHTS)


@pytest.mark.parametrize(("azimuth", "elevation"), [(AZIMUTH, ELEVATION), (301.0, 72.0), (200.0, 5.1)])
def test_azimuth_and_elevation_come_back(azimuth, elevation):
    """From five degrees above the horizon on."""
    view = np.degrees(seen_from(azimuth, elevation).view)
    np.testing.assert_allclose(view, (azimuth, elevation), rtol=0, atol=1e-4)


def test_heights_of_a_plane_include_the_plane():
    assert plane().with_heights(1310.0, 1390.0).height_range == (PLANE, 1390.0)
    assert plane().with_heights(1210.0, 1290.0).height_range == (1210.0, PLANE)


@pytest.mark.parametrize(
    "changes",
    [
        {"map_crs": "EPSG:4326"}, {"map_crs": "EPSG:2263"}, {"map_crs": "nonsense"}, {"pixel": (1.0, -1.0)},
        {"heights": (1400.0, 1200.0)}, {"plane": 9000.0}, {"relief": (math.nan, 0.0)}, {"size": (0, 5)},
    ],
)  # fmt: skip
def test_impossible_planes_are_refused(changes):
    with pytest.raises(InputError):
        plane(**changes)


@pytest.mark.parametrize("elevation", [0.5, 4.9, 90.1])
def test_a_satellite_near_the_horizon_or_beyond_the_zenith_is_refused(elevation):
    with pytest.raises(InputError, match="an elevation of"):
        seen_from(57.0, elevation)


def measured(model: MapPlane, count: int, tmp_path: Path, noise: float = 0.0) -> Path:
    """Write control points that `model` sees, over the image and its heights."""
    rng = np.random.default_rng(4)
    image = rng.uniform(20, 280, (count, 2))
    ground = model.image_to_ground(image, rng.uniform(*HEIGHTS, count))
    image += rng.normal(0, noise, image.shape) if noise else 0.0
    rows = [f"p{k},{c!r},{r!r},{x!r},{y!r},{h!r}" for k, ((c, r), (x, y, h)) in
            enumerate(zip(image.tolist(), ground.tolist(), strict=True))]  # fmt: skip
    path = tmp_path / "gcps.csv"
    path.write_text(f"#CRS: {UTM}\n#vertical: ellipsoid\n" + "\n".join(["id,col,row,x,y,h", *rows]) + "\n")
    return path


def test_one_point_shifts_and_more_turn_the_line_of_sight(tmp_path):
    image = write_order(tmp_path / "order")
    truth = plane(shift=(12.0, -7.5), relief=tuple(np.add(plane().relief, (0.004, -0.003))))
    one = commands.fit(image, PointOptions(gcps=measured(plane(shift=(12.0, -7.5)), 1, tmp_path), correction="shift"))
    np.testing.assert_allclose(one.fit.model.params, [12.0, 7.5], atol=1e-6)
    assert one.fit.model_name == "geo+shift"
    all_of_it = commands.fit(
        image, PointOptions(gcps=measured(truth, 8, tmp_path, noise=0.1), correction="model")
    ).fit  # fmt: skip
    sigma = np.sqrt(np.diag(all_of_it.covariance))
    assert (np.abs(all_of_it.model.params - truth.params) < 4 * sigma).all()
    assert sigma[2] < 0.003
    # One point and what the vendor knows of the rest: a shift, the direction hardly moves.
    soft = commands.fit(image, PointOptions(gcps=measured(plane(shift=(12.0, -7.5)), 1, tmp_path), correction="model"))
    np.testing.assert_allclose(soft.fit.predicted, soft.fit.points.image, atol=0.05)
    np.testing.assert_allclose(soft.fit.model.relief, plane().relief, atol=0.02)


# -- opening ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rpc", [False, True])
def test_an_order_opens_best_model_first(tmp_path, rpc):
    image = write_order(tmp_path / "order", rpc=rpc)
    scene = check_sensor(SENSOR, image)
    assert list(scene.models) == (["rpc", "geo"] if rpc else ["geo"])
    assert scene.model_source.endswith("_rpc.txt" if rpc else "_metadata.txt")
    assert not scene.warnings
    assert scene.facts["reference_height_m"] == PLANE
    assert scene.facts["acquired"] == "2001-05-25T07:01Z"
    assert "cloud_cover_percent" not in scene.facts
    assert Host.discover().recognise(gdal.Open(str(image))).name == "ikonos"
    ground = plane().image_to_ground([[10.0, 20.0]], 1390.0)
    np.testing.assert_allclose(scene.models["geo"].ground_to_image(ground), [[10.0, 20.0]], atol=1e-9)
    other = open_order(image, geometry="geo")
    assert next(iter(other.models)) == "geo"
    assert set(other.priors) == {"shift_x", "shift_y", "relief_x", "relief_y"}
    assert commands.info(image)["sensor"] == "ikonos"


def test_only_ikonos_orders_are_recognised(tmp_path):
    image = write_order(tmp_path / "order")
    assert SENSOR.recognises(gdal.Open(str(image)))
    (tmp_path / "order" / "po_39001_metadata.txt").write_text(metadata_text().replace("IKONOS", "OTHER"))
    assert not SENSOR.recognises(gdal.Open(str(image)))
    for name in ("scene.tif", "po_39001_pan_1.tif", "po_39002_pan_0000000.tif"):
        other = image.rename(image.with_name(name))
        assert not SENSOR.recognises(gdal.Open(str(other)))
        image = other


@pytest.mark.parametrize(("ending", "driver"), [("TIF", "GTiff"), ("NTF", "NITF")])
def test_nitf_and_other_cases_of_letters(tmp_path, ending, driver):
    if gdal.GetDriverByName(driver) is None:
        pytest.skip(f"this GDAL writes no {driver}")
    folder = tmp_path / "order"
    folder.mkdir()
    image = write_image(folder / f"PO_39001_PAN_0000000.{ending}", ramps()[:1], driver=driver)
    (folder / "PO_39001_METADATA.TXT").write_text(metadata_text())
    write_rpc_txt(export_rpc(plane()).rpc, folder / "PO_39001_PAN_0000000_RPC.TXT")
    scene = check_sensor(SENSOR, image)
    assert list(scene.models) == ["rpc", "geo"]
    assert not scene.warnings


def test_what_contradicts_is_said(tmp_path):
    folder = tmp_path / "order"
    image = write_order(folder, rpc=True, text=metadata_text(component_text("0000000", (535003.0, 3957000.0))))
    with pytest.raises(InputError, match=r"RPC and metadata differ by 3\.0 px") as caught:
        open_order(image)
    assert caught.value.file.endswith("po_39001_pan_0000000_rpc.txt")
    assert "geometry=geo" in caught.value.remedy
    for choice in ({"rpc": "sidecar"}, {"geometry": "rpc"}, {"geometry": "geo"}):
        found = " ".join(open_order(image, **choice).warnings)
        assert "georeferencing of the image is 3.00 px off" in found
        assert "RPC and metadata differ by 3.0 px" in found
    image.with_name(f"{image.stem}_rpc.txt").unlink()
    (folder / "po_39001_metadata.txt").write_text(metadata_text().replace("Product Line: Geo", "Product Line: Pro"))
    assert any("corrected twice" in text for text in open_order(image).warnings)
    (folder / "po_39001_metadata.txt").write_text(metadata_text().replace("Zone Number: 39", "Zone Number: 38"))
    assert any("in the image, but" in text for text in open_order(image).warnings)


@pytest.mark.parametrize("key", ["Nominal Collection Azimuth", "Nominal Collection Elevation", "Reference Height"])
def test_what_the_plane_lacks_is_named(tmp_path, key):
    text = "".join(line for line in metadata_text().splitlines(keepends=True) if not line.startswith(key))
    image = write_order(tmp_path / "order", text=text)
    with pytest.raises(InputError, match=f"needs {key}"):
        open_order(image)
    scene = open_order(write_order(tmp_path / "order", text=text, rpc=True))
    assert list(scene.models) == ["rpc"]
    assert scene.facts["geo_model_lacks"] == [key]


def test_a_projection_that_is_not_utm_is_taken_from_the_image(tmp_path):
    text = metadata_text().replace("Universal Transverse Mercator", "Lambert Conformal Conic")
    assert open_order(write_order(tmp_path / "order", text=text)).model.crs == UTM


def test_wrong_options_and_crops_are_refused(tmp_path):
    image = write_order(tmp_path / "order")
    for options in ({"geometry": "dem"}, {"geometry": "rpc"}, {"heights": "5"}, {"bands": "red"}, {"bands": "xyz"}):
        with pytest.raises(InputError):
            open_order(image, **options)
    image.unlink()  # GDAL would delete the metadata with an image that it overwrites
    write_image(image, ramps()[:, :200])
    with pytest.raises(InputError, match="400 x 200 pixels, but the metadata are for 400 x 300"):
        open_order(image)
    assert open_order(write_order(tmp_path / "order"), heights="1000,2500").model.height_range == (1000.0, 2500.0)


def test_side_cars_of_another_image_are_refused_whatever_reads_them(tmp_path):
    # GDAL attaches any .RPB, and takes it before the vendor's own text.
    image = write_order(tmp_path / "order", rpc=True)
    far = plane(corner=(CORNER[0], CORNER[1] - 400000.0))
    write_rpb(export_rpc(far).rpc, image.with_suffix(".RPB"))
    with pytest.raises(InputError, match="differ by") as caught:
        open_order(image)
    assert caught.value.file.endswith(".RPB")
    assert next(iter(open_order(image, geometry="geo").models)) == "geo"


@pytest.mark.parametrize("part", [2, 4])
def test_a_crop_to_a_part_is_not_taken_for_coarser_pixels(tmp_path, part):
    image = write_order(tmp_path / "order")
    red = image.with_name("po_39001_red_0000000.tif")
    columns, rows = SIZE[0] // part, SIZE[1] // part
    refused = f"the image has {columns} x {rows} pixels"
    image.unlink()  # GDAL would delete the metadata with an image that it overwrites
    for path in (image, red):
        write_image(path, ramps()[:1, :rows, :columns])
        with pytest.raises(InputError, match=refused):
            open_order(path)
        path.unlink()
        # Resampled, and it says so.
        write_image(path, ramps()[:1, ::part, ::part], pixel=float(part))
        assert open_order(path).model.pixel == (float(part), float(part))
        path.unlink()
        # Where nothing says so, only colours are coarser, by 4.
        gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1).FlushCache()
        if path == red and part == 4:
            assert open_order(path).model.pixel == (4.0, 4.0)
        else:
            with pytest.raises(InputError, match=refused):
                open_order(path)
        path.unlink()


def test_the_header_of_an_image_comes_before_the_metadata(tmp_path):
    image = write_order(tmp_path / "order")
    header = image.with_name("po_39001_pan_0000000_hdr.txt")
    header.write_text(
        "Producer: Space Imaging\nBand: Pan\nUL Map X (Easting): 535010.50 meters\nUL Map Y (Northing): 3956999.50\n"
        "Pixel Size X: 1.0000 meters\nPixel Size Y: 1.0000 meters\nColumns: 400\nRows: 300\n"
    )
    assert read_header(header).upper_left == (535010.5, 3956999.5)
    assert open_order(image).model.corner == (535010.0, 3957000.0)


# -- bands and components --------------------------------------------------------------------------------------------


def write_bands(folder: Path) -> dict[str, Path]:
    """Write four colour bands with 4 m pixels beside metadata of the panchromatic image."""
    write_order(folder)
    made = {}
    for value, band in enumerate(("blu", "grn", "red", "nir"), start=1):
        row, column = np.mgrid[0:75, 0:100]
        pixels = (500 + 100 * value + 3 * column + row).astype(np.uint16)[None]
        made[band] = write_image(folder / f"po_39001_{band}_0000000.tif", pixels, pixel=4.0)
    return made


def test_colour_images_share_the_outer_corner_of_the_panchromatic_one(tmp_path):
    scene = open_order(write_bands(tmp_path / "order")["red"])
    assert scene.model.pixel == (4.0, 4.0)
    assert scene.model.corner == CORNER
    assert not scene.warnings
    assert {piece.path.name[9:12] for piece in scene.pieces} == {"blu", "grn", "nir", "pan"}


def test_bands_are_stacked_and_each_is_as_by_itself(tmp_path):
    bands = write_bands(tmp_path / "order")
    options = {"surface": SurfaceOptions(height=1330.0), "output": OutputOptions(resolution=4.0)}
    made = commands.rectify(
        bands["red"], tmp_path / "all", scene=SceneOptions(sensor_options={"bands": "all"}), **options
    )
    stack = gdal.Open(str(made.files["ortho"]))
    assert [stack.GetRasterBand(k).GetDescription() for k in range(1, 5)] == [path.stem for path in bands.values()]
    hashed = {entry["path"] for entry in made.document["report"]["provenance"]["inputs"]}
    assert {*map(str, bands.values()), str(tmp_path / "order" / "po_39001_metadata.txt")} <= hashed
    for number, (band, path) in enumerate(bands.items(), start=1):
        alone = commands.rectify(path, tmp_path / band, **options)
        np.testing.assert_array_equal(
            gdal.Open(str(alone.files["ortho"])).ReadAsArray(), stack.GetRasterBand(number).ReadAsArray()
        )
    some = open_order(bands["red"], bands="red,grn")
    assert [path.name[9:12] for path in some.rasters] == ["red", "grn"]
    with pytest.raises(InputError, match="no file found for band 'ms'"):
        open_order(bands["red"], bands="red,ms")


FAR = (CORNER[0] + 1600.0, CORNER[1] + 37.0)


def write_components(folder: Path) -> tuple[Path, Path]:
    """Write two components of one acquisition, 1.6 km apart, each with an RPC of its own."""
    text = metadata_text(component_text("0000000", CORNER), component_text("0010000", FAR))
    first = write_order(folder, text=text)
    second = write_image(folder / "po_39001_pan_0010000.tif", ramps(), FAR)
    for image, corner in ((first, CORNER), (second, FAR)):
        write_rpc_txt(export_rpc(plane(corner=corner)).rpc, image.with_name(f"{image.stem}_rpc.txt"))
    return first, second


def write_shared(path: Path, images: tuple[Path, Path], bias: tuple[float, float]) -> Path:
    """Write points of both components, whose images all carry one bias."""
    rng, rows = np.random.default_rng(5), ["id,col,row,x,y,h,role,image"]
    for image, corner in zip(images, (CORNER, FAR), strict=True):
        at = rng.uniform(30, 270, (6, 2))
        ground = plane(corner=corner).image_to_ground(at, rng.uniform(*HEIGHTS, 6))
        at += bias + rng.normal(0, 0.2, at.shape)
        for k in range(6):
            cells = (f"{image.stem[-7:]}-{k}", *at[k].tolist(), *ground[k].tolist(), "control", image.name)
            rows.append(",".join(map(str, cells)))
    path.write_text(f"#CRS: {UTM}\n#vertical: ellipsoid\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("correction", ["shift", "affine"])
def test_components_share_one_adjustment(tmp_path, correction):
    images = write_components(tmp_path / "order")
    gcps = write_shared(tmp_path / "gcps.csv", images, (4.0, -3.0))
    first, second = (commands.fit(image, PointOptions(gcps=gcps, correction=correction)).fit for image in images)
    assert first.used.sum() == second.used.sum() == 12
    assert isinstance(first.model.model, Pieces)
    np.testing.assert_allclose(first.rmse("control").total, second.rmse("control").total, rtol=1e-6)
    # One correction of the whole plane: seen from either component it moves the same place alike.
    places = np.array([[20.0, 30.0], [380.0, 200.0], [1700.0, 100.0]])
    offset = np.array([1600.0, -37.0])
    moved = [corrected(fitted.model, at) for fitted, at in ((first, places), (second, places - offset))]
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-5)
    if correction == "shift":
        np.testing.assert_allclose(first.model.params, [4.0, -3.0], atol=0.25)


def corrected(model: ImageCorrection, image: np.ndarray) -> np.ndarray:
    """Return by how much a correction moves image points."""
    return image @ model.matrix.T + model.offset - image


def test_the_rpc_of_a_component_takes_the_shared_shift_exactly(tmp_path):
    images = write_components(tmp_path / "order")
    gcps = write_shared(tmp_path / "gcps.csv", images, (4.0, -3.0))
    made = commands.rectify(
        images[1], tmp_path / "out", points=PointOptions(gcps=gcps), surface=SurfaceOptions(height=1300.0)
    )
    assert made.document["report"]["rpc"]["exact"]
    model = load_model(made.files["model"])
    assert isinstance(model, ImageCorrection)
    assert model.model.kind == "rpc"
    delivered, written = read_rpc(images[1].with_name(f"{images[1].stem}_rpc.txt")), read_rpc(made.files["rpc"])
    assert written.col_off - delivered.col_off == pytest.approx(model.params[0], abs=1e-9)


def test_pieces_keep_the_contract():
    far = plane(corner=FAR)
    pieces = Pieces((plane(), far), ((0.0, 0.0), (1600.0, -37.0)), (SIZE, SIZE))
    ground = np.concatenate([box_of(plane(), 20), box_of(far, 20)])
    check_sensor_model(pieces, ground)
    np.testing.assert_allclose(pieces.ground_to_image(ground), plane().ground_to_image(ground), atol=1e-6)
    for broken in ((), (plane(), replace(plane(), map_crs="EPSG:32638"))):
        with pytest.raises(InputError):
            Pieces(broken, ((0.0, 0.0),) * 2, (SIZE,) * 2)


def test_a_point_of_several_bands_counts_once(tmp_path):
    bands = write_bands(tmp_path / "order")
    rows = [f"g{k},{col},{row},{535000 + 4 * col},{3957000 - 4 * row},{PLANE},{bands[band].name}"
            for k, (col, row, band) in enumerate([(10, 10, "red"), (80, 15, "nir"), (40, 60, "blu")])]  # fmt: skip
    rows.append(f"g1,80.2,15.2,{535000 + 320},{3957000 - 60},{PLANE},{bands['red'].name}")
    path = tmp_path / "gcps.csv"
    path.write_text(f"#CRS: {UTM}\n#vertical: ellipsoid\nid,col,row,x,y,h,image\n" + "\n".join(rows) + "\n")
    fitted = commands.fit(bands["red"], PointOptions(gcps=path, correction="none")).fit
    assert sorted(fitted.points.ids) == ["g0", "g1", "g2"]
    # The image that is adjusted comes first.
    np.testing.assert_array_equal(fitted.points.image[fitted.points.ids.index("g1")], [80.2, 15.2])


@pytest.mark.parametrize("origin", ["corner", "center"])
def test_points_in_the_panchromatic_image_adjust_the_colour_bands(tmp_path, origin):
    # Nobody measures in 4 m pixels what can be seen in those of 1 m.
    bands, rng = write_bands(tmp_path / "order"), np.random.default_rng(3)
    at = rng.uniform(20, 280, (8, 2))
    ground = plane().image_to_ground(at, rng.uniform(*HEIGHTS, 8))
    at += (6.0, -4.0) - np.array(0.5 if origin == "center" else 0.0)
    rows = [f"g{k},{','.join(map(str, (*at[k], *ground[k])))},po_39001_pan_0000000.tif,0.5" for k in range(8)]
    path = tmp_path / "gcps.csv"
    path.write_text(f"#CRS: {UTM}\n#vertical: ellipsoid\nid,col,row,x,y,h,image,sigma_image\n" + "\n".join(rows) + "\n")
    options = PointOptions(gcps=path, correction="shift", pixel_origin=origin)
    found = commands.fit(bands["red"], options).fit
    np.testing.assert_allclose(found.model.params, [1.5, -1.0], atol=1e-6)
    np.testing.assert_allclose(found.points.sigma_image, 0.125)
    # Coarser by as much, and the same in metres, the other way round.
    path.write_text(path.read_text().replace("pan_0000000", "red_0000000"))
    found = commands.fit(tmp_path / "order" / "po_39001_pan_0000000.tif", options).fit
    np.testing.assert_allclose(found.points.sigma_image, 2.0)


def test_sharpened_colours_have_pixels_of_their_own(tmp_path):
    bands = write_bands(tmp_path / "order")
    sharp = write_image(tmp_path / "order" / "po_39001_rgb_0000000.tif", ramps())
    assert {piece.path.name[9:12]: piece.scale for piece in open_order(sharp).pieces} == {
        "pan": 1.0, "blu": 4.0, "grn": 4.0, "red": 4.0, "nir": 4.0,
    }  # fmt: skip
    assert {piece.path.name[9:12]: piece.scale for piece in open_order(bands["red"]).pieces} == {
        "pan": 0.25, "rgb": 0.25, "blu": 1.0, "grn": 1.0, "nir": 1.0,
    }  # fmt: skip


def test_a_neighbour_that_is_broken_is_no_obstacle(tmp_path):
    bands = write_bands(tmp_path / "order")
    (tmp_path / "order" / "po_39001_pan_0000000.tif").write_bytes(b"cut off")
    scene = open_order(bands["red"])
    assert {piece.path.name[9:12] for piece in scene.pieces} == {"blu", "grn", "nir"}
    assert "points in po_39001_pan_0000000.tif are not used" in scene.warnings[0]


# -- what GDAL makes of it -------------------------------------------------------------------------------------------


def slope(path: Path) -> Path:
    """Write a DEM that is a plane of ellipsoidal heights, 1220 to 1380 m over the image."""
    step, columns, rows = 20.0, 60, 55
    left, top = CORNER[0] - 400, CORNER[1] + 400
    x, y = np.meshgrid(left + step * (np.arange(columns) + 0.5), top - step * (np.arange(rows) + 0.5))
    heights = 1300 + 0.35 * (x - CORNER[0] - 200) - 0.1 * (y - CORNER[1] + 150)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1, gdal.GDT_Float64)
    utm = osr.SpatialReference()
    utm.ImportFromEPSG(32639)
    dataset.SetSpatialRef(utm)
    dataset.SetGeoTransform((left, step, 0.0, top, 0.0, -step))
    dataset.WriteArray(heights)
    dataset.FlushCache()
    return path


def warped_by_gdal(source: Path, ours: Path, folder: Path, *transformer: str) -> np.ndarray:
    """Return what gdalwarp makes of `source` on the grid of an ortho, exactly and unchunked (NaN: nothing)."""
    grid, path = gdal.Open(str(ours)), folder / "gdal.tif"
    left, dx, _, top, _, dy = grid.GetGeoTransform()
    bounds = (left, top + dy * grid.RasterYSize, left + dx * grid.RasterXSize, top)
    gdal.Warp(
        str(path), str(source), dstSRS=UTM, outputBounds=bounds, width=grid.RasterXSize, height=grid.RasterYSize,
        transformerOptions=list(transformer), errorThreshold=0, resampleAlg="bilinear", dstNodata=-1,
        warpOptions=["XSCALE=1", "YSCALE=1"],
    )  # fmt: skip
    pixels = gdal.Open(str(path)).ReadAsArray()[:2]
    return np.where(pixels == -1, np.nan, pixels)


def difference(ours: Path, theirs: np.ndarray) -> float:
    """Return the largest distance (px of the image) between where two orthos of the ramps have their pixels from."""
    dataset = gdal.Open(str(ours))
    pixels = dataset.ReadAsArray()[:2].astype(np.float64)
    pixels[:, dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() == 0] = np.nan
    # At the rim a kernel is cut off, and a ramp is no ramp any more.
    inside = (pixels > 2) & (pixels < np.array(SIZE)[:, None, None] - 2)
    inside = inside.all(axis=0) & np.isfinite(theirs).all(axis=0)
    assert inside.sum() > 60_000
    return float(np.hypot(*(pixels - theirs))[inside].max())


@pytest.mark.parametrize(
    ("rpc", "options", "exact"),
    [
        (True, {"correction": "shift"}, True),
        (True, {"correction": "affine"}, False),
        (False, {"correction": "shift"}, False),
        (False, {"correction": "model"}, False),
        (False, {"fit_model": "affine3d"}, False),
        (False, {"fit_model": "dlt"}, False),
    ],
    ids=["rpc+shift", "rpc+affine", "geo+shift", "geo+model", "affine3d", "dlt"],
)
def test_gdalwarp_makes_the_same_ortho_of_the_rpc(tmp_path, rpc, options, exact):
    image = write_order(tmp_path / "order", rpc=rpc)
    dem = slope(tmp_path / "dem.tif")
    gcps = measured(plane(shift=(5.0, -4.0)), 15, tmp_path, noise=0.2)
    made = commands.rectify(
        image, tmp_path / "out", points=PointOptions(gcps=gcps, **options),
        surface=SurfaceOptions(dem=dem, vertical="ellipsoid"), output=OutputOptions(extent=EXTENT, resolution=1.0),
    )  # fmt: skip
    stated = made.document["report"]["rpc"]
    assert stated["exact"] is exact
    assert stated["max_error_px"] <= 1e-3
    theirs = warped_by_gdal(
        made.files["vrt"], made.files["ortho"], tmp_path, "METHOD=RPC", f"RPC_DEM={dem}",
        "RPC_DEMINTERPOLATION=bilinear", "RPC_DEM_APPLY_VDATUM_SHIFT=NO",
    )  # fmt: skip
    # Ours is within 0.01 px of the model by contract; the RPC is within what is stated of it.
    assert difference(made.files["ortho"], theirs) <= 0.01 + stated["max_error_px"]


EXTENT = (CORNER[0], CORNER[1] - SIZE[1], CORNER[0] + SIZE[0], CORNER[1])


@pytest.mark.parametrize(("family", "order"), [("affine2d", "1"), ("poly2", "2")])
def test_gdalwarp_makes_the_same_ortho_of_the_control_points(tmp_path, family, order):
    image = write_order(tmp_path / "order")
    gcps = measured(plane(shift=(5.0, -4.0)), 15, tmp_path, noise=0.2)
    points = PointOptions(gcps=gcps, fit_model=family)
    made = commands.rectify(
        image, tmp_path / "out", points=points, surface=SurfaceOptions(height=PLANE),
        output=OutputOptions(extent=EXTENT, resolution=1.0),
    )  # fmt: skip
    exported = commands.export(image, tmp_path / "gcp", points=points, formats=["gcp"])
    theirs = warped_by_gdal(
        exported.files["gcp"], made.files["ortho"], tmp_path, "METHOD=GCP_POLYNOMIAL", f"MAX_GCP_ORDER={order}"
    )
    assert difference(made.files["ortho"], theirs) < 0.02


def test_the_fitted_rpc_stands_for_the_plane_as_stated():
    exported, ground = export_rpc(plane()), box_of(plane(), 50)
    there = exported.rpc.ground_to_image(ground_transform(UTM, "EPSG:4979")(ground))
    assert not exported.exact
    np.testing.assert_allclose(there, plane().ground_to_image(ground), atol=exported.max_error_px + 1e-6)


def test_fits_are_linear_in_the_parameters(tmp_path):
    start = plane()
    scene = open_order(write_order(tmp_path / "order"))
    points = commands.fit(
        scene.path, PointOptions(gcps=measured(plane(shift=(3.0, 4.0)), 5, tmp_path), correction="none")
    ).fit.points
    again = fit(start, points, robust=False)
    np.testing.assert_allclose(again.model.shift, (3.0, 4.0), atol=1e-6)
