"""Rasters on other machines: how often is asked, what is read, and that it is what files on this one would give."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from servers import PublicFolder, serving

from ortho_pipeline.commands import check, rectify
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.models import RPC
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.caching.read_ahead import ReadAhead, read_ahead
from ortho_pipeline.raster.source import RasterSource

gdal.UseExceptions()
SIDE = 1500
OUTPUT = OutputOptions(format="GTiff")


@pytest.fixture(scope="module")
def bucket(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that is served, with the noise of a scene in tiles that are stored as they are, and a DEM."""
    folder = tmp_path_factory.mktemp("far") / "bucket"
    folder.mkdir()
    return folder


@pytest.fixture
def scene(bucket: Path, tiny: Any) -> Path:
    path = bucket / "scene.tif"
    if not path.exists():
        write_scene(path, tiny.model, SIDE)
        (bucket / "dem.tif").write_bytes(tiny.dem.read_bytes())
    return path


def write_scene(path: Path, model: RPC, side: int) -> None:
    """Write the noise of a scene in tiles, with a model of that size."""
    half = side / 2
    sized = model._replace(col_off=half, row_off=half, col_scale=half, row_scale=half)
    options = ["TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256"]
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), side, side, 1, gdal.GDT_UInt16, options)
    dataset.SetMetadata(rpc_metadata(sized), "RPC")
    dataset.WriteArray(np.random.default_rng(1).integers(0, 4000, (side, side), dtype=np.uint16))


def made(where: str, folder: Path, output: OutputOptions = OUTPUT) -> Any:
    given = SurfaceOptions(dem=f"{where}/dem.tif", vertical="ellipsoid")
    return rectify(f"{where}/scene.tif", folder, scene=SceneOptions(allow_network=True), surface=given, output=output)


def at_s3(public: PublicFolder, monkeypatch: pytest.MonkeyPatch) -> str:
    """Let GDAL find S3 in a served folder; return the address of its bucket."""
    monkeypatch.setenv("AWS_S3_ENDPOINT", public.address.removeprefix("http://"))
    for name, value in {"AWS_HTTPS": "NO", "AWS_VIRTUAL_HOSTING": "FALSE", "AWS_NO_SIGN_REQUEST": "YES"}.items():
        monkeypatch.setenv(name, value)
    return "s3://bucket"


@pytest.mark.parametrize("kind", ["http", "s3"])
def test_an_ortho_of_far_files_waits_for_few_answers_and_reads_no_byte_twice(
    kind: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Side-cars are asked for at once (GDAL has fifty names, one by one), and windows read before their turn."""
    local = made(str(scene.parent), tmp_path / "local")
    with serving(scene.parent.parent, delay=0.04) as public:
        where = at_s3(public, monkeypatch) if kind == "s3" else f"{public.address}/bucket"
        far = made(where, tmp_path / "far")
    np.testing.assert_array_equal(
        gdal.Open(str(far.files["ortho"])).ReadAsArray(), gdal.Open(str(local.files["ortho"])).ReadAsArray()
    )
    both = scene.stat().st_size + (scene.parent / "dem.tif").stat().st_size
    assert public.sent < 1.05 * both, "GDAL reads headers in pieces of 16 kB"
    assert public.rounds < 25, "it was beyond 100 by HTTP, and 20 windows one after the other"
    assert far.document["report"]["provenance"]["network_bytes"] == pytest.approx(public.sent, rel=0.01), (
        "GDAL 3.13 does not count headers, which it reads first"
    )
    assert "network" in far.summary
    assert local.document["report"]["provenance"]["network_bytes"] is None


def test_bytes_are_counted_though_others_asked_gdal_first(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GDAL decides at the first request of a process whether it counts."""
    monkeypatch.delenv("CPL_VSIL_NETWORK_STATS_ENABLED", raising=False)
    gdal.NetworkStatsReset()
    with serving(scene.parent.parent) as public:
        gdal.Open(f"/vsicurl/{public.address}/bucket/dem.tif").ReadAsArray()
        sent = public.sent
        far = made(f"{public.address}/bucket", tmp_path / "far")
    counted = far.document["report"]["provenance"]["network_bytes"]
    assert counted == pytest.approx(public.sent - sent, rel=0.01)


def share_read(folder: Path, tmp_path: Path) -> float:
    """Make an ortho of a twentieth of a scene that is served; return the share of its bytes that was read."""
    place = {"scene": SceneOptions(), "surface": SurfaceOptions(dem=folder / "dem.tif", vertical="ellipsoid")}
    xmin, ymin, xmax, ymax = check(folder / "scene.tif", **place)["grid"]["extent"]
    x, y, side = xmin + 0.4 * (xmax - xmin), ymin + 0.4 * (ymax - ymin), 0.05**0.5
    extent = (x, y, x + side * (xmax - xmin), y + side * (ymax - ymin))
    with serving(folder.parent) as public:
        made(f"{public.address}/{folder.name}", tmp_path / "far", OutputOptions(format="GTiff", extent=extent))
    return public.sent / (folder / "scene.tif").stat().st_size


def test_a_crop_reads_its_share(scene: Path, tmp_path: Path) -> None:
    # 335 pixels of 1500, with what the kernel needs next to them, lie on three tiles of 256 at most in each direction:
    # 9 of 36, a header and the DEM.
    assert share_read(scene.parent, tmp_path) < 9.5 / 36 + 0.01


@pytest.mark.slow
def test_a_crop_of_a_large_cog_reads_a_twelfth_at_most(tiny: Any, tmp_path: Path) -> None:
    folder = tmp_path / "bucket"
    folder.mkdir()
    write_scene(tmp_path / "plain.tif", tiny.model, 12_000)
    gdal.Translate(
        str(folder / "scene.tif"), str(tmp_path / "plain.tif"), format="COG", creationOptions=["COMPRESS=LZW"]
    )
    (folder / "dem.tif").write_bytes(tiny.dem.read_bytes())
    share = share_read(folder, tmp_path)
    print(f"{share:.1%} of {(folder / 'scene.tif').stat().st_size / 1e6:.0f} MB")
    assert share < 0.12


def test_windows_are_those_of_the_file_whatever_was_expected(scene: Path) -> None:
    random = np.random.default_rng(5)
    truth = RasterSource(scene)
    with serving(scene.parent) as public:
        far = RasterSource(f"{public.address}/scene.tif", allow_network=True)
        with read_ahead(truth, 1) as near:
            assert near is truth
        # Memory for a few blocks only: what was used goes, and is read again.
        with read_ahead(far, 600_000) as source:
            assert isinstance(source, ReadAhead)
            for _ in range(40):
                left, top = random.integers(0, SIDE - 1, 2).tolist()
                width, height = (int(random.integers(1, min(SIDE - k, 500) + 1)) for k in (left, top))
                if random.random() < 0.7:
                    source.expect(left, top, left + width, top + height)
                window = truth.read(left, top, width, height)
                pixels = source.read(left, top, width, height)
                np.testing.assert_array_equal(pixels, window)
                assert source.read_valid(left, top, pixels) is None


def test_masks_are_read_ahead_too(bucket: Path) -> None:
    path = bucket / "masked.tif"
    plain = gdal.GetDriverByName("GTiff").Create(str(path), 300, 200, 2, gdal.GDT_Byte, ["TILED=YES"])
    plain.WriteArray(np.random.default_rng(2).integers(0, 9, (2, 200, 300), dtype=np.uint8))
    plain.GetRasterBand(1).SetNoDataValue(4)
    plain = None
    truth = RasterSource(path)
    with serving(bucket) as public:
        far = RasterSource(f"{public.address}/masked.tif", allow_network=True)
        with read_ahead(far, 10_000_000) as source:
            pixels = source.read(40, 30, 250, 160)
            valid = source.read_valid(40, 30, pixels)
    np.testing.assert_array_equal(valid, truth.read_valid(40, 30, truth.read(40, 30, 250, 160)))


@pytest.mark.parametrize("along", [0, 1])
def test_pixels_are_kept_up_to_the_memory_and_those_used_longest_ago_go(tmp_path: Path, along: int) -> None:
    """Nine blocks in a row, of 256 x 256 pixels of two bytes and a byte of validity each; memory for four."""
    size = [300, 300]
    size[along] = 9 * 256
    options = ["TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256"]
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "row.tif"), *size, 1, gdal.GDT_UInt16, options)
    made.WriteArray(np.random.default_rng(1).integers(0, 4000, size[::-1], dtype=np.uint16))
    made = None
    asked = []

    class Counted(RasterSource):
        def read(self, *window: int) -> Any:
            asked.append(window[along] // 256)
            return super().read(*window)

    truth = RasterSource(tmp_path / "row.tif")
    with ThreadPoolExecutor(1) as pool:
        source = ReadAhead(Counted(tmp_path / "row.tif"), 4 * 256 * 256 * 3, pool)
        for number in (*range(9), 8, 7, 5, 4, 8):
            place = [10, 10]
            place[along] = 256 * number + 20
            np.testing.assert_array_equal(source.read(*place, 50, 60), truth.read(*place, 50, 60))
    assert asked == [*range(9), 4], "5 to 8 were still there"
