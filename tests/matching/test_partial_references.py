"""References that cover little of a scene, or of which a part is displaced: the reason is the right one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from scenes import Case, Setting
from trials import tried

from ortho_pipeline.commands.control.matching import _partial
from ortho_pipeline.imaging import matching
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.dem import open_dem

PLAIN = Setting(side=500, seed=3, error=12.0)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return Case(PLAIN, tmp_path_factory.mktemp("partial")).write()


def part(case: Case, share: float, path: Path) -> Path:
    """Return a part of the reference that covers a share of the scene."""
    whole = gdal.Open(str(case.reference_file))
    side = math.sqrt(share)
    columns, rows = (int((size - 2 * PLAIN.margin) * side) for size in (whole.RasterXSize, whole.RasterYSize))
    window = [whole.RasterXSize // 3, whole.RasterYSize // 3, columns, rows]
    gdal.Translate(str(path), whole, srcWin=window).FlushCache()
    return path


def displaced(case: Case, share: float, by: int, path: Path) -> Path:
    """Return the reference with a share of it, in the east, displaced by some pixels to the south."""
    whole = gdal.Open(str(case.reference_file))
    pixels = whole.ReadAsArray()
    first = round(pixels.shape[1] * (1 - share))
    pixels[:, first:] = np.roll(pixels, by, axis=0)[:, first:]
    made = gdal.GetDriverByName("GTiff").CreateCopy(str(path), whole)
    made.WriteArray(pixels)
    return path


def matched(case: Case, reference: Path, search: float = 40.0) -> matching.Matches:
    surface = open_dem(case.dem_file, "ellipsoid")
    view = matching.SceneView(Intensity(RasterSource(case.scene_file)), case.model, surface)
    return matching.match(view, matching.open_references([reference]), matching.MatchSettings(search, 80))


def test_a_reference_of_five_hundredths_is_matched_with_a_notice(case: Case, tmp_path: Path) -> None:
    found = matched(case, part(case, 0.05, tmp_path / "small.tif"))
    truth = case.image_of(found.points.to_crs("EPSG:32735").ground[:, :2])
    assert np.sqrt(((found.points.image - truth) ** 2).mean()) < 0.15
    assert found.coverage == pytest.approx(0.05, abs=0.025)
    (notice,) = _partial(found)
    assert (notice.code, notice.fields["coverage"]) == ("reference-covers-part", found.coverage)


@pytest.mark.parametrize(("share", "said"), [(0.012, "chip"), (0.002, "covers 0.")])
def test_a_reference_that_is_too_small_says_so(case: Case, tmp_path: Path, share: float, said: str) -> None:
    found = tried(case, [part(case, share, tmp_path / "small.tif")])
    assert said in found.refused
    assert "ortho info" not in found.refused


def test_a_reference_without_values_says_so(case: Case, tmp_path: Path) -> None:
    empty = tmp_path / "empty.tif"
    gdal.GetDriverByName("GTiff").CreateCopy(str(empty), gdal.Open(str(case.reference_file))).WriteArray(
        np.zeros((case.reference_grid()[2], case.reference_grid()[1]), np.uint16)
    )
    refused = tried(case, [empty]).refused
    assert "has no pixel values" in refused
    assert "reference_bands" in refused


def test_a_mosaic_of_which_half_is_displaced_is_inconsistent(case: Case, tmp_path: Path) -> None:
    found = tried(case, [displaced(case, 0.5, 40, tmp_path / "half.tif")], search=80.0)
    assert "inconsistent" in found.refused
    assert "40 m" in found.refused or "39 m" in found.refused or "41 m" in found.refused, found.refused


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.15, 0.35, 0.42])
def test_a_smaller_part_that_is_displaced_spoils_nothing(case: Case, tmp_path: Path, share: float) -> None:
    found = tried(case, [displaced(case, share, 40, tmp_path / "part.tif")], search=80.0)
    assert found.rms < 0.15 if not found.refused else "inconsistent" in found.refused


@pytest.mark.slow
def test_a_whole_reference_has_neither_notice(case: Case) -> None:
    assert not _partial(matched(case, case.reference_file))
