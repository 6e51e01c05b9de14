"""`ortho verify` names deliberate errors: datum, heights, shift, rotation and old model, four each; one is refused."""

from __future__ import annotations

import types
from pathlib import Path

import numpy as np
import pytest
from landscape import field_of
from osgeo import gdal
from pairs import CORNER, Array, Look, Pair
from scipy.ndimage import gaussian_filter, map_coordinates

from ortho_pipeline.commands.orthos.dependence import steps_of
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.options import MatchOptions, SurfaceOptions

gdal.UseExceptions()
SIDE, POST = 320, 2
#: PROJ's differences at the place of the pairs: metres to the east and north.
DATUMS = {"Cape": (34.0, 62.1), "Arc 1950": (30.5, 59.6), "WGS 72BE": (-22.6, -1.5), "WGS 72": (-15.4, -3.9)}


class Displaced(Pair):
    """A pair whose displacement is a function of parts (0 to 1) to the east and south."""

    def displacement(self):
        return lambda image: WRONG[self.seed](image / self.pixels)


def terrain(seed: int) -> Array:
    return 300.0 + 25.0 * field_of(np.random.default_rng([seed, 9]), 256, 50.0)[: SIDE // POST, : SIDE // POST]


def leaning(seed: int, wrong: Array | float) -> Array:
    """Return metres to the east and north by which wrong heights displace posts, from a view off vertical."""
    random = np.random.default_rng([seed, 10])
    azimuth, tangent = random.uniform(0, 2 * np.pi), random.uniform(0.1, 0.3)
    rate = tangent * np.array([np.sin(azimuth), np.cos(azimuth)])
    return rate * (terrain(seed) - wrong)[..., None]


def of_posts(posts: Array):
    def at(part: Array) -> Array:
        where = [part[:, 1] * SIDE / POST - 0.5, part[:, 0] * SIDE / POST - 0.5]
        return np.column_stack([map_coordinates(posts[..., k], where, order=1, mode="nearest") for k in (0, 1)])

    return at


def linear(shift: tuple[float, float], slopes: Array):
    """Return a displacement that is a shift in the middle, with slopes per part of the side."""
    return lambda part: np.array(shift) + (part - 0.5) * (1, -1) @ np.asarray(slopes).T


def turned(degrees: float, shift: tuple[float, float] = (0.0, 0.0)):
    """Return a displacement by a rotation, clockwise in the map."""
    return linear(shift, SIDE * np.radians(degrees) * np.array([[0.0, 1.0], [-1.0, 0.0]]))


CASES = {
    "datum": [lambda _, east=east, north=north: (east, north) for east, north in DATUMS.values()],
    "heights": [
        of_posts(leaning(4, 280.0)),  # flat ground
        of_posts(leaning(5, 0.0)),  # no heights at all
        of_posts(leaning(6, gaussian_filter(terrain(6), 20))),  # a coarse DEM
        of_posts(leaning(7, terrain(7) * 0.9)),  # a DEM of another unit or scale
    ],
    "shift": [lambda _, by=by: by for by in ((0.4, -0.3), (2.6, 1.3), (-8.0, 7.5), (0.0, 25.0))],
    "rotation": [turned(0.1), turned(-0.2), turned(0.6, (1.0, -2.0)), turned(-1.0)],
    "model": [
        linear((3.0, -2.0), [[0.8, 0.3], [-0.1, -0.4]]),
        linear((0.0, 0.0), [[0.0, 0.0], [1.5, 0.2]]),
        linear((-6.0, 4.0), [[-2.0, 0.5], [0.4, 1.0]]),
        linear((1.0, 1.0), [[0.1, 0.6], [0.5, -0.2]]),
    ],
}
WRONG = dict(enumerate(one for kind in CASES.values() for one in kind))
#: Another season, and relief that displaces by 10 px within 100 px: the limit of so small an ortho.
REFUSED = 5
KINDS = [kind for kind, cases in CASES.items() for _ in cases]


def written(heights: Array, gsd: float, path: Path) -> Path:
    made = gdal.GetDriverByName("GTiff").Create(str(path), *heights.shape[::-1], 1, gdal.GDT_Float32)
    made.SetProjection(parse_crs("EPSG:32735").to_wkt())
    made.SetGeoTransform((CORNER[0], POST * gsd, 0.0, CORNER[1], 0.0, -POST * gsd))
    made.GetRasterBand(1).WriteArray(heights)
    return path


@pytest.mark.parametrize(("lines", "jump"), [(10, 0.0), (30, 0.0), (30, 1.0)])
def test_a_step_needs_two_lines_of_matches_on_each_side(lines, jump):
    """Of a displacement that is the same everywhere, or jumps at row 200; few lines stay without a step."""
    places = np.linspace(10.0, 390.0, lines)
    image = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    noise = np.random.default_rng(3).normal(0.0, 0.005, image.shape)
    displacement = noise + (5.3, -3.1) + jump * (image[:, 1:] > 200)
    measured = types.SimpleNamespace(image=image, displacement=displacement, pixel=2.0)
    found = steps_of(measured)
    assert len(found) == (jump > 0)
    for step in found:
        assert (step.axis, round(step.east, 1), round(step.north, 1)) == ("row", jump, jump)
        assert step.at == pytest.approx(200, abs=20)


@pytest.mark.parametrize(
    "number",
    [pytest.param(k, marks=() if k == 12 else pytest.mark.slow, id=f"{kind}-{k % 4}") for k, kind in enumerate(KINDS)],
)
def test_a_deliberate_error_is_named(tmp_path, number):
    kind = KINDS[number]
    # Datums differ by many metres.
    gsd = 4.0 if kind == "datum" else 1.0
    pair = Displaced(
        ground=("country", "woods", "town")[number % 3], seed=number, side=SIDE, ortho=Look(gsd=gsd, season=number % 2),
        reference=Look(gsd=gsd), shift=(30.0 * gsd, 30.0 * gsd),
    )  # fmt: skip
    ortho, reference = pair.write(tmp_path / "pair")
    dem = written(terrain(number), gsd, tmp_path / "dem.tif")
    surface = SurfaceOptions(dem=str(dem), vertical="ellipsoid")
    match = MatchOptions(reference=[str(reference)], search=120.0)
    if number == REFUSED:
        with pytest.raises(InputError, match="cannot match"):
            verify(ortho, match=match, surface=surface)
        return
    result = verify(ortho, match=match, surface=surface)
    causes = result.document["causes"]
    assert causes, "no cause"
    # A shift may explain more than the error that comes with it.
    assert kind == next(one["code"] for one in causes if one["code"] != "shift" or kind == "shift"), causes
    shares = [one["share"] for one in causes]
    assert shares == sorted(shares, reverse=True)
    # The errors of a coarse DEM hardly follow the heights themselves.
    assert (0.1 if kind == "heights" else 0.5) < sum(shares) < 1.1, causes
    # A shift may come on top of any other error; nothing else is named.
    assert {one["code"] for one in causes} <= {kind, "shift"} | ({"smooth"} if kind == "heights" else set()), causes
    if kind == "datum":
        assert any(name in causes[0]["text"] for name in DATUMS), causes
