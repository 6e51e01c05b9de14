"""Normal equations in levels against dense matrices, where images follow each other in no order of their numbers."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pyproj
import pytest

from ortho_pipeline.block.equations import cofactors, level_factor, unknowns
from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.image_pairs import ImagePairs, Levels
from ortho_pipeline.block.equations.level_factor import LevelFactor, LevelMatrix
from ortho_pipeline.block.equations.reduced_system import NormalSystem
from ortho_pipeline.block.equations.unknowns import Columns, Ordering
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import NotConverged

#: Images of each point: a chain 4 - 1 - 6 - 0 - 5 - 2 with some triplets, and the image 3 with 7 apart from it.
SHOWN = [(4, 1), (6, 1), (6, 1, 0), (0, 5), (5, 2), (0, 5, 2), (3, 7), (4,), (7, 3), (1, 4), (6, 0)]
COUNTS = (2, 3, 1, 2, 4, 2, 0, 3)


def points_of(shown: list[tuple[int, ...]]) -> BlockPoints:
    point = np.repeat(np.arange(len(shown)), [len(images) for images in shown])
    return BlockPoints(
        ids=tuple(f"p{k}" for k in range(len(shown))), ground=np.full((len(shown), 3), math.nan),
        roles=np.full(len(shown), "tie"), sigma_ground=np.zeros((len(shown), 3)), crs=pyproj.CRS(4326),
        images=tuple(f"i{k}" for k in range(8)), point=point, image=np.concatenate(shown).astype(int),
        measured=np.arange(2.0 * len(point)).reshape(-1, 2), sigma_image=np.ones(len(point)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def levels() -> Levels:
    return Levels(ImagePairs.of(points_of(SHOWN)), Columns.of(COUNTS))


@pytest.fixture(scope="module")
def normal(levels: Levels) -> np.ndarray:
    """Return normal equations of parameters of very different sizes, zero between images without a common point."""
    random = np.random.default_rng(1)
    columns, tied = levels.columns, levels.pairs.slot >= 0
    rows = []
    for a, b in itertools.combinations_with_replacement(range(8), 2):
        if tied[a, b]:
            own = np.zeros((6, columns.size))
            for image in (a, b):
                own[:, columns.of_image(image)] = random.normal(size=(6, COUNTS[image]))
            rows.append(own)
    design = np.concatenate(rows) * 10.0 ** random.uniform(-2, 2, columns.size)
    return np.asarray(design.T @ design)


def blocks_of(levels: Levels, matrix: np.ndarray) -> np.ndarray:
    """Return the parts ``(S, p, p)`` of pairs of images of a dense matrix."""
    found = np.zeros((len(levels.pairs.first), 4, 4))
    for k, (a, b) in enumerate(zip(levels.pairs.first, levels.pairs.second, strict=True)):
        part = matrix[np.ix_(levels.columns.of_image(a), levels.columns.of_image(b))]
        found[k, : part.shape[0], : part.shape[1]] = part
    return found


def scaled(matrix: np.ndarray) -> np.ndarray:
    lengths = np.sqrt(np.diag(matrix))
    return np.asarray(matrix / np.outer(lengths, lengths))


def test_images_of_a_level_share_points_with_the_next_and_the_one_before_alone(levels: Levels) -> None:
    pairs = levels.pairs
    tied = {(a, b) for images in SHOWN for a in images for b in images} | {(k, k) for k in range(8)}
    assert {(a, b) for a in range(8) for b in range(8) if pairs.slot[a, b] >= 0} == tied
    assert (pairs.first <= pairs.second).all()
    place = {image: k for k, level in enumerate(pairs.levels) for image in level.tolist()}
    assert sorted(place) == list(range(8))
    assert all(abs(place[a] - place[b]) <= 1 for a, b in tied)
    chain = [place[image] for image in (4, 1, 6, 5)]
    assert chain in (sorted(chain), sorted(chain, reverse=True)), "a search that begins at the rim"
    assert len(set(chain)) == 4
    # Some pairs have their first image in the later level: their blocks are transposed there.
    assert {place[a] > place[b] for a, b in zip(pairs.first, pairs.second, strict=True) if place[a] != place[b]} == {
        True, False,
    }  # fmt: skip


def test_the_equations_and_their_solution_are_those_of_the_dense_matrix(levels: Levels, normal: np.ndarray) -> None:
    blocks, random = blocks_of(levels, normal), np.random.default_rng(2)
    np.testing.assert_allclose(LevelMatrix(levels, blocks).dense(), scaled(normal), rtol=0, atol=1e-13)
    factor, right = LevelFactor(levels, blocks), random.normal(size=(len(normal), 3))
    lengths = np.sqrt(np.diag(normal))
    wanted = np.linalg.solve(scaled(normal), right / lengths[:, None]) / lengths[:, None]
    np.testing.assert_allclose(factor.solve(right) * lengths[:, None], wanted * lengths[:, None], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(factor.solve(right[:, 1]), factor.solve(right)[:, 1], rtol=1e-10, atol=1e-14)
    values = np.linalg.eigvalsh(scaled(normal))
    assert factor.condition() == pytest.approx(math.sqrt(values[-1] / values[0]), rel=1e-9)
    damped = LevelFactor(levels, blocks, 0.3)
    longer = scaled(normal) + 0.3 * np.eye(len(normal))
    wanted = np.linalg.solve(longer, right / lengths[:, None]) / lengths[:, None]
    np.testing.assert_allclose(damped.solve(right) * lengths[:, None], wanted * lengths[:, None], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("few", [0, 200])
def test_the_condition_of_equations_that_are_not_definite_is_infinite(
    levels: Levels, normal: np.ndarray, monkeypatch: pytest.MonkeyPatch, few: int
) -> None:
    monkeypatch.setattr(level_factor, "_FEW", few)
    values = np.linalg.eigvalsh(scaled(normal))
    found = LevelFactor(levels, blocks_of(levels, normal)).condition()
    assert found == pytest.approx(math.sqrt(values[-1] / values[0]), rel=1e-6)
    open_ = normal.copy()
    open_[3] = open_[:, 3] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        LevelFactor(levels, blocks_of(levels, open_))
    system = NormalSystem(levels)
    system.blocks += blocks_of(levels, open_)
    solution = system.solve(0.0)
    assert np.isnan(solution.values).all()
    assert solution.condition == math.inf
    with pytest.raises(NotConverged):
        _ = solution.cofactors


def test_rows_of_one_image_are_added_to_its_equations(levels: Levels, normal: np.ndarray) -> None:
    random = np.random.default_rng(3)
    system = NormalSystem(levels)
    system.blocks += blocks_of(levels, normal)
    first = random.normal(size=(8, 4)) * (levels.columns.padded >= 0)
    system.right += first
    image, right = np.array([5, 1, 5]), random.normal(size=3)
    design = random.normal(size=(3, 4)) * (levels.columns.padded[image] >= 0)
    system.add(image, design, right)
    rows = np.zeros((3, len(normal)))
    for k, one in enumerate(image):
        rows[k, levels.columns.of_image(one)] = design[k, : COUNTS[one]]
    side = first[levels.columns.padded >= 0] + rows.T @ right
    wanted, lengths = normal + rows.T @ rows, np.sqrt(np.diag(normal + rows.T @ rows))
    np.testing.assert_allclose(system.scaled(), scaled(wanted), rtol=0, atol=1e-13)
    found = system.solve(0.0).values
    np.testing.assert_allclose(found * lengths, np.linalg.solve(scaled(wanted), side / lengths), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("at_once", [1, 1 << 19])
def test_cofactors_are_those_of_the_dense_inverse(
    levels: Levels, normal: np.ndarray, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """Also with a factor and further columns, once and again."""
    monkeypatch.setattr(cofactors, "_AT_ONCE", at_once)
    random, lengths = np.random.default_rng(4), np.sqrt(np.diag(normal))
    dense = np.linalg.inv(scaled(normal)) / np.outer(lengths, lengths)
    plain = Cofactors(levels, LevelFactor(levels, blocks_of(levels, normal)))
    root, more = (random.normal(size=(len(normal), count)) / lengths[:, None] for count in (3, 2))
    inner, other = (half @ half.T for half in (random.normal(size=(3, 3)), random.normal(size=(2, 2))))
    once = 2.5 * dense + root @ inner @ root.T
    for found, wanted in (
        (plain, dense),
        (plain.mixed(2.5, root, inner), once),
        (plain.mixed(2.5, root, inner).mixed(0.4, more, other), 0.4 * once + more @ other @ more.T),
    ):
        unit = np.sqrt(np.diag(wanted))
        np.testing.assert_allclose(found.matrix / np.outer(unit, unit), scaled(wanted), rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.variances, np.diag(wanted), rtol=1e-9)
        right = random.normal(size=(len(normal), 2)) * lengths[:, None]
        np.testing.assert_allclose(
            found.times(right) / unit[:, None], wanted @ right / unit[:, None], rtol=1e-8, atol=1e-8
        )
        for a, b in itertools.product(range(8), range(8)):
            if levels.pairs.slot[a, b] < 0:
                continue
            rows, columns = levels.columns.of_image(a), levels.columns.of_image(b)
            part = found.between(np.array([a]), np.array([b]))[0]
            scale = np.outer(unit[rows], unit[columns])
            kept = part[: len(rows), : len(columns)]
            np.testing.assert_allclose(kept / scale, wanted[np.ix_(rows, columns)] / scale, rtol=0, atol=1e-9)
            if a == b:
                np.testing.assert_array_equal(found.of_image(a), kept)


# -- places of the unknowns --------------------------------------------------------------------------------------------


def test_columns_of_images_follow_each_other() -> None:
    columns = Columns.of(COUNTS)
    assert (columns.size, columns.widest) == (17, 4)
    assert [columns.of_image(k).tolist() for k in (0, 4, 6, 7)] == [[0, 1], [8, 9, 10, 11], [], [14, 15, 16]]
    assert columns.padded[[0, 2, 6]].tolist() == [[0, 1, -1, -1], [5, -1, -1, -1], [-1] * 4]
    images, places = columns.image_and_place([0, 16, 5, 11, 12, 14])
    assert (images.tolist(), places.tolist()) == ([0, 7, 2, 4, 5, 7], [0, 2, 0, 3, 0, 0])
    assert (Columns.of([]).size, Columns.of([]).widest) == (0, 0)


@pytest.mark.parametrize("size", [1, 2, 2000])
def test_points_are_eliminated_with_their_rays_that_take_part(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """Points of the same images follow each other, and parts of equally many rays have all of them once."""
    monkeypatch.setattr(unknowns, "_CHUNK", size)
    points = points_of(SHOWN)
    points = points.of_rays(np.random.default_rng(5).permutation(points.rays))
    taking = np.ones(points.rays, dtype=bool)
    for point, image in ((2, 6), (5, 0), (10, 6), (10, 0)):
        taking[(points.point == point) & (points.image == image)] = False
    grounded = np.isin(np.arange(len(SHOWN)), [0, 2, 7, 10])
    found = Ordering.of(points, taking, grounded)
    kept = {k: sorted(set(images) - {2: {6}, 5: {0}, 10: {6, 0}}.get(k, set())) for k, images in enumerate(SHOWN)}
    assert sorted(found.numbers.tolist()) == list(range(10)), "the last one has no ray left"
    images = []
    for t, number in enumerate(found.numbers.tolist()):
        rays = found.rays[found.starts[t] : found.starts[t + 1]]
        assert set(points.point[rays].tolist()) == {number}
        images.append(tuple(points.image[rays].tolist()))
        assert list(images[-1]) == kept[number]
        assert found.known[t] == grounded[number]
    assert [key for key, _ in itertools.groupby(images)] == list(dict.fromkeys(images))
    assert [one[0] for one in images] == sorted(one[0] for one in images)
    assert found.grounded.tolist() == [number for number in found.numbers.tolist() if grounded[number]]
    assert (found.points, found.observations) == (10, 2 * sum(len(kept[k]) for k in range(10)))
    for image, rays in enumerate(found.rays_of_image):
        np.testing.assert_array_equal(rays, np.flatnonzero(taking & (points.image == image)))
    seen = []
    for chunk in found.chunks:
        assert 0 < len(chunk.points) <= size
        for number, rays, of in zip(chunk.points.tolist(), chunk.rays, chunk.images, strict=True):
            seen.append(number)
            assert of.tolist() == points.image[rays].tolist() == kept[number]
            assert set(points.point[rays].tolist()) == {number}
            assert chunk.ground == grounded[number]
    assert sorted(seen) == list(range(10))
