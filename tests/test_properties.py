"""What holds for every sensor model, fit and warp, at examples that hypothesis chooses (few, the same in every run)."""

from __future__ import annotations

import json
import math
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from orthos import rectify

from ortho_pipeline.errors import DegeneratePoints, InputError
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.model_file import SavedModel, read_model_file, write_model_file
from ortho_pipeline.exchange.rpc_files import read_rpc_text, rpc_metadata, rpc_of_fields, write_rpb, write_rpc_txt
from ortho_pipeline.models import (
    KINDS,
    RPC,
    Cropped,
    FrameCamera,
    ImageCorrection,
    MapPlane,
    Pieces,
    Pushbroom,
    Rational,
    SensorModel,
    families,
    family_of,
    model_from_dict,
    start_model,
)
from ortho_pipeline.models.frame.camera import PARAMETERS
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.orthos.map_grid import MapGrid
from ortho_pipeline.models.orthos.smooth_field import SmoothField
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.warp import lattice_engine as warp

SEEDS = st.integers(0, 10_000)
LONGITUDES = st.one_of(st.floats(-180, 180), st.sampled_from([-180.0, 179.99, -1e-9, 0.0, 180.0]))
LATITUDES = st.floats(-80, 80)


# -- models of every kind --------------------------------------------------------------------------------------------


def made(cls: type, *given: Any, **named: Any) -> Any:
    """Return an object, or give the example up if its numbers are refused."""
    try:
        return cls(*given, **named)
    except InputError:
        assume(False)


@st.composite
def rpcs(draw: st.DrawFn) -> RPC:
    """Draw an RPC of pixels of 0.3 to 10 m, up to 45 degrees off nadir, with all 78 coefficients at work."""
    random = np.random.default_rng(draw(SEEDS))
    lon, lat, gsd = draw(LONGITUDES), draw(LATITUDES), draw(st.floats(0.3, 10.0))
    half, heights = np.array([draw(st.integers(100, 20_000)) for _ in range(2)]), draw(st.floats(50.0, 2000.0))
    parallax = draw(st.floats(0.0, 1.0)) * heights / gsd / half * random.uniform(-1, 1, 2)
    higher, turn = random.normal(0, 2e-5, (4, 16)), random.uniform(-0.3, 0.3, 2)
    return made(
        RPC, *(half + draw(st.floats(-1e4, 1e4))), lon, lat, draw(st.floats(-300.0, 6000.0)), *half,
        half[0] * gsd / 111e3 / math.cos(math.radians(lat)), half[1] * gsd / 111e3, heights,
        [random.normal(0, 1e-3), 1.0, turn[0], parallax[0], *higher[0]],
        [1.0, *random.normal(0, 1e-3, 3), *higher[1] / 10],
        [random.normal(0, 1e-3), turn[1], -1.0, parallax[1], *higher[2]],
        [1.0, *random.normal(0, 1e-3, 3), *higher[3] / 10],
        err_bias=draw(st.none() | st.floats(0.0, 1e3)), err_rand=draw(st.none() | st.floats(0.0, 1e3)),
    )  # fmt: skip


@st.composite
def corrections(draw: st.DrawFn) -> ImageCorrection:
    """Draw a correction of an RPC: shifts of many pixels, turns and scales of a hundredth."""
    model, kind = draw(rpcs()), draw(st.sampled_from(["none", "shift", "shift-drift", "affine"]))
    identity = ImageCorrection.identity(model, kind, (draw(st.floats(0.0, 2e4)), draw(st.floats(0.0, 2e4))))
    random = np.random.default_rng(draw(SEEDS))
    sizes = [20.0 if "shift" in name else 1e-2 for name in identity.param_names]
    return identity.with_params(random.normal(0, 1, len(sizes)) * sizes)


@st.composite
def rationals(draw: st.DrawFn) -> Rational:
    """Draw a classical model, with start values from an RPC and all of its coefficients at work."""
    rpc = draw(rpcs())
    name = draw(st.sampled_from([name for family in families() for name in family.variants or (family.name,)]))
    crs = draw(st.sampled_from(["geocentric", "geographic", "utm"]))
    start = start_model(name, seen(rpc, 80, draw(SEEDS)), crs=crs)
    nudge = np.random.default_rng(draw(SEEDS)).normal(0, 1e-4, len(start.params))
    return start.with_params(start.params + nudge)


@st.composite
def frames(draw: st.DrawFn) -> FrameCamera:
    """Draw a frame camera of a satellite, up to 40 degrees off nadir, with a lens that distorts."""
    distortion = (3e-5, -2e-5, -0.2, 0.05, 0.01, 1e-3, -5e-4) if draw(st.booleans()) else ()
    angles = [draw(st.floats(-0.5, 0.5)), draw(st.floats(-0.5, 0.5)), draw(st.floats(-math.pi, math.pi))]
    free = PARAMETERS if draw(st.booleans()) else PARAMETERS[:6]
    return FrameCamera.from_roll_pitch_yaw(
        Interior(2048, 2048, 0.18, 7.3e-6, 7.2e-6, *distortion), (draw(LONGITUDES), draw(LATITUDES), 686e3), *angles,
        heights=(0.0, 1900.0), refraction=draw(st.booleans()), free=free,
    )  # fmt: skip


@st.composite
def map_planes(draw: st.DrawFn) -> MapPlane:
    """Draw a scene on a plane in UTM."""
    heights = draw(st.floats(-400.0, 1300.0)), 1400.0
    return MapPlane.from_view(
        "EPSG:32639", (draw(st.floats(3e5, 7e5)), draw(st.floats(1e5, 8e6))), (draw(st.floats(0.3, 5.0)),) * 2,
        (draw(st.integers(10, 20_000)), draw(st.integers(10, 20_000))), 1300.0,
        draw(st.floats(-math.pi, math.pi)), draw(st.floats(0.5, math.pi / 2)), heights,
    )  # fmt: skip


@lru_cache
def pushbroom(seed: int) -> Pushbroom | None:
    """Return a line scanner from what metadata say of it, None where they are refused; half a second each."""
    random = np.random.default_rng(seed)
    lon, lat, heading = random.uniform(-180, 180), random.uniform(-70, 70), random.uniform(-math.pi, math.pi)
    square = 15e3 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    turned = square @ np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    try:
        return pushbroom_of_metadata(
            (lon, lat) + turned / 111e3 / (math.cos(math.radians(lat)), 1.0), 12_000, 12_000, altitude=618e3,
            along_deg=random.uniform(-30, 30), across_deg=random.uniform(-20, 20), focal_length=1.945, pixel_size=7e-6,
            heights=(0.0, 1500.0),
        )  # fmt: skip
    except InputError:
        return None


@st.composite
def pushbrooms(draw: st.DrawFn) -> Pushbroom:
    """Draw one of a few line scanners."""
    drawn = pushbroom(draw(st.integers(0, 4)))
    assume(drawn is not None)
    return drawn  # type: ignore[return-value]


@st.composite
def pieces(draw: st.DrawFn) -> Pieces:
    """Draw an image of two parts side by side, both of one RPC."""
    rpc = draw(rpcs())
    width, height = (max(2, round(2 * value)) for value in (rpc.col_scale, rpc.row_scale))
    left = width // 2
    sizes = (left, height), (width - left, height)
    return Pieces((rpc, rpc.shifted(left, 0)), ((0.0, 0.0), (float(left), 0.0)), sizes)


@st.composite
def map_grids(draw: st.DrawFn) -> MapGrid:
    """Draw the grid of a finished ortho in UTM: rotated, and south-up or not."""
    pixel, turn = draw(st.floats(0.3, 30.0)), draw(st.floats(-math.pi, math.pi))
    east, north, down = pixel * math.cos(turn), pixel * math.sin(turn), draw(st.sampled_from((-1.0, 1.0)))
    place = draw(st.floats(3e5, 7e5)), draw(st.floats(1e6, 8e6))
    size = draw(st.integers(100, 5_000)), draw(st.integers(100, 5_000))
    return MapGrid("EPSG:32639", (place[0], east, down * -north, place[1], north, down * east), size)


@st.composite
def smooth_fields(draw: st.DrawFn) -> SmoothField:
    """Draw an ortho that a smooth field of up to 3 px moves."""
    grid = draw(map_grids())
    seed = draw(st.integers(0, 99))
    return SmoothField(grid, grid.size, np.random.default_rng(seed).uniform(-3.0, 3.0, (3, 4, 2)))


@st.composite
def crops(draw: st.DrawFn) -> Cropped:
    """Draw a crop of an image that a correction moves."""
    return Cropped(draw(corrections()), (draw(st.floats(-1e4, 1e4)), draw(st.floats(-1e4, 1e4))))


MODELS = {
    RPC: rpcs, Rational: rationals, ImageCorrection: corrections, Cropped: crops, FrameCamera: frames,
    MapGrid: map_grids, MapPlane: map_planes, Pieces: pieces, Pushbroom: pushbrooms, SmoothField: smooth_fields,
}  # fmt: skip
EVERY_KIND = pytest.mark.parametrize("kind", MODELS, ids=lambda kind: kind.kind)


def inner_ground(model: SensorModel, count: int, seed: int) -> np.ndarray:
    """Return points in the inner part of a model's domain that it sees."""
    centre, half = model.domain
    ground = centre + half * np.random.default_rng(seed).uniform(-0.6, 0.6, (count, 3))
    return ground[np.isfinite(model.ground_to_image(ground)).all(axis=1)]


def seen(model: SensorModel, count: int, seed: int, noise: float = 0.0) -> Points:
    """Return points that a model sees, measured with noise (px)."""
    ground = inner_ground(model, count, seed)
    n = len(ground)
    assume(n > 0.5 * count)
    image = model.ground_to_image(ground) + noise * np.random.default_rng(seed).normal(size=(n, 2))
    return Points(
        ids=tuple(f"p{k}" for k in range(n)), image=image, ground=ground, roles=np.full(n, "control"),
        sigma_image=np.ones(n), sigma_ground=np.zeros((n, 3)), crs=pyproj.CRS(model.crs), source="drawn",
    )  # fmt: skip


def test_no_kind_of_model_is_left_out() -> None:
    # Other tests install models of their own.
    assert set(MODELS) == {kind for kind in KINDS.values() if kind.__module__.startswith("ortho_")}


@EVERY_KIND
@given(data=st.data())
def test_ground_to_image_to_ground(kind: type[SensorModel], data: st.DataObject) -> None:
    """The inverse closes to 1e-5 px, and comes back to the same ground: another root would close as well."""
    model = data.draw(MODELS[kind]())
    ground = inner_ground(model, 40, data.draw(SEEDS))
    assert len(ground) >= 10
    image = model.ground_to_image(ground)
    back = model.image_to_ground(image, ground[:, 2])
    assert np.abs(model.ground_to_image(back) - image).max() < 1e-5
    assert np.abs((back - ground) / model.domain[1]).max() < 1e-6


@EVERY_KIND
@given(data=st.data())
def test_models_are_read_as_they_were_written(kind: type[SensorModel], tmp_path: Path, data: st.DataObject) -> None:
    """From JSON, from a model file and from another process: the same projections to the last bit."""
    model = data.draw(MODELS[kind]())
    text = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    saved = SavedModel(model, data.draw(text), data.draw(text), (7, 9), {"adjustment": {"note": data.draw(text)}})
    write_model_file(saved, tmp_path / "a_model.json")
    again = read_model_file(tmp_path / "a_model.json")
    assert (again.sensor, again.model_source, again.size, dict(again.provenance)) == (
        saved.sensor, saved.model_source, saved.size, saved.provenance,
    )  # fmt: skip
    ground = inner_ground(model, 20, 0)
    copies = again.model, model_from_dict(json.loads(json.dumps(model.to_dict()))), pickle.loads(pickle.dumps(model))
    for copy in copies:
        assert copy.to_dict() == model.to_dict()
        np.testing.assert_array_equal(copy.ground_to_image(ground), model.ground_to_image(ground))


@given(rpc=rpcs())
def test_rpcs_are_read_as_they_were_written(tmp_path: Path, rpc: RPC) -> None:
    """As text, as RPB and as GDAL's metadata; only offsets lose half a pixel's last bits."""
    write_rpc_txt(rpc, tmp_path / "a_RPC.TXT")
    write_rpb(rpc, tmp_path / "a.RPB")
    again = read_rpc_text(tmp_path / "a_RPC.TXT"), read_rpc_text(tmp_path / "a.RPB"), rpc_of_fields(rpc_metadata(rpc))
    for copy in again:
        there, here = copy.to_dict(), rpc.to_dict()
        for name in ("col_off", "row_off"):
            # Half a pixel is taken away and added again: half of the last bit of numbers up to a pixel.
            assert there.pop(name) == pytest.approx(here.pop(name), rel=0, abs=1.2e-16)
        assert there == here


@given(model=rpcs(), columns=st.floats(-1e5, 1e5), rows=st.floats(-1e5, 1e5), factor=st.floats(0.1, 16.0))
def test_crop_and_scale_of_an_rpc(model: RPC, columns: float, rows: float, factor: float) -> None:
    ground = inner_ground(model, 20, 0)
    image = model.ground_to_image(ground)
    np.testing.assert_allclose(model.shifted(columns, rows).ground_to_image(ground), image - (columns, rows), atol=1e-9)
    np.testing.assert_allclose(model.scaled(factor).ground_to_image(ground), image / factor, rtol=1e-12, atol=1e-8)


# -- fits ------------------------------------------------------------------------------------------------------------


@EVERY_KIND
@given(data=st.data())
@settings(max_examples=3)
def test_a_fit_does_not_depend_on_the_order_of_points(kind: type[SensorModel], data: st.DataObject) -> None:
    model = data.draw(MODELS[kind]())
    points = seen(model, 60, data.draw(SEEDS), noise=0.3)
    order = np.random.default_rng(data.draw(SEEDS)).permutation(len(points))
    try:
        first = fit(model, points)
    except DegeneratePoints:
        # Random rational functions of high order are not determined by 60 points.
        with pytest.raises(DegeneratePoints):
            fit(model, points.select(order))
        return
    second = fit(model, points.select(order))
    assert {found["id"] for found in first.to_json()["rejected"]} == {f["id"] for f in second.to_json()["rejected"]}
    # A thousandth of a pixel of 0.3 px noise: parameters that hardly differ in effect may differ more.
    np.testing.assert_allclose(second.residuals, first.residuals[order], rtol=0, atol=3e-4)


#: The classical models but those whose regularisation counts terms in normalised units.
CLOSED = [family.name for family in families() if not family.regularised]


@given(name=st.sampled_from(CLOSED), seed=SEEDS, factor=st.floats(0.05, 20.0))
@settings(max_examples=30)
def test_a_fit_goes_along_with_ground_and_image(name: str, seed: int, factor: float) -> None:
    """Another origin of the ground, a crop of the image and another size of its pixels change no residual."""
    random = np.random.default_rng(seed)
    ground = np.column_stack(
        [random.uniform(4e5, 43e4, 60), random.uniform(50e5, 503e4, 60), random.uniform(0, 1500, 60)]
    )
    truth = (ground - (415e3, 5015e3, 700)) @ np.array([[0.3, 0.02], [0.01, -0.3], [0.1, 0.05]]) + 5000
    points = Points(
        ids=tuple(f"p{k}" for k in range(60)), image=truth + random.normal(0, 0.5, (60, 2)), ground=ground,
        roles=np.full(60, "control"), sigma_image=np.full(60, 0.5), sigma_ground=np.zeros((60, 3)),
        crs=pyproj.CRS(32633), source="drawn",
    )  # fmt: skip
    shift = np.append(random.uniform(-3e5, 3e5, 2), random.uniform(-500, 5000))
    crop = random.uniform(-1e4, 1e4, 2)
    moved = Points(
        **{**vars(points), "ground": ground + shift, "image": (points.image - crop) / factor,
           "sigma_image": points.sigma_image / factor}
    )  # fmt: skip
    here, there = fit_family(name, points, robust=False), fit_family(name, moved, robust=False)
    assert family_of(here.model.family) == family_of(there.model.family)
    np.testing.assert_allclose(there.residuals * factor, here.residuals, rtol=0, atol=1e-6)


@given(
    model=corrections(), columns=st.integers(-5000, 5000), rows=st.integers(-5000, 5000), factor=st.floats(0.25, 8.0)
)
def test_a_correction_goes_along_with_crop_and_scale(model: Any, columns: int, rows: int, factor: float) -> None:
    points = seen(model, 30, 1, noise=0.5)
    here = fit(ImageCorrection.identity(model.model, model.correction, model.origin), points, robust=False)
    place = tuple((np.array(model.origin) - (columns, rows)) / factor)
    rpc = model.model.shifted(columns, rows).scaled(factor)
    moved = Points(
        **{
            **vars(points),
            "image": (points.image - (columns, rows)) / factor,
            "sigma_image": points.sigma_image / factor,
        }
    )
    there = fit(ImageCorrection.identity(rpc, model.correction, place), moved, robust=False)
    np.testing.assert_allclose(there.residuals * factor, here.residuals, rtol=0, atol=1e-6)


# -- the warp --------------------------------------------------------------------------------------------------------


@given(
    tile=st.integers(1, 6), memory=st.integers(400_000, 100_000_000), threads=st.integers(1, 4),
    kernel=st.sampled_from(["nearest", "bilinear", "cubic", "lanczos"]),
)  # fmt: skip
@settings(max_examples=4)
def test_an_ortho_depends_on_no_tiles_memory_or_threads(
    tiny: Any, tile: int, memory: int, threads: int, kernel: str
) -> None:
    from osgeo import gdal

    source, surface = RasterSource(tiny.image), open_dem(tiny.dem, "ellipsoid")
    utm = pyproj.CRS(32734)
    centre = pyproj.Transformer.from_crs(4326, utm, always_xy=True).transform(tiny.model.lon_off, tiny.model.lat_off)
    grid = Grid.of_extent(utm, (centre[0] - 900, centre[1] - 700, centre[0] + 900, centre[1] + 700), (4.8, 4.8))
    found = []
    for blocks, given_memory, given_threads in ((4, 512_000_000, 1), (tile, memory, threads)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(warp, "TILE", blocks * warp.BLOCK)
            path = tiny.folder / "ortho.tif"
            rectify(
                tiny.model, source, surface, grid, path, resampling=kernel, driver="GTiff",
                resources=Resources(memory=given_memory, threads=given_threads),
            )  # fmt: skip
        found.append(gdal.Open(str(path)).ReadAsArray())
    assert found[0].any()
    np.testing.assert_array_equal(*found)
