"""Parts of single dates that are displaced, as a wrong tile of a mosaic is: `stack-part-displaced`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from networks import Truth
from osgeo import gdal
from rasters import Rasters
from scipy.stats import chi2

from ortho_pipeline.batch.stack.command import stack
from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.block.stack.moving import Left
from ortho_pipeline.block.stack.parts import DatePart, has_two, parts_of
from ortho_pipeline.block.stack.trends import design_of
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


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_ground_that_moves_fast_is_no_part_of_the_first_or_last_date(share):
    """All pairs of such a date show the motion in the same sense."""
    made = Truth(seed=2, dates=16, interval=30.0, hidden=0.0, moving=share, rate=6.0).made()
    stack = adjust(made.truth.cells, made.edges, made.years.tolist())
    assert stack.motion.moving[made.moving].all()
    assert stack.parts == ()


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


# -- limits ------------------------------------------------------------------------------------------------------------

#: Six dates; date 2 is the first date of two pairs, and the second of three. Thirty cells.
FIRST, SECOND = np.array([(2, 0), (2, 1), (3, 2), (4, 2), (5, 2), (1, 0), (3, 1), (4, 3), (5, 4)]).T
CELLS = Cells(np.zeros(2), 100.0, (6, 5))
SIGN = np.where(FIRST == 2, 1.0, np.where(SECOND == 2, -1.0, 0.0))


def left_with(shift: np.ndarray, own: np.ndarray, noise: float = 0.0, seen: np.ndarray | None = None) -> Left:
    """Return what is left of pairs if date 2 is displaced by `shift` ``(K, 2)`` and other dates differ by noise."""
    random, count = np.random.default_rng(4), len(shift)
    value = SIGN[:, None, None] * shift
    value[5:] += noise * np.array([1.0, -1.0, 1.0, -1.0])[:, None, None]
    weight = np.full((9, count), 100.0) if seen is None else 100.0 * seen
    shared, scale = random.uniform(0.01, 0.02, count) * own.mean() / 0.05, random.uniform(0.5, 2.0, 6)
    return Left(value, weight, own, shared, scale, np.eye(6), FIRST, SECOND)


@pytest.mark.parametrize("noisier", [1.0, 2.0])
@pytest.mark.parametrize("factor", [0.985, 1.015])
def test_a_part_has_four_cells_beyond_a_chance_of_one_in_a_thousand_over_all_places(factor, noisier):
    """A median has pi / 2 times the variance of a mean. Three pairs or more are needed, and ground that is still."""
    own, still, seen = np.random.default_rng(5).uniform(0.03, 0.07, (9, 30)), np.ones(30, bool), np.ones((9, 30), bool)
    still[[9, 29]] = False
    seen[[0, 3], 1] = seen[[0, 2, 4], 4] = False
    # Half of the squares of noise are below chi-squared's median; date 2 itself is less or more than half of them.
    left = left_with(np.zeros((30, 2)), own, np.sqrt(noisier * chi2.median(1) / 100.0) * (noisier > 1), seen)
    count = seen[:5].sum(axis=0)
    variance = left.scale[2] * left.shared + np.pi / 2 * (own * seen)[:5].sum(axis=0) / count**2
    far = np.sqrt(noisier * variance * chi2.isf(1e-3 / (28 * 6), 2))
    assert far.min() > 0.55
    shift = np.zeros((30, 2))
    for size, places in ((factor, [0, 1, 6, 7]), (3.0, [3, 4, 9, 10]), (3.0, [24, 25, 26])):
        shift[places, 0] = size * far[places]
    left = left_with(shift, own, np.sqrt(noisier * chi2.median(1) / 100.0) * (noisier > 1), seen)
    np.testing.assert_allclose(left.noisier[[0, 1, 6, 7]], noisier, rtol=1e-9)
    found = parts_of(CELLS, left, still, design_of(CELLS.place, 3))
    middle = float(np.median(shift[[0, 1, 6, 7], 0]))
    assert found == ([DatePart(2, 4, 27, (pytest.approx(middle), 0.0))] if factor > 1 else [])


@pytest.mark.parametrize(("size", "told"), [(0.49, False), (0.51, True)])
def test_half_a_pixel_is_the_least_that_is_told(size, told):
    """Of four cells, and of half of the date."""
    for count in (4, 15):
        shift = np.zeros((30, 2))
        places = [0, 1, 6, 7] if count == 4 else range(15)
        shift[places, 1] = -size
        left = left_with(shift, np.full((9, 30), 1e-6))
        found = parts_of(CELLS, left, np.ones(30, bool), design_of(CELLS.place, 3))
        assert [(one.date, one.cells) for one in found] == [(2, count)] * told
        # Of two halves, nothing shows which one is displaced.
        assert all(np.abs(one.shift) == pytest.approx((0.0, size)) for one in found)
    assert has_two(left, 2, np.ones(30, bool), design_of(CELLS.place, 3)) is told


@pytest.mark.parametrize(("cells", "two"), [(10, False), (11, True), (19, True), (20, False)])
def test_two_displacements_are_each_that_of_35_per_cent_of_a_date(cells, two):
    shift = np.where(np.arange(30)[:, None] < cells, (2.0, -1.0), (0.0, 0.0))
    assert has_two(left_with(shift, np.full((9, 30), 0.01)), 2, np.ones(30, bool), design_of(CELLS.place, 3)) is two


@pytest.mark.parametrize("cells", [12, 18])
def test_of_two_displacements_the_rarer_one_is_the_part(cells):
    """It is told relative to the rest of the date, wherever the correction of the date is."""
    shift = np.where(np.arange(30)[:, None] < cells, (1.5, -0.5), (-0.5, 1.0))
    (part,) = parts_of(CELLS, left_with(shift, np.full((9, 30), 0.01)), np.ones(30, bool), design_of(CELLS.place, 3))
    assert (part.date, part.cells, part.of) == (2, 12, 30)
    assert part.shift == pytest.approx((2.0, -1.5) if cells == 12 else (-2.0, 1.5))


def test_a_bent_date_has_no_two_displacements():
    """Two displacements fit a bend along the middle better than slopes do, and yet it is none."""
    place = Cells(np.zeros(2), 100.0, (12, 4)).place
    left = left_with(3.0 * np.abs(place[:, :1]) * [1.0, 0.5], np.full((9, 48), 0.01))
    assert not has_two(left, 2, np.ones(48, bool), design_of(place, 3))
