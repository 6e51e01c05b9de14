"""Real orthos: a QuickBird ortho, two aerial orthos and Landsat of one place; surveyed points say what is right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortho_pipeline import commands
from ortho_pipeline.commands.orthos.aligning import align
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SurfaceOptions

pytestmark = pytest.mark.realdata
AERIAL = ("ngi_rgb_byte_1.tif", "ngi_rgb_byte_2.tif")


def bias_of(document: dict[str, Any]) -> np.ndarray:
    return np.array([document["relative"][f"bias_{axis}_m"]["value"] for axis in ("east", "north")])


def half_of(document: dict[str, Any]) -> np.ndarray:
    found = [document["relative"][f"bias_{axis}_m"] for axis in ("east", "north")]
    return np.array([(one["high"] - one["low"]) / 2 for one in found])


@pytest.fixture(scope="module")
def homonim(real: Path) -> Path:
    return real / "homonim"


@pytest.fixture(scope="module")
def quickbird(real: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return orthos of the QuickBird scene by what adjusted it, on one grid."""
    folder, made = tmp_path_factory.mktemp("quickbird"), {}
    surface = SurfaceOptions(
        dem=real / "orthority" / "ngi" / "dem.tif", vertical="egm96", override_vertical=True, fill="mask"
    )
    output = OutputOptions(crs="EPSG:32735", resolution=5.0)
    for name, points in (
        ("delivered", PointOptions()),
        ("surveyed", PointOptions(gcps=real / "orthority" / "rpc" / "gcps.geojson", correction="shift")),
    ):
        image = real / "orthority" / "rpc" / "qb2_basic1b.tif"
        result = commands.rectify(image, folder / name, points=points, surface=surface, output=output)
        made[name] = result.files["ortho"]
    return made


def test_the_shift_of_a_delivered_rpc_is_that_of_surveyed_points(homonim, quickbird, tmp_path):
    match = MatchOptions(reference=[str(homonim / name) for name in AERIAL])
    found = {name: verify(path, match=match).document for name, path in quickbird.items()}
    # Against the aerial orthos, the ortho by surveyed points is right to a small part of a pixel of 5 m.
    assert np.hypot(*bias_of(found["surveyed"])) < 1.0
    # About 3 px by 2 px, as the surveyed points say (README of the data).
    moved = bias_of(found["delivered"]) - bias_of(found["surveyed"])
    assert 6.0 < np.hypot(*moved) < 20.0
    assert found["delivered"]["causes"][0]["code"] == "shift"
    aligned = align(quickbird["delivered"], tmp_path, match=match).document
    assert aligned["relative"]["rmse_m"]["value"] < 0.3 * aligned["before"]["rmse_m"]["value"]


def test_aerial_orthos_see_the_same_displacement_of_each_other(homonim):
    first, second = (homonim / name for name in AERIAL)
    there = verify(first, match=MatchOptions(reference=[str(second)])).document
    back = verify(second, match=MatchOptions(reference=[str(first)])).document
    # They overlap in a part of each. Both are measured there.
    limit = 3.0 * np.hypot(half_of(there), half_of(back)) / 1.96 + 0.25
    assert (np.abs(bias_of(there) + bias_of(back)) < limit).all()


def test_landsat_and_an_aerial_ortho_see_the_same_displacement_of_each_other(homonim):
    landsat, aerial = homonim / "landsat8_byte.tif", homonim / AERIAL[1]
    there = verify(aerial, match=MatchOptions(reference=[str(landsat)])).document
    back = verify(landsat, match=MatchOptions(reference=[str(aerial)])).document
    # Both are measured where they overlap, in pixels of 5 m and of 30 m.
    limit = 3.0 * np.hypot(half_of(there), half_of(back)) / 1.96 + 1.5
    assert (np.abs(bias_of(there) + bias_of(back)) < limit).all()
