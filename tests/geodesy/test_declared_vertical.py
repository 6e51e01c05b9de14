"""Heights that coordinate systems declare, by systems that are built from EPSG's definitions."""

from __future__ import annotations

from typing import Any

import pyproj
import pytest

from ortho_pipeline.errors import DatumError
from ortho_pipeline.geodesy.crs import Vertical, parse_crs
from ortho_pipeline.geodesy.declared_vertical import declared_vertical

FOOT = {"type": "LinearUnit", "name": "foot", "conversion_factor": 0.3048}


def changed(code: int, axis: int, **changes: Any) -> pyproj.CRS:
    """Return a system of EPSG with another axis, and so without its code."""
    data = pyproj.CRS(code).to_json_dict()
    del data["id"]
    data["coordinate_system"]["axis"][axis].update(changes)
    return pyproj.CRS.from_json_dict(data)


def of(crs: pyproj.CRS) -> tuple[Vertical | None, bool, float]:
    declared = declared_vertical(crs)
    assert declared is not None
    return declared.vertical, declared.certain, declared.metres_per_unit


def compound(vertical: dict[str, Any]) -> pyproj.CRS:
    parts = [pyproj.CRS(32631).to_json_dict(), vertical]
    return pyproj.CRS.from_json_dict({"type": "CompoundCRS", "name": "both", "components": parts})


def without_ids(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_ids(part) for key, part in value.items() if key not in ("id", "ids")}
    return [without_ids(part) for part in value] if isinstance(value, list) else value


def test_three_dimensions_declare_the_ellipsoid_in_the_unit_of_the_third_axis() -> None:
    assert of(changed(4979, 2, unit=FOOT)) == (Vertical("ellipsoid"), True, 0.3048)
    # Feet in the plane, and heights in metres.
    assert of(changed(4979, 2)) == (Vertical("ellipsoid"), True, 1.0)
    assert of(parse_crs("EPSG:32631").to_3d()) == (Vertical("ellipsoid"), True, 1.0)
    assert of(parse_crs("EPSG:4978")) == (Vertical("ellipsoid"), True, 1.0)
    # A datum shift bound to it changes nothing.
    bound = "+proj=longlat +ellps=bessel +towgs84=598,73,418,0,0,0,0 +type=crs"
    assert of(parse_crs(bound).to_3d())[0] == Vertical("ellipsoid")
    assert declared_vertical(parse_crs(bound)) is None


@pytest.mark.parametrize("code", ["EPSG:4326+5715", "EPSG:4326+6358"])
def test_depths_are_refused(code: str) -> None:
    with pytest.raises(DatumError, match="depths"):
        declared_vertical(parse_crs(code))


def test_depths_below_the_ellipsoid_are_refused() -> None:
    with pytest.raises(DatumError, match="depths"):
        declared_vertical(changed(4979, 2, direction="down"))
    assert of(changed(4979, 0, direction="north"))[0] == Vertical("ellipsoid")


def test_only_a_code_that_is_written_is_certain() -> None:
    datum = pyproj.CRS(3855).to_json_dict()
    assert of(compound(datum)) == (Vertical("EPSG:3855"), True, 1.0)
    # PROJ recognises the definition.
    assert of(compound(without_ids(datum))) == (Vertical("EPSG:3855"), False, 1.0)
    # In feet it is another datum than EPSG's; the name alone is known.
    feet = without_ids(datum)
    feet["coordinate_system"]["axis"][0]["unit"] = FOOT
    assert of(compound(feet)) == (Vertical("EPSG:3855"), False, 0.3048)


def test_of_a_code_of_another_authority_the_name_is_known() -> None:
    for code, unit in (("105797", 0.3048), ("105798", 1200 / 3937)):  # EGM96_Geoid in both feet
        vertical, certain, metres = of(compound(pyproj.CRS.from_authority("ESRI", code).to_json_dict()))
        assert (vertical, certain) == (Vertical("EPSG:5773"), False)
        assert metres == pytest.approx(unit, rel=1e-9)


def test_a_bound_grid_is_the_datum() -> None:
    for name in ("unknown", "EGM2008 height (local)"):
        text = "+proj=utm +zone=31 +datum=WGS84 +geoidgrids=egm96_15.gtx +vunits=ft"
        crs = pyproj.CRS(text).to_json_dict()
        crs["components"][1]["source_crs"]["name"] = name
        assert of(pyproj.CRS.from_json_dict(crs)) == (Vertical("egm96_15.gtx"), True, 0.3048)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("WGS84 EGM96", "EPSG:5773"), ("egm_1996", "EPSG:5773"), ("EGM96 geoid (m)", "EPSG:5773"),
        ("WGS 84 EGM 2008", "EPSG:3855"), ("EGM08", "EPSG:3855"), ("Heights over the Ellipsoid (m)", "ellipsoid"),
        ("EGM84", None), ("my EGM96", None), ("unknown", None),
    ],
)  # fmt: skip
def test_names_that_are_known(name: str, code: str | None) -> None:
    vertical = without_ids(pyproj.CRS(5621).to_json_dict())
    vertical["name"] = name
    vertical["datum" if "datum" in vertical else "datum_ensemble"]["name"] = "local"
    assert of(compound(vertical)) == (None if code is None else Vertical(code), False, 1.0)
