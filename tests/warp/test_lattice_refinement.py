"""How fine the lattices of blocks become, and what a warp says of them, for image points that are quadratic in plan.

Bilinear interpolation of q x^2 between nodes at a distance s is off by q s^2 / 4 in their middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.lattice import Lattices, OutputBlock, TileHeights

UTM = pyproj.CRS.from_epsg(32651)
#: Half of it is the limit of a block.
TOLERANCE = 0.01


@dataclass(frozen=True)
class Bent:
    """A camera whose columns are those of the map, and more by `columns` times the square of their distance from 512.

    They are the same on the left of it; rows are so by `rows`. A pixel is `side` metres.
    """

    columns: float = 0.0
    rows: float = 0.0
    side: tuple[float, float] = (1.0, 1.0)

    crs, detail = UTM, np.inf

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([500_000.0, 1_000_000.0, 100.0]), np.array([1000.0, 1000.0, 50.0])

    def ground_to_image(self, ground: np.ndarray) -> np.ndarray:
        x, y = (ground[:, 0] - 499_000) / self.side[0], (1_001_000 - ground[:, 1]) / self.side[1]
        bend = [q * np.maximum(part - 512.5, 0.0) ** 2 for q, part in ((self.columns, x), (self.rows, y))]
        return np.stack([x + bend[0], y + bend[1]], axis=1)


def surface() -> Any:
    """Heights of 100 m everywhere, a sample for 10 m."""
    return SimpleNamespace(
        sampler=lambda crs: lambda ground: (ground[:, :2] - [499_000.0, 1_000_000.0]) * [0.1, 0.1] + 500.0,
        window_around=lambda *box: (int(box[0]), int(box[1]), int(box[2]) + 2, int(box[3]) + 2),
        window=lambda left, top, width, height: np.full((height, width), 100.0),
    )


def lattices(model: Bent, *, averages: bool = False, pixel: tuple[float, float] = (1.0, 1.0)) -> Lattices:
    grid = Grid(UTM, 499_000.0, 1_001_000.0, *pixel, 2000, 2000)
    made: Any = model
    return Lattices(made, surface(), grid, (4000, 4000), tolerance=TOLERANCE, reach=2, averages=averages)


def built(made: Lattices, *places: tuple[int, int]) -> list[OutputBlock]:
    return made.build([OutputBlock(*place) for place in places], TileHeights(surface(), False, 1 << 24))


@pytest.mark.parametrize("axis", ["columns", "rows"])
@pytest.mark.parametrize("spacing", [64, 32, 16, 8, 4])
def test_nodes_are_as_close_as_half_of_the_tolerance_asks_for(axis: str, spacing: int) -> None:
    place = (0, 2) if axis == "columns" else (2, 0)
    limit = TOLERANCE / 2
    for part, wanted in ((0.999, spacing), (1.001, {4: 1}.get(spacing, spacing // 2))):
        bend = part * 4 * limit / spacing**2
        made = lattices(Bent(columns=bend) if axis == "columns" else Bent(rows=bend))
        (block,) = built(made, place)
        assert block.spacing == made.finest == wanted
        # Blocks whose pixels are all projected have no error.
        error = 0.0 if wanted == 1 else part * limit * (wanted / spacing) ** 2
        assert made.worst == pytest.approx(error, rel=1e-3)
        assert made.refined == (wanted != 64)


def test_the_figures_are_those_of_the_worst_the_finest_and_all_refined_blocks() -> None:
    """Blocks on the left are linear; the others need nodes every 16 pixels."""
    made = lattices(Bent(columns=0.9 * 4 * TOLERANCE / 2 / 16**2))
    assert [block.spacing for block in built(made, (0, 0), (3, 0), (0, 3))] == [64, 64, 16]
    assert (made.finest, made.refined) == (16, 1)
    assert made.worst == pytest.approx(0.9 * TOLERANCE / 2, rel=1e-3)
    assert [block.spacing for block in built(made, (4, 0))] == [64]
    assert [block.spacing for block in built(made, (4, 3), (4, 4))] == [16, 16]
    assert (made.finest, made.refined) == (16, 3)
    assert made.worst == pytest.approx(0.9 * TOLERANCE / 2, rel=1e-3)


@pytest.mark.parametrize(
    ("pixel", "box", "reach"), [((1.0, 1.0), (1.0, 1.0), 3), ((2.0, 5.0), (2.0, 5.0), 5), ((6.5, 0.5), (6.5, 1.0), 6)]
)
def test_an_average_reaches_half_of_the_longer_side_of_an_output_pixel_farther(
    pixel: tuple[float, float], box: tuple[float, float], reach: int
) -> None:
    (block,) = built(lattices(Bent(), averages=True, pixel=pixel), (1, 1))
    assert block.box == pytest.approx(box)
    assert block.reach == reach
    # From the middle of the first pixel to that of the next block's, with the reach and four pixels.
    sides = [(256.5 * side, 512.5 * side) for side in pixel]
    (left, right), (top, bottom) = (
        (int(np.floor(low)) - reach - 4, int(np.ceil(high)) + reach + 4) for low, high in sides
    )
    assert block.window == (left, top, right, bottom)
    (plain,) = built(lattices(Bent(), pixel=pixel), (1, 1))
    assert (plain.reach, plain.box) == (2, (1.0, 1.0))
