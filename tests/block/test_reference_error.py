"""The common error of a reference in a block: blocks drawn with it, dense least squares, and the fit of one image."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.variances import shared_errors
from ortho_pipeline.commands.control.block_points import relative_to_reference
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models import RPC, ImageCorrection, SensorModel
from ortho_pipeline.options import BlockOptions, MatchOptions
from ortho_pipeline.points import Points

SIZE = 10_000.0
#: Pixels per metre east, north and up, of two images that look from both sides.
LOOKS = {
    "left": np.array([[1.0, 0.1, 0.4], [0.2, -1.0, 0.1]]),
    "right": np.array([[1.0, -0.1, -0.4], [0.1, -1.0, 0.0]]),
}
NOISE, NEAR = 0.3, 1e-3


def rpc_of(look: np.ndarray) -> RPC:
    plan = metres_per_degree(np.array([[20.0, -30.0, 500.0]]))[0] * 0.05
    one, col, row = np.eye(20)[0], np.zeros(20), np.zeros(20)
    # Terms 1, 2, 3 of an RPC are longitude, latitude and height, in units of half the scene.
    scale = np.array([*plan, 300.0]) / (SIZE / 2)
    col[[1, 2, 3]], row[[1, 2, 3]] = look * scale
    half = SIZE / 2
    return RPC(half, half, 20.0, -30.0, 500.0, half, half, 0.05, 0.05, 300.0, col, one, row, one)


@pytest.fixture(scope="module")
def rpcs() -> dict[str, RPC]:
    return {name: rpc_of(look) for name, look in LOOKS.items()}


def starts(rpcs: dict[str, RPC], kind: str = "shift") -> dict[str, SensorModel]:
    return {name: ImageCorrection.identity(rpc, kind, (SIZE / 2, SIZE / 2)) for name, rpc in rpcs.items()}


def places(random: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([random.uniform(-1, 1, (count, 2)) * 0.04 + (20, -30), random.uniform(300, 700, count)])


def table(
    name: str, rpc: RPC, random: np.random.Generator, ground: np.ndarray, role: str, ids: list[str], *,
    sigma: float = 0.0, off: np.ndarray | None = None,
) -> Points:  # fmt: skip
    """Return what was measured in an image of the true ground; the model is right, the ground lies `off` (m)."""
    said = ground.copy()
    if off is not None:
        said[:, :2] += off / metres_per_degree(ground)
    count = len(ground)
    return Points(
        ids=tuple(ids), image=rpc.ground_to_image(ground) + random.normal(0, NOISE, (count, 2)),
        ground=np.full((count, 3), np.nan) if role == "tie" else said, roles=np.full(count, role),
        sigma_image=np.full(count, NOISE), sigma_ground=np.full((count, 3), NEAR), crs=pyproj.CRS(4326), source=name,
        sigma_common=np.full(count, sigma),
    )  # fmt: skip


def together(parts: list[Points]) -> Points:
    def all_of(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    names = ("image", "ground", "roles", "sigma_image", "sigma_ground", "sigma_common", "sigma_alike")
    return replace(parts[0], ids=tuple(one for part in parts for one in part.ids), covariance_image=None, groups=None,
                   **{name: all_of(name) for name in names})  # fmt: skip


def block(
    rpcs: dict[str, RPC], random: np.random.Generator, *, matched: int, ties: int = 20, surveyed: int = 0,
    sigma: float = 2.0, off: np.ndarray | tuple[float, float] = (0.0, 0.0), role: str = "control",
) -> tuple[BlockPoints, np.ndarray]:  # fmt: skip
    """Return matches of each image with a reference that lies `off`, ties and surveyed points; and the ties' ground."""
    of_ties, of_survey = places(random, ties), places(random, surveyed)
    tables = {}
    for name, rpc in rpcs.items():
        tables[name] = together([
            table(name, rpc, random, places(random, matched), "control", [f"{name} m{k}" for k in range(matched)],
                  sigma=sigma, off=np.asarray(off)),
            table(name, rpc, random, of_survey, role, [f"s{k}" for k in range(surveyed)]),
            table(name, rpc, random, of_ties, "tie", [f"t{k}" for k in range(ties)]),
        ])  # fmt: skip
    return BlockPoints.of(tables), of_ties


def off_by(found: BlockFit, ground: np.ndarray) -> np.ndarray:
    """Return how far ties lie from their true ground (m), east and north, over their sigmas."""
    ties = found.points.tie
    apart = (found.ground[ties] - ground)[:, :2] * metres_per_degree(ground)
    return apart / found.ground_sigmas[ties, :2]


@pytest.mark.parametrize("kind", ["shift", "affine"])
def test_no_number_of_matches_makes_it_less(rpcs: dict[str, RPC], kind: str) -> None:
    """A reference of 2 m leaves 2 m times d(image)/d(ground) in all shifts alike, and 2 m in the ground of ties."""
    for matched in (30, 240):
        points, _ = block(rpcs, np.random.default_rng(1), matched=matched)
        found = adjust(starts(rpcs, kind), points)
        alone = adjust(starts(rpcs, kind), replace(points, sigma_common=None))
        np.testing.assert_array_equal(found.values, alone.values)
        shifts = [k for k, (_, name) in enumerate(found.parameters) if name in ("col_shift", "row_shift")]
        moved = np.vstack([LOOKS[name][:, :2] for name in rpcs])
        more = (found.covariance - alone.covariance)[np.ix_(shifts, shifts)]
        np.testing.assert_allclose(more, 4.0 * moved @ moved.T, atol=0.1)
        more = (found.ground_covariance - alone.ground_covariance)[found.points.tie]
        np.testing.assert_allclose(more, np.broadcast_to(np.diag([4.0, 4.0, 0.0]), more.shape), atol=0.1)
        # The matches themselves agree as they did: what they share is no part of their residuals or weights.
        assert found.sigma0 == alone.sigma0 == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    ("kind", "surveyed"),
    [("affine", 0), *(pytest.param(*one, marks=pytest.mark.slow) for one in (("shift", 0), ("affine", 4)))],
)
def test_sigmas_cover_where_the_reference_lies_anywhere(rpcs: dict[str, RPC], kind: str, surveyed: int) -> None:
    """Spread of (estimate - truth) / sigma over references drawn by their sigma, of shifts and of the ties' ground.

    The four shifts of a block, and the ground of its ties, share one draw of two axes where nothing else tells of it:
    25 blocks know a spread to 10 %, so 0.7 to 1.3 is three of that. Without the common error it is 22.
    """
    random = np.random.default_rng([7, surveyed])
    shifts, grounds = [], []
    for _ in range(25):
        points, ground = block(
            rpcs, random, matched=30, ties=10, surveyed=surveyed, off=random.normal(0, 2.0, 2), sigma=2.0
        )  # fmt: skip
        found = adjust(starts(rpcs, kind), points, robust=False)
        of = [k for k, (_, name) in enumerate(found.parameters) if name in ("col_shift", "row_shift")]
        shifts.append((found.values / found.sigmas)[of])
        grounds.append(off_by(found, ground))
    assert 0.7 < np.sqrt(np.square(shifts).mean()) < 1.3
    assert 0.7 < np.sqrt(np.square(grounds).mean()) < 1.3


def test_one_image_is_the_fit_of_one_image(rpcs: dict[str, RPC]) -> None:
    random = np.random.default_rng(4)
    rpc = rpcs["left"]
    parts = [
        table("left", rpc, random, places(random, 60), "control", [f"m{k}" for k in range(60)], sigma=2.0,
              off=np.array([2.5, -1.5])),
        table("left", rpc, random, places(random, 5), "control", [f"s{k}" for k in range(5)]),
    ]  # fmt: skip
    points = together(parts)
    start = starts(rpcs, "affine")["left"]
    single = fit(start, points)
    found = adjust({"left": start}, BlockPoints.of({"left": points}))
    assert found.common_error is not None
    assert single.common_error is not None
    np.testing.assert_allclose(found.values, single.values, atol=0.02 * single.sigmas.max())
    np.testing.assert_allclose(found.sigmas, single.sigmas, rtol=0.06)
    np.testing.assert_allclose(found.common_error.value, single.common_error.value, atol=0.01)


def test_few_surveyed_points_are_no_gross_errors_beside_many_matches(rpcs: dict[str, RPC]) -> None:
    """Of 400 matches whose reference is off by 1.5 sigmas, five surveyed points, one of them really wrong."""
    points, ground = block(rpcs, np.random.default_rng(5), matched=200, surveyed=5, sigma=4.0, off=(5.0, 3.0))
    wrong = points.ground.copy()
    wrong[points.ids.index("s2"), 0] += 12.0 / metres_per_degree(ground)[0, 0]
    points = replace(points, ground=wrong)
    found = adjust(starts(rpcs), points)
    assert {one.point for one in found.rejected} == {"s2"}
    assert np.abs(found.values).max() < 0.6
    assert np.abs(off_by(found, ground)).max() < 4.5
    said = json.loads(json.dumps(found.to_json()["common_error"]))
    assert said["points"] == 400
    assert said["sigma_m"] == 4.0
    np.testing.assert_allclose(said["estimate_m"], (5.0, 3.0), atol=3.5 * max(said["estimate_sigma_m"]))
    assert max(said["estimate_sigma_m"]) < 0.3
    # The estimate explains the 6 m, so little is left in the ground of the matches.
    assert found.object_rms("control").plan < 1.5
    plain = adjust(starts(rpcs), replace(points, sigma_common=None))
    assert {"s0", "s1", "s2", "s3", "s4"} <= {one.point for one in plain.rejected}


def test_what_is_known_of_an_image_tells_of_it(rpcs: dict[str, RPC]) -> None:
    points, _ = block(rpcs, np.random.default_rng(9), matched=60, sigma=5.0, off=(4.0, -6.0))
    known = {"left": {name: Prior(0.0, 0.1) for name in ("col_shift", "row_shift")}}
    found = adjust(starts(rpcs), points, priors=known)
    assert found.common_error is not None
    np.testing.assert_allclose(found.common_error.value * 5.0, (4.0, -6.0), atol=0.5)
    assert np.abs(found.values).max() < 0.5
    assert (found.sigmas < 0.2).all()


def test_surveyed_check_points_may_lie_off_by_it(rpcs: dict[str, RPC]) -> None:
    """They are named where they contradict the block; an error that was stated is no contradiction."""
    points, _ = block(rpcs, np.random.default_rng(6), matched=60, surveyed=4, sigma=4.0, off=(4.0, -2.0), role="check")
    assert not adjust(starts(rpcs), points).outlying
    assert len(adjust(starts(rpcs), replace(points, sigma_common=None)).outlying) == 4


def test_tables_keep_what_points_have_in_common(rpcs: dict[str, RPC]) -> None:
    points, _ = block(rpcs, np.random.default_rng(2), matched=3, ties=2, sigma=1.5)
    assert points.sigma_common.tolist() == [1.5] * 3 + [0.0] * 2 + [1.5] * 3
    assert points.select([0, 3]).sigma_common.tolist() == [1.5, 0.0]
    assert points.in_image("left").sigma_common.tolist() == [1.5] * 3 + [0.0] * 2


# -- errors that neighbours share --------------------------------------------------------------------------------------


def alike(
    rpcs: dict[str, RPC], random: np.random.Generator, *, matched: int = 120, ties: int = 10, surveyed: int = 0,
    reach: float = 0.15, **options: object,
) -> tuple[BlockPoints, np.ndarray]:  # fmt: skip
    """Return a block whose matches err alike over a part of each image, a pixel, and know in which cells they stand."""
    points, ground = block(rpcs, random, matched=matched, ties=ties, surveyed=surveyed, **options)
    groups, measured = np.full(points.rays, -1), points.measured.copy()
    covariance = points.covariance_image.copy()
    for number in range(len(rpcs)):
        rays = np.flatnonzero(points.image == number)
        rays = rays[[" m" in points.ids[k] for k in points.point[rays]]]
        apart = np.linalg.norm(measured[rays, None] - measured[rays], axis=2) / (reach * SIZE)
        values, vectors = np.linalg.eigh(np.exp(-apart))
        measured[rays] += vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * random.normal(0, 1, (len(rays), 2)))
        cells = np.clip(points.measured[rays] // (SIZE / 6), 0, 5).astype(int)
        groups[rays] = 6 * cells[:, 1] + cells[:, 0]
        covariance[rays] = (1 + NOISE**2) * np.eye(2)
    sigma = np.sqrt(covariance[:, 0, 0])
    return replace(points, measured=measured, sigma_image=sigma, groups=groups), ground


@pytest.mark.parametrize(
    ("kind", "count", "far"),
    [("affine", 8, 1.7), *(pytest.param(kind, 25, 1.4, marks=pytest.mark.slow) for kind in ("shift", "affine"))],
)
def test_sigmas_grow_by_what_neighbours_share(rpcs: dict[str, RPC], kind: str, count: int, far: float) -> None:
    """Matches that err alike over a sixth of each image are some ten points, not 240.

    Each image and axis has its own draw: of 25 blocks a spread is known to 7 to 10 %, and has the tails of an estimated
    variance; counted as independent points, sigmas would be four times too small.
    """
    random = np.random.default_rng(11)
    values, grounds = [], []
    for _ in range(count):
        points, ground = alike(rpcs, random, sigma=0.0)
        found = adjust(starts(rpcs, kind), points, robust=False)
        values.append(found.values / found.sigmas)
        grounds.append(off_by(found, ground))
    assert 1 / far < np.sqrt(np.square(values).mean()) < far
    assert 1 / far < np.sqrt(np.square(grounds).mean()) < far
    alone = adjust(starts(rpcs, kind), replace(points, groups=None), robust=False)
    np.testing.assert_array_equal(found.values, alone.values)
    assert np.median(found.sigmas / alone.sigmas) > 2
    said = json.loads(json.dumps(found.to_json()["shared_errors"]))
    assert set(said) == set(rpcs)
    assert all(one["points"] == 120 and one["effective_points"] < 60 for one in said.values())


def test_groups_of_one_image_grow_as_in_its_fit(rpcs: dict[str, RPC]) -> None:
    points, _ = alike({"left": rpcs["left"]}, np.random.default_rng(3), ties=0, sigma=0.0)
    start = starts(rpcs, "affine")["left"]
    found, single = adjust({"left": start}, points), fit(start, points.in_image("left"))
    np.testing.assert_allclose(found.sigmas, single.sigmas, rtol=0.05)


def test_what_all_matches_of_an_image_err_alike_does_not_average_away(rpcs: dict[str, RPC]) -> None:
    """Interpolation moves all matches of an image by some 0.002 px: 120 of 0.005 px would claim 0.0005 px.

    Six blocks of two images have 24 draws, which know a spread to 15 %: 0.55 to 1.45 is three of that.
    """
    random, errors = np.random.default_rng(14), []
    for _ in range(6):
        points, _ = block(rpcs, random, matched=120, ties=0, sigma=0.0)
        exact = np.concatenate([rpcs[name].ground_to_image(points.ground[points.point[points.image == number]])
                                for number, name in enumerate(points.images)])  # fmt: skip
        shift = random.normal(0, 0.002, (len(rpcs), 2))
        measured = exact + random.normal(0, 0.005, exact.shape) + shift[points.image]
        cells = np.clip(measured // (SIZE / 6), 0, 5).astype(int)
        points = replace(points, measured=measured, sigma_image=np.full(points.rays, 0.005),
                         groups=6 * cells[:, 1] + cells[:, 0])  # fmt: skip
        found = adjust(starts(rpcs), points, robust=False)
        errors.append(found.values / found.sigmas)
    assert 0.55 < np.sqrt(np.square(errors).mean()) < 1.45


def test_a_large_block_says_that_its_sigmas_know_nothing_of_neighbours(
    rpcs: dict[str, RPC], monkeypatch: pytest.MonkeyPatch
) -> None:
    points, _ = alike(rpcs, np.random.default_rng(3), matched=40, sigma=2.0)
    options, match = BlockOptions(ties="auto"), MatchOptions(reference=("ortho.tif",), reference_sigma=2.0)
    words = [relative_to_reference(adjust(starts(rpcs), points), options, match)[0]]
    monkeypatch.setattr(shared_errors, "MOST_PARAMETERS", 3)
    large = adjust(starts(rpcs), points)
    assert not large.shared_errors
    words.append(relative_to_reference(large, options, match)[0])
    assert "errors common to neighbouring matches, estimated separately for each image" in words[0]
    assert "too large to include errors common to neighbouring matches" in words[1]


@pytest.mark.slow
def test_points_that_correct_the_reference_do_so_as_well_as_its_matches_allow(rpcs: dict[str, RPC]) -> None:
    """Beside four measured points the reference's place is as uncertain as the few points that its matches are."""
    random, found = np.random.default_rng(12), []
    for _ in range(25):
        points, ground = alike(rpcs, random, surveyed=4, sigma=2.0, off=random.normal(0, 2, 2))
        found.append(off_by(adjust(starts(rpcs, "affine"), points, robust=False), ground))
    assert 0.6 < np.sqrt(np.square(found).mean()) < 1.4
