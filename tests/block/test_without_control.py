"""Blocks of tie points alone: they meet, and what ties do not determine stays where it was, with the sigma of that."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.intersection import Intersection, intersect
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import DegeneratePoints
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.base import Array

LON, LAT, SIZE = 33.35, 37.25, 4000
ORIGIN = (SIZE / 2, SIZE / 2)


@pytest.fixture(scope="module")
def rpcs() -> dict[str, RPC]:
    """RPCs of line scanners at 650 km with pixels of 2.5 m: a pixel of parallax is 2.8 to 4.5 m of height."""
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


def ground_of(count: int, random: np.random.Generator) -> Array:
    plan = np.array([LON, LAT]) + [0.045, 0.036] * random.uniform(-1, 1, (count, 2))
    return np.column_stack([plan, random.uniform(200, 1500, count)])


def slow_errors(image: Array, size: float, random: np.random.Generator) -> Array:
    """Return errors of an image that change slowly over it, as those of attitude do: cubic, with an RMS of `size`."""
    x, y = ((image - ORIGIN) / ORIGIN).T
    terms = np.column_stack([x, y, x * x / 2, x * y / 2, y * y / 2, x**3 / 4, x * x * y / 4, x * y * y / 4, y**3 / 4])
    found = terms @ random.normal(0, 1, (9, 2))
    return size * (found - found.mean(axis=0)) / found.std()


def ties(
    rpcs: dict[str, RPC], ground: Array, *, bias: float, slow: float, noise: float, random: np.random.Generator
) -> BlockPoints:
    """Return ties of images whose RPCs are wrong by a bias, and by slow errors that no parameter stands for."""
    seen = []
    for rpc in rpcs.values():
        image = rpc.ground_to_image(ground)
        seen.append(image + random.normal(0, bias, 2) + slow_errors(image, slow, random))
    count, images = len(ground), len(rpcs)
    return BlockPoints(
        ids=tuple(map(str, range(count))), ground=np.full((count, 3), np.nan), roles=np.full(count, "tie"),
        sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS(4326), images=tuple(rpcs),
        point=np.tile(np.arange(count), images), image=np.repeat(np.arange(images), count),
        measured=np.concatenate(seen) + random.normal(0, noise, (images * count, 2)),
        sigma_image=np.full(images * count, noise),
    )  # fmt: skip


def starts(rpcs: dict[str, RPC], correction: str) -> dict[str, ImageCorrection]:
    return {name: ImageCorrection.identity(rpc, correction, ORIGIN) for name, rpc in rpcs.items()}


def misses(found: BlockFit | Intersection, ground: Array) -> Array:
    """Return found minus true ground, metres east, north, up."""
    frame = GroundFrame.about(ground)
    apart = frame.of_geodetic(found.ground) - frame.of_geodetic(ground)
    return np.asarray((frame.enu_at(ground) @ apart[:, :, None])[:, :, 0])


def apart(found: BlockFit | Intersection) -> float:
    return float(np.nanmedian(np.hypot(*found.residuals.T)))


@pytest.mark.parametrize("correction", ["shift", "affine"])
@pytest.mark.parametrize("names", [("left", "right"), ("left", "right", "down")])
def test_ties_bring_images_together_and_leave_heights(
    rpcs: dict[str, RPC], names: tuple[str, ...], correction: str
) -> None:
    """Slow errors of 0.1 px look like parallax of tens of pixels, which is 50 m of height."""
    some: dict[str, RPC] = {name: rpcs[name] for name in names}
    before, after, missed = list[Array](), list[Array](), list[tuple[float, float]]()
    for seed in range(3):
        random = np.random.default_rng(seed)
        ground = ground_of(150, random)
        points = ties(some, ground, bias=0.5, slow=0.1, noise=0.05, random=random)
        start, found = intersect(some, points), adjust(starts(some, correction), points)
        assert apart(found) < 0.15
        missed += [(apart(start), apart(found))]
        before.append(misses(start, ground)[:, 2])
        after.append(misses(found, ground)[:, 2])
    assert np.mean(missed, axis=0)[1] < 0.35 * np.mean(missed, axis=0)[0]
    # Neither the level of heights nor their slope over the block, which is in their spread.
    np.testing.assert_allclose(np.nanmedian(after, axis=1), np.nanmedian(before, axis=1), rtol=0, atol=0.3)
    assert (np.nanstd(after, axis=1) < np.nanstd(before, axis=1) + 0.3).all()


def test_more_ties_do_not_tell_more_of_heights(rpcs: dict[str, RPC]) -> None:
    """What ties share does not average out: 4,000 of them move heights no farther than 100."""
    random = np.random.default_rng(7)
    ground = ground_of(4000, random)
    points = ties(rpcs, ground, bias=1.0, slow=0.1, noise=0.1, random=random)
    for count in (100, 4000):
        some = points.select(np.arange(4000) < count)
        start, found = intersect(rpcs, some), adjust(starts(rpcs, "shift"), some)
        moved = misses(found, ground[:count])[:, 2] - misses(start, ground[:count])[:, 2]
        assert abs(np.nanmedian(moved)) < 0.5


def test_what_stays_has_the_sigma_of_where_it_started(rpcs: dict[str, RPC]) -> None:
    """Vendors' orientations of ten pixels, and slow errors beside: heights are as uncertain as they were."""
    two, normalised = {name: rpcs[name] for name in ("left", "right")}, list[Array]()
    for seed in range(30):
        random = np.random.default_rng(seed)
        ground = ground_of(40, random)
        points = ties(two, ground, bias=10.0, slow=0.05, noise=0.1, random=random)
        found = adjust(starts(two, "shift"), points, robust=False)
        normalised.append(np.median(misses(found, ground) / found.ground_sigmas, axis=0))
        assert apart(found) < 0.15
    # The spread of thirty draws to a tenth. Where rays miss each other by more than 10 px the sigma is larger.
    assert 0.65 < np.sqrt(np.mean(np.square(normalised))) < 1.15


def test_images_that_miss_each_other_by_more_are_held_by_more(rpcs: dict[str, RPC]) -> None:
    """Rays that miss by tens of pixels say that the start values are not good to ten."""
    random = np.random.default_rng(1)
    ground = ground_of(60, random)
    points = ties(rpcs, ground, bias=60.0, slow=0.05, noise=0.1, random=random)
    found = adjust(starts(rpcs, "shift"), points)
    assert apart(found) < 0.2
    sigma = float(found.gauge.split("sigma ")[1].split(" px")[0])
    assert 20.0 < sigma < 120.0
    stated = adjust(starts(rpcs, "shift"), points, hold=25.0)
    assert "sigma 25 px" in stated.gauge
    np.testing.assert_allclose(
        np.nanmedian(stated.ground_sigmas[:, 2] / found.ground_sigmas[:, 2]), 25.0 / sigma, rtol=0.05
    )


def test_sigmas_stated_too_large_do_not_move_heights(rpcs: dict[str, RPC]) -> None:
    """Ties of 0.05 px that claim 1 px: found to be better, they must not outweigh the start values by that."""
    random = np.random.default_rng(3)
    ground = ground_of(150, random)
    points = ties(rpcs, ground, bias=0.5, slow=0.1, noise=0.05, random=random)
    points = points.with_image_sigmas(np.full(points.rays, 1.0))
    start, found = intersect(rpcs, points), adjust(starts(rpcs, "shift"), points)
    assert found.sigma0 is not None
    assert found.sigma0 < 0.2
    assert np.nanmedian(misses(found, ground)[:, 2]) == pytest.approx(
        np.nanmedian(misses(start, ground)[:, 2]), abs=0.3
    )


def test_a_block_of_parallel_rays_says_so(rpcs: dict[str, RPC]) -> None:
    """Its ties have no place; that they are too few would mislead."""
    random = np.random.default_rng(3)
    views = {"one": rpcs["down"], "other": rpcs["down"]}
    points = ties(views, ground_of(60, random), bias=5.0, slow=0.0, noise=0.1, random=random)
    with pytest.raises(DegeneratePoints, match="parallel or meet outside"):
        adjust(starts(views, "shift"), points)
