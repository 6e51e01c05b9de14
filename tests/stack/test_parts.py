"""Parts of single dates that are displaced, as a wrong tile of a mosaic is: `stack-part-displaced`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from networks import Truth
from osgeo import gdal
from rasters import Rasters

from ortho_pipeline.batch.stack.command import stack
from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.options import MatchOptions, StackOptions

AT = 7


def solved(
    share: float, shift: float, seed: int = 30, dates: int = 16, at: int = AT, slope: float = 0.0
) -> AdjustedStack:
    """Return a stack of which the left `share` of one date is displaced along columns; all of it has a `slope`."""
    made = Truth(seed=seed, dates=dates, interval=30.0, hidden=0.0).made()
    part = made.truth.cells.place[:, 0] < 2 * share - 1
    sign = (made.edges.first == at) * 1.0 - (made.edges.second == at)
    value = made.edges.value.copy()
    value[:, :, 0] += sign[:, None] * (shift * part + slope * made.truth.cells.place[:, 0])
    return adjust(made.truth.cells, dataclasses.replace(made.edges, value=value), made.years.tolist())


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_a_displaced_part_of_one_date_is_told(share):
    stack = solved(share, 3.0)
    (part,) = stack.parts
    assert (part.date, part.of) == (AT, 144)
    assert part.cells == pytest.approx(144 * share, abs=12)
    assert part.shift == pytest.approx((3.0, 0.0), abs=0.15)
    # It is neither motion nor in the correction.
    assert not stack.motion.moving.any()
    others = solved(0.0, 0.0)
    assert np.abs(stack.network.value[:, 0] - others.network.value[:, 0]).max() < 0.03


@pytest.mark.parametrize("shift", [1.5, 3.0])
def test_a_displaced_half_of_one_date_is_no_slope(shift):
    """Nothing shows which half is right, so the correction is between them, and its sigma covers both."""
    stack = solved(0.5, shift)
    (part,) = stack.parts
    assert (part.date, part.cells, part.of) == (AT, 72, 144)
    assert np.abs(part.shift) == pytest.approx((shift, 0.0), abs=0.15)
    assert not stack.sloped.any()
    error = stack.network.value[AT, 0, 0] - solved(0.0, 0.0).network.value[AT, 0, 0]
    assert 0.25 * shift < error < 0.75 * shift
    assert stack.sigma[AT, 0] > 0.2 * shift


def test_a_few_wrong_places_take_no_slopes_from_a_date():
    made = Truth(seed=31, dates=16, interval=30.0, hidden=0.0, sloped=1).made()
    at = int(np.abs(made.slopes).sum(axis=(1, 2)).argmax())
    value = made.edges.value.copy()
    sign = (made.edges.first == at) * 1.0 - (made.edges.second == at)
    value[:, [40, 90, 91], 0] += 25.0 * sign[:, None]
    found = adjust(made.truth.cells, dataclasses.replace(made.edges, value=value), made.years.tolist())
    assert np.flatnonzero(found.sloped).tolist() == [at]
    assert found.parts == ()


@pytest.mark.parametrize("shift", [3.0, 8.0])
def test_slopes_of_a_date_are_kept_where_a_smaller_part_is_displaced(shift):
    stack = solved(0.2, shift, slope=0.6)
    assert np.flatnonzero(stack.sloped).tolist() == [AT]
    assert stack.network.value[AT, 1, 0] == pytest.approx(0.6, abs=0.05)
    (part,) = stack.parts
    assert part.shift == pytest.approx((shift, 0.0), abs=0.15)


@pytest.mark.parametrize(("share", "shift"), [(0.0, 0.0), (0.2, 0.3), (1.0, 3.0)])
def test_a_whole_date_and_small_displacements_are_no_part(share, shift):
    assert solved(share, shift).parts == ()


def test_two_pairs_do_not_tell_which_date_has_the_part():
    assert solved(0.25, 3.0, seed=3, dates=3, at=1).parts == ()


@pytest.mark.parametrize("moved", [0, 4])
def test_the_notice_names_the_date(tmp_path: Path, moved: int) -> None:
    paths = Rasters(side=240, dates=4, error=4.0).write(tmp_path / "in")
    opened = gdal.Open(str(paths[2]), gdal.GA_Update)
    pixels = opened.ReadAsArray()
    pixels[:, 150:] = np.roll(pixels[:, 150:], moved, axis=0)
    opened.GetRasterBand(1).WriteArray(pixels)
    opened = None
    done = stack(
        [tmp_path / "in"], tmp_path / "out", StackOptions(corrections_only=True), match=MatchOptions(points=120)
    )
    found = [one for one in done.document["notices"] if one["code"] == "stack-part-displaced"]
    assert [one["date"] for one in found] == ([paths[2].stem] if moved else [])
    if moved:
        # Rows count downwards, and so does the displacement.
        assert found[0]["shift_px"] == pytest.approx([0.0, 4.0], abs=0.3)
