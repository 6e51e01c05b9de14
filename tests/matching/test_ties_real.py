"""Ties between real Pleiades images, found by the matcher; a relative adjustment tells how well they meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.exchange.rpc import read_rpc, rpc_of_dataset
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.surface.base import Surface

pytestmark = pytest.mark.realdata


def shifted(model: RPC, path: Path) -> RPC:
    """Return the model in the pixels of a crop: its origin in the whole image is in its geotransform."""
    left, _, _, top, _, _ = gdal.Open(str(path)).GetGeoTransform()
    return replace(model, col_off=model.col_off - left, row_off=model.row_off - top)


def pleiades(real: Path, name: str) -> tuple[dict[str, Path], dict[str, RPC], Surface]:
    """Return images, models in their pixels, and the ground: 'triplet', 'ventoux' or 'gizeh'."""
    if name == "triplet":
        images = {k: real / "s2p" / "input_triplet" / f"img_0{k}.tif" for k in "123"}
        models = {k: rpc_of_dataset(gdal.Open(str(path)))[0] for k, path in images.items()}
        dsm = real / "s2p" / "expected_output" / "triplet" / "dsm.tif"
        return images, models, Surface.open(dsm, "ellipsoid", fill="nearest")
    folder, names = real / "shareloc", {"ventoux": ("left_image", "right_image"), "gizeh": ("img1", "img2")}[name]
    images = {one: folder / "image" / f"phr_{name}" / f"{one}.tif" for one in names}
    models = {one: shifted(read_rpc(folder / "rpc" / f"phr_{name}" / f"{one}.geom"), images[one]) for one in names}
    if name == "ventoux":
        dem = folder / "dtm" / "srtm_ventoux" / "srtm90_resampled_UTM31" / "N44E005_UTM.tif"
        return images, models, Surface.open(dem, "egm96", override=True)
    # No DEM: the plateau of the pyramids lies 60 m above the sea, and the geoid 15 m above the ellipsoid.
    return images, models, Surface.constant(75.0)


def pair(images: Mapping[str, Path], models: Mapping[str, RPC], surface: Surface, one: str, other: str) -> np.ndarray:
    """Return ties ``(n, 4)``: column and row in one image and in the other."""
    from ortho_pipeline.imaging.matching import MatchSettings, OtherScene, View, match
    from ortho_pipeline.raster.intensity import Intensity
    from ortho_pipeline.raster.source import RasterSource

    view = View(Intensity(RasterSource(images[one])), models[one], surface)
    target = OtherScene(Intensity(RasterSource(images[other])), models[other])
    points = match(view, [target], MatchSettings(search=15.0, points=600)).points
    return np.column_stack([points.image, models[other].ground_to_image(points.to_crs("EPSG:4979").ground)])


def as_block(ties: Mapping[tuple[str, str], np.ndarray], names: tuple[str, ...]) -> BlockPoints:
    """Return the ties of pairs as tie points that two images see each."""
    counts = {key: len(rows) for key, rows in ties.items()}
    total = sum(counts.values())
    first = np.concatenate([np.full(count, names.index(key[0])) for key, count in counts.items()])
    second = np.concatenate([np.full(count, names.index(key[1])) for key, count in counts.items()])
    rows = np.concatenate(list(ties.values()))
    return BlockPoints(
        ids=tuple(map(str, range(total))), ground=np.full((total, 3), np.nan), roles=np.array(["tie"] * total),
        sigma_ground=np.zeros((total, 3)), crs=pyproj.CRS(4326), images=names, point=np.tile(np.arange(total), 2),
        image=np.concatenate([first, second]), measured=np.concatenate([rows[:, :2], rows[:, 2:]]),
        sigma_image=np.full(2 * total, 0.2),
    )  # fmt: skip


@pytest.mark.parametrize(("name", "median"), [("ventoux", 0.34), ("gizeh", 0.34), ("triplet", 0.34)])
def test_ties_of_pleiades_images_meet(real, name, median):
    images, models, surface = pleiades(real, name)
    ties = {two: pair(images, models, surface, *two) for two in combinations(images, 2)}
    for two, found in ties.items():
        assert len(found) >= 300, two
        # Well spread: of 5 x 5 cells of what both images show, most have some.
        low, high = found[:, :2].min(axis=0), found[:, :2].max(axis=0)
        cells = {tuple(cell) for cell in ((found[:, :2] - low) / (high - low + 1e-6) * 5).astype(int).tolist()}
        assert len(cells) >= 20, two
    start = {
        one: ImageCorrection.identity(model, "shift", (model.col_off, model.row_off)) for one, model in models.items()
    }
    after = adjust(start, as_block(ties, tuple(images)))
    apart = np.hypot(*after.residuals[after.used_rays].T)
    assert np.nanmedian(apart) <= median
