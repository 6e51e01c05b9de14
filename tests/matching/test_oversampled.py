"""Images that were enlarged are matched in the pixels that they resolve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from landscape import PICTURES, REAL
from osgeo import gdal
from scenes import UTM, Case, Setting, View
from trials import matches

from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.dem import open_dem

#: As much noise as structure: an enlarged scene has it in wider spots than it has pixels.
NOISY = Setting(side=360, seed=3, error=12.0, scene=View(noise=0.2), reference=View(noise=0.15))
#: Pixels of a chip.
CHIP = 40
KERNELS = ("bilinear", "cubic", "cubicspline", "lanczos")


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Case:
    return Case(NOISY, tmp_path_factory.mktemp("noisy")).write()


def enlarged(path: Path, times: int, kernel: str, folder: Path) -> Path:
    """Return the middle of an image, at most 700 px a side, enlarged."""
    made, image = folder / f"{path.stem}_{times}_{kernel}.tif", gdal.Open(str(path))
    columns, rows = image.RasterXSize, image.RasterYSize
    wide, tall = min(columns, 700), min(rows, 700)
    window = [(columns - wide) // 2, (rows - tall) // 2, wide, tall]
    gdal.Translate(
        str(made), image, srcWin=window, width=times * wide, height=times * tall, resampleAlg=kernel
    ).FlushCache()
    return made


def was_enlarged(path: Path) -> bool:
    return Intensity(RasterSource(path)).enlarged


@dataclass(frozen=True)
class Found:
    """Matches of a scene that was enlarged, judged by the truth.

    Parameters
    ----------
    count : int
    rms : float
        Of the errors of the matches (px of the original).
    normalised : float
        Mean square of these errors, in units of their sigmas: 1 where sigmas are true.
    variance : float
        Of `normalised`, if they are. Chips that overlap have noise in common, by the part of the area that they share.
    """

    count: int
    rms: float
    normalised: float
    variance: float


def matched(case: Case, scene: Path, reference: Path, times: int) -> Found:
    surface = open_dem(case.dem_file, "ellipsoid")
    points = matches(
        scene, case.model.scaled(1 / times), surface, [reference], search=case.search, points=200
    )  # fmt: skip
    errors = points.image - times * case.image_of(points.to_crs(UTM).ground[:, :2])
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(points.covariance_image), errors)
    shared = np.maximum(1 - np.abs(points.image[:, None] - points.image) / (CHIP * times), 0).prod(axis=2)
    # Of two squares of each, whose correlation is that of the errors squared.
    variance = float((shared**2).sum()) / len(points) ** 2
    return Found(len(points), float(np.sqrt((errors**2).mean())) / times, float(squares.mean()) / 2, variance)


def test_an_enlarged_scene_of_much_noise_is_matched(noisy: Case, tmp_path: Path) -> None:
    scene = enlarged(noisy.scene_file, 2, "cubic", tmp_path)
    found = matched(noisy, scene, noisy.reference_file, 2)
    assert found.count > 40
    assert found.rms < 0.15
    assert abs(found.normalised - 1) < 3 * np.sqrt(found.variance), found


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
def test_sigmas_of_matches_in_much_noise_are_true(tmp_path: Path, times: int) -> None:
    rows = []
    for seed in range(3, 13):
        case = Case(replace(NOISY, seed=seed), tmp_path / str(seed)).write()
        scene = case.scene_file if times == 1 else enlarged(case.scene_file, times, "cubic", case.folder)
        rows.append(matched(case, scene, case.reference_file, times))
    assert max(row.rms for row in rows) < 0.2, rows
    mean, variance = np.mean([(row.normalised, row.variance) for row in rows], axis=0)
    assert abs(mean - 1) < 3 * np.sqrt(variance / len(rows)), rows


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "limit"), [
    (NOISY, 0.15),
    (replace(NOISY, scene=View(noise=0.06), reference=View(season=2, noise=0.06, bands="b")), 0.3),
    (replace(NOISY, scene=View(), reference=View()), 0.012),
], ids=["noise", "season", "plain"])  # fmt: skip
def test_enlarged_images_are_matched_as_they_were(tmp_path: Path, setting: Setting, limit: float) -> None:
    case = Case(setting, tmp_path).write()
    scene, reference = (enlarged(one, 2, "cubic", tmp_path) for one in (case.scene_file, case.reference_file))
    own = matched(case, case.scene_file, case.reference_file, 1).count
    for other in (case.reference_file, reference):
        found = matched(case, scene, other, 2)
        assert found.count > 0.95 * own
        assert found.rms < limit


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_was_enlarged_is_known_by_what_it_does_not_show(noisy: Case, tmp_path: Path, kernel: str) -> None:
    for times in (2, 4):
        assert was_enlarged(enlarged(noisy.reference_file, times, kernel, tmp_path))
    assert not was_enlarged(noisy.reference_file)
    assert not was_enlarged(noisy.scene_file)


@pytest.mark.realdata
@pytest.mark.parametrize("name", [name for name, _, _ in PICTURES[-4:]])
def test_real_images_were_not_enlarged_until_they_are(tmp_path: Path, name: str) -> None:
    assert not was_enlarged(REAL / name)
    assert all(was_enlarged(enlarged(REAL / name, 2, kernel, tmp_path)) for kernel in KERNELS)


def test_an_image_of_one_value_was_not_enlarged(tmp_path: Path) -> None:
    path = tmp_path / "even.tif"
    made = gdal.GetDriverByName("GTiff").Create(str(path), 200, 200, 1, gdal.GDT_Byte)
    made.WriteArray(np.full((200, 200), 7, np.uint8))
    made = None
    assert not was_enlarged(path)
