"""Images on other machines are matched at few spots, so that few of their blocks are read."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from pairs import Pair
from servers import serving

from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.imaging.matching.candidates import at_spots, candidates, spots_of
from ortho_pipeline.options import MatchOptions, SceneOptions

gdal.UseExceptions()


class Pixels:
    """An image of noise, as the matcher reads it."""

    saturated = np.inf

    def __init__(self, path: str, size: int, block: int) -> None:
        band = SimpleNamespace(GetBlockSize=lambda: [block, block])
        self.source = SimpleNamespace(path=path, bands=[band])
        self.width = self.height = size
        self.found: dict[Any, Any] = {}
        self.windows = 0

    def read(self, left: int, top: int, width: int, height: int, factor: int = 1) -> np.ndarray:
        self.windows += 1
        return np.random.default_rng([left, top]).normal(size=(height, width)).astype(np.float32)


def view(path: str, size: int, block: int, spots: int = 6) -> Any:
    return SimpleNamespace(intensity=Pixels(path, size, block), size=(size, size), spots=spots)


def test_the_number_of_spots_follows_the_blocks():
    local = view("tile.tif", 10980, 512)
    assert spots_of(local, [local.intensity]) is None
    for block, spots in ((256, 6), (512, 5), (1024, 3)):
        far = view("https://store.test/tile.tif", 10980, block)
        assert spots_of(far, [far.intensity, local.intensity]) == spots
        assert spots_of(local, [far.intensity, local.intensity]) is not None


def test_chips_stay_in_the_windows_that_the_search_has_read():
    far = view("https://store.test/tile.tif", 3000, 512)
    shown = np.ones((3, 3), dtype=bool)
    shown[0, 0] = False
    origins, cells = at_spots(far, (0, 0, 3000, 3000), 40, 1, shown)
    assert len(origins) == 8 * 9
    assert sorted(cells.tolist()) == list(range(9, 9 * 9))
    middles = np.stack(np.divmod(cells // 9, 3)[::-1], axis=1) * 1000 + 500
    assert np.abs(origins + 20 - middles).max() <= 168 / 2 - 20


def test_an_image_that_is_matched_again_is_not_searched_again():
    near, every = view("tile.tif", 1000, 512), np.ones((4, 4), dtype=bool)
    first = candidates(near, (0, 0, 1000, 1000), (4, 4), 40, 1, every)
    again = candidates(near, (0, 0, 1000, 1000), (4, 4), 40, 1, every)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert near.intensity.windows == 16
    for changed in (((0, 0, 900, 1000), (4, 4), 40, 1), ((0, 0, 1000, 1000), (4, 4), 30, 1)):
        candidates(near, *changed, every)
    assert near.intensity.windows == 48


@pytest.mark.slow
def test_orthos_behind_urls_are_verified_from_a_part_of_their_bytes(tmp_path):
    pair = Pair(side=1800, shift=(4.0, -3.0))
    sizes = 0
    for path in pair.write(tmp_path / "pair"):
        made = tmp_path / path.name
        gdal.Translate(str(made), str(path), creationOptions=["TILED=YES", "BLOCKXSIZE=128", "BLOCKYSIZE=128"])
        sizes += made.stat().st_size
    with serving(tmp_path) as server:
        names = [f"{server.address}/{name}.tif" for name in ("ortho", "reference")]
        network = SceneOptions(allow_network=True)
        document = verify(names[0], match=MatchOptions(reference=[names[1]]), scene=network).document
        read = server.sent
    assert read < 0.45 * sizes
    relative = document["relative"]
    np.testing.assert_allclose(
        [relative["bias_east_m"]["value"], relative["bias_north_m"]["value"]], pair.shift, atol=0.05
    )
