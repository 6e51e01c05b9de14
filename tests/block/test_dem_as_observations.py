"""Heights of a DEM as observations, number by number: slopes, their variance, shared information, planes, spots."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.block.heights.common_heights import CommonHeights, correlated
from ortho_pipeline.block.heights.source import DEFAULT_SIGMA, DemHeights
from ortho_pipeline.block.heights.spots import SpotDifferences
from ortho_pipeline.block.heights.terrain import LocalTerrain, expected_slopes
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.points.heights.spot_heights import SpotHeights
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem

CRS, EAST, NORTH, CELL, SIDE = "EPSG:32636", 500_000.0, 4_100_000.0, 10.0, 60
#: On the central meridian a metre of the map is 1 / 0.9996 m on the ground.
SCALE = 0.9996


class Made:
    """A DEM of heights by metres of the map from its middle, with places in it."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "dem.tif"

    def of(self, heights, **more: object) -> DemHeights:
        at = (np.arange(SIDE) + 0.5 - SIDE / 2) * CELL
        x, y = np.meshgrid(at, -at)
        made = np.broadcast_to(np.asarray(heights(x, y), dtype=float), x.shape).astype(np.float64)
        write_dem(self.path, made, (EAST - SIDE / 2 * CELL, NORTH + SIDE / 2 * CELL), CELL, CRS)
        surface = open_dem(self.path, "ellipsoid", override=True).with_sigma(more.pop("sigma", None))
        return DemHeights(surface, **more)

    def at(self, *places: tuple[float, float]) -> np.ndarray:
        xy = np.array(places, dtype=float) + np.array([EAST, NORTH])
        return ground_transform(CRS, "EPSG:4979")(np.column_stack([xy, np.zeros(len(xy))]))


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return Made(tmp_path)


def test_slopes_are_those_of_the_ground(made: Made) -> None:
    source = made.of(lambda x, y: 100.0 + 0.2 * x - 0.1 * y)
    for spacing in (10.0, 17.0, 30.0):
        slopes, level = source.slopes(made.at((5.0, 5.0), (-33.0, 41.0)), spacing)
        np.testing.assert_allclose(slopes, [[0.2 * SCALE, -0.1 * SCALE]] * 2, rtol=1e-3)
        assert not level.any()


@pytest.mark.parametrize(
    ("heights", "level"),
    [
        (lambda x, y: 0 * x, True),
        (lambda x, y: 0.0009 * x, True),
        (lambda x, y: 0.0012 * x, False),
        (lambda x, y: 0.0009 * y, True),
        (lambda x, y: -0.0012 * y, False),
        (lambda x, y: 1.9e-5 * x * y, True),
        (lambda x, y: -2.2e-5 * x * y, False),
        # One quarter of the nine heights is enough.
        *((lambda x, y, a=a, b=b: np.where((a * x > -8) & (b * y > -8), 0.0, 3.0 + x), True)
          for a, b in itertools.product((-1, 1), repeat=2)),
        (lambda x, y: np.where(x > 6, 0.0, 3.0 + x), False),
    ],
)  # fmt: skip
def test_water_is_level_ground_on_one_side(made: Made, heights, level: bool) -> None:
    assert bool(made.of(heights).slopes(made.at((0.0, 0.0)), 10.0)[1][0]) is level


def test_heights_for_a_slope_are_eight_sigmas_apart(made: Made) -> None:
    source = made.of(lambda x, y: 0 * x)
    side = source.surface.sample_size
    assert side == pytest.approx(CELL, rel=1e-3)
    for sigmas, wanted in (([0.5, 1.0, 9.0], side), ([2.0], 16.0), ([np.nan, 2.5, np.nan], 20.0), ([5.0], 3 * side)):
        assert source.spacing(np.array(sigmas)) == pytest.approx(wanted)
    assert source.spacing(np.array([np.nan])) == side


def mean_of_cells(apart: float) -> float:
    """Return the correlation of two interpolated heights so many samples apart, on average over where they are."""
    begin = (np.arange(2000) + 0.5) / 2000
    nodes = np.arange(-6, 7)[:, None]

    def weights(at: np.ndarray) -> np.ndarray:
        return np.maximum(1.0 - np.abs(at - nodes), 0.0)

    alike = (weights(begin) * weights(begin + apart)).sum(axis=0).mean()
    return float(alike / (weights(begin) ** 2).sum(axis=0).mean())


def slope_variance(correlation) -> float:
    """Return the variance of the slope of a plane through nine heights, by their correlation at steps apart."""
    steps = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=2)))
    alike = np.array([[correlation(*(one - other)) for other in steps] for one in steps])
    gain = np.linalg.pinv(np.column_stack([np.ones(9), steps]))[1]
    return float(gain @ alike @ gain)


def test_the_variance_of_a_slope_is_that_of_a_plane_by_least_squares(made: Made) -> None:
    source = made.of(lambda x, y: 0 * x, correlation=40.0)
    for spacing in (10.0, 25.0):
        wanted = slope_variance(lambda x, y, s=spacing: math.exp(-s * math.hypot(x, y) / 40.0)) / spacing**2
        assert source.slope_variance(spacing) == pytest.approx(wanted, rel=1e-9)
    alone = replace(source, correlation=None)
    for samples in (1.0, 0.7, 1.3, 3.0):
        by = {k: mean_of_cells(abs(k) * samples) for k in (0.0, 1.0, 2.0)}
        spacing = samples * source.surface.sample_size
        wanted = slope_variance(lambda x, y, by=by: by[abs(x)] * by[abs(y)]) / spacing**2
        assert alone.slope_variance(spacing) == pytest.approx(wanted, rel=1e-5)


def test_places_share_information_by_their_cells(made: Made) -> None:
    """Mean correlations of two places in the same cell, in the next and in the one after that, along each axis."""
    at, by = (np.arange(200) + 0.5) / 200, []
    apart = (at[:, None] - at).ravel()
    lags = np.linspace(-1, 3, 401)
    known = np.array([mean_of_cells(abs(lag)) for lag in lags])
    for cell in range(3):
        by.append(float(np.interp(cell + apart, lags, known).mean()))
    source, first = made.of(lambda x, y: 0 * x), (2.0, 3.0)
    for across, down in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (2, 2)):
        for a, b in itertools.product((-1, 1), repeat=2):
            found = source.sharing(made.at(first, (first[0] + 10.0 * a * across, first[1] + 10.0 * b * down)))
            np.testing.assert_allclose(found, 1.0 + by[across] * by[down], rtol=2e-3)
    # Farther apart nothing is shared, nor by the end of a row with the begin of the next.
    for other in ((33.0, 3.0), (2.0, -28.0), (-38.0, 13.0), (32.0, 13.0)):
        np.testing.assert_allclose(source.sharing(made.at(first, other)), 1.0, rtol=1e-12)
    found = source.sharing(made.at(first, first, first, (52.0, 3.0)))
    np.testing.assert_allclose(found, [1 + 2 * by[0] ** 2] * 3 + [1.0], rtol=2e-3)


def test_a_break_is_the_farthest_height_off_its_plane(made: Made) -> None:
    source = made.of(lambda x, y: 0.3 * x - 0.2 * y)
    plane = np.array([[0.3, -0.2]]) * SCALE
    assert source.breaks(made.at((0.0, 0.0)), plane, np.array([20.0]))[0] == pytest.approx(0.0, abs=5e-3)
    for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        cliff = made.of(lambda x, y, a=a, b=b: 0.3 * x - 0.2 * y + np.where(a * x + b * y > 12, 7.0, 0.0))
        found = cliff.breaks(made.at((0.0, 0.0), (0.0, 0.0)), np.vstack([plane, plane]), np.array([20.0, 1.0]))
        np.testing.assert_allclose(found, [7.0, 0.0], atol=6e-3)


def test_a_shifted_dem_is_read_where_it_is(made: Made) -> None:
    source = made.of(lambda x, y: 0.3 * x - 0.2 * y, read_at=(10.0, -20.0))
    np.testing.assert_allclose(source.heights(made.at((0.0, 0.0))), 3.0 * SCALE + 4.0 * SCALE, rtol=1e-3)
    np.testing.assert_allclose(source.breaks(made.at((0.0, 0.0)), np.zeros((1, 2)), np.array([10.0])), 3.0, rtol=1e-3)


@pytest.mark.parametrize(
    ("number", "ok"),
    [({"bias": 0.0}, True), ({"shift": 0.0}, True), ({"correlation": 0.0}, False), ({"correlation": 0.5}, True)]
    + [({name: value}, False) for name in ("bias", "shift", "correlation") for value in (-1e-9, np.inf, np.nan)],
)
def test_lengths_of_a_dem_are_checked(made: Made, number: dict[str, float], ok: bool) -> None:
    if ok:
        made.of(lambda x, y: 0 * x, **number)
    else:
        with pytest.raises(InputError, match="not a length"):
            made.of(lambda x, y: 0 * x, **number)


def test_expected_slopes_are_the_regression_of_true_ones() -> None:
    random, variance = np.random.default_rng(5), 3e-4
    images, sigmas = np.array([0] * 15 + [2] * 25), random.uniform(1.0, 4.0, 40)
    slopes = random.normal(0, 1, (40, 2)) @ [[0.3, 0.1], [0.0, 0.2]] + (0.5, -0.2)
    slopes[4, 1], sigmas[7] = np.nan, 0.0
    rows = np.setdiff1d(np.arange(40), (4, 7))
    weights, found = sigmas[rows] ** -2.0, slopes[rows].copy()
    means = {k: np.average(found[images[rows] == k], axis=0, weights=weights[images[rows] == k]) for k in (0, 2)}
    middle = np.array([means[k] for k in images[rows].tolist()])
    seen = ((found - middle).T * weights) @ (found - middle) / (len(rows) - 2)
    wanted = slopes.copy()
    wanted[rows] = middle + (found - middle) @ ((seen - variance * np.eye(2)) @ np.linalg.inv(seen)).T
    np.testing.assert_allclose(expected_slopes(slopes, sigmas, variance, images), wanted, rtol=1e-12)
    # Slopes that are no larger than their errors are the mean.
    wanted[rows] = middle
    np.testing.assert_allclose(expected_slopes(slopes, sigmas, 10.0, images), wanted, rtol=1e-12)


def test_slopes_are_read_again_where_points_moved_a_quarter_of_the_spacing(made: Made) -> None:
    source = made.of(lambda x, y: 0.001 * x**2 + 0.3 * y)
    of, sigmas, images = np.array([True, True, False]), np.full(3, 2.0), np.zeros(3, dtype=np.int64)
    before = LocalTerrain.under(source, made.at((0.0, 0.0), (40.0, 0.0), (80.0, 0.0)), of, sigmas, images)
    np.testing.assert_allclose(before.measured[:2], [[0.0, 0.3], [0.08, 0.3]], atol=2e-3)
    assert np.isnan(before.heights[2])
    assert np.isnan(before.measured[2]).all()
    assert before.spacing == pytest.approx(16.0)
    # A quarter is 4 m.
    for moved, again in (((3.9, 0.0), False), ((4.1, 0.0), True), ((0.0, -3.9), False), ((0.0, -4.1), True)):
        ground = made.at((0.0, 0.0), (40.0 + moved[0], moved[1]), (80.0, 0.0))
        found = LocalTerrain.under(source, ground, of, sigmas, images, before)
        read = ground if again else made.at((40.0, 0.0), (40.0, 0.0))
        np.testing.assert_allclose(found.read[1], read[1, :2], rtol=0, atol=1e-12)
        assert found.heights[1] == pytest.approx(0.001 * (40 + moved[0]) ** 2 + 0.3 * moved[1], abs=0.03)
        assert (found.measured[1] != before.measured[1]).any() == again


@pytest.mark.parametrize(("level", "water"), [(2, 2), (3, 3), (4, 0), (8, 0)])
def test_level_ground_is_water_if_less_than_half_of_it_is(made: Made, level: int, water: int) -> None:
    source = made.of(lambda x, y: np.where(x > 0, 0.2 * x, 0.0))
    ground = made.at(*((-100.0, 5.0 * k) for k in range(level)), *((100.0, 5.0 * k) for k in range(8 - level)))
    found = LocalTerrain.under(source, ground, np.ones(8, dtype=bool), np.ones(8), np.zeros(8, dtype=np.int64))
    assert found.level.sum() == level
    assert found.water.sum() == water
    assert np.isnan(found.slopes).all(axis=1).sum() == water


# -- errors that heights share -----------------------------------------------------------------------------------------


def test_few_correlated_errors_are_their_leading_modes() -> None:
    places = np.random.default_rng(1).uniform(0, 100, (60, 3))
    alike = np.exp(-np.linalg.norm(places[:, None] - places, axis=2) / 300.0)
    values, vectors = np.linalg.eigh(alike)
    held = np.cumsum(values[::-1]) / values.sum()
    kept = int((held < 0.99).sum()) + 1
    loads, own = correlated(places, 300.0)
    assert loads.shape == (60, kept)
    wanted = (vectors[:, -kept:] * values[-kept:]) @ vectors[:, -kept:].T
    np.testing.assert_allclose(loads @ loads.T, wanted, atol=1e-10)
    np.testing.assert_allclose(own, np.maximum(1.0 - np.diag(wanted), 0.01), rtol=1e-9)


@pytest.mark.parametrize(("side", "modes"), [(20, 120), (40, 120), (75, 106)])
def test_many_errors_of_a_short_length_have_information_by_their_density(side: int, modes: int) -> None:
    """What modes do not hold counts as if neighbours that are alike were one: the weights add up to the right one."""
    plan = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * 40.0 / side
    places = np.column_stack([plan, np.zeros(len(plan))])
    loads, own = correlated(places, 2.0)
    assert loads.shape == (side**2, modes)
    chosen = np.random.default_rng(0).permutation(side**2)[:800]
    alike = np.exp(-np.linalg.norm(places[chosen][:, None] - places[chosen], axis=2) / 2.0)
    values, vectors = np.linalg.eigh(alike)
    left = alike - (vectors[:, -modes:] * values[-modes:]) @ vectors[:, -modes:].T
    more = np.maximum(left, 0.0).sum() / np.trace(left) * side**2 / len(chosen)
    assert more > 1.5
    np.testing.assert_allclose(own[chosen], np.maximum(np.diag(left), 0.01) * more, rtol=1e-6)


def common(told: list[float], value: list[float], **more: object) -> CommonHeights:
    found = CommonHeights.of(np.ones((2, 3)), 5.0, 2, 1)
    return replace(found, told=np.diag(told), value=np.array(value), **more)


def test_the_chance_of_a_shift_is_that_of_chi_squared_of_what_the_block_says() -> None:
    # The block says 2 and -1 standard deviations with the information 4 and 9; the prior draws both to 0.
    found = common([1.0, 4.0, 9.0], [0.0, 2.0 * 4 / 5, -9 / 10])
    assert found.chance == pytest.approx(math.exp(-(4 * 4 + 9 * 1) / 2))
    assert common([1.0, 2e-6, 1.0], [0.0, 0.0, 0.0]).chance == pytest.approx(1.0)
    assert common([1.0, 0.5e-6, 1.0], [0.0, 0.0, 0.0]).chance is None
    value, covariance = found.shift(8.0)
    np.testing.assert_allclose(value, [2.0 * 4 / 5 * 8, -9 / 10 * 8])
    np.testing.assert_allclose(covariance, np.diag([64 / 5, 64 / 10]), atol=1e-12)


def test_the_chance_of_correlated_errors_is_that_of_a_distribution_with_their_mean_and_variance() -> None:
    """Estimates of variance 1/2 each have a sum of squares as chi-squared; bias and shift are none of them."""
    told, value = [0.5, 2.0, 3.0, *[1.0] * 4], [9.0, -9.0, 9.0, 0.7, -1.2, 0.4, 1.1]
    square = 0.49 + 1.44 + 0.16 + 1.21
    assert common(told, value).chance_of_correlated == pytest.approx(float(stats.chi2.sf(2.0 * square, 4)))
    root = np.random.default_rng(8).normal(size=(7, 7))
    dense = replace(common(told, value), told=root @ root.T)
    spread = np.linalg.solve(np.eye(7) + dense.told, dense.told)[3:, 3:]
    mean, variance = np.trace(spread), 2.0 * np.trace(spread @ spread)
    wanted = stats.gamma.sf(square, mean**2 / variance, scale=variance / mean)
    assert 0.01 < wanted < 0.99
    assert dense.chance_of_correlated == pytest.approx(float(wanted))
    # Of which nothing is told, or there are none, nothing is improbable.
    for nothing in (common([1.0] * 3, [9.0] * 3), common([1.0] * 3 + [0.0] * 4, value)):
        assert nothing.chance_of_correlated == 1.0


def test_shared_errors_in_metres() -> None:
    found = common([3.0, 0.0, 0.0], [0.5, 1.0, 2.0], loads=np.array([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    assert found.bias == pytest.approx((2.5, 2.5))
    # A DEM that is shifted to the east is too low where it rises to the east.
    found = found.with_slopes(np.array([[0.2, 0.0], [0.1, -0.3]]), 10.0)
    np.testing.assert_allclose(found.offset, [2.5 - 2.0, 2.5 - 1.0 + 6.0])
    read = replace(found, undone=np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(read.offset, [2.5, 2.5])


def test_spots_tell_the_shared_errors_as_in_one_least_squares_problem() -> None:
    spots = SpotHeights(np.zeros((5, 3)), np.full(5, 0.3), np.full(5, 2.0), tuple("abcde"))
    slopes = np.array([[0.1, 0.0], [0.0, 0.2], [0.3, -0.1], [0.0, 0.0], [0.1, 0.1]])
    apart, sigmas = np.array([4.0, 6.0, 5.0, np.nan, 300.0]), np.array([1.0, 2.0, 1.5, 1.0, 1.0])
    wrong = np.array([False, False, False, False, True])
    made = SpotDifferences(spots, apart, slopes, sigmas, np.array([1.0, 2.5, 0.5, 1.0, 1.0]), np.zeros((5, 3)), wrong)
    made = replace(made.with_loads(5.0, 8.0, np.zeros((5, 0)), None), scale=2.0)
    np.testing.assert_allclose(made.loads, np.column_stack([np.full(5, 5.0), -8.0 * slopes]))
    own = np.array([1.0, 2.5, 0.5, 1.0, 1.0])
    variances = own * (2.0 * sigmas) ** 2 + 0.09 + (slopes**2).sum(axis=1) * 4.0
    np.testing.assert_allclose(made.variances(7.0), variances)
    # One by one, a difference varies as its height does, however many share it.
    np.testing.assert_allclose(made.variances(7.0, shared=False), variances - np.maximum(own - 1, 0) * 4 * sigmas**2)
    unstated = replace(made, stated=None)
    np.testing.assert_allclose(unstated.variances(7.0), own * 49.0 + 0.09 + (slopes**2).sum(axis=1) * 4.0)
    np.testing.assert_allclose(unstated.with_loads(1.0, 0.0, np.ones((5, 1)), own).loads[:, 3], DEFAULT_SIGMA)
    with_more = made.with_loads(1.0, 0.0, np.full((5, 1), 0.5), np.full(5, 0.25))
    np.testing.assert_allclose(with_more.loads[:, 3], 0.5 * sigmas)
    np.testing.assert_allclose(with_more.own, 0.25)
    # The prior of unit weight, and three differences.
    told, slope = made.told(common([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), 7.0, np.zeros(3))
    rows = np.vstack([np.eye(3), made.loads[:3] / np.sqrt(variances[:3])[:, None]])
    best = np.linalg.lstsq(rows, np.concatenate([np.zeros(3), apart[:3] / np.sqrt(variances[:3])]), rcond=None)[0]
    np.testing.assert_allclose(told.step(slope), best, rtol=1e-10)
    # At the best nothing is left to do.
    settled = replace(told, value=best)
    assert np.abs(settled.step(made.told(replace(settled, told=np.zeros((3, 3))), 7.0, np.zeros(3))[1])).max() < 1e-12
    left = (apart - made.loads @ best)[:3]
    record = made.record(settled)
    assert (record.used, record.left_out, record.without) == (3, ("e",), 1)
    assert record.mean_m == pytest.approx(5.0)
    assert record.rms_m == pytest.approx(np.sqrt(np.mean(left**2)))
    alone = np.sqrt(made.variances(7.0, shared=False)[:3])
    np.testing.assert_allclose(made.standardised(settled, 7.0), np.abs(left) / alone)


def test_a_spot_is_wrong_beyond_four_sigmas_of_it_and_of_the_estimate() -> None:
    spots = SpotHeights(np.zeros((4, 3)), np.full(4, 3.0), np.zeros(4), tuple("abcd"))
    flat, none = np.zeros((4, 2)), np.zeros(4, dtype=bool)
    # Sigmas: 3 m of the spot, 4 m of the DEM, and 12 m of the bias after one observation: 13 m.
    # However many share the information of a spot, it varies by itself.
    own, apart = np.array([1.0, 4.0, 4.0, 1.0]), np.array([51.9, 52.1, -51.9, -52.1])
    made = SpotDifferences(spots, apart, flat, None, own, np.zeros((4, 3)), none)
    made = made.with_loads(24.0, 0.0, np.zeros((4, 0)), None)
    judged = made.judged(common([3.0, 0.0, 0.0], [0.0, 0.0, 0.0]), 4.0)
    assert judged.wrong.tolist() == [False, True, False, True]
