"""Options as gdalwarp's users write them: each does what gdalwarp does, down to the pixels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np
import pyproj
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.cli import flags
from ortho_pipeline.cli.flags import as_typed
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import rectify
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.raster.source import Grid

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"

#: Not on whole multiples of the resolution, and larger than the scene.
EXTENT = (402003.0, 6679002.0, 404011.0, 6681004.0)
EDGE = 2
#: A value that no band has.
EMPTY = 40


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def ortho(image: Path, folder: Path, *options: Any) -> gdal.Dataset:
    done = run("rectify", image, "--height", "500", "-t_srs", "EPSG:32734", "-of", "GTiff", "-o", folder, "--json",
               *options)  # fmt: skip
    assert done.exit_code == 0, done.stderr
    return gdal.Open(json.loads(done.stdout)["files"]["ortho"])


def gdalwarp(image: Path, **options: Any) -> gdal.Dataset:
    # Kernels of the size of a source pixel, as ours are.
    given = {"transformerOptions": ["RPC_HEIGHT=500"], "rpc": True, "errorThreshold": 0, "dstSRS": "EPSG:32734",
             "warpOptions": ["XSCALE=1", "YSCALE=1"]}  # fmt: skip
    return gdal.Warp("", str(image), format="MEM", **given, **options)


@pytest.fixture
def bands(tiny):
    """Give the scene three bands whose values go beyond a byte, and one of which goes below zero."""
    row, col = np.mgrid[0 : tiny.height, 0 : tiny.width]
    wave = np.sin(col / 7) * np.cos(row / 9)
    old = gdal.Open(str(tiny.image))
    rpc = old.GetMetadata("RPC")
    old = None
    made = gdal.GetDriverByName("GTiff").Create(str(tiny.image), tiny.width, tiny.height, 3, gdal.GDT_Int16)
    made.SetMetadata(rpc, "RPC")
    for number, (mean, size) in enumerate(((200, 150), (5, 20), (-100, 60)), 1):
        made.GetRasterBand(number).WriteArray((mean + size * wave).astype(np.int16))
    made = None
    return tiny


def same_grid(ours: gdal.Dataset, theirs: gdal.Dataset) -> None:
    assert ours.GetGeoTransform() == pytest.approx(theirs.GetGeoTransform(), abs=1e-9)
    assert (ours.RasterXSize, ours.RasterYSize) == (theirs.RasterXSize, theirs.RasterYSize)


@pytest.mark.parametrize("tap", [False, True])
def test_the_grid_is_that_of_gdalwarp(tiny, tmp_path, tap):
    size = 12.5, 7.0
    ours = ortho(tiny.image, tmp_path / "out", "-te", *EXTENT, "-tr", *size, *(["-tap"] if tap else []))
    theirs = gdalwarp(tiny.image, outputBounds=EXTENT, xRes=size[0], yRes=size[1], targetAlignedPixels=tap)
    same_grid(ours, theirs)


@pytest.mark.parametrize("size", [(12.5, 8.0), (0.1, 0.3), (1 / 3, 1 / 7)])
def test_an_extent_that_is_aligned_stays(size):
    """Whether or not its sides are whole multiples in floating point; where they are, as in any gdalwarp."""
    west, south, columns, rows = 41_237, 523_111, 120, 70
    extent = west * size[0], south * size[1], (west + columns) * size[0], (south + rows) * size[1]
    grid = Grid.of_extent(pyproj.CRS.from_epsg(32734), extent, size, align=True)
    assert grid.extent == pytest.approx(extent, abs=1e-6)
    assert (grid.width, grid.height) == (columns, rows)
    if size == (12.5, 8.0):
        source = gdal.GetDriverByName("MEM").Create("", 2, 2)
        source.SetGeoTransform((extent[0] - 1, 500, 0, extent[3] + 1, 0, -500))
        options = {"xRes": size[0], "yRes": size[1], "targetAlignedPixels": True}
        theirs = gdal.Warp("", source, format="MEM", srcSRS="EPSG:32734", outputBounds=extent, **options)
        assert (theirs.RasterXSize, theirs.RasterYSize) == (columns, rows)


def given_output(monkeypatch, *words: Any) -> Any:
    """Return the output options that `rectify` is called with."""
    from ortho_pipeline import commands

    given = {}

    def rectify(*_: Any, output: Any, **more: Any) -> Any:
        given["output"] = output
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "rectify", rectify)
    run("rectify", "a.tif", "-o", "out", *words)
    return given["output"]


@pytest.mark.parametrize(
    ("words", "size"),
    [
        (["-tr", "10"], 10), (["--resolution=10"], 10), (["--resolution", "10,5"], (10, 5)),
        (["-tr", "10", "5"], (10, 5)), (["-tr", "1e1", ".5", "-r", "cubic"], (10, 0.5)),
    ],
)  # fmt: skip
def test_one_number_is_a_square_pixel(monkeypatch, words, size):
    assert given_output(monkeypatch, *words).resolution == size


@pytest.mark.parametrize("words", [["-tr", "0", "5"], ["-tr", "10", "-10"], ["-tr", "ten"], ["--resolution=1,2,3"]])
def test_a_pixel_has_a_positive_size(tiny, tmp_path, words):
    assert run("rectify", tiny.image, "--height", "500", *words, "-o", tmp_path / "out").exit_code == 2


@pytest.mark.parametrize(
    ("kind", "resampling", "engine"),
    [
        ("Byte", "cubic", "ortho"), ("UInt16", "nearest", "ortho"), ("Float32", "bilinear", "ortho"),
        ("Byte", "cubic", "gdal"),
    ],
)  # fmt: skip
def test_types_are_rounded_and_clamped_as_by_gdalwarp(bands, tmp_path, kind, resampling, engine):
    options = {"-ot": kind, "-dstnodata": EMPTY, "-r": resampling, "--engine": engine}
    words = [word for pair in options.items() for word in pair]
    ours = ortho(bands.image, tmp_path / "out", "-te", *EXTENT, "-tr", 10, 10, *words)
    grid = {"outputBounds": EXTENT, "xRes": 10, "yRes": 10, "resampleAlg": resampling}
    # Without a working type gdalwarp clamps the pixels of the image before it interpolates them.
    types = {"outputType": gdal.GetDataTypeByName(kind), "workingType": gdal.GDT_Float32}
    theirs = gdalwarp(bands.image, **grid, **types, dstNodata=EMPTY)
    same_grid(ours, theirs)
    assert ours.GetRasterBand(1).DataType == theirs.GetRasterBand(1).DataType
    assert [ours.GetRasterBand(i).GetNoDataValue() for i in (1, 2, 3)] == [EMPTY] * 3
    a, b = ours.ReadAsArray().astype(float), theirs.ReadAsArray().astype(float)
    seen = (a != EMPTY).any(axis=0) & (b != EMPTY).any(axis=0)
    # At the border of the image the kernels stand half outside.
    inside = np.array([[seen[max(0, j - EDGE) : j + EDGE + 1, max(0, i - EDGE) : i + EDGE + 1].all()
                        for i in range(seen.shape[1])] for j in range(seen.shape[0])])  # fmt: skip
    assert inside.sum() > 10_000
    # The lattice is within 0.01 px, and the steepest flank of the waves is 150 / 7 a pixel; integers are rounded.
    # The nearest pixel is another one only where the place is so near to its border.
    different = np.abs(a - b)[:, inside]
    if resampling == "nearest":
        assert (different > 0).mean() < 2 * 2 * 0.01
    else:
        assert different.max() <= 0.01 * 150 / 7 + (0.0 if kind == "Float32" else 1.0)
    if kind == "Float32" and resampling != "nearest":
        assert (a[:, inside] % 1 != 0).any()


def test_pixels_without_an_image_are_nodata_and_no_others(bands, tmp_path):
    ours = ortho(bands.image, tmp_path / "out", "-te", *EXTENT, "-tr", 10, 10, "-dstnodata", "-9999")
    masked = ortho(bands.image, tmp_path / "masked", "-te", *EXTENT, "-tr", 10, 10)
    valid = masked.GetRasterBand(1).GetMaskBand().ReadAsArray() != 0
    assert ours.GetRasterBand(1).GetMaskFlags() == gdal.GMF_NODATA
    pixels = ours.ReadAsArray()
    assert ((pixels == -9999) == ~valid).all()
    assert (pixels[:, valid] == masked.ReadAsArray()[:, valid]).all()


def test_nodata_that_the_image_has_becomes_the_value_asked_for(bands, tmp_path):
    image = gdal.Open(str(bands.image), gdal.GA_Update)
    image.GetRasterBand(1).SetNoDataValue(-32768)
    for number in (1, 2, 3):
        image.GetRasterBand(number).SetNoDataValue(-32768)
        image.GetRasterBand(number).WriteArray(np.full((50, 50), -32768, np.int16), 150, 100)
    image = None
    options = ["-te", *EXTENT, "-tr", 10, 10, "-r", "nearest"]
    kept, other = (ortho(bands.image, tmp_path / str(i), *options, *more).ReadAsArray() for i, more in
                   enumerate(([], ["-dstnodata", "0", "-ot", "Float64"])))  # fmt: skip
    assert ((kept == -32768) == (other == 0)).all()
    done = run("rectify", bands.image, "--height", "500", "-ot", "Byte", "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "--nodata" in done.stderr


def test_a_nan_as_nodata_goes_into_the_report(tiny, tmp_path):
    made = ortho(tiny.image, tmp_path / "out", "-ot", "float32", "-dstnodata", "nan", "-te", *EXTENT, "-tr", 20, 20)
    assert np.isnan(made.GetRasterBand(1).GetNoDataValue())
    assert np.isnan(made.ReadAsArray()).any()
    report = json.loads((tmp_path / "out" / "tiny_report.json").read_text())
    assert report["provenance"]["options"]["output"]["nodata"] == "nan"


@pytest.mark.parametrize("value", ["300", "-1", "0.5", "nan"])
def test_nodata_has_to_fit(tiny, tmp_path, value):
    done = run("rectify", tiny.image, "--height", "500", "-ot", "Byte", "-dstnodata", value, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "-dstnodata" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("engine", ["ortho", "gdal"])
def test_bands_are_chosen_in_the_order_given(bands, tmp_path, engine):
    options = ["-te", *EXTENT, "-tr", 10, 10, "--engine", engine]
    every = ortho(bands.image, tmp_path / "all", *options).ReadAsArray()
    some = ortho(bands.image, tmp_path / "some", *options, "-b", 3, "-b", 1)
    assert some.RasterCount == 2
    assert (some.ReadAsArray() == every[[2, 0]]).all()
    done = run("rectify", bands.image, "--height", "500", "-b", "4", "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "from 1 to 3" in done.stderr


def test_without_its_alpha_band_an_ortho_has_a_mask(tiny, tmp_path):
    old = gdal.Open(str(tiny.image))
    pixels, rpc, old = old.ReadAsArray() // 6, old.GetMetadata("RPC"), None
    alpha = np.full_like(pixels, 255)
    alpha[100:150, 150:200] = 0
    # GDAL takes the last of two or four bands for a mask.
    image = gdal.GetDriverByName("GTiff").Create(
        str(tiny.image), tiny.width, tiny.height, 2, gdal.GDT_Byte, ["ALPHA=YES"]
    )
    image.SetMetadata(rpc, "RPC")
    image.WriteArray(np.stack([pixels, alpha]))
    image = None
    made = ortho(tiny.image, tmp_path / "out", "-b", 1, "-tr", 5, 5, "-r", "nearest")
    mask = made.GetRasterBand(1).GetMaskBand().ReadAsArray()
    assert made.GetRasterBand(1).GetMaskFlags() == gdal.GMF_PER_DATASET
    every = ortho(tiny.image, tmp_path / "all", "-tr", 5, 5, "-r", "nearest")
    assert ((every.GetRasterBand(2).ReadAsArray() > 0) == (mask > 0)).all()
    middle = mask[mask.shape[0] // 4 : -mask.shape[0] // 4, mask.shape[1] // 4 : -mask.shape[1] // 4]
    assert 0 < (middle == 0).mean() < 0.2
    done = run("rectify", tiny.image, "--height", "500", "-dstnodata", "0", "-o", tmp_path / "no")
    assert "alpha" in done.stderr
    assert done.exit_code == 2


@pytest.mark.parametrize(("text", "size"), [("64", 64e6), ("2GB", 2e9), ("512MB", 512e6), ("536870912", 536870912)])
def test_memory_is_megabytes_or_bytes(monkeypatch, text, size):
    assert given_output(monkeypatch, "-wm", text).memory == size
    assert run("rectify", "a.tif", "-o", "out", "-wm", "8").exit_code == 2


def test_the_least_memory_is_the_same_in_python_and_on_the_command_line(monkeypatch):
    """Python took 1 MB, less than the smallest cache that a job has."""
    assert OutputOptions(memory=16_000_000) == given_output(monkeypatch, "-wm", "16")
    assert "too little" in run("rectify", "a.tif", "-o", "out", "-wm", "15").stderr
    with pytest.raises(InputError, match=r"output\.memory"):
        OutputOptions(memory=15_999_999)


# -- overwriting -----------------------------------------------------------------------------------------------------


def test_overwrite_is_an_option_and_no_folder(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("rectify", tiny.image, "--height", "500", "-overwrite", "-o", "out")
    assert done.exit_code == 0, done.stderr
    assert not (tmp_path / "verwrite").exists()
    assert (tmp_path / "out" / "tiny_ortho.tif").exists()


def test_overwrite_removes_what_would_attach_and_what_no_longer_belongs(tiny, tmp_path):
    out = tmp_path / "out"
    points = ["--gcps", tiny.gcps, "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]
    common = ["rectify", tiny.image, "--height", "500", "-o", out]
    assert run(*common, *points).exit_code == 0
    attached = [out / name for name in ("tiny_ortho_RPC.TXT", "tiny_ortho.tif.aux.xml", "tiny_ortho.tif.ovr")]
    for path in attached:
        path.write_text("of an older ortho")
    (out / "notes.txt").write_text("mine")
    refused = run(*common)
    assert refused.exit_code == 2
    assert "--overwrite" in refused.stderr
    assert run(*common, "--overwrite").exit_code == 0
    assert not [path for path in attached if path.exists()]
    assert not (out / "tiny_residuals.geojson").exists()
    assert (out / "notes.txt").read_text() == "mine"


def test_what_overwrite_would_remove_is_not_read(tiny, tmp_path):
    out = tmp_path / "out"
    assert run("rectify", tiny.image, "--height", "500", "-o", out).exit_code == 0
    (out / "tiny_RPC.TXT").rename(out / "tiny_ortho_RPC.TXT")
    done = run("rectify", tiny.image, "--height", "500", "-o", out, "--rpc", out / "tiny_ortho_RPC.TXT", "-overwrite")
    assert done.exit_code == 2
    assert (out / "tiny_ortho_RPC.TXT").exists()


# -- words -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("-ovr", "full resolution"), ("-overwrit", "'-overwrite'"), ("-oout", "'-o out'"), ("-r=cubic", "'-r cubic'"),
        ("-output", "'--output'"), ("-multi", "--threads"), ("-et", "--tolerance"), ("-rpc", "--rpc FILE"),
        ("-zzz", "No such option: -zzz."),
    ],
)  # fmt: skip
def test_a_word_with_one_dash_is_no_value(tiny, tmp_path, monkeypatch, word, said):
    monkeypatch.chdir(tmp_path)
    done = run("rectify", tiny.image, "--height", "500", "-o", "out", word)
    assert done.exit_code == 2
    assert said in done.stderr
    assert not [path for path in tmp_path.iterdir() if path.is_dir() and path != tiny.folder]


@pytest.mark.parametrize("command", ["fit", "compare", "rectify", "export", "adjust", "run", "edge", "intersect"])
def test_every_command_refuses_unknown_words(command):
    assert "No such option: -overwr" in run(command, "x", "-overwr").stderr


def test_negative_numbers_are_values(tiny, tmp_path):
    done = run("rectify", tiny.image, "--height", "-43", "-te", "-5", "-5", "-6", "-6", "-o", tmp_path / "out")
    assert "No such option" not in done.stderr
    assert "not an extent" in done.stderr


def test_numbers_are_shown_as_they_were_given(tiny, tmp_path):
    y = 4899698.2 + 0.32
    assert repr(y) != "4899698.52"
    done = run("rectify", tiny.image, "--height", "500", "-te", "9", repr(y), "1", "5e6", "-o", tmp_path / "out")
    assert "9 4899698.52 1 5000000 is not an extent" in done.stderr


def test_several_images_are_for_run(tiny, tmp_path):
    done = run("rectify", tiny.image, tiny.image, "b.tif", "--height", "500", "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "ortho run" in done.stderr


def test_like_takes_the_grid_of_another_raster(tiny, tmp_path):
    given = ("-te", 402603, 6680103, 403603, 6681103, "-tr", 12.5, 8)
    first = ortho(tiny.image, tmp_path / "first", *given)
    words = ("rectify", tiny.image, "--height", 500, "-of", "GTiff", "--like", first.GetDescription())
    again = gdal.Open(json.loads(run(*words, "-o", tmp_path / "again", "--json").stdout)["files"]["ortho"])
    same_grid(again, first)
    assert again.GetSpatialRef().IsSame(first.GetSpatialRef())
    assert np.array_equal(again.ReadAsArray(), first.ReadAsArray())
    both = run(*words, "-tr", 5, "-o", tmp_path / "x")
    assert both.exit_code == 2
    assert "--like sets the grid, which -tr would change" in both.stderr
    document = json.loads((tmp_path / "again" / f"{tiny.image.stem}_report.json").read_text())
    assert first.GetDescription() in {one["path"] for one in document["provenance"]["inputs"] if one["role"] == "grid"}
    assert document["provenance"]["options"]["output"]["like"] == first.GetDescription()


@pytest.fixture
def refused(tiny, tmp_path):
    def words(*more: Any) -> str:
        done = run("rectify", tiny.image, "--height", "500", *more)
        assert done.exit_code == 2, done.output
        assert not (tmp_path / "out").exists()
        return done.stderr

    return words


def test_metres_given_as_degrees_are_refused_with_the_usual_size(refused, tmp_path):
    said = refused("-t_srs", "EPSG:4326", "-tr", 30, 30, "-o", tmp_path / "out")
    assert "a resolution of 30 means 30 degrees" in said
    # 400 x 300 pixels cover 0.02 x 0.013 degrees.
    assert "for 30 m give -tr 0.00029 (the scene's own pixel is 0.000047, 4.8 m)" in said
    assert "or choose a CRS in metres with -t_srs EPSG:" in said


def test_outputs_named_as_a_file_are_refused(refused, tmp_path):
    assert f"did you mean '-o {tmp_path / 'out'}'?" in refused("-o", tmp_path / "out.tif")


def test_a_misspelt_creation_option_names_the_one_most_like_it(refused, tmp_path):
    for words in ((), ("--dry-run",)):
        assert "did you mean COMPRESS?" in refused("-co", "COMPRES=ZSTD", "-o", tmp_path / "out", *words)


def test_a_dry_run_says_what_would_be_made(tiny, tmp_path):
    words = ("rectify", tiny.image, "--height", 500, "-tr", 10, "-o", tmp_path / "out")
    done = run(*words, "--dry-run")
    assert done.exit_code == 0, done.stderr
    assert not (tmp_path / "out").exists()
    made = json.loads(run(*words, "--json").stdout)["report"]["ortho"]
    assert f"{made['size'][0]} x {made['size'][1]} px of 10 in {made['crs']}" in done.stdout


def test_quiet_prints_only_warnings(tiny, tmp_path):
    done = run("rectify", tiny.image, "--height", 500, "-q", "-o", tmp_path / "out")
    assert (done.stdout, done.stderr, done.exit_code) == ("", "", 0)
    words = ("rectify", SAMPLE / "scene.tif", "--gcps", SAMPLE / "gcps.geojson", "--dem", SAMPLE / "dem.tif")
    done = run(*words, "-tr", 30, 30, "-q", "-o", tmp_path / "out")
    assert (done.stdout, done.exit_code) == ("", 0)
    assert done.stderr.startswith("Warning: 6 check points: fewer than the 30")
    assert "Note" not in done.stderr
    shown = run("rectify", tiny.image, "--height", 500, "-q", "--json", "-o", tmp_path / "out")
    assert json.loads(shown.stdout)["files"]


def test_each_stage_of_a_job_has_its_own_progress(tiny, tmp_path):
    told: list[tuple[str, float]] = []
    rectify(tiny.image, tmp_path / "out", surface=SurfaceOptions(height=500.0), progress=lambda *one: told.append(one))
    stages = list(dict.fromkeys(stage for stage, _ in told))
    assert stages == ["Adjusting", "Warping", "Writing the COG", "Layers and report"]
    for stage in stages[1:3]:
        shares = [share for one, share in told if one == stage]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


@pytest.mark.parametrize("command", cli.list_commands(click.Context(cli)))
def test_the_help_has_no_stray_blanks(command):
    text = run(command, "--help").stdout.split("Options:")[0]
    assert not [line for line in text.splitlines() if "  " in line.strip()]


def test_messages_name_options_as_typed_and_split_no_command_line(monkeypatch):
    def named(*words: str) -> str:
        with cli.make_context("ortho", ["rectify", *words]) as ctx:
            command = cli.get_command(ctx, "rectify")
            with click.Context(command, parent=ctx):
                return as_typed(Text("give ", Setting("output.bands", "1")))

    assert named("a.tif") == "give --band 1"
    assert named("a.tif", "-b", "2") == "give -b 1"
    # The form with = counts too.
    assert named("a.tif", "-b", "2", "--band=3") == "give --band 1"
    monkeypatch.setattr(flags, "flags_of", pytest.fail)
    with cli.make_context("ortho", ["rectify", "a.tif"]):
        assert as_typed("3 points") == "3 points"
