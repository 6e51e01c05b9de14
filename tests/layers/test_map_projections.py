"""Layers of one scene on maps of every kind: what they say is of the ground, and the same on all.

Truth is a ray tracer in geocentric coordinates (`space`) that shares no code with the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyproj
import pytest
from osgeo import gdal
from space import Hills, Satellite, angles, axes, between, radius_of, to_space, towards

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.warp.quality.accuracy import Budget, layer_grid, write_accuracy
from ortho_pipeline.warp.quality.angles import Sun, write_angles, write_shadows
from ortho_pipeline.warp.quality.sight import Sight

#: East of the middle of its UTM zone by 2.9°, of that of EPSG:3035 by 7.9°.
LON = 17.9
SUN = Sun(142.0, 24.0)
COVARIANCE = np.array([[0.50, 0.12], [0.12, 0.25]])
SIGMA_H = 4.0
STEP = 8
#: Ground size (m) of the ortho's pixels, about, and its side.
PIXEL, SIDE = 10.0, 256
NOTHING = "+datum=WGS84 +no_defs"


def maps(lat: float) -> dict[str, str]:
    """Return the CRSs that are used at a latitude, by what they are."""
    around = f"+lat_0={lat - 2} +lon_0={LON - 9}"
    found = {
        "UTM": f"EPSG:{32633 if lat >= 0 else 32733}",
        "Web Mercator": "EPSG:3857",
        "geographic": "EPSG:4326",
        "LAEA": "EPSG:3035" if 30 <= lat <= 75 else f"+proj=laea {around} {NOTHING}",
        "Lambert": "EPSG:3034"
        if 30 <= lat <= 75
        else f"+proj=lcc +lat_1={lat + 1} +lat_2={lat + 6} {around} {NOTHING}",
        "custom transverse Mercator": f"+proj=tmerc +lat_0=0 +lon_0={LON - 5} +k=0.93 +x_0=7e5 {NOTHING}",
        "feet": f"+proj=tmerc +lat_0={lat - 1} +lon_0={LON - 3} +k=0.9999 +units=us-ft {NOTHING}",
    }
    if abs(lat) >= 60:
        found["polar stereographic"] = "EPSG:3413" if lat > 0 else "EPSG:3031"
    return found


@dataclass(frozen=True)
class Found:
    """Largest errors of the layers: degrees of zenith, azimuth and incidence, shares of shadow, parts of ce90."""

    zenith: float
    azimuth: float
    incidence: float
    shadow: float
    wrong: float
    ce90: float
    share: float


def compared(crs: str, place: tuple[float, float], folder, hills: Hills, dem: Surface) -> Found:
    """Return how far the layers of a scene on a map are from what the ray tracer says at random pixels of them."""
    plane, model = pyproj.CRS.from_user_input(crs), Satellite(place)
    grid, random = grid_about(plane, place), np.random.default_rng(7)
    geodetic_from_map = between(crs, "EPSG:4979")

    def lonlat(columns, rows):
        x, y = grid.left + columns * grid.dx, grid.top - rows * grid.dy
        found = np.column_stack(geodetic_from_map.transform(x, y, np.zeros(len(x))))
        found[:, 2] = hills.at(found)
        return found

    heights = float(hills.heights.min()), float(hills.heights.max())
    sight, size = Sight(model, grid), (model.side, model.side)
    write_angles(sight, dem, size, folder / "a.tif", heights=heights, step=STEP, sun=SUN)
    share = write_shadows(sight, dem, SUN, folder / "s.tif", heights=heights)
    budget = Budget(covariance=COVARIANCE, heights=SIGMA_H)
    write_accuracy(budget, sight, dem, size, folder / "c.tif", heights=heights, step=STEP)

    # Of the layers every pixel that is in the image, but for a rim; its sides tell the normal of the terrain.
    small = layer_grid(grid, STEP)
    columns, rows = (part.ravel() for part in np.meshgrid(np.arange(small.width), np.arange(small.height)))
    middle = (columns + 0.5) * STEP, (rows + 0.5) * STEP
    at = lonlat(*middle)
    image = model.ground_to_image(at)
    seen = ((image >= 5) & (image <= model.side - 5)).all(axis=1)
    assert seen.mean() > 0.4
    at, frame = at[seen], axes(at[seen])
    zenith, azimuth, incidence = read(folder / "a.tif")[:, rows[seen], columns[seen]]
    true = angles(np.einsum("nij,nj->ni", frame, model.centre - to_space(at)))
    ends = [to_space(lonlat(middle[0][seen] + STEP * i, middle[1][seen] + STEP * j)) for i, j in _SIDES]
    normal = np.einsum("nij,nj->ni", frame, np.cross(ends[0] - ends[1], ends[2] - ends[3]))
    cosine = normal @ towards(90 - SUN.elevation_deg, SUN.azimuth_deg) / np.linalg.norm(normal, axis=1)
    ce90 = read(folder / "c.tif")[3, rows[seen], columns[seen]]
    covariance, rising = model.ellipse(at, COVARIANCE, SIGMA_H, -normal[:, :2] / normal[:, 2:])
    open_to_view = rising > 0.25
    assert open_to_view.mean() > 0.9
    off = np.abs(ce90 / radius_of(covariance) - 1)[open_to_view]

    columns, rows = random.integers(0, SIDE, (2, 3000))
    dark = hills.shaded(lonlat(columns + 0.5, rows + 0.5), towards(90 - SUN.elevation_deg, SUN.azimuth_deg))
    mask = read(folder / "s.tif")[rows, columns] == 2
    return Found(
        zenith=float(np.abs(zenith - true[0]).max()),
        azimuth=float(np.abs((azimuth - true[1] + 180) % 360 - 180).max()),
        incidence=float(np.abs(incidence - np.degrees(np.arccos(cosine))).max()),
        shadow=abs(float(mask.mean() - dark.mean())),
        wrong=float((mask != dark).mean()),
        ce90=float(off.max()),
        share=share,
    )


#: East, west, north and south of a pixel's middle.
_SIDES = ((0.5, 0.0), (-0.5, 0.0), (0.0, -0.5), (0.0, 0.5))


def grid_about(plane: pyproj.CRS, place: tuple[float, float]) -> Grid:
    """Return a grid about a place whose pixels are about as wide on the ground as `PIXEL`."""
    there = pyproj.Transformer.from_crs(4326, plane, always_xy=True)
    x, y = there.transform(*place)
    lat = place[1] + PIXEL / 111.2e3
    lon = place[0] + PIXEL / 111.2e3 / math.cos(math.radians(place[1]))
    north, east = (
        np.subtract(there.transform(place[0], lat), (x, y)),
        np.subtract(there.transform(lon, place[1]), (x, y)),
    )
    if plane.is_geographic:
        dx, dy = float(abs(east[0])), float(abs(north[1]))
    else:
        dx = dy = float(math.hypot(*east))
    return Grid(plane, x - SIDE / 2 * dx, y + SIDE / 2 * dy, dx, dy, SIDE, SIDE)


def read(path):
    return gdal.Open(str(path)).ReadAsArray()


def check(found: Found) -> None:
    assert found.zenith < 0.02
    assert found.azimuth < 0.02
    assert found.incidence < 0.02
    assert found.shadow < 0.005
    assert found.wrong < 0.005
    assert found.ce90 < 0.02
    assert 0.05 < found.share < 0.5


@pytest.fixture(scope="module")
def hills_at(tmp_path_factory):
    """Return the terrain at latitudes, and the DEM that was written of it."""
    made = {}

    def at(lat: float) -> tuple[Hills, Surface]:
        if lat not in made:
            path = tmp_path_factory.mktemp("hills") / "dem.tif"
            hills = Hills((LON, lat))
            hills.write(path)
            made[lat] = hills, open_dem(path, "ellipsoid")
        return made[lat]

    return at


@pytest.mark.parametrize(("lat", "name"), [(60, "Web Mercator"), (60, "LAEA"), (60, "polar stereographic")])
def test_layers_are_of_the_ground_whatever_the_map(tmp_path, hills_at, lat, name):
    check(compared(maps(lat)[name], (LON, lat), tmp_path, *hills_at(lat)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lat", "name"), [(lat, name) for lat in (-70, -35, 0, 15, 30, 45, 60, 75) for name in maps(lat)]
)
def test_layers_on_every_map_at_every_latitude(tmp_path, hills_at, lat, name):
    check(compared(maps(lat)[name], (LON, lat), tmp_path, *hills_at(lat)))
