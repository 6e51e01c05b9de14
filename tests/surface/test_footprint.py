"""Where a scene lies: heights, pixel, extent and coverage from the surface under it, against plain geometry."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from ortho_pipeline.commands.heights.opening import require_geoid
from ortho_pipeline.errors import CoverageError, InputError
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.models import RPC, FrameCamera, ImageCorrection
from ortho_pipeline.models.frame.camera import MAP
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface import footprint
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.footprint import Footprint, choose_grid, ground_sample_distance, lay, scene_pixels
from ortho_pipeline.surface.writing import write_dem

CRS, X, Y = "EPSG:32651", 300_000.0, 2_700_000.0
#: A drone 200 m above the ellipsoid and 120 m above the ground: pixels of 0.12 m, 120 x 80 m in all.
WIDTH, HEIGHT, FLYING, GROUND = 1000, 668, 200.0, 80.0


def drone(tilt: float = 0.0) -> FrameCamera:
    """Return a camera of which nothing is known but that the ground is below it."""
    interior = Interior(WIDTH, HEIGHT, 0.01, 1e-5, 1e-5)
    exterior = [X, Y, FLYING, np.radians(tilt), 0.0, 0.0]
    return FrameCamera.from_map(interior, CRS, exterior, frame=MAP, heights=(-800.0, 100.0))


@pytest.mark.parametrize("heading", [0.0, 20.0, 45.0, 120.0])
def test_a_pixel_has_the_same_size_whichever_way_the_camera_is_turned(heading):
    """Focal length 1000 pixels, 120 m above the ground: 0.12 m."""
    interior = Interior(WIDTH, HEIGHT, 0.01, 1e-5, 1e-5)
    exterior = [X, Y, FLYING, 0.0, 0.0, np.radians(heading)]
    model = FrameCamera.from_map(interior, CRS, exterior, frame=MAP, heights=(-800.0, 100.0))
    assert ground_sample_distance(model, parse_crs(CRS), WIDTH, HEIGHT, GROUND) == pytest.approx(0.12, rel=1e-9)


def surface(folder: Path, heights: Any = GROUND, west: float = -450.0, **options: Any) -> Surface:
    """Return a DEM of 2 m from 450 m south to 450 m north of the camera, from `west` to 450 m east."""
    rows, columns = 451, int(226 - west / 2)
    field = np.broadcast_to(np.asarray(heights, dtype=float), (rows, columns)).copy()
    path = folder / "dem.tif"
    write_dem(path, field, (X + west - 1.0, Y + 451.0), 2.0, CRS)
    return open_dem(path, "ellipsoid", **options)


def laid(model: Any, on: Surface) -> Footprint:
    return lay(model, on, WIDTH, HEIGHT)


def test_a_drone_lies_on_the_ground_and_not_between_guesses(tmp_path):
    model, on = drone(), surface(tmp_path)
    found = laid(model, on)
    assert found.heights == pytest.approx((GROUND, GROUND), abs=1e-3)
    assert found.middle == pytest.approx(GROUND, abs=1e-3)
    assert (found.coverage, found.complete, found.voids) == (1.0, True, 0)
    grid = choose_grid(model, found, (WIDTH, HEIGHT))
    assert grid.dx == pytest.approx(0.12)
    xmin, ymin, xmax, ymax = grid.extent
    assert (xmax - xmin, ymax - ymin) == pytest.approx((120.0, 668 * 0.12), abs=0.25)


def test_a_pixel_may_be_larger_than_the_scene_on_one_axis(tmp_path):
    model, on = drone(), surface(tmp_path)
    grid = choose_grid(model, laid(model, on), (WIDTH, HEIGHT), resolution=(500.0, 0.5))
    assert (grid.dx, grid.dy) == (500.0, 0.5)
    with pytest.raises(InputError, match="the whole scene is smaller than one pixel") as caught:
        choose_grid(model, laid(model, on), (WIDTH, HEIGHT), resolution=(121.0, 81.0))
    assert "the scene's own pixel is 0.12" in caught.value.remedy


@pytest.mark.parametrize("pixel", [(1.0, 1.0), (0.5, 2.0), (2.0, 0.25)])
def test_the_pixels_of_a_scene_are_its_ground_over_the_ground_of_a_pixel(tmp_path, pixel):
    model = drone()
    found = laid(model, surface(tmp_path))
    grid = Grid.of_extent(parse_crs(CRS), (X - 200, Y - 200, X + 200, Y + 200), pixel)
    assert scene_pixels(model, found, grid) == pytest.approx(120 * 668 * 0.12 / (pixel[0] * pixel[1]), rel=0.01)
    half = Grid.of_extent(parse_crs(CRS), (X, Y - 200, X + 200, Y + 200), pixel)
    assert scene_pixels(model, found, half) == pytest.approx(60 * 668 * 0.12 / (pixel[0] * pixel[1]), rel=0.01)


@pytest.mark.parametrize(("west", "share"), [(-30.0, 0.75), (0.0, 0.5), (30.0, 0.25), (-2.0, 62 / 120)])
def test_the_part_beyond_the_dem_is_laid_at_the_heights_there(tmp_path, west, share):
    model, on = drone(), surface(tmp_path, west=west)
    found = laid(model, on)
    assert found.coverage == pytest.approx(share, abs=1e-3)
    with pytest.raises(CoverageError, match=rf"covers {int(found.coverage * 1000) / 10:.1f} % of the scene"):
        found.require_coverage()
    whole = choose_grid(model, laid(model, surface(tmp_path)), (WIDTH, HEIGHT))
    assert choose_grid(model, found, (WIDTH, HEIGHT)).extent == pytest.approx(whole.extent, abs=0.13)
    masked = surface(tmp_path, west=west, fill="mask")
    (note,) = laid(model, masked).notes()
    assert f"covers {int(found.coverage * 1000) / 10:.1f} % of the scene" in note


def test_what_a_dem_does_not_cover_is_one_notice(tmp_path):
    beyond = "heights under the scene are 0 to 900 m above the ellipsoid, its model is good for 0 to 500 m"
    found = replace(laid(drone(), surface(tmp_path, west=0.0, fill="mask")), beyond=beyond)
    (note,) = found.notes()
    assert (note.code, note.fields["coverage"]) == ("dem-covers-part", found.coverage)
    assert note.startswith(f"{beyond}: these places have no pixels; the DEM covers 50.0 % of the scene")
    assert [str(one) for one in replace(found, coverage=1.0).notes()] == [f"{beyond}: these places have no pixels"]
    assert replace(found, coverage=1.0, beyond="").notes() == []


@pytest.mark.parametrize("fill", ["mask", "nearest", "75"])
def test_voids_count_whatever_fills_them(tmp_path, fill):
    heights = np.full((451, 451), GROUND)
    heights[220:225, 215:230] = -32768.0
    found = laid(drone(), surface(tmp_path, heights, fill=fill))
    assert found.voids == 75
    # Of 4 m2 each, in 120 x 80.16 m, whose border cuts through samples.
    assert 1 - found.coverage == pytest.approx(300 / (120 * 80.16), rel=0.04)


@pytest.mark.parametrize("block", [1, 2, 3, 5, 40, 41, 42, 43, 1024])
def test_voids_are_counted_up_to_the_last_row_and_column_whatever_the_blocks(tmp_path, monkeypatch, block):
    """Posts every 2 m: 60 x 41 are in 120 x 80.16 m, the last ones 59 m east and 40 m south of the camera."""
    monkeypatch.setattr(footprint, "_BLOCK", block)
    heights = np.full((451, 450), GROUND)
    heights[244:, 220:230] = -32768.0
    heights[215:225, 253:] = -32768.0
    found = laid(drone(), surface(tmp_path, heights, west=-449.0, fill="mask"))
    # Two rows of ten posts, two columns of ten.
    assert found.voids == 40
    assert found.coverage == pytest.approx(1 - 40 / (60 * 41))


def on_the_ground(model: FrameCamera, height: float) -> Any:
    """Return the outline of the image on level ground, by its corners: a pinhole keeps straight lines straight."""
    corners = np.array([[0.0, 0.0], [WIDTH, 0.0], [WIDTH, HEIGHT], [0.0, HEIGHT]])
    return shapely.Polygon(model.image_to_ground(corners, height)[:, :2])


@pytest.mark.parametrize("tilt", [0.0, 35.0, 45.0])
def test_coverage_is_of_the_ground_and_the_same_for_every_fill(tmp_path, tilt):
    """Of level ground: the area of the image on it that the DEM has, with a height that was given far off."""
    model, outline = drone(tilt), on_the_ground(drone(tilt), GROUND)
    share = outline.intersection(shapely.box(X - 20.0, Y - 450.0, X + 450.0, Y + 450.0)).area / outline.area
    for fill in ("error", "mask", "nearest", "20"):
        found = laid(model, surface(tmp_path, west=-20.0, fill=fill))
        assert found.coverage == pytest.approx(share, abs=2e-3), fill


@pytest.mark.parametrize("tilt", [0.0, 35.0])
def test_coverage_of_slopes_is_the_same_for_every_fill(tmp_path, tilt):
    v, u = np.mgrid[:451, :236]
    heights = GROUND + 20 * np.sin(u / 20) * np.cos(v / 15)
    heights[210:240, 80:110] = -32768.0
    on = [surface(tmp_path, heights, west=-20.0, fill=fill) for fill in ("error", "mask", "nearest", "20")]
    found = [laid(drone(tilt), one) for one in on]
    assert len({(one.coverage, one.complete) for one in found}) == 1
    assert 0.3 < found[0].coverage < 0.9


@pytest.mark.parametrize("tilt", [0.0, 35.0, 55.0])
def test_rough_ground_and_an_oblique_view(tmp_path, tilt):
    v, u = np.mgrid[:451, :451]
    heights = GROUND + 20 * np.sin(u / 20) * np.cos(v / 15)
    model = drone(tilt)
    on = surface(tmp_path, heights, fill="mask")
    found = laid(model, on)
    low, high = found.heights
    assert 60.0 - 0.1 <= low < high <= 100.0 + 0.1
    # Every ground point of the DEM that the camera sees within its frame lies within the extent.
    x, y = X - 450 + 2 * u.ravel(), Y + 450 - 2 * v.ravel()
    ground = np.column_stack([x, y, heights.ravel()])
    image = model.ground_to_image(ground)
    inside = ((image >= 0) & (image <= (WIDTH, HEIGHT))).all(axis=1)
    xmin, ymin, xmax, ymax = choose_grid(model, found, (WIDTH, HEIGHT), resolution=0.5).extent
    seen = ground[inside]
    assert (seen[:, 0].min() > xmin, seen[:, 0].max() < xmax) == (True, True)
    assert (seen[:, 1].min() > ymin, seen[:, 1].max() < ymax) == (True, True)
    # And the extent is not much larger than that.
    assert (xmax - xmin) * (ymax - ymin) < 1.35 * np.prod(np.ptp(seen[:, :2], axis=0))


def test_a_scene_partly_far_from_all_heights_is_refused_with_the_reach(tmp_path):
    """Nearest fill looks 512 samples of 2 m far; half of the scene of 12 km lies west of the DEM."""
    model = FrameCamera.from_map(
        Interior(WIDTH, HEIGHT, 0.01, 1e-5, 1e-5), CRS, [X, Y, 12_000.0, 0.0, 0.0, 0.0], frame=MAP, heights=(0.0, 500.0)
    )
    on = surface(tmp_path, west=30.0, fill="nearest")
    found = laid(model, on)
    assert found.unmet
    with pytest.raises(CoverageError, match=r"more than 1\.02 km from the nearest height"):
        found.require_coverage()
    near = laid(drone(), on)
    assert not near.unmet
    near.require_coverage()


def test_the_heights_of_a_scene_are_the_lowest_and_highest_under_it(tmp_path):
    """A pit and a peak of one sample, between the rays, and a higher peak outside."""
    heights = np.full((451, 451), GROUND)
    heights[225, 230], heights[220, 210], heights[10, 10] = 61.0, 97.0, 150.0
    found = laid(drone(), surface(tmp_path, heights))
    assert found.heights == pytest.approx((61.0, 97.0), abs=1e-3)
    assert found.middle == pytest.approx(GROUND, abs=1e-3)


@pytest.mark.parametrize("middle", [179.99, -179.98, 10.1])
def test_a_scene_across_the_antimeridian_has_a_narrow_grid(middle):
    """A scene of 0.2 degrees: the grid goes from one side to the other, not around the Earth."""
    column, row, one = np.eye(20)[1], -np.eye(20)[2], np.eye(20)[0]
    model = RPC(500.0, 500.0, middle, 10.0, 500.0, 500.0, 500.0, 0.1, 0.1, 500.0, column, one, row, one)
    found = lay(model, FlatSurface(500.0), 1000, 1000)
    grid = choose_grid(model, found, (1000, 1000), crs=parse_crs("EPSG:4326"))
    xmin, ymin, xmax, ymax = grid.extent
    assert (xmax - xmin, ymax - ymin) == pytest.approx((0.2, 0.2), abs=2 * grid.dx)
    assert (xmin - middle + 0.1 + 180.0) % 360.0 == pytest.approx(180.0, abs=2 * grid.dx)
    assert scene_pixels(model, found, grid) == pytest.approx(1e6, rel=0.02)


@pytest.mark.parametrize("middle", [179.98, -179.98])
def test_an_extent_on_the_other_side_of_the_antimeridian_is_of_the_scene(middle):
    column, row, one = np.eye(20)[1], -np.eye(20)[2], np.eye(20)[0]
    model = RPC(500.0, 500.0, middle, 10.0, 500.0, 500.0, 500.0, 0.1, 0.1, 500.0, column, one, row, one)
    found, crs = lay(model, FlatSurface(500.0), 1000, 1000), parse_crs("EPSG:4326")
    size, east = (1000, 1000), -179.95
    for west in (-180.05, 179.95):
        grid = choose_grid(model, found, size, crs=crs, resolution=0.001, extent=(west, 9.95, west + 0.1, 10.05))
        assert scene_pixels(model, found, grid) == pytest.approx(1e4, rel=1e-6)
    away = choose_grid(model, found, size, crs=crs, resolution=0.001, extent=(east + 10, 9.95, east + 10.1, 10.05))
    with pytest.raises(InputError, match="does not overlap"):
        scene_pixels(model, found, away)


@pytest.mark.parametrize(
    ("height", "said"),
    [(850.0, "500 to 850 m"), (150.0, "150 to 500 m"), (790.0, None), (210.0, None)],
)
def test_heights_that_a_model_does_not_project_are_told(tmp_path, height, said):
    """An RPC of 300 to 700 m is good for half of that more on both sides; the DEM has 500 m and a spot."""
    column, row, one = np.eye(20)[1], -np.eye(20)[2], np.eye(20)[0]
    model = RPC(500.0, 500.0, 10.0, 10.0, 500.0, 500.0, 500.0, 0.1, 0.1, 200.0, column, one, row, one)
    heights = np.full((80, 80), 500.0)
    heights[40:44, 30:34] = height
    write_dem(tmp_path / "dem.tif", heights, (9.8, 10.2), 0.005, "EPSG:4326")
    beyond = lay(model, open_dem(tmp_path / "dem.tif", "ellipsoid"), 1000, 1000).beyond
    whole = f"heights under the scene are {said} above the ellipsoid, its model is good for 200 to 800 m"
    assert beyond == ("" if said is None else whole)


@pytest.mark.parametrize(
    ("fill", "changes", "said"),
    [
        ("error", {}, None), ("error", {"complete": False, "coverage": 0.5}, "the DEM covers 50.0 % of the scene"),
        ("error", {"complete": False, "coverage": 0.5, "beyond": "too high"}, "too high"),
        ("error", {"beyond": "too high"}, None), ("mask", {"complete": False, "coverage": 1e-3}, None),
        ("mask", {"complete": False, "coverage": 0.0}, "the ortho would have no pixels"),
        ("mask", {"complete": False, "coverage": 0.0, "beyond": "too high"}, "too high"),
        ("mask", {"complete": False, "coverage": 0.5, "beyond": "too high"}, None),
        ("mask", {"complete": False, "coverage": 0.5, "unmet": True}, None),
        ("nearest", {"complete": False, "coverage": 0.5}, None),
        ("nearest", {"complete": False, "coverage": 0.5, "unmet": True}, "more than 1.02 km from the nearest height"),
        ("80", {"complete": False, "coverage": 0.0, "unmet": True}, None),
    ],
)  # fmt: skip
def test_which_coverage_is_refused(tmp_path, fill, changes, said):
    """Without a rule every gap; with voids left empty, only an ortho without pixels; with others what they lack."""
    found = replace(laid(drone(), surface(tmp_path, fill=fill)), **changes)
    if said is None:
        found.require_coverage()
        return
    with pytest.raises(CoverageError) as caught:
        found.require_coverage()
    assert said in str(caught.value)
    assert caught.value.file == str(tmp_path / "dem.tif")
    assert caught.value.remedy


def test_models_are_meant_for_the_heights_under_their_scene(tmp_path):
    v, u = np.mgrid[:451, :451]
    heights = GROUND + 10 * np.sin(u / 20) * np.cos(v / 15)
    on = surface(tmp_path, heights)
    model = drone()
    fitted = laid(model, on).fitted(model)
    there = heights[203:248, 193:258]
    assert fitted.height_range == pytest.approx((there.min() - 10, there.max() + 10), abs=1.0)
    # Nothing but the box changes; an RPC of the box of guesses is of no use (47 px).
    image = np.array([[0.0, 0.0], [400.0, 300.0]])
    np.testing.assert_array_equal(fitted.image_to_ground(image, 85.0), model.image_to_ground(image, 85.0))
    assert export_rpc(fitted).max_error_px < 0.1
    corrected = ImageCorrection.identity(model, "shift", (0.0, 0.0))
    assert laid(corrected, on).fitted(corrected).height_range == fitted.height_range


def test_a_model_that_misses_the_surface_keeps_its_heights(tmp_path):
    model = drone()
    far = model.with_params(model.params + np.array([50_000.0, 0, 0, 0, 0, 0]))
    found = laid(far, surface(tmp_path, fill="mask"))
    assert (found.coverage, found.heights) == (0.0, far.height_range)
    assert found.fitted(far) is far


@pytest.mark.parametrize(
    ("crs", "fits"), [("EPSG:3857", False), ("EPSG:6933", False), ("EPSG:3832", True), ("EPSG:4326", True)]
)
def test_a_crs_whose_edge_crosses_the_scene_is_refused(crs: str, fits: bool) -> None:
    """The grid was as wide as the world, and its ortho would have taken hours."""
    interior = Interior(WIDTH, HEIGHT, 0.01, 1e-5, 1e-5)
    model = FrameCamera.from_roll_pitch_yaw(interior, [180.0, 24.0, FLYING], 0.0, 0.0, 0.0, heights=(0.0, 100.0))
    found = laid(model, FlatSurface(GROUND))
    step = 1e-6 if crs == "EPSG:4326" else 0.12
    if fits:
        grid = choose_grid(model, found, (WIDTH, HEIGHT), crs=parse_crs(crs), resolution=step)
        assert grid.width < 2000
        return
    with pytest.raises(InputError, match="crosses the scene") as caught:
        choose_grid(model, found, (WIDTH, HEIGHT), crs=parse_crs(crs), resolution=step)
    assert caught.value.field == "output.crs"


def test_a_geoid_that_ends_within_the_scene_is_named_and_never_filled(tmp_path):
    """The grid ends where the camera is; the DEM has heights everywhere."""
    surface(tmp_path)
    lon, lat, _ = ground_transform(CRS, "EPSG:4979")(np.array([[X, Y, 0.0]]))[0]
    geoid = tmp_path / "half.gtx"
    geoid.write_bytes(struct.pack(">4d2i4f", lat - 0.1, lon - 0.2, 0.2, 0.2, 2, 2, *[5.0] * 4))
    for fill in ("error", "nearest", 80.0):
        found = laid(drone(), open_dem(tmp_path / "dem.tif", str(geoid), fill=fill))
        with pytest.raises(CoverageError, match=r"half.gtx does not cover 4\d.\d % of the scene") as caught:
            require_geoid(found, drone(), (WIDTH, HEIGHT))
        assert caught.value.field == "surface.vertical"
    for surface_known in (open_dem(tmp_path / "dem.tif", str(geoid), fill="mask"), surface(tmp_path, west=0.0)):
        require_geoid(laid(drone(), surface_known), drone(), (WIDTH, HEIGHT))
