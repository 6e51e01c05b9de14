"""Ties between real Pleiades images, found by the matcher; a relative adjustment tells how well they meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pyproj
import pytest
from orthos import rectify
from osgeo import gdal
from scipy.spatial import cKDTree

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.points import BlockPoints, shape_of
from ortho_pipeline.exchange.rpc import read_rpc, rpc_of_dataset
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.imaging.matching import MatchSettings, SceneView, match, open_references
from ortho_pipeline.imaging.ties import Ties, TieSettings, tie
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.points.image_errors import sigma_of_covariance
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.rays import meet_surface

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
        # A hill of 85 to 260 m, taken to be flat: heights are wrong by up to 130 m.
        return images, models, FlatSurface(210.0)
    folder, names = real / "shareloc", {"ventoux": ("left_image", "right_image"), "gizeh": ("img1", "img2")}[name]
    images = {one: folder / "image" / f"phr_{name}" / f"{one}.tif" for one in names}
    models = {one: shifted(read_rpc(folder / "rpc" / f"phr_{name}" / f"{one}.geom"), images[one]) for one in names}
    if name == "ventoux":
        dem = folder / "dtm" / "srtm_ventoux" / "srtm90_resampled_UTM31" / "N44E005_UTM.tif"
        return images, models, open_dem(dem, "egm96", override=True)
    # No DEM: the plateau of the pyramids lies 60 m above the sea, and the geoid 15 m above the ellipsoid.
    return images, models, FlatSurface(75.0)


def tied(images: Mapping[str, Path], models: Mapping[str, RPC], surface: Surface, dem_sigma: float) -> Ties:
    """Return the ties between images."""
    views = [SceneView(Intensity(RasterSource(path)), models[name], surface) for name, path in images.items()]
    return tie(views, TieSettings(search=15.0, points=700, dem_sigma=dem_sigma))


def as_block(ties: Ties, names: tuple[str, ...]) -> BlockPoints:
    """Return ties as the points of a block."""
    count = int(ties.track.max()) + 1
    return BlockPoints(
        ids=tuple(map(str, range(count))), ground=np.full((count, 3), np.nan), roles=np.full(count, "tie"),
        sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS(4326), images=names, point=ties.track, image=ties.image,
        measured=ties.measured, sigma_image=sigma_of_covariance(ties.covariance), shape_image=shape_of(ties.covariance),
    )  # fmt: skip


# Heights: SRTM of 90 m on a slope of Mont Ventoux, none at Gizeh, none and a hill in the triplet.
@pytest.mark.slow
@pytest.mark.parametrize(("name", "dem_sigma"), [("ventoux", 25.0), ("gizeh", 15.0), ("triplet", 40.0)])
def test_ties_of_pleiades_images_meet(real, name, dem_sigma):
    images, models, surface = pleiades(real, name)
    ties = tied(images, models, surface, dem_sigma)
    for two in combinations(range(len(images)), 2):
        tracks = ties.of_pair(*two)
        assert len(tracks) >= 300, two
        found = ties.measured[(ties.image == two[0]) & np.isin(ties.track, tracks)]
        # Well spread: of 5 x 5 cells of what both images show, most have some.
        low, high = found.min(axis=0), found.max(axis=0)
        cells = {tuple(cell) for cell in ((found - low) / (high - low + 1e-6) * 5).astype(int).tolist()}
        assert len(cells) >= 20, two
    start = {
        one: ImageCorrection.identity(model, "shift", (model.col_off, model.row_off)) for one, model in models.items()
    }
    after = adjust(start, as_block(ties, tuple(images)))
    apart = np.hypot(*after.residuals[after.used_rays].T)
    # The issue asks for 0.34 px, what the triplet's own authors reach.
    assert np.nanmedian(apart) <= 0.1
    assert len(after.rejected) < 0.02 * len(ties.track)


@pytest.mark.slow
def test_matches_with_an_ortho_of_the_other_image_are_the_ties(real, tmp_path):
    """One crop of Gizeh, rectified, is the reference of the other: both say what lies where."""
    images, models, surface = pleiades(real, "gizeh")
    one, other = images
    source, path = RasterSource(images[other]), tmp_path / "ortho.tif"
    corners = np.array([[0.0, 0.0], [source.width, 0.0], [0.0, source.height], [source.width, source.height]])
    ground = meet_surface(models[other], corners, surface)
    x, y = ground_transform("EPSG:4979", "EPSG:32636")(ground)[:, :2].T
    grid = Grid.of_extent(pyproj.CRS(32636), (x.min(), y.min(), x.max(), y.max()), (0.5, 0.5))
    rectify(models[other], source, surface, grid, path, resampling="cubic", driver="GTiff")
    view = SceneView(Intensity(RasterSource(images[one])), models[one], surface)
    matches = match(view, open_references([path]), MatchSettings(30.0, 700, 15.0)).points
    there = models[other].ground_to_image(matches.to_crs("EPSG:4979").ground)
    ties = tied(images, models, surface, 15.0)
    tracks = ties.of_pair(0, 1)
    left, right = (ties.measured[(ties.image == k) & np.isin(ties.track, tracks)] for k in (0, 1))
    apart, nearest = cKDTree(matches.image).query(left)
    same = apart < 1
    assert same.sum() >= 100
    # What little the places differ is the same in both images.
    difference = (there - matches.image)[nearest[same]] - (right - left)[same]
    # The issue asks for 0.2 px; an ortho of cubic convolution next to its image moves edges by a fiftieth.
    assert np.sqrt((difference**2).mean(axis=0)).max() <= 0.05
    assert np.abs(difference).max() <= 0.2
