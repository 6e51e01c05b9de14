"""Every command that a remedy names runs: each error is caused, its remedy read, and the command in it pasted.

`tools/product_text.py` lists the commands in the texts of the product. One that has neither a case nor a reason here
fails. Examples of help pages and the next steps of `ortho info` have tests of their own (test_examples.py,
test_first_use.py), and so have the commands that a crop offers (tests/commands/test_crops.py).
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import product_text
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import commands, open_dem, open_scene
from ortho_pipeline.batch.config import read_config
from ortho_pipeline.batch.plan import plan
from ortho_pipeline.batch.runner import run as run_pipeline
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.orthos.aligning import align
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.commands.sharpening.registration import Agreement, displaced
from ortho_pipeline.commands.sharpening.sharpen import sharpen
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.opening import gate
from ortho_pipeline.raster.regridded import grid_of, warped_bounds
from ortho_pipeline.raster.source import RasterSource, open_dataset, open_pixels
from ortho_pipeline.raster.valid_area import doubtful_alpha
from ortho_pipeline.warp.mosaic.layout import Mosaic, Ortho, lay_out

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_data"
BOX = {"WEST": "530000", "NORTH": "4124000", "EAST": "534000", "SOUTH": "4120000"}

#: Room and beginning of a command that has no case, and why.
WITHOUT = {
    ("errors", "pip install"): "needs the network",
    ("ortho_measure", "pip install"): "needs the network",
    ("points", "pip install"): "needs the network",
    ("commands", "ortho measure"): "serves a page until somebody stops it",
    ("report", "ortho measure"): "serves a page until somebody stops it",
    ("points", "ortho measure"): "serves a page until somebody stops it",
    ("commands", "ortho doctor --fetch-grids"): "needs the network",
    ("geodesy", "pyproj sync"): "needs the network",
    ("geodesy", "projsync"): "needs the network",
    ("raster", "gdal_translate"): "needs a GDAL with the driver that this one lacks",
    ("surface", "gdalwarp -r bilinear -dstnodata -9999 FILES"): "the files of a catalogue",
    ("batch", "ortho run"): "names the command that has the lock, and the schema of its file",
}  # fmt: skip


class Printed:
    """Texts that an error or a command printed, and the command in them."""

    def __init__(self, beginning: str, folder: Path) -> None:
        self.beginning, self.folder, self.pasted = beginning, folder, 0

    def paste(self, text: object, *more: str, **values: str) -> str:
        """Run the command in a text; return its output.

        `values` takes the place of words in capitals, and `more` are files for a command that names none.
        """
        beginning = self.beginning.partition(f" {product_text.VALUE}")[0]
        (line,) = {one for one in product_text.commands(str(text)) if one.startswith(beginning)}
        words = shlex.split(line)
        for name, value in values.items():
            assert any(name in word for word in words), f"no {name} in {line}"
            words = [word.replace(name, value) for word in words]
        words += more
        assert not [word for word in words if word.isupper() and word.isalpha()], f"{line}: not filled in"
        self.pasted += 1
        if words[0] == "ortho":
            done = CliRunner().invoke(cli, words[1:], prog_name="ortho")
            assert done.exit_code == 0, (line, done.output)
            return done.output
        typed = shlex.join(words) if shlex.join(words) != line and (more or values) else line
        ended = subprocess.run(
            typed, shell=True, cwd=self.folder, capture_output=True, text=True, check=False,
            env={**os.environ, "PATH": f"{os.environ['PATH']}:/usr/bin"},
        )  # fmt: skip
        assert ended.returncode == 0, (typed, ended.stderr)
        return ended.stdout


def driver(name: str) -> gdal.Driver:
    """Return a driver of GDAL; where this GDAL lacks it, the case is skipped."""
    found = gdal.GetDriverByName(name)
    if found is None:
        pytest.skip(f"this GDAL has no driver {name}")
    return found


Case = Callable[[Printed, Path], None]
CASES: dict[tuple[str, str], Case] = {}


def case(room: str, beginning: str) -> Callable[[Case], Case]:
    """Register the case of a command: it causes the error, pastes the command, and tests what that is for."""

    def register(function: Case) -> Case:
        CASES[room, beginning] = function
        return function

    return register


def refused(action: Callable[..., Any], *args: Any, **named: Any) -> str:
    """Return the remedy of the error that a call ends with."""
    with pytest.raises(InputError) as caught:
        action(*args, **named)
    assert caught.value.remedy
    return str(caught.value.remedy)


def ortho(*words: str) -> str:
    """Return what a command prints that the user can correct."""
    done = CliRunner().invoke(cli, list(words), prog_name="ortho")
    assert done.exit_code == 2, done.output
    return done.output


# -- the table -------------------------------------------------------------------------------------------------------


def told() -> list[tuple[str, str, str]]:
    """Return the commands that texts tell people to run: room, command and file."""
    return sorted({(one.room, command, one.path) for one in product_text.shown(ROOT) for command in one.commands()})


def keys_of(room: str, command: str) -> list[tuple[str, str]]:
    """Return the cases and reasons of a command: those with the longest beginning."""
    fitting = [key for key in (*CASES, *WITHOUT) if key[0] == room and command.startswith(key[1])]
    longest = max((len(key[1]) for key in fitting), default=0)
    return [key for key in fitting if len(key[1]) == longest]


def test_every_command_that_is_told_has_a_case() -> None:
    without = [(path, command) for room, command, path in told() if len(keys_of(room, command)) != 1]
    assert not without, f"these files tell people to run commands: write their cases. {without}"


def test_every_case_is_of_a_command_that_is_told() -> None:
    used = {key for room, command, _ in told() for key in keys_of(room, command)}
    assert {*CASES, *WITHOUT} == used
    assert not set(CASES) & set(WITHOUT)


def run_case(room: str, beginning: str, folder: Path) -> None:
    program = beginning.split(maxsplit=1)[0]
    if program != "ortho" and shutil.which(program, path=f"{os.environ['PATH']}:/usr/bin") is None:
        pytest.skip(f"{program} is not installed")
    printed = Printed(beginning, folder)
    CASES[room, beginning](printed, folder)
    assert printed.pasted


# -- files that cause the errors --------------------------------------------------------------------------------------


def tiff(path: Path, pixels: np.ndarray, *options: str, dem: bool = False) -> Path:
    """Write a GeoTIFF of 20 m pixels around the sample; a DEM has a place and is metres above the ellipsoid."""
    kind = gdal.GetDriverByName("GTiff")
    types = {"u1": gdal.GDT_Byte, "u8": 12, "f4": gdal.GDT_Float32, "c8": gdal.GDT_CFloat32}
    dataset = kind.Create(str(path), pixels.shape[1], pixels.shape[0], 1, types[pixels.dtype.str[1:]], list(options))
    if dem:
        dataset.SetGeoTransform((530000.0, 20.0, 0.0, 4124000.0, 0.0, -20.0))
        dataset.SetProjection("EPSG:32636")
    dataset.GetRasterBand(1).WriteArray(pixels)
    dataset.FlushCache()
    return path


def heights(value: float = 900.0, size: int = 200) -> np.ndarray:
    return np.full((size, size), value, np.float32)


def vrt(path: Path, source: str, extra: str = "", function: str = "") -> Path:
    """Write a VRT of a raster of 200 by 200 bytes; with a function of pixels it is none that is opened."""
    band = ' subClass="VRTDerivedRasterBand"' if function else ""
    name = f"<PixelFunctionType>{function}</PixelFunctionType>" if function else ""
    path.write_text(
        f'<VRTDataset rasterXSize="200" rasterYSize="200">{extra}<VRTRasterBand dataType="Byte" band="1"{band}>{name}'
        f'<SimpleSource><SourceFilename relativeToVRT="1">{source}</SourceFilename><SourceBand>1</SourceBand>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    return path


GREY = np.arange(40_000, dtype=np.uint8).reshape(200, 200)


# -- rasters ---------------------------------------------------------------------------------------------------------


@case("raster", "gdal_translate -co TILED=YES")
def _tiles(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "a strip.tif", np.zeros((2000, 2000), np.uint8), "BLOCKYSIZE=2000", "COMPRESS=DEFLATE")
    printed.paste(refused(open_pixels, path, memory=1_000_000))
    open_pixels(folder / "a strip_tiled.tif", memory=1_000_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ortho_pipeline.raster.source.MAX_BLOCK", 1_000_000)
        printed.paste(refused(open_dataset, path))
        open_dataset(folder / "a strip_tiled.tif")


@case("raster", "gdal_translate -colorinterp")
def _alpha_of_data(printed: Printed, folder: Path) -> None:
    path = folder / "near infrared.tif"
    made = gdal.GetDriverByName("GTiff").Create(str(path), 40, 40, 4)
    made.WriteArray(np.arange(6400).reshape(4, 40, 40) % 200)
    del made
    (notice,) = doubtful_alpha(gdal.Open(str(path)))
    printed.paste(notice)
    source = RasterSource(folder / "near infrared_bands.tif")
    assert (source.count, source.validity) == (4, "all")
    assert doubtful_alpha(source.dataset) == []


@case("raster", "gdal_calc.py -A")
def _signed(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "signed.tif", np.full((4, 4), 255, np.uint8), "PIXELTYPE=SIGNEDBYTE")
    if int(gdal.VersionInfo()) >= 3_070_000:
        pytest.skip("this GDAL has a type for signed bytes")
    printed.paste(refused(RasterSource, path))
    assert (RasterSource(folder / "int16.tif").read(0, 0, 4, 4) == -1).all()


@case("raster", "gdal_translate X dataset.tif")
def _within_a_file(printed: Printed, folder: Path) -> None:
    tiff(folder / "two.tif", GREY)
    gdal.Translate(
        str(folder / "two.tif"), str(tiff(folder / "next.tif", GREY + 1)), creationOptions=["APPEND_SUBDATASET=YES"]
    )
    printed.paste(refused(open_dataset, "GTIFF_DIR:2:two.tif"))
    assert (open_dataset(folder / "dataset.tif").ReadAsArray() == GREY + 1).all()


@case("raster", "gdal_translate X")
def _one_file(printed: Printed, folder: Path) -> None:
    beside, below = tiff(folder / "grey.tif", GREY), folder / "below"
    below.mkdir()
    headers = [
        vrt(below / "outside.vrt", "../grey.tif"),
        vrt(folder / "long.vrt", beside.name, "<Metadata>" + "<MDI key='a'>b</MDI>" * 300_000 + "</Metadata>"),
        vrt(folder / "derived.vrt", beside.name, function="real"),
    ]
    driver("GIF").CreateCopy(str(folder / "grey.gif"), gdal.Open(str(beside)))
    headers.append(vrt(folder / "odd.vrt", "grey.gif"))
    for path in headers:
        copy = folder / f"{'grey' if path.stem == 'odd' else path.stem}_copy.tif"
        printed.paste(refused(open_dataset, path))
        assert (open_dataset(copy).ReadAsArray() == GREY).all(), path
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gate, "_MANY", 0)
        printed.paste(refused(open_dataset, vrt(folder / "many.vrt", beside.name)))
        open_dataset(folder / "many_copy.tif")
    for name, data in (("PCIDSK", "pix"), ("ISIS3", "lbl")):
        if gdal.GetDriverByName(name) is not None:
            option = "INTERLEAVING=FILE" if name == "PCIDSK" else "DATA_LOCATION=EXTERNAL"
            path = folder / f"other.{data}"
            made = gdal.GetDriverByName(name).CreateCopy(str(path), gdal.Open(str(beside)), options=[option])
            made.FlushCache()
            del made
            if name == "ISIS3":  # a label of six megabytes
                text = path.read_text()
                path.write_text(text.replace("\nEnd\n", "\n" + "# comment\n" * 600_000 + "\nEnd\n"))
            printed.paste(refused(open_dataset, path))
            assert (open_dataset(folder / "other_copy.tif").ReadAsArray() == GREY).all(), path
            (folder / "other_copy.tif").unlink()


@case("raster", "gdaladdo -ro")
def _overviews(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "grey.tif", np.zeros((1000, 1000), np.uint8))
    side_car = vrt(folder / "grey.tif.ovr", "grey.tif")
    remedy = refused(open_dataset, path)
    side_car.unlink()  # the first half of the remedy
    printed.paste(remedy)
    assert open_dataset(path).GetRasterBand(1).GetOverviewCount()


@case("raster", "gdalwarp")
def _north_up(printed: Printed, folder: Path) -> None:
    skew = (530000.0, 20.0, 2.0, 4124000.0, 2.0, -20.0)
    south_up, mirrored = (530000.0, 20.0, 0.0, 4120000.0, 0.0, 20.0), (534000.0, -20.0, 0.0, 4124000.0, 0.0, -20.0)
    for number, numbers in enumerate((skew, south_up, mirrored)):
        path = tiff(folder / f"turned{number}.tif", GREY, dem=True)
        dataset = gdal.Open(str(path), gdal.GA_Update)
        dataset.SetGeoTransform(numbers)
        dataset.FlushCache()
        del dataset
        printed.paste(refused(grid_of, path))
        assert grid_of(folder / f"turned{number}_north_up.tif").width >= 200


@case("raster", "gdal_edit.py -a_srs")
def _stated_crs(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "grey.tif", GREY)
    gdal.Open(str(path), gdal.GA_Update).SetGeoTransform((530000.0, 20.0, 0.0, 4124000.0, 0.0, -20.0))
    printed.paste(refused(grid_of, path), CRS="EPSG:32636")
    assert grid_of(path).crs.to_epsg() == 32636


@case("raster", "gdal_edit.py -a_ullr")
def _finite(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "grey.tif", GREY)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.SetGeoTransform((530000.0, float("inf"), 0.0, 4124000.0, 0.0, -20.0))
    dataset.FlushCache()
    del dataset
    printed.paste(refused(open_dataset, path), **BOX)
    assert open_dataset(path).GetGeoTransform()[:2] == (530000.0, 20.0)


@case("raster", "ortho doctor")
def _formats(printed: Printed, folder: Path) -> None:
    (folder / "text.tif").write_text("no raster")
    assert "GTiff" in printed.paste(refused(open_dataset, folder / "text.tif"))


@case("host", "ortho compare")
def _without_a_model(printed: Printed, folder: Path) -> None:
    bare = tiff(folder / "bare.tif", np.zeros((1000, 1000), np.uint8))
    said = printed.paste(
        refused(open_scene, bare),
        str(bare), "--gcps", str(SAMPLE / "gcps.geojson"), "--dem", str(SAMPLE / "dem.tif"), "--models", "affine3d,dlt",
    )  # fmt: skip
    assert "Recommended: " in said


# -- heights ---------------------------------------------------------------------------------------------------------


@case("surface", "gdal_edit.py")
def _dem_place(printed: Printed, folder: Path) -> None:
    bare = tiff(folder / "bare.tif", heights())
    printed.paste(refused(open_dem, bare, "ellipsoid"), CODE="32636")
    printed.paste(refused(open_dem, bare, "ellipsoid"), **BOX)
    assert open_dem(bare, "ellipsoid").heights([[532000.0, 4122000.0]], "EPSG:32636") == 900.0
    unknown = tiff(folder / "unknown.tif", heights(), dem=True)
    for wkt, transform in (
        ('LOCAL_CS["somewhere",UNIT["metre",1]]', None),
        (None, (530000.0, 0.0, 0.0, 4124000.0, 0.0, 0.0)),
        (None, (530000.0, 1e-6, 0.0, 4124000.0, 0.0, -1e-6)),
    ):
        dataset = gdal.Open(str(unknown), gdal.GA_Update)
        if wkt:
            dataset.SetProjection(wkt)
        if transform:
            dataset.SetGeoTransform(transform)
        dataset.FlushCache()
        del dataset
        printed.paste(refused(open_dem, unknown, "ellipsoid"), **({"CODE": "32636"} if wkt else BOX))
        assert open_dem(unknown, "ellipsoid").heights([[532000.0, 4122000.0]], "EPSG:32636") == 900.0


@case("surface", "gdal_translate -ot Float32")
def _real_part(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "dem.tif", heights().astype(np.complex64) + np.complex64(5j), dem=True)
    printed.paste(refused(open_dem, path, "ellipsoid"))
    assert open_dem(folder / "dem_real.tif", "ellipsoid").height_range == (900.0, 900.0)


@case("surface", "gdalwarp -r bilinear -dstnodata -9999")
def _one_grid(printed: Printed, folder: Path) -> None:
    cells = folder / "my cells"
    cells.mkdir()
    for name, east in (("a", 0.0), ("b", 4007.0)):  # not on one grid
        path = tiff(cells / f"{name}.tif", heights(), dem=True)
        dataset = gdal.Open(str(path), gdal.GA_Update)
        dataset.SetGeoTransform((530000.0 + east, 20.0, 0.0, 4124000.0 - east, 0.0, -20.0))
        dataset.FlushCache()
        del dataset
    printed.paste(refused(open_dem, f"{cells}/*.tif", "ellipsoid"))
    dem = open_dem(folder / "dem.tif", "ellipsoid", fill="mask")
    # Heights of both, and none in the gap between them.
    places = [[532000.0, 4122000.0], [536000.0, 4118000.0], [536000.0, 4122000.0]]
    assert dem.heights(places, "EPSG:32636")[:2].tolist() == [900.0, 900.0]
    assert np.isnan(dem.heights(places, "EPSG:32636")[2])


@case("geodesy", "gdal_edit.py -units m")
def _unit(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "dem.tif", heights(), dem=True)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.SetProjection("EPSG:32636+5773")
    dataset.GetRasterBand(1).SetUnitType("ft")
    dataset.FlushCache()
    del dataset
    printed.paste(refused(open_dem, path), FILE="dem.tif")
    assert open_dem(path).height_range[0] > 800.0
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.GetRasterBand(1).SetUnitType("metres above the geoid")
    dataset.FlushCache()
    del dataset
    printed.paste(refused(open_dem, path), FILE="dem.tif")
    assert open_dem(path).height_range[0] > 800.0


# -- warp ------------------------------------------------------------------------------------------------------------


def _rectified(folder: Path, image: Path, resampling: str = "bilinear") -> None:
    shutil.copy(SAMPLE / "scene_RPC.TXT", image.with_name(f"{image.stem}_RPC.TXT"))
    output = OutputOptions(resolution=100.0, resampling=resampling)
    commands.rectify(image, folder / "out", surface=SurfaceOptions(height=900.0), output=output, overwrite=True)


@case("warp", "gdal_translate -ot Float64")
def _long_integers(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "long.tif", np.ones((1000, 1000), np.uint64))
    printed.paste(refused(_rectified, folder, path))
    _rectified(folder, folder / "long_float.tif")


@case("warp", "gdal_translate -expand rgb")
def _palette(printed: Printed, folder: Path) -> None:
    path = folder / "palette.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 1000, 1000)
    table = gdal.ColorTable()
    table.SetColorEntry(1, (200, 100, 50))
    dataset.GetRasterBand(1).SetColorTable(table)
    dataset.GetRasterBand(1).Fill(1)
    dataset.FlushCache()
    del dataset
    printed.paste(refused(_rectified, folder, path))
    _rectified(folder, folder / "palette_rgb.tif")


# -- scenes, points and references -----------------------------------------------------------------------------------


@case("host", "gdal_translate")
def _of_several_images(printed: Printed, folder: Path) -> None:
    rpc = gdal.Open(str(SAMPLE / "scene.tif")).GetMetadata("RPC")
    for number, name in enumerate(("a strip.tif", "next.tif")):
        image = gdal.Open(str(tiff(folder / name, GREY + number)), gdal.GA_Update)
        image.SetMetadata(rpc, "RPC")
        del image
    gdal.Translate("a strip.tif", "next.tif", creationOptions=["APPEND_SUBDATASET=YES"])
    (notice,) = [one for one in open_scene("a strip.tif").notices if "images" in one]
    assert notice.startswith("the file has 2 images")
    printed.paste(notice)
    assert (open_dataset("a strip_second.tif").ReadAsArray() == GREY + 1).all()
    assert not [one for one in open_scene("a strip_second.tif").notices if "images" in one]


@case("host", "ortho sensors")
def _sensors(printed: Printed, folder: Path) -> None:
    assert "ikonos" in printed.paste(refused(open_scene, SAMPLE / "scene.tif", "no-such"))
    assert "ikonos" in printed.paste(refused(open_scene, SAMPLE / "scene.tif", options={"no-such": "1"}))


@case("commands", "ortho sensors")
def _installed(printed: Printed, folder: Path) -> None:
    assert "ikonos" in printed.paste(refused(commands.sensor_test, "no-such", None))


@case("commands", "ortho sensors --test")
def _tested(printed: Printed, folder: Path) -> None:
    assert "passes" in printed.paste(refused(commands.sensor_test, "rpc", None), IMAGE=str(SAMPLE / "scene.tif"))
    several = refused(commands.sensor_test, "ortho-pipeline", None).replace("asp", "rpc")
    assert "passes" in printed.paste(several, IMAGE=str(SAMPLE / "scene.tif"))


@case("commands", "ortho info")
def _one_scene_in_a_folder(printed: Printed, folder: Path) -> None:
    (folder / "my photos").mkdir()
    for name in ("scene.tif", "scene_RPC.TXT"):
        (folder / "my photos" / name).symlink_to(SAMPLE / name)
    told = ortho("adjust", "my photos", "--ties", "auto", "--height", "900", "-o", "out")
    assert "1000 x 1000, rpc" in printed.paste(told)


@case("imaging", "ortho info")
def _elsewhere(printed: Printed, folder: Path) -> None:
    far = tiff(folder / "far.tif", GREY, dem=True)
    gdal.Open(str(far), gdal.GA_Update).SetGeoTransform((630000.0, 5.0, 0.0, 4124000.0, 0.0, -5.0))
    (folder / "scene.tif").symlink_to(SAMPLE / "scene.tif")
    (folder / "scene_RPC.TXT").symlink_to(SAMPLE / "scene_RPC.TXT")
    told = ortho("match", "scene.tif", "--reference", "far.tif", "--height", "900", "-o", "m.geojson")
    assert "scene_RPC.TXT" in printed.paste(told, IMAGE="scene.tif")
    fore = [str(SAMPLE / "cartosat" / "BANDF.tif"), str(SAMPLE / "scene.tif")]
    told = ortho("ties", *fore, "--height", "900", "-o", "ties.csv")
    printed.paste(told, IMAGE="scene.tif")


@case("imaging", "gdal_edit.py -a_srs")
def _reference(printed: Printed, folder: Path) -> None:
    reference = gdal.Open(str(SAMPLE / "reference.tif"))
    west, dx, _, north, _, dy = reference.GetGeoTransform()
    tiff(folder / "reference.tif", reference.GetRasterBand(1).ReadAsArray().astype(np.uint8))
    words = ["match", str(SAMPLE / "scene.tif"), "--reference", "reference.tif", "--dem", str(SAMPLE / "dem.tif")]
    told = ortho(*words, "-o", "m.geojson")
    east, south = west + dx * reference.RasterXSize, north + dy * reference.RasterYSize
    box = {"WEST": f"{west}", "NORTH": f"{north}", "EAST": f"{east}", "SOUTH": f"{south}"}
    printed.paste(told, CODE="32636", **box)
    done = CliRunner().invoke(cli, [*words, "-o", "m.geojson"], prog_name="ortho")
    assert done.exit_code == 0, done.output


@case("commands", "ortho models")
def _models(printed: Printed, folder: Path) -> None:
    points = PointOptions(gcps=SAMPLE / "gcps.csv", fit_model="no-such")
    assert "affine3d" in printed.paste(refused(commands.fit, SAMPLE / "scene.tif", points))


@case("commands", "ortho fit")
def _fit(printed: Printed, folder: Path) -> None:
    image, gcps = str(SAMPLE / "scene.tif"), str(SAMPLE / "gcps.csv")
    remedy = refused(commands.compare, image, PointOptions(gcps=gcps, prune=True))
    assert "RMSE" in printed.paste(remedy, image, "--gcps", gcps, "--prune")


@case("commands", "ortho rectify")
def _raw(printed: Printed, folder: Path) -> None:
    reference = MatchOptions(reference=[SAMPLE / "reference.tif"])
    printed.paste(refused(verify, SAMPLE / "scene.tif", match=reference), DEM=str(SAMPLE / "dem.tif"))
    assert (folder / "out" / "scene_ortho.tif").exists()


@case("commands", "gdalbuildvrt -separate")
def _bands(printed: Printed, folder: Path) -> None:
    pan, coarse = folder / "pan.tif", folder / "blue.tif"
    gdal.Translate(str(coarse), str(SAMPLE / "reference.tif"), widthPct=25, heightPct=25)
    shutil.copy(SAMPLE / "reference.tif", pan)
    printed.paste(
        refused(sharpen, pan, coarse, folder / "out"), BLUE="blue.tif", GREEN="blue.tif", RED="blue.tif", NIR="blue.tif"
    )
    assert gdal.Open(str(folder / "ms.vrt")).RasterCount == 4


@case("commands", "gdal_translate -unscale")
def _with_an_offset(printed: Printed, folder: Path) -> None:
    pan = folder / "pan.tif"
    made = gdal.Translate(str(pan), str(SAMPLE / "reference.tif"))
    made.GetRasterBand(1).SetOffset(-0.1)
    made = None
    printed.paste(refused(sharpen, pan, pan, folder / "out"))
    unscaled = gdal.Open(str(folder / "pan_unscaled.tif"))
    assert not unscaled.GetRasterBand(1).GetOffset()


def _sharpened_badly(folder: Path, ratio: int | None) -> str:
    pan, coarse = folder / "pan.tif", folder / "ms.tif"
    gdal.Translate(str(pan), str(SAMPLE / "reference.tif"), srcWin=[100, 100, 400, 400])
    band = gdal.Translate("", str(pan), format="MEM", widthPct=50, heightPct=50, resampleAlg="average")
    wide = {"width": 400, "height": 400} if ratio else {}
    gdal.Translate(str(coarse), band, bandList=[1, 1, 1], **wide)
    return str(displaced(Agreement((0.7, 0.0), (0.02, 0.02), 0.7, 90, 100), "pan.tif", "ms.tif", ratio))


@case("commands", "ortho align")
def _displaced(printed: Printed, folder: Path) -> None:
    printed.paste(_sharpened_badly(folder, None))
    assert (folder / "aligned" / "ms_aligned.tif").is_file()


@case("commands", "ortho sharpen")
def _sharpened_again(printed: Printed, folder: Path) -> None:
    text = _sharpened_badly(folder, 2)
    align(folder / "ms.tif", folder / "aligned", match=MatchOptions(reference=("pan.tif",)))
    printed.paste(text)
    assert (folder / "sharpened" / "pan_sharpened.tif").is_file()


def _combined(*paths: Path) -> Mosaic:
    return lay_out([Ortho(path.stem, path) for path in paths], "first-on-top")


@case("warp", "ortho rectify")
def _other_grid(printed: Printed, folder: Path) -> None:
    first = folder / "first.tif"
    gdal.Translate(str(first), str(SAMPLE / "reference.tif"), srcWin=[100, 100, 200, 200], noData=0)
    for name, changes in {
        "zone": {"dstSRS": "EPSG:32635"}, "coarse": {"xRes": 12.5, "yRes": 12.5},
        "moved": {"outputBounds": (531001.3, 4121002.7, 532001.3, 4122002.7)},
    }.items():  # fmt: skip
        other = folder / f"{name}.tif"
        gdal.Warp(str(other), str(SAMPLE / "reference.tif"), dstNodata=0, **changes)
        printed.paste(refused(_combined, first, other))
        regridded = folder / "regridded" / f"{name}_ortho.tif"
        assert len(_combined(first, regridded).layers) == 2
        # All that the other ortho shows is in it.
        before, after = (grid_of(path) for path in (other, regridded))
        xmin, ymin, xmax, ymax = warped_bounds(before, after.crs)
        grown = np.subtract((xmin, ymin, -xmax, -ymax), (*after.extent[:2], -after.extent[2], -after.extent[3]))
        assert (grown > -1e-6).all()


@case("warp", "gdalwarp -dstnodata")
def _other_nodata(printed: Printed, folder: Path) -> None:
    values = gdal.Open(str(SAMPLE / "reference.tif")).ReadAsArray()
    void = folder / "void.tif"
    gdal.Translate(str(void), str(SAMPLE / "reference.tif"), noData=7)
    plain, zero = folder / "plain.tif", folder / "zero.tif"
    gdal.Translate(str(plain), str(SAMPLE / "reference.tif"), noData="none")
    gdal.Translate(str(zero), str(SAMPLE / "reference.tif"), noData=0)
    for first, other in ((void, plain), (plain, void), (void, zero)):
        printed.paste(refused(_combined, first, other))
        changed, kept = (first, other) if first == plain else (other, first)
        made = folder / f"{changed.stem}_nodata.tif"
        assert len(_combined(kept, made).layers) == 2
        # Valid pixels that had the value are changed to the next one, not lost.
        assert np.abs(gdal.Open(str(made)).ReadAsArray().astype(int) - values).max() <= 1
        made.unlink()


@case("commands", "gdal_edit.py -a_srs")
def _ortho(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "ortho.tif", GREY)
    reference = MatchOptions(reference=[SAMPLE / "reference.tif"])
    printed.paste(refused(verify, path, match=reference), CODE="32636", **BOX)
    assert open_ortho(path, SceneOptions()).model.map_crs


# -- the command line ------------------------------------------------------------------------------------------------


def _as_gdalwarp(*words: str) -> str:
    return ortho("rectify", str(SAMPLE / "scene.tif"), "-o", "out", *words)


@case("cli", "ortho models")
def _transformers(printed: Printed, folder: Path) -> None:
    for option in (("-order", "2"), ("-tps",)):
        told = _as_gdalwarp(*option)
        names = set(re.findall(r"--fit-model ([a-z]\w*)", told))
        assert names <= set(printed.paste(told).split()), "it names a model that is not there"


@case("cli", "ortho sensors")
def _geolocation(printed: Printed, folder: Path) -> None:
    assert "geolocation" in printed.paste(_as_gdalwarp("-geoloc"))


@case("cli", "gdal_translate -a_nodata")
def _nodata(printed: Printed, folder: Path) -> None:
    files = {"IN": str(SAMPLE / "scene.tif"), "OUT": "scene_0.tif"}
    printed.paste(_as_gdalwarp("-srcnodata", "0"), VALUE="0", **files)
    assert open_dataset(folder / "scene_0.tif").GetRasterBand(1).GetNoDataValue() == 0
    assert open_scene(folder / "scene_0.tif", "rpc").model_source


@case("cli", "gdalwarp -cutline")
def _cutline(printed: Printed, folder: Path) -> None:
    ring = [[530500, 4121000], [532500, 4121000], [532500, 4123000], [530500, 4121000]]
    crs = {"type": "name", "properties": {"name": "EPSG:32636"}}
    area = {"type": "Polygon", "coordinates": [ring]}
    (folder / "area.geojson").write_text(json.dumps({**area, "crs": crs}))
    for option in ("-cutline", "-crop_to_cutline"):
        files = {"AREA": "area.geojson", "ORTHO": str(SAMPLE / "reference.tif"), "OUT": f"cut{option}.tif"}
        printed.paste(_as_gdalwarp(option, "area.geojson"), **files)
        assert (folder / f"cut{option}.tif").exists()


@case("cli", "ortho run")
def _many(printed: Printed, folder: Path) -> None:
    shutil.copytree(SAMPLE / "orbview3", folder / "orbview3")
    assert CliRunner().invoke(cli, ["init", "orbview3"], prog_name="ortho").exit_code == 0
    image = str(SAMPLE / "scene.tif")
    told = ortho("rectify", image, image, "-o", "out")
    printed.paste(told, "--dry-run", **{"PIPELINE.yaml": "orbview3/pipeline.yaml"})


# -- many scenes -----------------------------------------------------------------------------------------------------


def _pipeline(folder: Path, mosaic: bool) -> Path:
    """Write a pipeline of two orthos on one grid."""
    scenes = []
    for name, west in (("west", 530_000), ("east", 531_000)):
        for ending in (".tif", "_RPC.TXT"):
            shutil.copy(SAMPLE / f"scene{ending}", folder / f"{name}{ending}")
        extent = [west, 4_121_500, west + 2000, 4_123_500]
        scenes.append({"image": f"{name}.tif", "surface": {"height": 900.0}, "output": {"extent": extent}})
    defaults = {"output": {"crs": "EPSG:32636", "resolution": 50.0}}
    document = {"output": "out", "defaults": defaults, "scenes": scenes} | ({"mosaic": {}} if mosaic else {})
    (folder / "pipeline.yaml").write_text(json.dumps(document))  # JSON is YAML
    return folder / "pipeline.yaml"


@case("batch", "ortho run X --list")
def _names(printed: Printed, folder: Path) -> None:
    path = _pipeline(folder, mosaic=False)
    assert "west" in printed.paste(refused(plan(path).chosen, ["no-such"]))


@case("batch", "ortho init")
def a_folder_is_no_pipeline_file(printed: Printed, folder: Path) -> None:
    scenes = folder / "scenes"
    shutil.copytree(SAMPLE / "orbview3", scenes)
    printed.paste(refused(read_config, scenes))
    assert (scenes / "pipeline.yaml").exists()


@case("batch", "ortho mosaic")
def _mosaic(printed: Printed, folder: Path) -> None:
    remedy = refused(run_pipeline, _pipeline(folder, mosaic=True), store="s3://bucket/orthos", allow_network=True)
    run_pipeline(_pipeline(folder, mosaic=False), executor="sequential")
    orthos = [str(path) for path in sorted((folder / "out").rglob("*_ortho.tif"))]
    printed.paste(remedy, *orthos, "-o", "mosaic.tif")
    assert (folder / "mosaic.tif").exists()


# -- products --------------------------------------------------------------------------------------------------------


@case("ortho_rpc", "gdal_translate")
def _arrays(printed: Printed, folder: Path) -> None:
    driver("ENVI").CreateCopy(str(folder / "lon.dat"), gdal.Open(str(tiff(folder / "a.tif", heights()))))
    remedy = refused(open_scene, tiff(folder / "grey.tif", GREY), "geolocation")
    printed.paste(remedy, IN="lon.dat", OUT="lon.tif")
    open_dataset(folder / "lon.tif")


@case("ortho_sar", "gdalwarp -t_srs")
def _plane(printed: Printed, folder: Path) -> None:
    path = tiff(folder / "radar.tif", GREY, dem=True)
    gdal.Warp(str(folder / "lonlat.tif"), str(path), dstSRS="EPSG:4326")
    angles = {"incidence": "35", "azimuth": "100", "plane": "900"}
    remedy = refused(open_scene, folder / "lonlat.tif", "sar", options=angles)
    printed.paste(remedy, CODE="32636", IN="lonlat.tif", OUT="utm.tif")
    assert open_scene(folder / "utm.tif", "sar", options=angles).model


@pytest.mark.parametrize(("room", "beginning"), sorted(CASES))
def test_the_command_works_when_pasted(
    room: str, beginning: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_case(room, beginning, tmp_path)
