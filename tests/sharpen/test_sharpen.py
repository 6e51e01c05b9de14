"""`ortho sharpen`: pixels as GDAL's own tool makes them, masks, weights, registration and quality; and its errors."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
from bundles import CORNER, Bundle, errors, write
from click.testing import CliRunner, Result
from osgeo import gdal
from osgeo_utils.gdal_pansharpen import gdal_pansharpen

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.sharpening import registration
from ortho_pipeline.commands.sharpening.quality import reduced_quality
from ortho_pipeline.commands.sharpening.samples import Sample, read_samples, regress
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.pansharpened import Pansharpened
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import Grid, RasterSource

gdal.UseExceptions()


def run(*words: Any) -> Result:
    return CliRunner().invoke(cli, list(map(str, words)))


def pixels_of(pan: Path, colours: Path, weights: Any) -> tuple[np.ndarray, np.ndarray, Pansharpened]:
    """Return all pixels of the product, read in windows, and which are valid."""
    sources = RasterSource(pan), RasterSource(colours)
    image = Pansharpened(*sources, (grid_of(pan), grid_of(colours)), weights, Profile.of(sources[1]))
    grid = image.overlap.grid
    pixels = np.zeros((sources[1].count, grid.height, grid.width), sources[1].dtype)
    valid = np.zeros((grid.height, grid.width), dtype=bool)
    for top in range(0, grid.height, 150):
        for left in range(0, grid.width, 130):
            size = min(130, grid.width - left), min(150, grid.height - top)
            part = slice(top, top + size[1]), slice(left, left + size[0])
            pixels[:, *part], valid[part] = image.read(left, top, *size)
    return pixels, valid, image


def gdals(pan: Path, colours: Path, weights: Any, folder: Path) -> np.ndarray:
    """Return what GDAL's own tool makes."""
    made = folder / "gdal.tif"
    gdal_pansharpen(
        pan_name=str(pan), spectral_names=[str(colours)], dst_filename=str(made), weights=list(weights),
        driver_name="GTiff", progress_callback=None,
    )  # fmt: skip
    return gdal.Open(str(made)).ReadAsArray()


# -- pixels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bundle",
    [
        Bundle(side=384),
        Bundle(seed=1, side=384, ratio=2, count=3, dtype="uint8", level=100.0),
        Bundle(seed=2, side=360, ratio=3, count=8, dtype="int16"),
        Bundle(seed=3, side=360, ratio=5, count=2, dtype="float32"),
    ],
    ids=["11 bits", "8 bits", "8 bands", "float"],
)
def test_pixels_are_those_of_gdal(bundle: Bundle, tmp_path: Path) -> None:
    pan, colours = bundle.write(tmp_path)
    pixels, valid, _ = pixels_of(pan, colours, bundle.weights)
    expected = gdals(pan, colours, bundle.weights, tmp_path)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected, rtol=1e-6 if bundle.dtype == "float32" else 0)


@pytest.mark.parametrize(("dtype", "scale"), [("int16", 1.0), ("float32", 1e-4)])
def test_dark_water_with_negative_values_has_no_bright_pixels(dtype: str, scale: float, tmp_path: Path) -> None:
    """A correction of the atmosphere leaves noise about 0 there; a quotient of it by a sum near 0 has no bound."""
    bundle = Bundle(side=384, ratio=4)
    truth = bundle.truth()
    row, column = np.ogrid[:384, :384]
    water = np.hypot(row - 192, column - 192) < 90
    truth = np.where(water, np.random.default_rng(0).normal(0, 6, truth.shape), truth) * scale
    wide = truth.reshape(4, 96, 4, 96, 4).mean(axis=(2, 4))
    sharp = np.einsum("b,bij->ij", bundle.weights, truth)
    pan, colours = write(tmp_path / "p.tif", sharp[None], 0.5, dtype), write(tmp_path / "m.tif", wide, 2.0, dtype)
    pixels, valid, _ = pixels_of(pan, colours, bundle.weights)
    assert valid.all()
    # No band is larger than the panchromatic value by its weight, if no band is negative.
    inner = np.hypot(row - 192, column - 192) < 80
    assert np.abs(pixels[:, inner]).max() < np.abs(sharp[inner]).max() / min(bundle.weights) + scale
    result = run("sharpen", pan, colours, "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    quality = json.loads(result.stdout)["quality"]["sharpened"]["ergas"]
    with np.errstate(invalid="ignore"):  # no spectrum where all bands are 0
        assert errors(truth, pixels, 4)[0] < quality
    below = write(tmp_path / "decibels.tif", wide - truth.max(), 2.0, dtype)
    assert "most values of this ortho are negative" in refused(pan, below, "-o", tmp_path / "out")


def test_pixels_with_one_nodata_value_are_those_of_gdal(tmp_path: Path) -> None:
    bundle = Bundle(side=384)
    sharp, wide = bundle.pixels()
    sharp[:40, :70], wide[:, 50:60, 20:44] = 0, 0
    pan, colours = write(tmp_path / "p.tif", sharp[None], 0.5, nodata=0), write(tmp_path / "m.tif", wide, 2.0, nodata=0)
    pixels, valid, _ = pixels_of(pan, colours, bundle.weights)
    np.testing.assert_array_equal(pixels, gdals(pan, colours, bundle.weights, tmp_path))
    np.testing.assert_array_equal(valid, (pixels != 0).all(axis=0))


def test_masks_and_other_nodata_values_do_not_leak(tmp_path: Path) -> None:
    bundle = Bundle(side=384)
    sharp, wide = bundle.pixels()
    expected, _, _ = pixels_of(*bundle.write(tmp_path), bundle.weights)
    mask = np.ones(sharp.shape, dtype=bool)
    mask[:40, :70] = False
    pan = write(tmp_path / "p.tif", np.where(mask, sharp, 65_000)[None], 0.5, mask=mask)
    holed = wide.copy()
    holed[:, 50:60, 20:44] = 9
    colours = write(tmp_path / "m.tif", holed, 2.0, nodata=9)
    pixels, valid, _ = pixels_of(pan, colours, bundle.weights)
    hidden = ~mask
    hidden[200:240, 80:176] = True
    # GDAL's kernel gives a value where most of its weight is on valid pixels: up to half a pixel into a hole.
    core = hidden.copy()
    core[200:240, 80:176] = False
    core[202:238, 82:174] = True
    assert not valid[core].any()
    assert valid[~hidden].all()
    assert (pixels[:, ~valid] == 9).all()
    difference = np.abs(pixels.astype(int) - expected)
    far = ~hidden
    far[188:252, 68:188] = False
    # Rounding differs where GDAL computes in floating point; next to the hole the kernel lacks pixels.
    assert difference[:, far].max() <= 1
    assert difference[:, ~hidden].max() < 0.25 * bundle.level


def test_another_grid_is_resampled_to_its_place(tmp_path: Path) -> None:
    bundle = Bundle(side=384)
    pan, colours = bundle.write(tmp_path)
    expected, _, _ = pixels_of(pan, colours, bundle.weights)
    sharp = gdal.Open(str(pan)).ReadAsArray()
    # Pixels that nest, with a corner within a multispectral pixel; GDAL 3.6 would stretch the colours.
    nested = write(tmp_path / "n.tif", sharp[None, 5:301, 3:300], 0.5, corner=(CORNER[0] + 1.5, CORNER[1] - 2.5))
    pixels, valid, image = pixels_of(nested, colours, bundle.weights)
    assert valid.all()
    assert image.overlap.ratio == 4
    np.testing.assert_array_equal(pixels, expected[:, 5:301, 3:300])
    # The same pixels in another CRS: the colours come from GDAL's warper.
    moved = gdal.Warp("", str(colours), format="VRT", dstSRS="EPSG:32635", resampleAlg="cubic", xRes=2, yRes=2)
    other = tmp_path / "other.tif"
    gdal.Translate(str(other), moved, noData=0)
    pixels, valid, image = pixels_of(pan, other, bundle.weights)
    assert image.overlap.ratio == 0
    assert valid.mean() > 0.95
    inner = (slice(None), slice(30, -30), slice(30, -30))
    assert np.sqrt(np.mean((pixels[inner].astype(float) - expected[inner]) ** 2)) < 0.02 * bundle.level


# -- weights and quality ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [*range(6), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 40))])
def test_drawn_bundles_are_better_than_upsampling(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng([seed, 9])
    ratio = int(random.choice([2, 3, 4, 5]))
    bundle = Bundle(
        seed=seed, side=60 * ratio * (8 // ratio), ratio=ratio, count=int(random.integers(2, 9)),
        own=float(random.uniform(0.05, 0.6)), dtype=str(random.choice(["uint16", "int16"])),
    )  # fmt: skip
    pan, colours = bundle.write(tmp_path)
    wide = gdal.Open(str(colours)).ReadAsArray().astype(np.float32)
    mean = gdal.Open(str(pan)).ReadAsArray().reshape(wide.shape[1], ratio, -1, ratio).mean(axis=(1, 3))
    sample = Sample(mean.astype(np.float32), wide)
    weights = regress([sample], bundle.count)
    np.testing.assert_allclose(weights.values, bundle.weights, atol=0.03)
    pixels, _, _ = pixels_of(pan, colours, weights.values)
    large = {"buf_xsize": bundle.side, "buf_ysize": bundle.side, "resample_alg": gdal.GRIORA_Cubic}
    naive = gdal.Open(str(colours)).ReadAsArray(**large)
    ergas, angle = errors(bundle.truth(), pixels, ratio)
    upsampled, same = errors(bundle.truth(), naive, ratio)
    assert ergas < upsampled
    # Brovey multiplies all bands of a pixel by one number, so the angle can change by rounding only.
    assert angle == pytest.approx(same, abs=0.02)
    side = wide.shape[1] // ratio * ratio
    quality = reduced_quality(
        [Sample(sample.pan[:side, :side], wide[:, :side, :side])], weights.values, ratio, np.dtype(np.float32)
    )
    if quality is not None:
        assert quality["sharpened"]["ergas"] < quality["upsampled"]["ergas"]


def test_bright_objects_next_to_dark_ground_do_not_spoil_the_quality() -> None:
    """Upsampled pixels of unsigned types are not below 0, in the ortho and in the test of its quality."""
    random = np.random.default_rng(1)
    wide = random.integers(40, 300, (4, 128, 128)).astype(np.float32)
    for left, top in random.integers(0, 100, (12, 2)):
        wide[:, top : top + 24, left : left + 24] = random.integers(1500, 4000, 4)[:, None, None]
    quality = reduced_quality([Sample(wide.mean(axis=0), wide)], [0.25] * 4, 4, np.dtype(np.uint16))
    assert quality is not None
    assert quality["sharpened"]["ergas"] < 0.5 * quality["upsampled"]["ergas"]


def test_a_band_without_light_does_not_hide_the_quality_of_the_others() -> None:
    wide = np.random.default_rng(1).integers(40, 300, (3, 128, 128)).astype(np.float32)
    empty = np.zeros((1, 128, 128), np.float32)
    found = [
        reduced_quality([Sample(wide.mean(axis=0), bands)], [1 / 3, 1 / 3, 1 / 3, 0.0][: len(bands)], 4, wide.dtype)
        for bands in (wide, np.concatenate([wide, empty]))
    ]
    assert found[0] is not None
    assert found[1] is not None
    for name in ("ergas", "sam_deg"):
        assert found[1]["sharpened"][name] == pytest.approx(found[0]["sharpened"][name])


def test_weights_are_never_negative() -> None:
    random = np.random.default_rng(0)
    bands = random.uniform(100, 200, (3, 40, 40)).astype(np.float32)
    pan = 0.7 * bands[0] - 0.2 * bands[1]
    weights = regress([Sample(pan, bands)], 3)
    assert weights.values[1] == 0
    assert min(weights.values) >= 0
    # Two bands that are the same share one weight.
    twins = regress([Sample(bands[0], bands[[0, 0]])], 2)
    assert sum(twins.values) == pytest.approx(1.0, abs=1e-4)
    assert twins.explained > 0.9999


def test_saturated_panchromatic_pixels_do_not_change_the_weights() -> None:
    bundle = Bundle(side=256, seed=2)
    sharp, wide = bundle.pixels()
    cloud = np.ones((64, 64))
    cloud[10:34, 16:40] = 6.0
    bright = np.minimum(sharp * np.kron(cloud, np.ones((4, 4))), 2047).reshape(64, 4, 64, 4).mean(axis=(1, 3))
    for brighter in (0.0, 3.0):  # interpolation makes some pixels brighter
        bright[11, 17] += brighter
        weights = regress([Sample(bright.astype(np.float32), (wide * cloud).astype(np.float32))], bundle.count)
        np.testing.assert_allclose(weights.values, bundle.weights, atol=0.03)
    # An even image has no other pixels.
    even = regress([Sample(np.full((64, 64), 500, np.float32), wide.astype(np.float32))], bundle.count)
    assert even.pixels == 64 * 64


# -- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Bundle, Path, dict[str, Any]]:
    """A bundle whose orthos are displaced by 0.3 px, sharpened."""
    folder = tmp_path_factory.mktemp("done")
    bundle = Bundle(side=640, seed=5, shift=(0.18, -0.24))
    pan, colours = bundle.write(folder)
    result = run("sharpen", pan, colours, "-o", folder / "out", "--json")
    assert result.exit_code == 0, result.output
    return bundle, folder, json.loads(result.stdout)


def test_a_displacement_of_a_third_of_a_pixel_is_measured(done: tuple[Bundle, Path, dict[str, Any]]) -> None:
    bundle, _, document = done
    found = document["registration"]
    # The panchromatic ortho minus the multispectral one.
    np.testing.assert_allclose([found["column_px"], found["row_px"]], -np.array(bundle.shift), atol=0.05)
    assert 0 < found["sigma_column_px"] < 0.05
    assert found["rmse_px"] == pytest.approx(0.3, abs=0.05)
    assert document["notices"] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_displacements_of_drawn_bundles_are_measured(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng([seed, 4])
    angle, ratio = random.uniform(0, 2 * np.pi), int(random.choice([2, 4, 5]))
    shift = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
    bundle = Bundle(seed=100 + seed, side=800, ratio=ratio, own=float(random.uniform(0.05, 0.6)), shift=shift)
    found = registration.measure_agreement(*bundle.write(tmp_path), SceneOptions(), OutputOptions(threads=1))
    np.testing.assert_allclose(found.shift, -np.array(shift), atol=0.05)
    assert (np.abs(np.add(found.shift, shift)) < 4 * np.array(found.sigma)).all()


def test_the_ortho_is_a_cog_with_names_of_bands_and_a_mask(done: tuple[Bundle, Path, dict[str, Any]]) -> None:
    bundle, folder, document = done
    made = gdal.Open(document["files"]["ortho"])
    assert made.GetMetadataItem("LAYOUT", "IMAGE_STRUCTURE") == "COG"
    assert (made.RasterXSize, made.RasterCount) == (bundle.side, bundle.count)
    assert made.GetGeoTransform() == gdal.Open(str(folder / "pan.tif")).GetGeoTransform()
    assert (made.GetRasterBand(1).GetMaskBand().ReadAsArray() == 255).all()
    expected, _, _ = pixels_of(folder / "pan.tif", folder / "ms.tif", document["weights"]["values"])
    np.testing.assert_array_equal(made.ReadAsArray(), expected)
    assert document["quality"]["sharpened"]["ergas"] < document["quality"]["upsampled"]["ergas"]
    assert json.loads((folder / "out" / "pan_sharpened.json").read_text())["weights"] == document["weights"]


def test_more_than_half_a_pixel_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agreement = registration.Agreement((0.6, 0.0), (0.02, 0.02), 0.61, 100, 120)
    monkeypatch.setattr("ortho_pipeline.commands.sharpening.sharpen.measure_agreement", lambda *_: agreement)
    pan, colours = Bundle(side=256).write(tmp_path)
    result = run("sharpen", pan, colours, "-o", tmp_path / "out", "--weights", "0.25,0.25,0.25,0.25")
    assert result.exit_code == 0, result.output
    assert "Warning" in result.output
    assert f"ortho align {colours} --reference {pan}" in result.output
    assert "as given" in result.output


# -- wrong input -----------------------------------------------------------------------------------------------------


def refused(*words: Any) -> str:
    result = run("sharpen", *words)
    assert result.exit_code == 2, result.output
    return result.output


def test_wrong_pairs_are_refused(tmp_path: Path) -> None:
    bundle = Bundle(side=256)
    pan, colours = bundle.write(tmp_path)
    out = "-o", tmp_path / "out"
    sharp, wide = bundle.pixels()
    assert "one band" in refused(pan, pan, *out) or "1 band" in refused(pan, pan, *out)
    assert "panchromatic image has one" in refused(colours, pan, *out)
    far = write(tmp_path / "far.tif", wide, 2.0, corner=(CORNER[0] + 9000, CORNER[1]))
    assert "do not overlap" in refused(pan, far, *out)
    coarse = write(tmp_path / "coarse.tif", sharp[None], 8.0)
    assert "coarser than" in refused(coarse, colours, *out)
    same = write(tmp_path / "same.tif", np.repeat(sharp[None], 3, axis=0), 0.5)
    assert "no detail to add" in refused(pan, same, *out)
    assert "3 weights for 4 bands" in refused(pan, colours, *out, "--weights", "0.3,0.3,0.4")
    assert "must not be negative" in refused(pan, colours, *out, "--weights", "0.3,0.3,0.4,-1")
    west, east = np.arange(256) < 100, np.arange(64) >= 32
    left = write(tmp_path / "left.tif", np.where(west, sharp, 0)[None], 0.5, nodata=0)
    right = write(tmp_path / "right.tif", np.where(east, wide, 0), 2.0, nodata=0)
    assert "no valid pixels in common" in refused(left, right, *out)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").glob("*.tif"))


@pytest.mark.parametrize("of", ["pan", "ms"])
def test_values_with_an_offset_are_refused_and_the_remedy_works(
    of: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reflectance is scale x value + offset: ratios of these values are not those of the light."""
    bundle = Bundle(side=256)
    monkeypatch.chdir(tmp_path)
    sharp, wide = bundle.pixels()
    pixels, size = {"pan": (sharp[None], 0.5), "ms": (wide, 2.0)}[of]
    names = {"pan": bundle.write(tmp_path)[0].name, "ms": "ms.tif"}
    plain = run("sharpen", *names.values(), "-o", "plain")
    assert plain.exit_code == 0, plain.output
    raised = gdal.Open(str(write(tmp_path / names[of], pixels + 1000, size)), gdal.GA_Update)
    for number in range(raised.RasterCount):
        raised.GetRasterBand(number + 1).SetScale(1e-4)
        raised.GetRasterBand(number + 1).SetOffset(-0.1)
    raised = None
    text = refused(*names.values(), "-o", "out")
    assert f"{of}.tif: offset: the values of this image have an offset" in text
    subprocess.run(text.split("`")[1].split(), check=True, capture_output=True)
    names[of] = f"{of}_unscaled.tif"
    done = run("sharpen", *names.values(), "-o", "out")
    assert done.exit_code == 0, done.output
    scale = 1e-4 if of == "ms" else 1.0
    first, second = (
        gdal.Open(str(next((tmp_path / name).glob("*_sharpened.tif")))).ReadAsArray().astype(float)
        for name in ("plain", "out")
    )
    assert np.median(np.abs(second / scale / first - 1)) < 2e-3


def test_different_scenes_are_refused(tmp_path: Path) -> None:
    pan, _ = Bundle(side=320, seed=1).write(tmp_path)
    _, colours = Bundle(side=320, seed=2).write(tmp_path / "other")
    text = refused(pan, colours, "-o", tmp_path / "out")
    assert "different scenes" in text
    assert "% of the panchromatic variance" in text


def test_too_little_detail_is_a_warning(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    ramp = 500 + 200 * np.add.outer(np.arange(320), np.arange(320)) / 640
    wide = np.repeat(ramp.reshape(80, 4, 80, 4).mean(axis=(1, 3))[None], 3, axis=0)
    pan = write(tmp_path / "pan.tif", (ramp + random.normal(0, 1, ramp.shape))[None], 0.5)
    colours = write(tmp_path / "ms.tif", wide + random.normal(0, 1, wide.shape), 2.0)
    result = run("sharpen", pan, colours, "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["registration"] is None
    # The detail is noise, so it does not help either.
    assert [notice["code"] for notice in document["notices"]] == ["sharpen-not-matched", "sharpen-no-gain"]


def test_a_large_ratio_has_a_quality_and_one_too_large_is_named() -> None:
    """Windows hold enough reduced pixels at any ratio."""
    random = np.random.default_rng(0)
    wide = random.uniform(100, 200, (4, 200, 200))

    def image(pixels: np.ndarray) -> Any:
        def read(left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
            part = pixels[:, top : top + height, left : left + width]
            return part, np.ones(part.shape, dtype=bool)

        return SimpleNamespace(read=read)

    def samples_of(side: int, ratio: int) -> list[Sample]:
        grid = Grid(pyproj.CRS("EPSG:32636"), 0.0, 0.0, 20.0, 20.0, side, side)
        return read_samples(image(wide.mean(axis=0)[None]), image(wide), (1, 2, 3, 4), grid, ratio)

    quality = reduced_quality(samples_of(200, 20), [0.25] * 4, 20, np.dtype(np.float32))
    assert quality is not None
    assert quality["pixels"] >= 1600
    with pytest.raises(InputError, match="9 multispectral pixels in common; the weights of 4 bands need 40") as caught:
        regress(samples_of(3, 100), 4)
    assert "ratio" in str(caught.value.remedy)


@pytest.mark.parametrize("multiple", [2, 3, 4, 20])
def test_windows_of_samples_cross_no_block_of_the_warper(multiple: int) -> None:
    """GDAL resamples whole blocks of 512 x 128 pixels, so a window across the sides of four costs four of them."""
    places: set[tuple[int, int, int, int]] = set()

    def read(*window: int) -> tuple[np.ndarray, np.ndarray]:
        places.add(window)
        return np.zeros((4, *window[:1:-1])), np.ones((4, *window[:1:-1]), dtype=bool)

    image: Any = SimpleNamespace(read=read)
    grid = Grid(pyproj.CRS("EPSG:32636"), 0.0, 0.0, 2.0, 2.0, 1500, 1100)
    read_samples(image, image, (1, 2, 3, 4), grid, multiple)
    used = np.zeros((grid.height, grid.width), dtype=int)
    for left, top, width, height in places:
        used[top : top + height, left : left + width] += 1
        if multiple < 20:  # its windows are larger than blocks
            assert (left // 512, top // 128) == ((left + width - 1) // 512, (top + height - 1) // 128)
    assert used.max() == 1
    parts = [half for rows in np.array_split(used, 2) for half in np.array_split(rows, 2, axis=1)]
    assert min(part.mean() for part in parts) > 0.2


def test_small_orthos_with_values_at_one_side_are_sharpened(tmp_path: Path) -> None:
    """Windows reach the right and the lower end of orthos that are less than two windows wide."""
    bundle = Bundle(side=800)
    pan, colours = bundle.pixels()
    pan[:, :560] = 0
    sharp = write(tmp_path / "pan.tif", pan[None], 0.5, nodata=0)
    result = run("sharpen", sharp, write(tmp_path / "ms.tif", colours, 2.0, nodata=0), "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["weights"]["values"] == pytest.approx(bundle.weights, abs=0.02)
    assert document["quality"]["sharpened"]["ergas"] < document["quality"]["upsampled"]["ergas"]


def test_registration_needs_a_match(tmp_path: Path) -> None:
    pan, _ = Bundle(side=256, seed=1).write(tmp_path)
    _, colours = Bundle(side=256, seed=2).write(tmp_path / "other")
    with pytest.raises(InputError):
        registration.measure_agreement(pan, colours, SceneOptions(), OutputOptions(threads=1))
