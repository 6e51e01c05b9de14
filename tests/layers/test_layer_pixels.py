"""Every pixel and every figure of layers whose geometry has a closed form: rays that lean more from pixel to pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
from blocks import FLOOR, NORTH, WEST, ZONE, slopes_of
from osgeo import gdal
from scipy.optimize import brentq

from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array, SensorModel, as_ground
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp.quality import accuracy, angles
from ortho_pipeline.warp.quality.accuracy import Budget, Parts, parts_at, tiles
from ortho_pipeline.warp.quality.angles import Sun
from ortho_pipeline.warp.quality.error_ellipse import circular_error, share_beyond
from ortho_pipeline.warp.quality.sight import Sight

UTM = pyproj.CRS.from_epsg(ZONE)
#: Map of 150 x 130 pixels of 2 x 3 m.
GRID = Grid(UTM, WEST, NORTH, 2.0, 3.0, 150, 130)
#: Image pixels per pixel of the map.
PLAIN = np.array([[0.8, 0.1], [-0.05, 0.9]])
#: Image pixels per metre of height: at the first pixel, and what that changes by per pixel of column and row.
LEAN, CHANGE = np.array([0.3, -0.7]), np.array([[0.012, -0.003], [0.002, 0.009]])


@dataclass(frozen=True, eq=False)
class Leaning(SensorModel):
    """Image points are linear in the place, and move with the height, by more from pixel to pixel.

    Columns of the map from `last` on are not seen.
    """

    kind = "leaning"
    last: float = np.inf

    @property
    def crs(self) -> str:
        return f"EPSG:{ZONE}"

    @property
    def domain(self) -> tuple[Array, Array]:
        return np.array([WEST + 150, NORTH - 195, FLOOR]), np.array([150.0, 195.0, 50.0])

    def ground_to_image(self, ground: Any) -> Array:
        x, y, h = as_ground(ground).T
        place = np.stack([(x - WEST) / 2, (NORTH - y) / 3], axis=1)
        image = place @ PLAIN.T + (h - FLOOR)[:, None] * (LEAN + place @ CHANGE.T)
        image[place[:, 0] >= self.last] = np.nan
        return np.asarray(image)


def test_a_place_is_seen_with_its_derivatives() -> None:
    columns, rows, heights = np.array([20.5, 90.25]), np.array([100.0, 7.5]), FLOOR + np.array([3.0, -2.0])
    seen = Sight(Leaning(), GRID).seen(columns, rows, heights)
    for k in range(2):
        place, up = np.array([columns[k], rows[k]]), heights[k] - FLOOR
        inverse = np.linalg.inv(PLAIN + up * CHANGE)
        np.testing.assert_allclose(seen.ground[k], [WEST + 2 * columns[k], NORTH - 3 * rows[k], heights[k]])
        np.testing.assert_allclose(seen.image[k], PLAIN @ place + up * (LEAN + CHANGE @ place))
        np.testing.assert_allclose(seen.place_per_pixel[k], inverse, rtol=1e-8)
        np.testing.assert_allclose(seen.displacement[k], inverse @ (LEAN + CHANGE @ place), rtol=1e-8)


def test_pixels_are_metres_true_east_and_north() -> None:
    """Against geodesics on the ellipsoid, 10 pixels to both sides; the UTM zone's edge is turned by a degree."""
    grid = Grid(UTM, WEST + 150_000, NORTH, 2.0, 3.0, 150, 130)
    metres = Sight(Leaning(), grid).metres(np.array([40.0]), np.array([70.0]), np.array([0.0]))[0]
    lonlat = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True).transform
    for k, (right, down) in enumerate([(10.0, 0.0), (0.0, 10.0)]):
        first, last = (lonlat(grid.left + 2 * (40 + s * right), grid.top - 3 * (70 + s * down)) for s in (-1, 1))
        azimuth, back, length = pyproj.Geod(ellps="WGS84").inv(*first, *last)
        bearing = np.radians((azimuth + back + 180) / 2 if abs(azimuth - back - 180) < 5 else azimuth)
        wanted = length / 20 * np.array([np.sin(bearing), np.cos(bearing)])
        np.testing.assert_allclose(metres[:, k], wanted, atol=2e-3)


# -- accuracy --------------------------------------------------------------------------------------------------------


def plane(path: Path, first: float, east: float, south: float, rough: float = 0.0, void: bool = False) -> Surface:
    """Write heights that change evenly by a metre east and south, 10 m apart from 100 m outside on.

    Rough ones are higher and lower in turn.
    """
    x, y = np.meshgrid(10.0 * np.arange(60) - 95.3, 10.0 * np.arange(60) - 94.9)
    heights = first + east * x + south * y + rough * (-1.0) ** np.add.outer(np.arange(60), np.arange(60))
    if void:
        heights[20:24, 17:19] = -32768.0
    write_dem(path, heights, (WEST - 100.3, NORTH + 99.9), 10.0, f"EPSG:{ZONE}")
    return open_dem(path, "ellipsoid", override=void, fill="mask" if void else "error")


@dataclass(frozen=True)
class Scene:
    budget: Budget
    sight: Sight
    surface: Surface
    size: tuple[int, int]

    def layer(self) -> Any:
        bounds = (FLOOR - 1.5, FLOOR + 1.0)
        return accuracy._Layer(self.budget, self.sight, self.surface, self.size, bounds, 1 << 28)

    def exact(self) -> tuple[Parts, np.ndarray, np.ndarray]:
        """Return the parts at all pixels, which of them show the image, and whose accuracy is known, row by row."""
        columns, rows = (part.ravel() + 0.5 for part in np.meshgrid(np.arange(150.0), np.arange(130.0)))
        xy = np.stack(GRID.xy(columns, rows), axis=1)
        heights = self.surface.heights(xy, UTM)
        assert isinstance(self.budget.heights, Surface)
        sigma = self.budget.heights.heights(xy, UTM)
        image, slopes = self.sight.image(columns, rows, heights), slopes_of(self.surface, self.sight, columns, rows)
        shown = np.asarray((image >= 0).all(axis=1) & (image <= self.size).all(axis=1))
        parts = parts_at(self.budget, self.sight, columns, rows, heights, sigma, slopes)
        return parts, shown, shown & np.isfinite(sigma)


def scene(folder: Path, last: float = np.inf) -> Scene:
    surface = plane(folder / "dem.tif", FLOOR - 0.8, 0.002, 0.0015, rough=0.6)
    sigma = plane(folder / "sigma.tif", 1.5, 0.004, 0.001, rough=0.4, void=True)
    model = ImageCorrection.identity(Leaning(last), "shift", (60.0, 50.0))
    covariance = np.array([[0.4, 0.15], [0.15, 0.9]])
    budget = Budget(covariance=covariance, heights=sigma, datum=0.7, reference=0.6, interpolation_px=0.9)
    return Scene(budget, Sight(model, GRID), surface, (110, 105))


def bands_of(total: Array, known: np.ndarray) -> Array:
    """Return the bands ``(4, 130, 150)`` by their definition."""
    east, north = np.sqrt(total[:, 0]), np.sqrt(total[:, 1])
    bands = np.stack([east, north, total[:, 2] / (east * north), circular_error(total)])
    bands[:, ~known] = np.nan
    return bands.reshape(4, 130, 150)


def assembled(layer: Any, side: int) -> np.ndarray:
    found = np.zeros((4, 130, 150), dtype=np.float32)
    for left, top, width, height in tiles(GRID, side):
        found[:, top : top + height, left : left + width] = layer.make(left, top, width, height)
    return found


@pytest.mark.parametrize("spacing", [None, 4, 1])
def test_each_pixel_has_the_accuracy_of_its_own_middle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spacing: int | None
) -> None:
    monkeypatch.setattr(accuracy, "_EXACT_TILE", 32)
    made = scene(tmp_path)
    parts, _, known = made.exact()
    layer = made.layer()
    assert layer.spacing == 64
    layer.spacing = spacing or layer.spacing
    # Bands are rounded to one part in two thousand.
    np.testing.assert_allclose(assembled(layer, 70), bands_of(parts.total, known), rtol=5e-4, atol=1e-5)


def test_pixels_before_the_end_of_the_model_are_exact_and_those_behind_it_have_no_accuracy(tmp_path: Path) -> None:
    """The model ends in the column 83, between nodes."""
    made = scene(tmp_path, last=83.2)
    parts, _, known = made.exact()
    wanted = bands_of(parts.total, known)
    assert np.isfinite(wanted[:, :, 81]).any()
    layer = made.layer()
    layer.spacing = 16
    found = assembled(layer, 70)
    np.testing.assert_allclose(found[:, :, :83], wanted[:, :, :83], rtol=5e-4, atol=1e-5)
    assert np.isnan(found[:, :, 83:]).all()


@pytest.mark.parametrize(("sample", "stride"), [(20_000, 1), (500, 6)])
def test_the_figures_of_a_layer_are_those_of_its_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sample: int, stride: int
) -> None:
    monkeypatch.setattr(accuracy, "_SAMPLE", sample)
    made = scene(tmp_path)
    parts, shown, known = made.exact()
    layer = made.layer()
    assembled(layer, 70 if stride > 1 else 150)
    found, total = layer.result(), parts.total
    assert found.known == pytest.approx(known.sum() / shown.sum(), rel=1e-12)
    assert 0.9 < found.known < 0.999
    np.testing.assert_allclose(found.sigma, np.sqrt(total[known, :2].mean(axis=0)), rtol=1e-5)
    sums = [part[known, :2].sum() for part in parts]
    np.testing.assert_allclose(list(found.shares.values()), sums / np.sum(sums), rtol=1e-5)
    assert list(found.shares) == ["model", "heights", "even", "interpolation"]
    ce90 = bands_of(total, known)[3]
    taken = ce90[::stride, ::stride]
    np.testing.assert_allclose(found.quantiles, np.nanquantile(taken, (0.05, 0.5, 0.95)), rtol=1e-5)
    assert found.cell == 5
    assert found.cells.shape == (26, 30)
    for j, i in np.ndindex(26, 30):
        cell = ce90[5 * j : 5 * j + 5, 5 * i : 5 * i + 5]
        wanted = np.nanmean(cell) if np.isfinite(cell).any() else np.nan
        np.testing.assert_allclose(found.cells[j, i], wanted, rtol=1e-5)
    assert np.isnan(found.cells).any()
    # About a thousand, evenly many, stand for all.
    if stride == 1:
        some = total[known][:: known.sum() // 1000]
        axes = [np.sqrt(np.linalg.eigvalsh([[xx, xy], [xy, yy]])) for xx, yy, xy in some]
        smaller, larger = np.array(axes).T
        mixed = brentq(lambda radius: share_beyond(np.array(radius), larger, smaller).mean() - 0.1, 1.0, 50.0)
        assert found.ce90 == pytest.approx(mixed, rel=1e-4)


def test_a_scene_that_shows_nothing_has_no_figures(tmp_path: Path) -> None:
    made = scene(tmp_path)
    layer = Scene(made.budget, made.sight, made.surface, (-5, -5)).layer()
    assert np.isnan(assembled(layer, 200)).all()
    found = layer.result()
    assert found.known == 0.0
    assert np.isnan([found.ce90, *found.quantiles, *found.sigma, *found.shares.values()]).all()
    assert np.isnan(found.cells).all()


@pytest.mark.parametrize(
    ("budget", "sigma", "rho", "ce90"),
    [
        (Budget(), 0.0, 0.0, 0.0),
        (Budget(stated=2.0), 2.0, 0.0, 2 * np.sqrt(-2 * np.log(0.1))),
        (Budget(stated=2.0, reference=1.5), 2.5, 0.0, 2.5 * np.sqrt(-2 * np.log(0.1))),
    ],
)
def test_an_error_that_is_the_same_in_all_directions_has_the_radius_of_a_circle(
    tmp_path: Path, budget: Budget, sigma: float, rho: float, ce90: float
) -> None:
    sight, surface = Sight(Leaning(), GRID), plane(tmp_path / "dem.tif", FLOOR - 1.0, 0.0, 0.0)
    layer = Scene(budget, sight, surface, (110, 105)).layer()
    found = assembled(layer, 200)
    shown = np.isfinite(found[0])
    for band, value in zip(found, (sigma, sigma, rho, ce90), strict=True):
        np.testing.assert_allclose(band[shown], value, rtol=5e-4, atol=1e-6)
    result = layer.result()
    np.testing.assert_allclose([result.ce90, *result.quantiles], ce90, rtol=1e-5, atol=1e-6)
    assert result.known == 1.0


# -- angles ----------------------------------------------------------------------------------------------------------

SUN = Sun(142.0, 24.0)


def curved(places: Array, crs: Any) -> Array:
    """Heights that rise ever faster to the east and the south, and a saddle."""
    x, y = (places - [WEST, NORTH]).T
    return np.asarray(FLOOR - 1.0 + 0.004 * x + 2e-5 * x**2 - 0.003 * y + 1e-5 * y**2 + 1e-5 * x * y)


@pytest.mark.parametrize("last", [np.inf, 83.2])
@pytest.mark.parametrize("window", [(0, 0, 150, 130), (35, 18, 70, 41), (64, 100, 16, 1)])
def test_each_pixel_has_the_angles_of_its_own_middle(last: float, window: tuple[int, int, int, int]) -> None:
    left, top, width, height = window
    sight, surface, size = Sight(Leaning(last), GRID), SimpleNamespace(heights=curved), (100, 95)
    found = angles._angles(sight, surface, size, (FLOOR - 1.5, FLOOR + 5.0), window, SUN)  # type: ignore[arg-type]
    columns, rows = np.meshgrid(left + 0.5 + np.arange(width), top + 0.5 + np.arange(height))
    columns, rows = columns.ravel(), rows.ravel()
    xy = np.stack(GRID.xy(columns, rows), axis=1)
    heights = curved(xy, None)
    seen, metres = sight.seen(columns, rows, heights), sight.metres(columns, rows, heights)
    east, north = (metres @ seen.displacement[:, :, None])[:, :, 0].T
    # The rise by a pixel of column and of row, by the derivatives of the surface.
    x, y = (xy - [WEST, NORTH]).T
    rise = np.stack([2 * (0.004 + 4e-5 * x + 1e-5 * y), -3 * (-0.003 + 2e-5 * y + 1e-5 * x)], axis=1)
    slope = (rise[:, None, :] @ np.linalg.inv(metres))[:, 0]
    normal = np.column_stack([-slope, np.ones(len(slope))])
    azimuth, elevation = np.radians([142.0, 24.0])
    sun = [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    wanted = np.stack(
        [
            np.degrees(np.arctan(np.hypot(east, north))),
            np.degrees(np.arctan2(-east, -north)) % 360,
            np.degrees(np.arccos(normal @ sun / np.linalg.norm(normal, axis=1))),
        ]
    )
    shown = (seen.image >= 0).all(axis=1) & (seen.image <= size).all(axis=1)
    wanted[:, ~shown] = np.nan
    assert shown.any()
    np.testing.assert_allclose(found, wanted.reshape(3, height, width), atol=2e-3)


def test_the_range_of_view_angles_is_that_of_all_tiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles in the lower right show nothing of the image."""
    monkeypatch.setattr(angles, "_TILE", 32)
    surface: Any = SimpleNamespace(heights=curved)
    sight, heights = Sight(Leaning(), GRID), (FLOOR - 1.5, FLOOR + 5.0)
    found = angles.write_angles(sight, surface, (60, 55), tmp_path / "a.tif", heights=heights, step=1, sun=SUN)
    bands = gdal.Open(str(tmp_path / "a.tif")).ReadAsArray()
    whole = angles._angles(sight, surface, (60, 55), heights, (0, 0, 150, 130), SUN)
    np.testing.assert_allclose(bands, whole, rtol=1e-5, atol=2e-4)
    assert found.view_zenith_deg == pytest.approx((np.nanmin(whole[0]), np.nanmax(whole[0])), abs=1e-3)
    assert np.isnan(bands[0, 64:, 96:]).all()
