"""Files of strangers: nothing outside of their folder is read, nobody is asked, and honest files open as before."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import RasterSource, open_dataset
from ortho_pipeline.raster.valid_area import valid_outline
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.warp.mosaic import Ortho, lay_out

sys.path.insert(0, str(Path(__file__).parent))
import hostile
from traps import Trap, listening, trapped

POINTS = ["--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]


@pytest.fixture(scope="module")
def trap(tmp_path_factory) -> Iterator[Trap]:
    yield from trapped(tmp_path_factory)


def test_there_are_enough_of_them_and_they_bite(trap):
    """Without the gate most of them lead GDAL to the secret or to the server."""
    assert len(trap.rasters) >= 60
    bitten = 0
    with contextlib.redirect_stderr(None):
        for path in trap.rasters.values():
            before = len(trap.asked)
            try:
                seen = (hostile.pixels(gdal.OpenEx(str(path), gdal.OF_RASTER)) == hostile.SECRET).any()
            except RuntimeError:
                seen = False
            bitten += bool(seen or len(trap.asked) > before)
    trap.asked.clear()
    gdal.VSICurlClearCache()
    assert bitten >= 40


@pytest.mark.parametrize("name", hostile.RECIPES)
def test_nothing_outside_is_read_and_nobody_is_asked(trap, name):
    if name not in trap.rasters:
        pytest.skip("this GDAL cannot write such a file")
    for path in (trap.rasters[name], trap.pipes[name]):
        refused, values = None, np.zeros(0)
        try:
            values = hostile.pixels(open_dataset(path))
        except InputError as error:
            refused = error
        # What GDAL does not follow either is harmless.
        assert not (values == hostile.SECRET).any()
        assert refused is None or (refused.file and refused.remedy)
    assert not trap.asked
    assert not trap.readers


@pytest.mark.parametrize(
    "name",
    ["vrt-tag-sourcefilename", "vrt-warped-lower", "side-vrt.msk", "side-wms.ovr", "tag-overview", "dimap-parent"],
)
def test_every_way_in_leads_through_the_gate(trap, tiny, tmp_path, name):
    path = trap.pipes[name]
    ways = (
        lambda: RasterSource(path),
        lambda: RasterSource(tiny.image, path),
        lambda: open_dem(path, "ellipsoid"),
        lambda: lay_out([Ortho("a", Path(path))]),
        lambda: valid_outline(Path(path)),
    )
    for way in ways:
        with pytest.raises(InputError):
            way()
    out = ["-o", tmp_path / "out"]
    for words in (
        ["info", path],
        ["rectify", path, "--height", "500", *out],
        ["rectify", tiny.image, "--dem", path, "--dem-vertical", "ellipsoid", *out],
        ["fit", path, "--gcps", tiny.gcps, *POINTS],
        ["info", tiny.image, "--rpc", path],
    ):
        done = CliRunner().invoke(cli, [str(word) for word in words])
        assert done.exit_code == 2, done.output
        assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
    assert not trap.asked
    assert not trap.readers


CLOSED = """
import sys
from ortho_pipeline.cli import program as cli
from ortho_pipeline.files.locations import located
sys.argv = ["ortho", "models"]
try:
    cli.main()
except SystemExit:
    pass
from ortho_pipeline.raster.source import gdal, open_dataset
url, image = {url!r}, {image!r}
open_dataset(image)
wms = "<GDAL_WMS><Service name='TMS'><ServerUrl>" + url + "/${{z}}</ServerUrl></Service><DataWindow><SizeX>64</SizeX>" \
    "<SizeY>64</SizeY></DataWindow></GDAL_WMS>"
for name in ("/vsicurl/" + url, "/vsicurl_streaming/" + url, "/vsicurl?url=" + url, url, "WMS:" + url, wms):
    for act in (gdal.Open, gdal.VSIStatL, gdal.ReadDir):
        try:
            opened = act(name)
            if act is gdal.Open:
                opened.GetRasterBand(1).Checksum()
        except (RuntimeError, AttributeError):
            pass
if {allowed}:
    try:
        open_dataset(url, allow_network=True)
    except Exception as error:
        print(type(error).__name__)
"""


@pytest.mark.parametrize("allowed", [False, True])
def test_the_process_of_a_command_is_kept_from_the_network(tmp_path, allowed):
    """Even GDAL itself, asked by name: no connection is made, until the user has allowed the network."""
    image = hostile.raster(tmp_path / "a.tif")
    with listening() as (url, asked):
        code = CLOSED.format(url=url, image=str(image), allowed=allowed)
        # GDAL itself must not be told by the surroundings to go without a proxy.
        surroundings = {**os.environ, "NO_PROXY": "127.0.0.1", "no_proxy": "127.0.0.1"}
        done = subprocess.run(
            [sys.executable, "-c", code], check=False, env=surroundings, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        assert bool(asked) == allowed, (asked, done.stdout, done.stderr)


# -- honest files ----------------------------------------------------------------------------------------------------


def only(path: Path | str, value: int = hostile.HARMLESS, **access: Any) -> gdal.Dataset:
    dataset = open_dataset(path, **access)
    assert set(np.unique(dataset.ReadAsArray())) == {value}
    return dataset


def test_views_of_files_beside_them_open(tmp_path):
    sub = tmp_path / "sub"
    sub.mkdir()
    files = [hostile.raster(tmp_path / "a b.tif"), hostile.raster(sub / "ä.tif")]
    for file in files:
        # To be mosaicked they need a georeference.
        dataset = gdal.Open(str(file), gdal.GA_Update)
        dataset.SetGeoTransform((5e5, 1.0, 0.0, 4e6, 0.0, -1.0))
        dataset.GetRasterBand(1).SetNoDataValue(0)
        dataset = None
    made = gdal.BuildVRT(str(tmp_path / "m.vrt"), [str(file) for file in files], separate=True)
    made.GetRasterBand(1).SetDescription("one")
    made.GetRasterBand(1).ComputeStatistics(False)
    made = None
    only(tmp_path / "m.vrt")
    translated = gdal.Translate(
        str(tmp_path / "t.vrt"), str(files[0]), format="VRT", scaleParams=[[0, 255, 0, 255]], noData=3, width=32,
        height=32, resampleAlg="average", metadataOptions=["A=http://example.org/x"], outputSRS="EPSG:32635",
    )  # fmt: skip
    translated.BuildOverviews("NEAREST", [2])
    translated = None
    only(tmp_path / "t.vrt")
    (tmp_path / "l.vrt").symlink_to(tmp_path / "m.vrt")
    only(tmp_path / "l.vrt")


@pytest.mark.parametrize(
    "driver", ["GTiff", "HFA", "PNG", "ENVI", "JP2OpenJPEG", "NITF", "PCIDSK", "ERS", "ISIS3", "BMP"]
)
def test_honest_side_cars_are_used(tmp_path, driver):
    if gdal.GetDriverByName(driver) is None:
        pytest.skip("this GDAL cannot write such a file")
    endings = {"GTiff": "tif", "HFA": "img", "PNG": "png", "JP2OpenJPEG": "jp2", "NITF": "ntf", "PCIDSK": "pix",
               "ERS": "ers", "ISIS3": "cub", "BMP": "bmp", "ENVI": "dat"}  # fmt: skip
    options = ["QUALITY=100", "REVERSIBLE=YES"] if driver == "JP2OpenJPEG" else []
    path = hostile.raster(tmp_path / f"a.{endings[driver]}", driver=driver, options=options)
    gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", "NO")
    # A PCIDSK file keeps all of it inside.
    dataset = gdal.Open(str(path), gdal.GA_Update if driver == "PCIDSK" else gdal.GA_ReadOnly)
    dataset.BuildOverviews("NEAREST", [2, 4])
    dataset.GetRasterBand(1).ComputeStatistics(False)
    if driver in ("GTiff", "PNG"):
        dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
        dataset.GetRasterBand(1).GetMaskBand().Fill(255)
    dataset = None
    gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", None)
    opened = only(path)
    assert opened.GetRasterBand(1).GetOverviewCount() == 2
    assert float(opened.GetRasterBand(1).GetMetadataItem("STATISTICS_MEAN")) == hostile.HARMLESS
    if driver in ("GTiff", "PNG"):
        assert opened.GetRasterBand(1).GetMaskFlags() == gdal.GMF_PER_DATASET
    linked = tmp_path / "elsewhere"
    linked.mkdir()
    (linked / path.name).symlink_to(path)
    if driver in ("GTiff", "PNG"):
        only(linked / path.name)


def test_files_that_hfa_and_isis3_split_open(tmp_path):
    if gdal.GetDriverByName("HFA") is not None:
        path = hostile.raster(tmp_path / "s.img", driver="HFA", options=["USE_SPILL=YES"])
        gdal.SetConfigOption("HFA_USE_RRD", "YES")
        dataset = gdal.Open(str(path), gdal.GA_Update)
        dataset.BuildOverviews("NEAREST", [2])
        dataset = None
        gdal.SetConfigOption("HFA_USE_RRD", None)
        assert only(path).GetRasterBand(1).GetOverviewCount() == 1
    # Wheels of GDAL are made without some drivers.
    for kind in ("External", "GeoTIFF") if gdal.GetDriverByName("ISIS3") is not None else ():
        only(hostile.raster(tmp_path / f"{kind}.lbl", driver="ISIS3", options=[f"DATA_LOCATION={kind}"]))


@pytest.mark.driver("DIMAP")
def test_products_open_with_their_own_image_also_in_archives(tmp_path):
    product = tmp_path / "product"
    product.mkdir()
    hostile.raster(product / "IMAGERY.TIF")
    (product / "METADATA.DIM").write_text(hostile.DIMAP.format('<DATA_FILE_PATH href="IMAGERY.TIF"/>'))
    only(product / "METADATA.DIM")
    only(product)
    archive = tmp_path / "p.zip"
    with zipfile.ZipFile(archive, "w") as made:
        for file in product.iterdir():
            made.write(file, f"p/{file.name}")
    for name in ("METADATA.DIM", "IMAGERY.TIF"):
        only(f"/vsizip/{archive}/p/{name}")


def test_roots_open_what_they_hold(tmp_path):
    secret = hostile.raster(tmp_path / "secret.tif", 9)
    (tmp_path / "a" / "b").mkdir(parents=True)
    path = hostile.vrt(tmp_path / "a" / "b" / "a.vrt", hostile.source(f"../../{secret.name}", relative=1))
    with pytest.raises(InputError, match=f"`scene.roots={tmp_path}"):
        open_dataset(path)
    only(path, 9, roots=[tmp_path])


# -- runs with a mosaic ----------------------------------------------------------------------------------------------

RUN = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {crs: "EPSG:32734", resolution: 20}
scenes:
  - images: raw/*.tif
mosaic: {format: COG, order: first-on-top}
"""


def plant(image: Path, kind: str, secret: Path, url: str) -> None:
    """Put a side-car next to an image that leads to a secret and to a server."""
    if kind == ".aux.xml":
        Path(f"{image}.aux.xml").write_text(
            f'<PAMDataset><Metadata domain="overviews"><MDI key="OVERVIEW_FILE">{secret}</MDI></Metadata></PAMDataset>'
        )
    elif kind == ".ovr":
        hostile.wms(Path(f"{image}.ovr"), url)
    else:
        hostile.vrt(Path(f"{image}.msk"), hostile.source(str(secret), tag="sourcefilename"))


def test_a_run_with_a_mosaic_reads_nothing_outside(trap, tiny, tmp_path):
    """Hostile files beside scenes, then next to the orthos of an earlier run that the mosaic is made of."""
    secret = Path(trap.pipes["vrt-absolute"]).parents[2] / "secret.tif"
    raw = tmp_path / "raw"
    raw.mkdir()
    (tmp_path / "dem.tif").write_bytes(tiny.dem.read_bytes())
    (tmp_path / "p.yaml").write_text(RUN)
    kinds = (".msk", ".ovr", ".aux.xml")
    for name in "abc":
        (raw / f"{name}.tif").write_bytes(tiny.image.read_bytes())

    def run(*more: str) -> tuple[int, str]:
        done = CliRunner().invoke(cli, ["run", str(tmp_path / "p.yaml"), "--executor", "sequential", *more])
        return done.exit_code, done.output

    assert run()[0] == 0
    mosaic = tmp_path / "out" / "mosaic.tif"
    honest = open_dataset(mosaic).ReadAsArray()
    for name, kind in zip("abc", kinds, strict=True):
        ortho = tmp_path / "out" / name / f"{name}_ortho.tif"
        plant(ortho, kind, secret, trap.url)
        mosaic.unlink(missing_ok=True)
        code, said = run()
        assert code == 3, said
        assert ortho.name in said
        assert "Remedy" in said
        assert not mosaic.exists()
        Path(f"{ortho}{kind}").unlink(missing_ok=True)
    assert run()[0] == 0
    np.testing.assert_array_equal(open_dataset(mosaic).ReadAsArray(), honest)
    for name, kind in zip("ab", kinds, strict=False):
        plant(raw / f"{name}.tif", kind, secret, trap.url)
    code, said = run()
    assert code == 3, said
    assert not trap.asked
    assert not trap.readers
