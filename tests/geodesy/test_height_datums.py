"""What a height datum, a unit or a position on Earth may be, at the limits: by EPSG's definitions and by hand."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import CrsError, DatumError
from ortho_pipeline.geodesy.crs import GroundTransform, Vertical, utm_crs
from ortho_pipeline.geodesy.datum import dem_unit, dem_vertical
from ortho_pipeline.geodesy.declared_vertical import DeclaredVertical
from ortho_pipeline.geodesy.geoid_grid import refuse_absurd

EGM96, EGM2008, ELLIPSOID = Vertical("EPSG:5773"), Vertical("EPSG:3855"), Vertical("ellipsoid")


@pytest.mark.parametrize(
    ("lon", "lat", "code"),
    [
        (6.0, 0.0, 32632), (5.999999, 0.0, 32631), (0.0, -1e-9, 32731), (180.0, 1.0, 32601), (-180.0, 1.0, 32601),
        (179.999, -1.0, 32760), (540.0, 1.0, 32601), (-540.0, 1.0, 32601), (3.0, 84.0, 32631), (3.0, -80.0, 32731),
        (3.0, 84.001, 5041), (3.0, -80.001, 5042), (0.0, 90.0, 5041), (0.0, -90.0, 5042),
    ],
)  # fmt: skip
def test_zones_begin_at_their_western_meridian_and_end_at_the_polar_caps(lon: float, lat: float, code: int) -> None:
    assert utm_crs(lon, lat).to_epsg() == code


@pytest.mark.parametrize(
    ("lon", "lat"), [(0.0, 90.001), (0.0, -90.001), (540.001, 0.0), (-540.001, 0.0), (np.nan, 0.0), (0.0, np.inf)]
)
def test_a_position_off_the_earth_has_no_zone(lon: float, lat: float) -> None:
    with pytest.raises(CrsError):
        utm_crs(lon, lat)


@pytest.mark.parametrize("code", ["EPSG:4326", "EPSG:4978", "EPSG:3857"])
def test_a_system_without_heights_of_its_own_is_no_height_datum(code: str) -> None:
    """WGS 84 without heights, the geocentric system, whose third axis is no height, and a map."""
    with pytest.raises(DatumError):
        Vertical.parse(code)


def test_the_heights_of_a_compound_system_are_those_of_its_vertical_part() -> None:
    # WGS 84 + EGM2008 height; ETRS89 + EVRF2007 height.
    assert Vertical.parse("EPSG:9518") == EGM2008
    assert Vertical.parse("EPSG:7423") == Vertical("EPSG:5621")


def test_heights_are_in_the_unit_of_their_datum_and_undulations_in_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Vertical, "undulation", lambda self, lon, lat: np.array([-26.5, np.nan]))
    for name, metres in (("EPSG:8228", 0.3048), ("EPSG:6360", 1200 / 3937), ("EPSG:5773", 1.0), ("ellipsoid", 1.0)):
        found = Vertical(name).ellipsoidal([-97.0, 0.0], [30.0, 0.0], [500.0, 500.0])
        np.testing.assert_allclose(found, [500.0 * metres - 26.5, np.nan], rtol=1e-12)


@pytest.mark.parametrize(("shift", "kept"), [(2.9, False), (-2.9, False), (3.1, True), (-3.1, True)])
def test_heights_follow_another_realisation_up_to_three_metres(shift: float, kept: bool) -> None:
    """On the equator at longitude 0 a shift along X is one of the height; a farther centre is that of another datum."""
    text = f"+proj=tmerc +lon_0=0 +ellps=GRS80 +towgs84={shift},0,0 +type=crs"
    there = GroundTransform("EPSG:4979", text)([[0.0, 0.0, 100.0]])
    assert there[0, 2] == pytest.approx(100.0 if kept else 100.0 - shift, abs=1e-3)
    np.testing.assert_allclose(GroundTransform(text, "EPSG:4979")(there), [[0.0, 0.0, 100.0]], atol=1e-3)


def test_a_file_states_a_grid_by_its_name_and_not_by_a_path(tmp_path: Path) -> None:
    path = tmp_path / "geoid.gtx"
    path.write_bytes(struct.pack(">ddddii", 30.0, 33.0, 1.0, 1.0, 2, 2) + struct.pack(">4f", *[20.0] * 4))
    assert Vertical.parse(str(path)).undulation([33.5], [30.5])[0] == pytest.approx(20.0)
    with pytest.raises(DatumError, match="by its path"):
        Vertical.stated(str(path))
    assert Vertical.stated(" egm2008 ") == EGM2008
    # A name is looked for in PROJ's folders.
    with pytest.raises(DatumError) as unknown:
        Vertical.stated("no_such_geoid.gtx")
    assert "path" not in unknown.value.message


def test_a_grid_is_interpolated_between_its_four_heights(tmp_path: Path) -> None:
    """Bilinearly, from the south-western corner; a row at a time to the north."""
    path = tmp_path / "geoid.gtx"
    path.write_bytes(struct.pack(">ddddii", 30.0, 33.0, 1.0, 2.0, 2, 2) + struct.pack(">4f", 10.0, 14.0, 20.0, 40.0))
    found = Vertical.parse(str(path)).undulation([33.0, 34.5, 34.0, 200.0], [30.0, 30.0, 30.25, 30.0])
    # South 10 to 14, north 20 to 40 over two degrees of longitude: at its middle 12 and 30, of which a quarter.
    np.testing.assert_allclose(found, [10.0, 13.0, 12 + (30 - 12) / 4, np.nan], atol=1e-5)


def test_the_largest_undulation_is_two_hundred_metres() -> None:
    refuse_absurd(np.array([199.9, -199.9, np.nan]), "EPSG:5773")
    for absurd in (200.1, -200.1):
        with pytest.raises(DatumError):
            refuse_absurd(np.array([10.0, absurd, np.nan]), "EPSG:5773")


def test_a_place_that_cannot_be_transformed_is_nan_in_all_columns() -> None:
    # The height is kept on a classical ellipsoid, but not that of a point without a position.
    out = GroundTransform("EPSG:4979", "EPSG:31370")([[4.4, 50.6, 100.0], [4.4, 95.0, 100.0]])
    assert np.isfinite(out[0]).all()
    assert np.isnan(out[1]).all()


def test_geocentric_points_of_a_classical_system_come_to_heights_over_wgs84() -> None:
    """PROJ's transformation in the plane, and the height on both sides as it is."""
    plane = pyproj.Transformer.from_crs(4326, 31370, always_xy=True).transform(4.4, 50.6)
    space = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(4.4, 50.6, 250.0)
    np.testing.assert_allclose(GroundTransform("EPSG:4978", "EPSG:31370")([space]), [[*plane, 250.0]], atol=0.01)
    np.testing.assert_allclose(GroundTransform("EPSG:31370", "EPSG:4978")([[*plane, 250.0]]), [space], atol=0.01)


# -- of DEMs ---------------------------------------------------------------------------------------------------------


def declares(vertical: Vertical | None, *, certain: bool = True, unit: float = 1.0) -> DeclaredVertical:
    return DeclaredVertical("stated", vertical, certain, unit)


@pytest.mark.parametrize(
    ("text", "axis", "unit"),
    [
        ("", None, 1.0), ("m", None, 1.0), ("Metre", 1.0, 1.0), ("cm", None, 0.01), ("ft", None, 0.3048),
        ("US survey foot", None, 1200 / 3937), ("us-ft", 1200 / 3937, 1200 / 3937), ("", 0.3048, 0.3048),
        # The two feet differ by two millionths: of them the CRS is believed.
        ("ft", 1200 / 3937, 1200 / 3937),
    ],
)  # fmt: skip
def test_heights_have_the_unit_of_the_band_or_of_the_crs(text: str, axis: float | None, unit: float) -> None:
    assert dem_unit(text, None if axis is None else declares(EGM96, unit=axis)) == unit


@pytest.mark.parametrize(("text", "axis"), [("ft", 1.0), ("m", 0.3048), ("cm", 1.0), ("fathom", None), ("km", 1.0)])
def test_units_that_differ_or_are_unknown_are_refused(text: str, axis: float | None) -> None:
    with pytest.raises(DatumError):
        dem_unit(text, None if axis is None else declares(EGM96, unit=axis))


@pytest.mark.parametrize(
    ("text", "axis", "code", "unit"),
    [
        ("", None, "EPSG:6360", 1200 / 3937), ("", None, "EPSG:8228", 0.3048), ("", None, "EPSG:5703", 1.0),
        ("ftUS", None, "EPSG:6360", 1200 / 3937), ("ft", None, "EPSG:5703", 0.3048), ("", 0.3048, "EPSG:8228", 0.3048),
    ],
)  # fmt: skip
def test_a_datum_in_feet_gives_the_unit_that_the_file_does_not_state(
    text: str, axis: float | None, code: str, unit: float
) -> None:
    stated = None if axis is None else declares(Vertical("EPSG:8228"), unit=axis)
    assert dem_unit(text, stated, Vertical(code)) == pytest.approx(unit, rel=1e-12)


@pytest.mark.parametrize(("text", "axis"), [("m", None), ("", 1.0), ("cm", None)])
def test_a_datum_in_feet_and_a_file_in_metres_are_refused(text: str, axis: float | None) -> None:
    with pytest.raises(DatumError, match="units of the heights differ"):
        dem_unit(text, None if axis is None else declares(EGM96, unit=axis), Vertical("EPSG:6360"))


def test_the_datum_of_a_dem_is_that_of_the_file_unless_the_user_is_allowed_another() -> None:
    grid = Vertical("local.gtx")
    for declared, option, override, used, notices in (
        (None, EGM96, False, EGM96, 0),
        (declares(EGM96), None, False, EGM96, 0),
        (declares(EGM96, certain=False), None, False, EGM96, 1),
        (declares(EGM96), EGM96, False, EGM96, 0),
        (declares(EGM96), EGM2008, True, EGM2008, 1),
        (declares(EGM96, certain=False), EGM2008, False, EGM2008, 1),
        (declares(None, certain=False), EGM96, False, EGM96, 1),
        # The user brings the geoid of the declared datum as a file.
        (declares(EGM96), grid, False, grid, 1),
    ):
        found, said = dem_vertical(declared, option, override)
        assert (found, len(said)) == (used, notices)


@pytest.mark.parametrize(
    ("declared", "option"),
    [
        (None, None),
        (declares(None, certain=False), None),
        (declares(EGM96), EGM2008),
        (declares(EGM96), ELLIPSOID),
        (declares(ELLIPSOID), EGM96),
        # A geoid does not realise the ellipsoid.
        (declares(ELLIPSOID), Vertical("local.gtx")),
    ],
)
def test_a_datum_that_is_unknown_or_contradicted_is_refused(
    declared: DeclaredVertical | None, option: Vertical | None
) -> None:
    with pytest.raises(DatumError):
        dem_vertical(declared, option, False)
