"""GDAL's transformers stand for sensor models: both engines give the same geometry, within what each says of itself.

The source is a ramp whose pixels are their own coordinates: warped bilinearly, an ortho of it holds the image
coordinates that the engine used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner
from orthos import rectify, rectify_gdal
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.exchange.rpc_fit import RpcExport
from ortho_pipeline.models import FrameCamera, ImageCorrection, SensorModel
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.tables import pushbroom_of_tables
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.warp.engines import engine_of
from ortho_pipeline.warp.gdal_engine import EXPRESSED, Exact, Transformer
from ortho_pipeline.warp.job import WARPING, WarpJob, WarpRecord
from ortho_pipeline.warp.quality.hiding import Hiding

UTM = pyproj.CRS.from_epsg(32651)
EAST, NORTH = 500_000.0, 1_000_000.0
WIDTH, HEIGHT = SIZE = (300, 240)
GRID = Grid.of_extent(UTM, (EAST - 69.7, NORTH - 60.2, EAST + 70.3, NORTH + 59.8), (0.5, 0.5))
#: Bilinear interpolation of ramps in Float32.
ROUNDING = 2e-4


def frame(**lens: float) -> FrameCamera:
    """A camera 100 m above the ground, 0.2 rad off nadir, with pixels of about 0.4 m."""
    interior = Interior(WIDTH, HEIGHT, 260e-6, 1e-6, 1e-6, **lens)
    return FrameCamera(
        interior, np.array([EAST, NORTH, 180.0, 0.2, 0.05, 0.3]), frame="map", ground_crs="EPSG:32651",
        heights=(60.0, 100.0),
    )  # fmt: skip


def pushbroom(roll_px: float) -> SensorModel:
    """A line scanner that rolls over the ground of the camera, a wave every 60 rows."""
    camera = LineScanner.over(
        123.0, 9.046, 80.0, image_width=WIDTH, image_height=HEIGHT, gsd=0.4, heading_deg=192.0, altitude=618e3,
        heights=(60.0, 100.0),
    )  # fmt: skip
    period = camera.line_period
    rows = np.arange(-400.0, 640.0, 5.0)
    positions, z = camera.rays(np.column_stack([np.full(len(rows), WIDTH / 2), rows]))
    across = camera.rays(np.column_stack([np.zeros(len(rows)), rows]))[1]
    across = across / (across * z).sum(axis=1)[:, None] - z
    x = -across / np.linalg.norm(across, axis=1)[:, None]
    turns = np.stack([x, np.cross(z, x), z], axis=2)
    angle = roll_px * camera.pixel_tan * np.sin(2 * np.pi * rows / 60)
    roll = np.zeros((len(rows), 3, 3))
    roll[:, 0, 0], roll[:, 0, 2], roll[:, 1, 1] = np.cos(angle), np.sin(angle), 1.0
    roll[:, 2, 0], roll[:, 2, 2] = -np.sin(angle), np.cos(angle)
    return pushbroom_of_tables(
        LineCamera(WIDTH, HEIGHT, WIDTH / 2, 0.0, 1 / camera.pixel_tan), line_period=period, first_time=0.0,
        orbit=(rows * period, positions), attitude=(rows * period, turns @ roll), heights=(60.0, 100.0),
    )  # fmt: skip


def fitted(family: str) -> SensorModel:
    """A classical model as control points of the camera give it; those of the plane from points of one height."""
    camera, random = frame(), np.random.default_rng(3)
    flat = family.startswith(("poly1", "poly2", "affine2d", "projective")) or family in ("poly3", "poly4")
    heights = np.full(200, 80.0) if flat else random.uniform(62.0, 98.0, 200)
    ground = camera.image_to_ground(random.uniform(0, SIZE, (200, 2)), heights)
    points = Points(
        ids=tuple(f"p{i}" for i in range(200)), image=camera.ground_to_image(ground), ground=ground,
        roles=np.full(200, "control"), sigma_image=np.full(200, 0.5), sigma_ground=np.zeros((200, 3)), crs=UTM,
        source="simulated",
    )  # fmt: skip
    return fit_family(family, points, crs="EPSG:32651", size=SIZE, robust=False).model


def terrain(folder: Path, *, void: bool = False) -> Surface:
    """Rough ground with a cliff of 15 m; with `void`, a hole in it."""
    path = folder / "dem.tif"
    rows, columns = np.mgrid[:120, :120]
    heights = 75 + 4 * np.sin(columns / 5) * np.cos(rows / 7) + 15 * (columns > 70)
    heights = heights + np.random.default_rng(0).normal(0, 0.5, heights.shape)
    if void:
        heights[50:56, 40:52] = -9999
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 120, 120, 1, gdal.GDT_Float64)
    dataset.SetProjection(UTM.to_wkt())
    dataset.SetGeoTransform((EAST - 120, 2.0, 0, NORTH + 120, 0, -2.0))
    dataset.GetRasterBand(1).SetNoDataValue(-9999)
    dataset.WriteArray(heights)
    dataset = None
    return open_dem(path, "ellipsoid", fill="mask") if void else open_dem(path, "ellipsoid")


def ramp(folder: Path) -> RasterSource:
    path, (rows, columns) = folder / "ramp.tif", np.mgrid[:HEIGHT, :WIDTH] + 0.5
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), WIDTH, HEIGHT, 2, gdal.GDT_Float32)
    dataset.WriteArray(np.stack([columns, rows]))
    dataset = None
    return RasterSource(path)


def rpc_of(model: SensorModel) -> RpcExport | None:
    try:
        return export_rpc(model)
    except InputError:
        return None


def both(model: SensorModel, surface: Surface, folder: Path, **options) -> tuple[float, float, WarpRecord]:
    """Return the largest difference (px) of the engines, the share of pixels of one alone, and what GDAL's says."""
    source, grid, found = ramp(folder), GRID, []
    ours = rectify(model, source, surface, grid, folder / "ours.tif", driver="GTiff")
    theirs = rectify_gdal(model, rpc_of(model), source, surface, grid, folder / "gdal.tif", driver="GTiff", **options)
    for name in ("ours", "gdal"):
        dataset = gdal.Open(str(folder / f"{name}.tif"))
        found.append((dataset.ReadAsArray(), dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0))
    assert 0.0 <= theirs.seconds < 3600.0  # a duration, not a time
    (one, valid), (other, their_valid) = found
    assert ours.pixels == theirs.pixels == valid.size
    assert (ours.valid_pixels, theirs.valid_pixels) == (valid.sum(), their_valid.sum())
    # Every pixel is projected: there is no lattice.
    assert (theirs.finest_spacing, theirs.refined_blocks, theirs.blocks) == (1, 0, 0)
    use = valid & their_valid
    assert use.mean() > 0.3
    difference = float(np.abs(one - other)[:, use].max())
    assert difference <= ours.max_error_px + theirs.max_error_px + ROUNDING
    return difference, float((valid != their_valid).mean()), theirs


def test_an_unknown_engine_is_refused_with_the_names_of_those_there_are():
    with pytest.raises(InputError, match="unknown engine 'warp9'") as refused:
        engine_of("warp9")
    assert (refused.value.field, refused.value.remedy) == ("output.engine", "ortho or gdal")


def test_gdals_warper_refuses_to_look_for_what_terrain_hides(tmp_path):
    source, surface = ramp(tmp_path), FlatSurface(500.0)
    job = WarpJob(frame(), source, surface, GRID)
    with pytest.raises(InputError, match="cannot detect occlusions") as refused:
        engine_of("gdal").rectify(job, Hiding(tmp_path / "ortho.tif", (400.0, 600.0)))
    assert refused.value.field == "output.visibility"
    assert not (tmp_path / "ortho.tif").exists()


def test_gdals_warper_refuses_masks_of_single_bands(tmp_path, monkeypatch):
    monkeypatch.setenv("GDAL_TIFF_INTERNAL_MASK", "NO")
    image = gdal.Open(ramp(tmp_path).path, gdal.GA_Update)
    image.GetRasterBand(2).CreateMaskBand(0)
    del image
    job = WarpJob(frame(), RasterSource(tmp_path / "ramp.tif"), FlatSurface(500.0), GRID)
    with pytest.raises(InputError, match="ignores masks of single bands"):
        engine_of("gdal").rectify(job, tmp_path / "ortho.tif")


def has_homography() -> bool:
    dataset = gdal.GetDriverByName("MEM").Create("", 100, 100, 1)
    corners = ((0.0, 0.0), (0.0, 90.0), (80.0, 0.0), (80.0, 90.0), (30.0, 20.0))
    dataset.SetGCPs([gdal.GCP(x, y, 0.0, 2 * x, 100 - y) for x, y in corners], "")
    try:
        gdal.Transformer(dataset, None, ["METHOD=GCP_HOMOGRAPHY"])
    except RuntimeError:
        return False
    return True


MODELS = {
    "affine2d": ("GCP_POLYNOMIAL", 1e-6),
    "poly2": ("GCP_POLYNOMIAL", 1e-6),
    "poly3": ("GCP_POLYNOMIAL", 1e-6),
    "projective": ("GCP_HOMOGRAPHY" if has_homography() else "RPC", 0.1),
    "dlt": ("RPC", 0.1),
    "frame, strong distortion": ("GEOLOC_ARRAY", 1e-6),
    "poly4": ("GEOLOC_ARRAY", 1e-6),
    "pushbroom, rolling": ("GEOLOC_ARRAY", 1e-6),
}


def model_of(name: str) -> SensorModel:
    made = {
        "frame, strong distortion": lambda: frame(k1=-0.35, k2=0.05),
        "pushbroom, rolling": lambda: pushbroom(5.0),
    }
    return made[name]() if name in made else fitted(name)


@pytest.mark.parametrize("name", MODELS)
def test_both_engines_agree_within_what_they_say(tmp_path, name):
    method, error = MODELS[name]
    _, apart, result = both(model_of(name), terrain(tmp_path), tmp_path)
    assert result.transformer == method
    assert result.max_error_px <= error
    assert apart < 1e-3


def test_voids_of_the_surface_stay_empty_with_arrays(tmp_path):
    _, apart, result = both(model_of("frame, strong distortion"), terrain(tmp_path, void=True), tmp_path)
    assert result.transformer == "GEOLOC_ARRAY"
    assert apart < 1e-3


def test_small_pieces_of_the_ortho_find_their_windows_beside_a_cliff(tmp_path):
    """GDAL cuts the ortho into chunks as small as its memory, and looks where the points of each lie in the image."""
    _, apart, _ = both(model_of("frame, strong distortion"), terrain(tmp_path), tmp_path, resources=Resources(400_000))
    assert apart < 1e-3


def test_a_correction_of_a_polynomial_is_one(tmp_path):
    """No table of classes says what stands for a model: it is tried."""
    model = ImageCorrection(fitted("poly2"), "shift", (0.0, 0.0), [3.0, 0, 0, -2.0, 0, 0])
    assert both(model, FlatSurface(80.0), tmp_path)[2].transformer == "GCP_POLYNOMIAL"


def test_the_error_is_that_of_the_transformer_at_the_ortho(tmp_path):
    """A polynomial of the first order for a model of the second: its error, found here at all pixels."""
    model, grid, dataset = fitted("poly2"), GRID, ramp(tmp_path).dataset
    exact = Exact(model, FlatSurface(80.0), grid, SIZE)
    ground = model.image_to_ground(np.random.default_rng(0).uniform(0, SIZE, (50, 2)), 80.0)
    gcps = tuple(gdal.GCP(*row) for row in np.column_stack([ground, model.ground_to_image(ground)]).tolist())
    affine = Transformer(
        "GCP_POLYNOMIAL", ("MAX_GCP_ORDER=1", "METHOD=GCP_POLYNOMIAL"), gcps=gcps, gcp_crs=UTM.to_wkt()
    )
    columns, rows = (axis.ravel() + 0.5 for axis in np.meshgrid(np.arange(grid.width), np.arange(grid.height)))
    place = gdal.GetDriverByName("MEM").Create("", grid.width, grid.height, 1)
    place.SetGeoTransform(grid.geotransform)
    place.SetProjection(UTM.to_wkt())
    made = gdal.Transformer(affine.source(dataset), place, list(affine.options))
    found = np.array(made.TransformPoints(1, np.column_stack([columns, rows, 0 * rows]).tolist())[0])[:, :2]
    truth = exact.image(columns, rows)
    seen = [((at >= 0) & (at <= SIZE)).all(axis=1) for at in (found, truth)]
    worst = np.abs(found - truth)[seen[0] | seen[1]].max()
    assert worst > 10 * EXPRESSED
    assert exact.error(affine, dataset) == pytest.approx(worst, rel=0.05)


def test_where_nothing_stands_for_the_model_the_remedy_is_our_engine(tmp_path, monkeypatch):
    monkeypatch.setattr(Transformer, "limit", -1.0)
    with pytest.raises(InputError, match=r"RPC: .* px error; GEOLOC_ARRAY: ") as caught:
        both(frame(k1=-0.05), FlatSurface(80.0), tmp_path)
    assert "`output.engine=ortho`" in str(caught.value.remedy)
    assert [path.name for path in tmp_path.iterdir() if "gdal" in path.name] == []


def test_what_gdals_warper_cannot_do_as_asked_is_refused_or_said(tiny, tmp_path):
    cubic = OutputOptions(engine="gdal", dem_interpolation="cubic")
    with pytest.raises(InputError, match=r"output\.dem_interpolation"):
        commands.rectify(tiny.image, tmp_path / "cubic", surface=SurfaceOptions(height=500.0), output=cubic)
    assert not list((tmp_path / "cubic").glob("*.tif"))
    arrays = WarpRecord(
        max_error_px=0.0, tolerance_px=0.1, pixels=10_000_000, valid_pixels=1, transformer="GEOLOC_ARRAY"
    )
    assert "about 1000 MB" in arrays.notes(512_000_000)[0]
    assert not arrays.notes(1_000_000_000)
    assert not arrays.replaced(transformer="RPC").notes(512_000_000)


def test_gdals_warper_reports_its_progress(tmp_path):
    told = []
    progress = Resources(threads=1, progress=lambda stage, share: told.append((stage, share)))
    both(fitted("affine2d"), FlatSurface(80.0), tmp_path, resources=progress)
    assert {stage for stage, _ in told} == {WARPING}
    shares = {share for _, share in told}
    assert len(shares) > 2
    # Parts of the ortho that do not see the image count for nothing in GDAL.
    assert 0.0 <= min(shares) < 0.5 < max(shares) <= 1.0


def test_gdals_own_transformer_stands_for_an_rpc(tmp_path):
    model = export_rpc(frame()).rpc
    _, apart, result = both(model, FlatSurface(80.0), tmp_path)
    assert result.transformer == "RPC"
    assert result.max_error_px < 1e-4
    assert apart < 1e-3
