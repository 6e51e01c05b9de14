"""When heights of points differ from those of a DEM as if their datums differed: limits on both sides, by hand."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.points.heights.datums import datums_apart

WGS84 = pyproj.CRS("EPSG:4979")
PLACE = np.array([[24.4, -33.65, 0.0]])


def five(median: float, step: float) -> np.ndarray:
    """Return differences with a median; the median of their distances from it is a step."""
    return median + step * np.array([1.0, -2.0, 0.0, -1.0, 2.0])


@pytest.mark.parametrize(
    ("difference", "apart"),
    [
        (five(5.1, 0.1), True), (five(-5.1, 0.1), True), (five(4.9, 0.1), False), (five(-4.9, 0.1), False),
        # Three standard deviations of 1.4826 steps: 11.57 m and 12.45 m.
        (five(12.0, 2.6), True), (five(-12.0, 2.6), True), (five(12.0, 2.8), False), (five(-12.0, 2.8), False),
        # Three points are enough; points that have their heights from the DEM do not count.
        (np.full(3, 30.0), True), (np.full(2, 30.0), False), (np.array([30.0, 30.0, 0.0, 1e-7, -1e-7]), False),
        (np.array([30.0, 30.0, 30.0, 0.0, 0.0, 0.0, 0.0]), True),
    ],
)  # fmt: skip
def test_a_difference_of_datums_is_larger_than_five_metres_and_three_standard_deviations(
    difference: np.ndarray, apart: bool
) -> None:
    assert [one.code for one in datums_apart(difference, PLACE, WGS84)] == ["heights-disagree"] * apart


@pytest.mark.parametrize(("median", "side"), [(30.0, "30.0 m above the DEM"), (-30.0, "30.0 m below the DEM")])
def test_the_notice_has_the_side_the_spread_and_the_effect(median: float, side: str) -> None:
    (notice,) = datums_apart(five(median, 2.0), PLACE, WGS84, displacement=0.25)
    assert side in str(notice)
    assert "that moves the ortho by 7.50 m" in str(notice)
    assert notice.fields == pytest.approx({"median_m": median, "spread_m": 1.4826 * 2.0, "moved_m": 7.5})
    (plain,) = datums_apart(five(median, 2.0), PLACE, WGS84)
    assert plain.fields["moved_m"] is None


@pytest.mark.parametrize(("undulation", "said"), [(28.2, "28.2 m above"), (-41.0, "41.0 m below")])
def test_the_notice_has_the_undulation_there(monkeypatch: pytest.MonkeyPatch, undulation: float, said: str) -> None:
    def there(self: Vertical, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        assert (lon[0], lat[0]) == pytest.approx((24.4, -33.65))
        return np.full(np.shape(lon), undulation)

    monkeypatch.setattr(Vertical, "undulation", there)
    (notice,) = datums_apart(np.full(3, 30.0), PLACE, WGS84)
    assert f"the geoid is {said} the ellipsoid there" in str(notice)
