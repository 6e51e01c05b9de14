"""The parts of the measuring along seams, by hand: places, the part of a chip, and which shifts count."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from ortho_pipeline.imaging.matching.correlation import orientation
from ortho_pipeline.warp.mosaic import seams
from ortho_pipeline.warp.mosaic.seams import _best_part, _places, _shifts


def test_a_seam_is_the_edges_between_cells_of_two_orthos() -> None:
    labels = np.array([[0, 0, 1, 1], [0, 2, 2, 1], [-1, 2, -1, 0]])
    found = {pair: sorted(places.tolist()) for pair, places in _places(labels).items()}
    assert found == {
        (0, 1): [[2.0, 0.5], [3.5, 2.0]],
        (0, 2): [[1.0, 1.5], [1.5, 1.0]],
        (1, 2): [[2.5, 1.0], [3.0, 1.5]],
    }
    assert _places(np.array([[1, 1], [-1, 1]])) == {}


@pytest.mark.parametrize("top", [0, 24, 48])
@pytest.mark.parametrize("left", [0, 24, 48])
def test_a_chip_is_taken_where_most_is_valid(left: int, top: int) -> None:
    """A window has 96 pixels, a chip 48; of nine places one is all valid, the others lack a row or a column."""
    valid = np.zeros((96, 96), dtype=bool)
    valid[top : top + 48, left : left + 48] = True
    assert _best_part(valid) == (slice(top, top + 48), slice(left, left + 48))
    some = np.random.default_rng(4).random((96, 96)) < 0.4
    starts = (0, 24, 48)
    counts = {(row, column): some[row : row + 48, column : column + 48].sum() for row in starts for column in starts}
    rows, columns = _best_part(some)
    assert counts[rows.start, columns.start] == max(counts.values())


def test_where_all_is_valid_the_middle_is_taken() -> None:
    assert _best_part(np.ones((96, 96), dtype=bool)) == (slice(24, 72), slice(24, 72))


def chip(moved: tuple[float, float], noise: float = 0.0) -> np.ndarray:
    """Return two chips of 48 pixels, whose second shows the content moved by (column, row)."""
    random = np.random.default_rng(7)
    image = gaussian_filter(random.normal(size=(120, 120)), 1.5) * 100
    other = shift(image, moved[::-1], order=3) + noise * random.normal(size=image.shape)
    both = np.stack([image, other])[:, 36:84, 36:84]
    return both.astype(np.float32)


def test_content_that_is_moved_is_found_and_what_is_not_alike_is_none() -> None:
    chips = np.stack([chip((0.0, 0.0)), chip((2.0, -1.0)), chip((-3.25, 4.5)), chip((0.0, 0.0), noise=1e4)])
    np.testing.assert_allclose(_shifts(chips), [[0, 0], [2, -1], [-3.25, 4.5]], atol=0.06)
    assert _shifts(chips[3:]).shape == (0, 2)


def test_a_chip_needs_ninety_five_per_cent() -> None:
    """115 of 2304 pixels are 4.99 %, and 51 of the inner 1024 are 4.98 %."""
    for inner, outer, known in ((0, 115, True), (0, 116, False), (51, 0, True), (52, 0, False)):
        one, other = chip((0.0, 0.0))
        part = one[8:40, 8:40].copy()
        part.flat[:inner] = np.nan
        one[8:40, 8:40] = part
        other.flat[:outer] = np.nan
        assert _known(np.stack([one, other])) == known


def _known(chips: np.ndarray) -> bool:
    """Return whether chips are compared at all: the matcher is asked for no others."""
    asked: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(seams, "orientation", lambda image: asked.append(1) or orientation(image))
        _shifts(chips[None])
    return bool(asked)
