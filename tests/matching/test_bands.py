"""Bands of a reference that disagree about the place of the scene are named; bands that agree are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from osgeo import gdal
from scenes import Case, Setting, View
from trials import fitted

from ortho_pipeline.commands.control.matching import _bands_apart
from ortho_pipeline.exchange.rpc import rpc_of_dataset
from ortho_pipeline.imaging import matching
from ortho_pipeline.imaging.band_shifts import BandShift
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem

SETTING = Setting(
    side=260, seed=5, error=6.0, margin=30.0, fine=1.0, scene=View(noise=0.03), reference=View(noise=0.03)
)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return Case(SETTING, tmp_path_factory.mktemp("bands")).write()


def delivered(case: Case, path: Path, *columns: int) -> Path:
    """Return the reference as bands, each with noise of its own and its content so many columns to the right."""
    whole = gdal.Open(str(case.reference_file))
    tone, random = whole.ReadAsArray().astype(float), np.random.default_rng(1)
    made = gdal.GetDriverByName("GTiff").Create(str(path), *tone.shape[::-1], len(columns), gdal.GDT_UInt16)
    made.SetGeoTransform(whole.GetGeoTransform())
    made.SetSpatialRef(whole.GetSpatialRef())
    for number, moved in enumerate(columns, start=1):
        noisy = np.roll(tone, moved, axis=1) + random.normal(0, 20, tone.shape)
        made.GetRasterBand(number).WriteArray(np.clip(np.rint(noisy), 1, 65535).astype(np.uint16))
    made.FlushCache()
    return path


def matched(
    scene: Path, model: SensorModel, surface: Surface, reference: Path, *bands: int, search: float = 20.0,
    points: int = 60,
) -> matching.Matches:  # fmt: skip
    view = matching.SceneView(Intensity(RasterSource(scene)), model, surface)
    references = matching.open_references([reference], bands)
    return matching.match(view, references, matching.MatchSettings(search, points))


def of_case(case: Case, reference: Path, *bands: int) -> matching.Matches:
    return matched(case.scene_file, case.model, open_dem(case.dem_file, "ellipsoid"), reference, *bands)


def test_a_band_that_is_displaced_is_named_and_counts_in_the_sigmas(case: Case, tmp_path: Path) -> None:
    found = of_case(case, delivered(case, tmp_path / "r.tif", 0, 1, 0))
    (notice,) = _bands_apart(found)
    shifts = {one["band"]: np.array(one["shift_px"]) for one in notice.fields["bands"]}
    assert np.hypot(*(shifts[2] - shifts[1])) == pytest.approx(1.0, abs=0.05)
    assert np.hypot(*(shifts[3] - shifts[1])) < 0.05
    assert max(max(one["sigma_px"]) for one in notice.fields["bands"]) < 0.05
    assert notice.fields["agreeing"] == [1, 3]
    assert notice.endswith("The largest group that agrees: `match.reference_bands=1,3`")
    # Variance of 0, 1, 0 px along the columns of the map, and none along its rows.
    spread = np.sqrt(1 / 3 / 2)
    assert notice.fields["spread_px"] == pytest.approx(spread, abs=0.02)
    assert fitted(case.model, found.points, "shift", case.frame).sigmas == pytest.approx([spread] * 2, abs=0.03)
    alone = replace(found.points, sigma_alike=None)
    assert (fitted(case.model, alone, "shift", case.frame).sigmas < 0.1).all()


def test_no_band_is_proposed_if_all_disagree() -> None:
    """The notice asked to choose bands that agree, and named one band."""
    bands = tuple(BandShift(k, (float(k), 0.0), (0.01, 0.01)) for k in (1, 2, 3))
    (notice,) = _bands_apart(SimpleNamespace(bands=bands))
    assert notice.endswith("No two bands agree")


def test_bands_that_agree_are_no_notice(case: Case, tmp_path: Path) -> None:
    found = of_case(case, delivered(case, tmp_path / "r.tif", 0, 0, 0))
    assert len(found.bands) == 3
    assert not _bands_apart(found)
    assert not found.points.sigma_alike.any()


@pytest.mark.slow
def test_bands_that_a_user_chose_are_compared_with_each_other(case: Case, tmp_path: Path) -> None:
    reference = delivered(case, tmp_path / "r.tif", 0, 2, 0, 0)
    assert not _bands_apart(of_case(case, reference, 1, 3))
    (notice,) = _bands_apart(of_case(case, reference, 2))
    assert notice.fields["agreeing"] == [1, 3, 4]


@pytest.mark.slow
def test_a_reference_of_one_band_is_compared_with_none(case: Case) -> None:
    found = of_case(case, case.reference_file)
    assert found.bands == ()
    assert not _bands_apart(found)


@pytest.mark.slow
@pytest.mark.realdata
def test_the_near_infrared_of_landsat_disagrees_with_the_other_bands(real: Path) -> None:
    """Matched with all chips, each band by itself: 2, 3, 4, 6 and 7 within 0.3 px, 5 off by -1.1, 0.25 ± 0.2 px."""
    scene = real / "orthority" / "rpc" / "qb2_basic1b.tif"
    model = rpc_of_dataset(gdal.Open(str(scene)))[0]
    surface = open_dem(real / "orthority" / "ngi" / "dem.tif", "egm96", override=True)
    reference = real / "homonim" / "landsat8_byte.tif"
    (notice,) = _bands_apart(matched(scene, model, surface, reference, search=60.0, points=500))
    found = {one["band"]: np.array(one["shift_px"]) for one in notice.fields["bands"]}
    assert found[5] - found[4] == pytest.approx([-1.1, 0.25], abs=0.4)
    assert 5 not in notice.fields["agreeing"]
    assert not _bands_apart(matched(scene, model, surface, reference, 4, 3, 2, search=60.0, points=500))
