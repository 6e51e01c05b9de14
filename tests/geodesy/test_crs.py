"""CRS, height datums and transformations: field notes 1, 2, 10, 11."""

from __future__ import annotations

import os
import pickle
import shutil
import struct
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal
from pyproj.database import query_crs_info

from ortho_pipeline.errors import CrsError, DatumError
from ortho_pipeline.geodesy import crs as module
from ortho_pipeline.geodesy.crs import (
    GroundTransform,
    Vertical,
    horizontal,
    parse_crs,
    utm_crs,
)  # fmt: skip
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.geodesy.missing_grids import grid_remedy
from ortho_pipeline.geodesy.naming import crs_definition, crs_text
from ortho_pipeline.geodesy.proj_grids import grids, proj_info

EGM96 = Path("/usr/share/proj/egm96_15.gtx")
needs_egm96 = pytest.mark.skipif(not EGM96.is_file(), reason="Debian's proj-data (egm96_15.gtx) is not installed")


def test_a_crs_in_words_and_as_it_is_read_again() -> None:
    # Only a code that is exactly the CRS defines it: this one has another false easting.
    own = pyproj.CRS.from_proj4("+proj=tmerc +lat_0=0 +lon_0=33 +k=0.9996 +x_0=400000 +y_0=0 +datum=WGS84 +no_defs")
    assert (crs_text(pyproj.CRS(32636)), crs_definition(pyproj.CRS(32636))) == ("EPSG:32636", "EPSG:32636")
    assert (own.name, crs_text(own)) == ("unknown", "custom Transverse Mercator")
    # The shift of its datum is not what a system is called after.
    bound = pyproj.CRS("+proj=tmerc +lon_0=33 +ellps=bessel +towgs84=598,73,418,0,0,0,0 +type=crs")
    assert (bound.is_bound, crs_text(bound)) == (True, "custom Transverse Mercator")
    assert crs_text(pyproj.CRS("+proj=longlat +ellps=bessel +type=crs")) == "custom geographic CRS"
    assert "\n" not in crs_definition(own)
    assert pyproj.CRS(crs_definition(own)) == own


def test_a_pair_of_systems_is_set_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """PROJ takes milliseconds for it, and `ortho rectify` asked nine times for two pairs."""
    made = []
    plain = pyproj.Transformer.from_crs

    def counted(*systems: object, **more: object) -> pyproj.Transformer:
        made.append(systems)
        return plain(*systems, **more)

    monkeypatch.setattr(module.Transformer, "from_crs", counted)
    ways = [GroundTransform("EPSG:4979", crs) for crs in ("EPSG:32637", pyproj.CRS.from_epsg(32637), utm_crs(39, 1))]
    assert len(made) <= 1
    assert np.array_equal(*(way(np.array([[39.0, 1.0, 50.0]])) for way in ways[::2]))


# -- heights


@needs_egm96
def test_egm96_is_found_out_of_the_box() -> None:
    # PROJ's own programs give 28.208 m here (EPSG:4326+5773 to EPSG:4979).
    assert Vertical.parse("egm96").undulation([24.4], [-33.65])[0] == pytest.approx(28.208, abs=0.01)


@needs_egm96
def test_system_grids_are_found_in_a_fresh_process_and_other_threads() -> None:
    code = "from ortho_pipeline import Vertical; print(Vertical.parse('egm96').undulation([24.4], [-33.65])[0])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(28.208, abs=0.01)
    seen: list[float] = []
    thread = threading.Thread(target=lambda: seen.append(float(Vertical("EPSG:5773").undulation([24.4], [-33.65])[0])))
    thread.start()
    thread.join()
    assert seen == [pytest.approx(28.208, abs=0.01)]


@pytest.mark.parametrize(
    "name", ["egm2008", "EPSG:3855", pytest.param("EPSG:5703", marks=pytest.mark.slow), "EPSG:5613"]
)
def test_a_missing_grid_is_an_error_that_names_it_and_the_remedy(name: str) -> None:
    grid = {"EPSG:5703": "us_noaa", "EPSG:5613": "se_lantmateriet"}.get(name, "us_nga_egm08_25.tif")
    if any(list(Path(folder).glob(f"{grid}*")) for folder in module.add_system_grids()):
        pytest.skip("the grid is installed here")
    with pytest.raises(DatumError, match=grid) as caught:
        Vertical.parse(name).undulation([-100.0], [40.0])
    # Debian's package has EGM96 alone of these: it is no remedy here.
    assert "proj-data" not in str(caught.value)
    assert "pyproj sync --file" in str(caught.value)


def test_only_egm96_is_to_be_had_from_debian() -> None:
    assert "Debian's proj-data" in grid_remedy("us_nga_egm96_15.tif", "or give a grid")
    assert "Debian" not in grid_remedy("us_nga_egm08_25.tif", "or give a grid")


def test_ellipsoid_needs_nothing() -> None:
    assert Vertical.parse("ellipsoid").undulation([1.0, np.nan], [2.0, 3.0]) == pytest.approx(
        [0.0, np.nan], nan_ok=True
    )
    assert Vertical.parse("EPSG:4979").is_ellipsoid


@needs_egm96
def test_grid_file_with_blanks_and_umlauts(tmp_path: Path) -> None:
    folder = tmp_path / "größe und so"
    folder.mkdir()
    copy = folder / "my geoid.gtx"
    shutil.copy(EGM96, copy)
    assert Vertical.parse(str(copy)).undulation([24.4], [-33.65])[0] == pytest.approx(28.208, abs=0.01)
    assert Vertical.parse("egm96_15.gtx").undulation([24.4], [-33.65])[0] == pytest.approx(28.208, abs=0.01)
    shutil.copy(EGM96, folder / "a,b.gtx")
    with pytest.raises(DatumError, match="comma"):
        Vertical.parse(str(folder / "a,b.gtx"))


@pytest.mark.parametrize("text", ["", "egm97", "EPSG:32735", "EPSG:999999", "EPSG:5715", "/nowhere/geoid.gtx", "28.2"])
def test_what_is_no_height_datum(text: str) -> None:
    with pytest.raises(DatumError):
        Vertical.parse(text)


def test_a_vertical_crs_of_another_authority_is_no_grid_file() -> None:
    with pytest.raises(DatumError, match=r"ESRI:105703 .* is not a vertical CRS of EPSG"):
        Vertical.parse("ESRI:105703")


def test_a_file_that_is_no_geoid(tmp_path: Path) -> None:
    path = tmp_path / "notes.gtx"
    path.write_text("this is no grid")
    with pytest.raises(DatumError, match="as a geoid grid"):
        Vertical.parse(str(path))


@pytest.mark.parametrize(
    "change",
    [
        (b">ddddii", (30.0, 33.0, 1.0, 1.0, 2**29, 2**29)),
        (b">ddddii", (30.0, 33.0, 1.0, 1.0, 8, 2**30)),
        (b">ddddii", (30.0, 33.0, 1.0, 1.0, -8, -8)),
        (b">ddddii", (30.0, 33.0, 0.0, 1.0, 8, 8)),
        (b">ddddii", (30.0, float("nan"), 1.0, 1.0, 8, 8)),
        (b">dddd", (30.0, 33.0, 1.0, 1.0)),
    ],
)
def test_a_geoid_whose_header_lies(tmp_path: Path, change: tuple[bytes, tuple]) -> None:
    # PROJ fills gigabytes with zeros for the first two.
    path = tmp_path / "geoid.gtx"
    path.write_bytes(struct.pack(change[0], *change[1]) + bytes(256))
    with pytest.raises(DatumError, match="as a geoid grid"):
        Vertical.parse(str(path))
    path.write_bytes(struct.pack(">ddddii", 30.0, 33.0, 1.0, 1.0, 8, 8) + bytes(256))
    assert Vertical.parse(str(path)).undulation([34.0], [33.0]) == 0


@pytest.mark.parametrize(("ending", "value"), [(".gtx", 250.0), (".tif", 250.0), (".tif", 1e30), (".tif", -28_000.0)])
def test_a_geoid_of_absurd_heights(tmp_path: Path, ending: str, value: float) -> None:
    path = tmp_path / f"geoid{ending}"
    if ending == ".gtx":  # of which PROJ takes what is beyond 1000 m for places without a value
        path.write_bytes(struct.pack(">ddddii", 30.0, 33.0, 1.0, 1.0, 8, 8) + struct.pack(">f", value) * 64)
    else:
        grid = gdal.GetDriverByName("GTiff").Create(str(path), 8, 8, 1, gdal.GDT_Float32)
        grid.SetProjection(pyproj.CRS.from_epsg(4326).to_wkt())
        grid.SetGeoTransform((32.5, 1.0, 0.0, 37.5, 0.0, -1.0))
        grid.WriteArray(np.full((8, 8), value))
        grid = None
    with pytest.raises(DatumError, match="above the ellipsoid") as refused:
        Vertical.parse(str(path)).undulation([34.5, 200.0], [33.5, 0.0])
    assert refused.value.file == str(path)
    assert refused.value.remedy


def geoid_tiff(path: Path, *options: str) -> bytes:
    """Write a sound GeoTIFF of 8 x 8 heights of 20 to 40 m from 33 E 30 N, and return it."""
    grid = gdal.GetDriverByName("GTiff").Create(str(path), 8, 8, 1, gdal.GDT_Float32, list(options))
    grid.SetProjection(pyproj.CRS.from_epsg(4326).to_wkt())
    grid.SetGeoTransform((32.5, 1.0, 0.0, 37.5, 0.0, -1.0))
    grid.WriteArray(np.linspace(20, 40, 64, dtype=np.float32).reshape(8, 8))
    grid = None
    return path.read_bytes()


_OTHER_TAG = struct.pack("<HHI", 278, 3, 1), struct.pack("<HHI", 31901, 3, 1)


def lying(data: bytes) -> dict[str, bytes]:
    """Return GeoTIFFs whose directory lies, by what of it does."""
    begin = struct.unpack_from("<I", data, 4)[0]
    entries = {}
    for k in range(struct.unpack_from("<H", data, begin)[0]):
        at = begin + 2 + 12 * k
        entries[struct.unpack_from("<H", data, at)[0]] = at

    def stating(tag: int, value: int) -> bytes:
        made = bytearray(data)
        struct.pack_into("<HHII", made, entries[tag], tag, 4, 1, value)
        return bytes(made)

    def placed(tag: int, offset: int, value: float) -> bytes:
        made = bytearray(data)
        struct.pack_into("<d", made, struct.unpack_from("<I", data, entries[tag] + 8)[0] + offset, value)
        return bytes(made)

    # Of a block that is said to lie elsewhere in the file nobody can tell.
    found = {f"tag {tag} {value}": stating(tag, value) for tag in (256, 257, 273) for value in (0, 10**5, 2**31)
             if (tag, value) != (273, 0)}  # fmt: skip
    found |= {f"place {tag} {offset} {value}": placed(tag, offset, value)
              for tag, offset in ((33550, 0), (33550, 8), (33922, 24), (33922, 32))
              for value in (np.nan, np.inf, 1e300, 1e-300)}  # fmt: skip
    # PROJ divides by the rows of a strip, also where they are not stated, and ended the process.
    found["no rows of a strip"], found["rows of a strip 0"] = data.replace(*_OTHER_TAG), stating(278, 0)
    found["bits"], found["cut off"] = stating(258, 64), data[:-100]
    return found


def test_a_geotiff_geoid_whose_header_lies(tmp_path: Path) -> None:
    """Refused, or the true heights; never without a word no heights, as outside of the grid."""
    sound = geoid_tiff(tmp_path / "geoid.tif")
    lon, lat = [34.0, 36.5, 90.0], [36.5, 31.5, 0.0]
    true = Vertical.parse(str(tmp_path / "geoid.tif")).undulation(lon, lat)
    assert np.isfinite(true[:2]).all()
    # Outside of it there are no heights, and that is no damage.
    assert np.isnan(true[2])
    refused = 0
    for number, (what, data) in enumerate(lying(sound).items()):
        path = tmp_path / f"{number}.tif"
        path.write_bytes(data)
        try:
            found = Vertical.parse(str(path)).undulation(lon, lat)
        except DatumError as error:
            refused += 1
            named = error
        else:
            named = None
            # A grid that lies elsewhere.
            elsewhere = what.startswith("place 33922") and "1e-300" in what
            assert elsewhere or np.array_equal(found, true, equal_nan=True), what
        assert named is None or (named.file == str(path) and named.remedy), what
    assert refused > 15


@pytest.mark.parametrize("name", ["pipe.gtx", "pipe.tif"])
def test_a_geoid_that_is_a_pipe(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(DatumError, match="as a geoid grid"):
        Vertical.parse(str(tmp_path / name))


@needs_egm96
def test_undulation_goes_round_the_world() -> None:
    egm96 = Vertical.parse("egm96")
    assert egm96.undulation([190.0, -0.1], [10.0, 10.0]) == pytest.approx(
        egm96.undulation([-170.0, 359.9], [10.0, 10.0])
    )
    # Across the antimeridian: no jump.
    near = egm96.undulation([179.999, -179.999, 180.0], [10.0, 10.0, 10.0])
    assert np.ptp(near) < 0.01
    assert np.isnan(egm96.undulation([np.nan, 0.0, 0.0], [0.0, np.nan, 95.0])).all()


@pytest.mark.parametrize(
    ("text", "name", "certain", "unit"),
    [
        ("EPSG:4979", "ellipsoid", True, 1.0),
        ("EPSG:32735+5773", "EPSG:5773", True, 1.0),
        ("EPSG:4326+3855", "EPSG:3855", True, 1.0),
        ("EPSG:4269+8228", "EPSG:8228", True, 0.3048),
        ("+proj=utm +zone=31 +datum=WGS84 +geoidgrids=egm96_15.gtx +vunits=us-ft", "egm96_15.gtx", True, 1200 / 3937),
    ],
)
def test_declared_vertical(text: str, name: str, certain: bool, unit: float) -> None:
    declared = declared_vertical(parse_crs(text))
    assert declared is not None
    assert declared.vertical == Vertical(name)
    assert declared.certain is certain
    assert declared.metres_per_unit == pytest.approx(unit)


def named_vertical(name: str) -> pyproj.CRS:
    flat = parse_crs("EPSG:32735").to_wkt()
    vertical = f'VERTCRS["{name}",VDATUM["unknown"],CS[vertical,1],AXIS["up",up,LENGTHUNIT["metre",1]]]'
    return pyproj.CRS.from_wkt(f'COMPOUNDCRS["both",{flat},{vertical}]')


@pytest.mark.parametrize(
    ("name", "found"),
    [("EGM2008 height", "EPSG:3855"), ("EGM96 geoid", "EPSG:5773"), ("Ellipsoid", "ellipsoid"), ("my zero", None)],
)
def test_vertical_known_by_its_name_only(name: str, found: str | None) -> None:
    declared = declared_vertical(named_vertical(name))
    assert declared is not None
    assert not declared.certain
    assert declared.vertical == (None if found is None else Vertical(found))


@pytest.mark.parametrize("text", ["EPSG:4326", "EPSG:32735"])
def test_two_dimensions_declare_no_height(text: str) -> None:
    assert declared_vertical(parse_crs(text)) is None


def test_grids_for_the_doctor() -> None:
    rows = {row["datum"]: row for row in grids()}
    assert set(rows) == {"egm96", "egm2008", "egm84"}
    assert rows["egm96"]["found"] is EGM96.is_file() or rows["egm96"]["found"]
    info = proj_info()
    assert info["network"] is False
    assert info["search_path"]


def test_the_network_of_proj_is_off_whatever_it_was_before() -> None:
    """Results depend only on files."""
    pyproj.network.set_network_enabled(True)
    try:
        module.add_system_grids()
        assert not pyproj.network.is_network_enabled()
    finally:
        pyproj.network.set_network_enabled(False)


# -- systems


def test_parse_and_horizontal() -> None:
    assert horizontal("EPSG:4979").to_epsg() == 4326
    assert horizontal("EPSG:32735+5773").to_epsg() == 32735
    for text in ("", "EPSG:0", "no such thing", "x" * 5000):
        with pytest.raises(CrsError):
            parse_crs(text)
    for text in ("EPSG:4978", "EPSG:5773"):
        with pytest.raises(CrsError):
            horizontal(text)


def test_only_what_can_be_a_name_is_sought_among_names(monkeypatch: pytest.MonkeyPatch) -> None:
    sought: list[str] = []
    monkeypatch.setattr(pyproj.CRS, "from_user_input", sought.append)
    names = [found.name for found in query_crs_info()]
    stated = [
        " EPSG:4326\n", "urn:ogc:def:crs:OGC:1.3:CRS84", "http://www.opengis.net/def/crs/EPSG/0/4326",
        "ITRF2014@2020.5", "+zone=36 +proj=utm", "proj = utm zone=36", "+init=epsg:4326", "{}",
        'GEOGCRS ["WGS 84",', "LOCAL_CS(1)",
    ]  # fmt: skip
    for text in (*names, *stated):
        parse_crs(text)
    assert sought == [*names, *stated]
    assert len(names) > 5000
    # PROJ takes a quarter of a second to find that these are none.
    for text in ("x" * 5000, '\ufeffPROJCS["a",1]', 'PROJC,S["a"]', "b" * 5000 + '["a"]', "+prkj=utm", "\0EPSG:4326"):
        with pytest.raises(CrsError):
            parse_crs(text)
    assert len(sought) == len(names) + len(stated)


@pytest.mark.parametrize(
    ("lon", "lat", "code"),
    [
        (24.4, -33.65, 32735),
        (-180.0, 1.0, 32601),
        (180.0, 1.0, 32601),
        (179.9, -1.0, 32760),
        (5.0, 85.0, 5041),
        (0.0, -89.0, 5042),
        # UTM is from 80 S to 84 N (NGA.SIG.0012).
        (31.0, -79.9, 32736),
        (31.0, -80.1, 5042),
        (31.0, 83.9, 32636),
        (31.0, 84.1, 5041),
    ],
)
def test_utm(lon: float, lat: float, code: int) -> None:
    assert utm_crs(lon, lat).to_epsg() == code


def test_utm_of_nowhere() -> None:
    with pytest.raises(CrsError):
        utm_crs(24.0, 95.0)


# -- ground to ground


@pytest.mark.parametrize("code", [4978, 4979, 32735, 2193, 3035, 31370, 27700, 2227, 5041])
def test_there_and_back(code: int) -> None:
    area = parse_crs(f"EPSG:{code}").area_of_use
    lon, lat = 24.4, -33.65
    if area is not None and code not in (4978, 4979, 32735):
        lon, lat = 0.5 * (area.west + area.east) % 360, 0.5 * (area.south + area.north)
        lon = 173.0 if code == 2193 else lon
    ground = np.array([[lon, lat, 123.4], [lon + 0.01, lat - 0.01, 0.0]])
    refused = None
    try:
        there = GroundTransform("EPSG:4979", f"EPSG:{code}")(ground)
    except CrsError as error:
        refused = error
    if refused is not None:
        # From PROJ 9.7 on the best operation or none is taken for these two; older ones fall back to a grid-less one.
        assert code in (27700, 2227), refused
        assert "grid" in refused.message
        assert refused.remedy
        return
    back = GroundTransform(f"EPSG:{code}", "EPSG:4979")(there)
    difference = back - ground
    difference[:, 0] = (difference[:, 0] + 180) % 360 - 180
    # Helmert transformations are inverted approximately: a tenth of a millimetre is PROJ's own closure.
    assert np.abs(difference).max() < (1e-5 if code == 27700 else 1e-8) + 1e-8
    if code != 4978:
        assert there[:, 2] == pytest.approx(ground[:, 2], abs=1e-6)


def test_heights_stay_wgs84_on_classical_ellipsoids() -> None:
    # PROJ's 3D promotion would give the height above the Hayford ellipsoid, 44 m lower, that nobody measures.
    assert GroundTransform("EPSG:4979", "EPSG:31370")([[4.4, 50.6, 100.0]])[0, 2] == 100.0
    through = GroundTransform("EPSG:31370", "EPSG:4978")(
        GroundTransform("EPSG:4979", "EPSG:31370")([[4.4, 50.6, 100.0]])
    )
    straight = GroundTransform("EPSG:4979", "EPSG:4978")([[4.4, 50.6, 100.0]])
    assert through == pytest.approx(straight, abs=0.01)


@pytest.mark.parametrize(
    ("text", "lon", "lat"),
    [
        ("EPSG:2100", 23.7, 38.0),  # GGRS87, on GRS80: PROJ's 3D height is 30 m lower
        ("EPSG:4756", 106.0, 16.0),  # VN-2000, on the ellipsoid of WGS84: 15 m higher
        ("+proj=tmerc +lon_0=24 +ellps=GRS80 +towgs84=-199.87,74.79,246.62 +type=crs", 23.7, 38.0),
    ],
)
def test_heights_stay_wgs84_on_modern_ellipsoids_about_another_centre(text: str, lon: float, lat: float) -> None:
    ground = np.array([[lon, lat, 100.0]])
    there = GroundTransform("EPSG:4979", text)(ground)
    assert there[0, 2] == 100.0
    assert GroundTransform(text, "EPSG:4979")(there) == pytest.approx(ground, abs=1e-6)
    assert GroundTransform(text, "EPSG:4978")(there) == pytest.approx(
        GroundTransform("EPSG:4979", "EPSG:4978")(ground), abs=0.01
    )


def test_a_bad_point_is_nan_and_spoils_no_other() -> None:
    ground = [[24.4, -33.65, 100.0], [np.nan, 1, 1], [24.4, -33.65, np.inf], [0, 95, 0]]
    out = GroundTransform("EPSG:4979", "EPSG:32735")(ground)
    assert np.isfinite(out[0]).all()
    assert np.isnan(out[1:]).all()
    assert np.isnan(GroundTransform("EPSG:4979", "EPSG:32735")([[0, 95, 0]])).all()


def test_identity_copies() -> None:
    ground = np.array([[1.0, 2.0, 3.0]])
    same = GroundTransform("EPSG:4979", "EPSG:4326")
    assert same.is_identity
    out = same(ground)
    assert (out == ground).all()
    out[0, 0] = 9
    assert ground[0, 0] == 1.0


def test_across_the_antimeridian() -> None:
    ground = np.array([[179.999, -17.0, 5.0], [-179.999, -17.0, 5.0], [180.001, -17.0, 5.0]])
    x = GroundTransform("EPSG:4979", "EPSG:32701")(ground)
    assert np.ptp(x[:, 0]) < 300
    assert x[1] == pytest.approx(x[2])


def test_pickle_and_threads() -> None:
    transform = pickle.loads(pickle.dumps(GroundTransform("EPSG:4979", "EPSG:32735")))
    ground = np.column_stack([np.linspace(20, 28, 20000), np.linspace(-35, -30, 20000), np.zeros(20000)])
    expected = transform(ground)
    results: list[bool] = []
    threads = [
        threading.Thread(target=lambda: results.append(bool(np.array_equal(transform(ground), expected))))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [True] * 4


def test_no_way_between_unknown_datums() -> None:
    local = 'ENGCRS["site",EDATUM["peg"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    with pytest.raises(CrsError):
        GroundTransform(local, "EPSG:4979")


def test_a_better_transformation_without_its_grid_is_told(caplog: pytest.LogCaptureFixture) -> None:
    if any((Path(folder) / "uk_os_OSTN15_NTv2_OSGBtoETRS.tif").is_file() for folder in module.add_system_grids()):
        pytest.skip("the grid is installed here")
    told = ""
    try:
        GroundTransform("EPSG:4979", "EPSG:27700")([[-2.0, 52.0, 0.0]])
    except CrsError as error:  # newer PROJs refuse
        told = error.message
    assert "uk_os_OSTN15_NTv2_OSGBtoETRS.tif" in caplog.text + told
