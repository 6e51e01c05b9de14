"""References of many bands: those without content take no part, whatever they are, and a user may choose."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal
from scenes import Case, Setting, View
from trials import tried

from ortho_pipeline.batch.config import MatchSettings
from ortho_pipeline.cli.program import cli
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource

SETTING = Setting(
    side=360, seed=5, error=9.0, margin=40.0, fine=1.0, scene=View(noise=0.03), reference=View(noise=0.03)
)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return Case(SETTING, tmp_path_factory.mktemp("bands")).write()


def delivered(case: Case, path: Path, order: str) -> Path:
    """Return the reference as a file whose bands are, by their letters, what products hold besides spectral bands."""
    whole = gdal.Open(str(case.reference_file))
    tone, place = whole.ReadAsArray().astype(float), whole.GetGeoTransform()
    random = np.random.default_rng(1)
    coarse = np.kron(tone[::8, ::8], np.ones((8, 8)))[: tone.shape[0], : tone.shape[1]]
    content = {
        "s": tone,  # a spectral band
        "0": np.zeros_like(tone),  # all nodata
        "1": np.full_like(tone, 900.0),  # one value
        "q": np.where(coarse > np.median(coarse), 21824.0, 22280.0),  # flags of quality
        "n": random.uniform(1, 4000, tone.shape),  # a channel of noise
        "h": np.where(np.arange(tone.shape[1]) < tone.shape[1] / 3, tone, 0.0),  # a third of the scene
        "x": tone[:, ::-1],  # content, but of nothing that is there
    }
    made = gdal.GetDriverByName("GTiff").Create(str(path), *tone.shape[::-1], len(order), gdal.GDT_UInt16)
    made.SetGeoTransform(place)
    made.SetSpatialRef(whole.GetSpatialRef())
    for number, letter in enumerate(order, start=1):
        made.GetRasterBand(number).SetNoDataValue(0)
        made.GetRasterBand(number).WriteArray(content[letter].astype(np.uint16))
    return path


@pytest.mark.parametrize(
    ("order", "chosen"),
    [
        ("s0", (1,)), ("0s", (2,)), ("1s", (2,)), ("qsq", (2,)), ("ns", (2,)), ("hs", (2,)), ("ss", (1, 2)),
        ("0q1s0n0hqss00q", (4, 10, 11)), ("ssssss", (1, 2, 3, 4)), ("00", (1, 2)), ("s", (1,)),
    ],
)  # fmt: skip
def test_bands_are_chosen_by_their_content(case: Case, tmp_path: Path, order: str, chosen: tuple[int, ...]) -> None:
    image = Intensity(RasterSource(delivered(case, tmp_path / "many.tif", order)))
    assert image.averaged == chosen


def test_bands_are_chosen_where_a_mosaic_has_values(case: Case, tmp_path: Path) -> None:
    small = delivered(case, tmp_path / "small.tif", "0sq")
    wide = tmp_path / "wide.vrt"
    gdal.Translate(str(wide), str(small), format="VRT", srcWin=[-3000, -3000, 6000, 6000]).FlushCache()
    assert Intensity(RasterSource(wide)).averaged == (2,)


def test_intensities_are_those_of_the_band_with_content(case: Case, tmp_path: Path) -> None:
    many = Intensity(RasterSource(delivered(case, tmp_path / "many.tif", "0q1s0n0hq0")))
    alone = Intensity(RasterSource(case.reference_file))
    for factor in (1, 3, 16):
        np.testing.assert_array_equal(many.read(-5, 3, 20, 20, factor), alone.read(-5, 3, 20, 20, factor))
    assert many.saturated == alone.saturated


def test_bands_without_values_do_not_stop_matching(case: Case, tmp_path: Path) -> None:
    found = tried(case, [delivered(case, tmp_path / "many.tif", "0q1s0n0hq0")], points=80)
    assert found.succeeded, found
    assert found.off < 0.1, found


def match(case: Case, reference: Path, output: Path, *words: object) -> tuple[int, dict]:
    given = ("match", case.scene_file, "--reference", reference, "--search", 30, "--dem", case.dem_file,
             "--dem-vertical", "ellipsoid", "--match-points", 80, *words, "-o", output, "--json")  # fmt: skip
    done = CliRunner().invoke(cli, [str(word) for word in given])
    return done.exit_code, json.loads(done.stdout)


def test_a_user_chooses_bands(case: Case, tmp_path: Path) -> None:
    # Chosen by content it would be all four, of which three show what is not there.
    reference = delivered(case, tmp_path / "many.tif", "xxsx")
    code, said = match(case, reference, tmp_path / "p.csv", "--reference-bands", "3")
    assert code == 0, said
    np.testing.assert_allclose(said["matching"]["shift_px"], -case.misfit(case.model)[0][4], atol=0.1)
    code, said = match(case, reference, tmp_path / "p.csv", "--reference-bands", "3,5")
    assert (code, said["error"]["field"], said["error"]["file"]) == (2, "--reference-bands", str(reference))


@pytest.mark.parametrize("command", ["rectify", "fit", "compare", "export", "match", "adjust", "measure"])
def test_every_command_that_takes_a_reference_takes_its_bands(command: str) -> None:
    (option,) = [one for one in cli.get_command(None, command).params if "--reference-bands" in one.opts]
    for words in (["--reference-bands", "4,3,2"], ["--reference-bands", "4", "--reference-bands", "3,2"]):
        made = click.Command(command, params=[option])
        assert made.make_context(command, words).params["match_reference_bands"] == (4, 3, 2)


def test_a_pipeline_file_takes_bands_of_the_reference(tmp_path: Path) -> None:
    settings = MatchSettings.model_validate({"reference": "ortho.tif", "reference_bands": [4, 3, 2]})
    assert settings.reference_bands == [4, 3, 2]


@pytest.mark.parametrize(
    ("option", "value"),
    [("--reference-bands", "1"), ("--check", "every:3"), ("--points-crs", "EPSG:4326"), ("--near", "5")],
)
def test_options_of_a_reference_or_of_points_that_are_not_given_are_refused(
    case: Case, tmp_path: Path, option: str, value: str
) -> None:
    words = ["rectify", str(case.scene_file), "--height", "300", "-o", str(tmp_path / "o"), option, value]
    done = CliRunner().invoke(cli, [*words, "--json"])
    assert (done.exit_code, json.loads(done.stdout)["error"]["field"]) == (2, option)


@pytest.mark.slow
@pytest.mark.realdata
def test_landsat_as_it_is_delivered(real: Path) -> None:
    """24 bands, those of quality without any value: bands 4, 3 and 2 alone give 367 of 405 matches."""
    from test_match_real import SIZE, QuickBird
    from trials import fitted, matches

    quickbird = QuickBird(real, Path())
    landsat = real / "homonim" / "landsat8_byte.tif"
    points = matches(quickbird.image, quickbird.model, quickbird.surface, [landsat], search=52.0, points=120)
    assert len(points) > 80
    shift = fitted(quickbird.model, points, "shift", SIZE)
    assert (np.abs(shift.values - quickbird.surveyed.values) < 4 * shift.sigmas).all()
