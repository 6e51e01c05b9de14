"""Control that states no sigma: the sigmas of a block fit its errors, however plan and height differ.

All is drawn: biases of the images, ground, errors of measuring and of the survey. The adjustment gets the plain RPCs,
the measurements and the wrong ground; its errors are counted against the drawn truth.

What can be expected: n control points of a block of shifts leave n - 1 degrees of freedom in height and 2 (n - 1) in
plan. The log of an estimated variance of f degrees of freedom has the variance trigamma(f / 2). All errors of one block
may come from one shift of it, so shares of intervals vary by no more than those of one draw for each block.
"""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner
from scipy.special import polygamma

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.base import Array

LON, LAT, SIZE = 33.35, 37.25, 4000
CHECKS, TIES = 5, 4
#: Errors of the survey, metres in plan and in height: as of satellite stereo, alike, and as of a map with levelling.
WORSE_HEIGHTS, ALIKE, WORSE_PLAN = (0.5, 2.0), (1.0, 1.0), (2.0, 0.5)


@pytest.fixture(scope="module")
def rpcs() -> dict[str, RPC]:
    """RPCs of line scanners with pixels of 2.5 m."""
    cameras = {"left": (18.0, 192.0), "right": (-14.0, 191.0), "down": (2.0, 200.0)}
    return {
        name: export_rpc(
            LineScanner.over(
                LON, LAT, 850.0, off_nadir_deg=angle, heading_deg=heading, image_width=SIZE, image_height=SIZE,
                heights=(0.0, 1700.0),
            )
        ).rpc
        for name, (angle, heading) in cameras.items()
    }  # fmt: skip


def of_enu(ground: Array, metres: Array) -> Array:
    """Return ground ``(n, 3)`` lon, lat, h moved by metres ``(n, 3)`` east, north, up."""
    frame = GroundFrame.about(ground)
    turned = frame.enu_at(ground).swapaxes(1, 2) @ metres[:, :, None]
    return frame.geodetic(frame.of_geodetic(ground) + turned[:, :, 0])


def surveyed(
    rpcs: dict[str, RPC], control: int, errors: tuple[float, float], noise: float, seed: int
) -> tuple[BlockPoints, Array]:
    """Return points of images whose biases are some 10 px, and their true ground."""
    random = np.random.default_rng([seed, control])
    count = control + CHECKS + TIES
    plan = np.array([LON, LAT]) + [0.045, 0.036] * random.uniform(-1, 1, (count, 2))
    ground = np.column_stack([plan, random.uniform(200, 1500, count)])
    seen = np.concatenate([rpc.ground_to_image(ground) + random.normal(0, 10.0, 2) for rpc in rpcs.values()])
    known = ground.copy()
    known[:control] = of_enu(ground[:control], random.normal(0, 1, (control, 3)) * (errors[0], errors[0], errors[1]))
    points = BlockPoints(
        ids=tuple(map(str, range(count))), ground=known,
        roles=np.array(["control"] * control + ["check"] * CHECKS + ["tie"] * TIES),
        sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS(4326), images=tuple(rpcs),
        point=np.tile(np.arange(count), len(rpcs)), image=np.repeat(np.arange(len(rpcs)), count),
        measured=seen + random.normal(0, noise, seen.shape), sigma_image=np.full(len(seen), noise),
    )  # fmt: skip
    return points, ground


def adjusted(rpcs: dict[str, RPC], points: BlockPoints) -> BlockFit:
    """Return the block with all points: a search for gross errors would take the largest errors of good points."""
    start = {name: ImageCorrection.identity(rpc, "shift", (SIZE / 2, SIZE / 2)) for name, rpc in rpcs.items()}
    return adjust(start, points, robust=False)


def normalised(found: BlockFit, ground: Array) -> Array:
    """Return errors ``(n, 3)`` east, north, up of the adjusted ground in its sigmas."""
    frame = GroundFrame.about(ground)
    apart = frame.of_geodetic(found.ground) - frame.of_geodetic(ground)
    return np.asarray((frame.enu_at(ground) @ apart[:, :, None])[:, :, 0] / found.ground_sigmas)


@pytest.mark.parametrize(
    ("images", "control", "errors"),
    [(2, 4, WORSE_HEIGHTS), pytest.param(3, 7, WORSE_HEIGHTS, marks=pytest.mark.slow), (2, 4, WORSE_PLAN)],
    ids=["pair, worse heights", "triplet, worse heights", "pair, worse plan"],
)
def test_plan_and_height_get_the_sigmas_that_they_have(
    rpcs: dict[str, RPC], images: int, control: int, errors: tuple[float, float]
) -> None:
    """Rays of 0.03 px leave some 0.2 m open in height, far below the survey."""
    block = {name: rpcs[name] for name in list(rpcs)[:images]}
    logs, ratios = [], []
    for seed in range(25):
        points, ground = surveyed(block, control, errors, 0.03, seed)
        found = adjusted(block, points)
        assert found.variances.sigma_xy is not None
        assert found.variances.sigma_h is not None
        logs.append(np.log(found.variances.sigma_h / found.variances.sigma_xy))
        ratios.append(normalised(found, ground))
    variance = sum(polygamma(1, freedom / 2) / 4 for freedom in (2 * (control - 1), control - 1))
    # The prior, whose standard deviation is log 10, weighs in as one more observation.
    drawn = abs(np.log(errors[1] / errors[0])) * variance / (variance + np.log(10) ** 2)
    assert np.mean(logs) == pytest.approx(np.log(errors[1] / errors[0]), abs=3 * np.sqrt(variance / len(logs)) + drawn)
    shares = (np.abs(ratios) < 1.96).mean(axis=(0, 1))
    assert (shares > 0.95 - 3 * np.sqrt(0.95 * 0.05 / len(ratios))).all()


@pytest.mark.slow
@pytest.mark.parametrize("errors", [WORSE_HEIGHTS, ALIKE, WORSE_PLAN])
@pytest.mark.parametrize("control", [4, 7])
@pytest.mark.parametrize("images", [2, 3])
def test_errors_of_the_ground_are_as_large_as_their_sigmas(
    rpcs: dict[str, RPC], images: int, control: int, errors: tuple[float, float]
) -> None:
    """Rays of 0.06 px leave some 0.4 m open in height: what is below is hardly seen, and heights are claimed worse."""
    block = {name: rpcs[name] for name in list(rpcs)[:images]}
    ratios = []
    for seed in range(100):
        points, ground = surveyed(block, control, errors, 0.06, seed)
        ratios.append(normalised(adjusted(block, points), ground))
    array = np.array(ratios)
    for part in (array[:, :control], array[:, control:]):
        for values, far_above_rays in ((part[..., :2], True), (part[..., 2:], errors[1] > 0.5)):
            squares = (values**2).mean(axis=(1, 2))
            spread = 3 * squares.std(ddof=1) / np.sqrt(len(squares))
            assert squares.mean() - spread < 1.0
            # At most a fifth too large, and two fifths where the rays hide much of the error.
            assert squares.mean() + spread > (1 / 1.2**2 if far_above_rays else 1 / 1.4**2)
            assert (np.abs(values) < 1.96).mean() > 0.95 - 3 * np.sqrt(0.95 * 0.05 / len(squares))
