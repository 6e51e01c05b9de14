"""The windows and patches in which two overlapping orthos are compared, by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal, osr
from scipy.ndimage import gaussian_filter, shift

from ortho_pipeline.imaging.registration import details
from ortho_pipeline.warp.mosaic.layout import Ortho, lay_out
from ortho_pipeline.warp.mosaic.overlaps import _all_valid, _ties, _windows, overlaps


@pytest.mark.parametrize(
    ("box", "lefts", "tops", "size"),
    [
        ((10, 20, 110, 70), [10], [20], (100, 50)),
        ((0, 0, 384, 384), [0], [0], (384, 384)),
        ((0, 0, 385, 384), [0, 1], [0], (384, 384)),
        ((5, 7, 1157, 1159), [5, 389, 773], [7, 391, 775], (384, 384)),
        # More than nine are thinned alike along both axes: 6 x 6 to 3 x 3, 12 x 3 to 6 x 2, and then to 4 x 2.
        ((0, 0, 2304, 2304), [0, 960, 1920], [0, 960, 1920], (384, 384)),
        ((0, 0, 4608, 1152), [0, 1408, 2816, 4224], [0, 768], (384, 384)),
        # One row of twenty: nine.
        ((0, 0, 7680, 100), [0, 912, 1824, 2736, 3648, 4560, 5472, 6384, 7296], [0], (384, 100)),
        ((0, 0, 100, 7680), [0], [0, 912, 1824, 2736, 3648, 4560, 5472, 6384, 7296], (100, 384)),
    ],
)
def test_at_most_nine_windows_are_spread_evenly(box, lefts, tops, size) -> None:
    found = list(_windows(box))
    assert found == [(left, top, *size) for top in tops for left in lefts]
    assert len(found) <= 9


def test_all_pixels_about_a_patch_have_to_be_valid() -> None:
    valid = np.ones((40, 50), dtype=bool)
    valid[10, 20] = False
    for centre, reach, good in [
        ((26.0, 10.2), 5, True), ((25.9, 10.2), 5, False), ((15.0, 10.0), 5, True), ((16.0, 10.0), 5, False),
        ((20.0, 15.0), 5, False), ((20.0, 16.0), 5, True), ((20.0, 6.0), 5, False), ((20.0, 5.0), 5, True),
        ((2.0, 2.0), 5, True), ((2.0, 2.0), 19, False), ((48.0, 38.0), 9, True),
    ]:  # fmt: skip
        assert _all_valid(valid, np.array(centre), reach) == good


@pytest.mark.parametrize("moved", [(0.0, 0.0), (3.0, -2.0), (-7.3, 5.6)])
def test_patches_show_how_far_the_second_image_is_moved(moved) -> None:
    image = gaussian_filter(np.random.default_rng(3).normal(size=(300, 300)), 1.5) * 100
    one, other = (part[40:260, 40:260] for part in (image, shift(image, moved[::-1], order=3)))
    valid = np.ones((220, 220), dtype=bool)
    ties = _ties(details(one), details(other), valid, 64)
    assert len(ties) > 3
    np.testing.assert_allclose(np.median(ties, axis=0), moved, atol=0.05)
    valid[:, 110:] = False
    fewer = _ties(details(one), details(other), valid, 64)
    assert len(fewer) < len(ties)
    assert _ties(one[:65], other[:65], valid[:65], 64).shape == (0, 2)


def oblong(path: Path, column: int, row: int, width: int, height: int) -> Ortho:
    """Write an ortho of pixels of 2 x 3 m, all of which are valid."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), width, height, 1, gdal.GDT_Byte)
    system = osr.SpatialReference()
    system.ImportFromEPSG(32633)
    dataset.SetSpatialRef(system)
    dataset.SetGeoTransform((5e5 + 2 * column, 2.0, 0.0, 5e6 - 3 * row, 0.0, -3.0))
    del dataset
    return Ortho(path.stem, path)


def test_orthos_overlap_in_a_pixel_or_more(tmp_path: Path) -> None:
    """The third meets the first in one pixel and the second in a side only; the fourth is alone."""
    orthos = [oblong(tmp_path / "a.tif", 0, 0, 40, 30), oblong(tmp_path / "b.tif", 33, 9, 20, 12),
              oblong(tmp_path / "c.tif", 39, -20, 20, 21), oblong(tmp_path / "d.tif", 90, 0, 5, 5),
              oblong(tmp_path / "e.tif", 53, 9, 9, 9)]  # fmt: skip
    found = overlaps(lay_out(orthos, "first-on-top"))
    assert [(pair.first.ortho.name, pair.second.ortho.name) for pair in found] == [("a", "b"), ("a", "c")]
    assert [pair.pixels for pair in found] == pytest.approx([7 * 12, 1])
