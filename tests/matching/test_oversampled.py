"""Images that were enlarged are matched in the pixels that they resolve."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from landscape import PICTURES, REAL
from osgeo import gdal
from scenes import UTM, Case, Setting, View
from trials import matches

from ortho_pipeline.points import Points
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.base import Surface

#: As much noise as structure: an enlarged scene has it in wider spots than it has pixels.
NOISY = Setting(side=360, seed=3, error=12.0, scene=View(noise=0.2), reference=View(noise=0.15))
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


def matched(case: Case, scene: Path, reference: Path, times: int) -> tuple[Points, float]:
    """Return the matches of a scene that was enlarged so many times, and their RMS (px of the original)."""
    surface = Surface.open(case.dem_file, "ellipsoid")
    points = matches(
        scene, case.model.scaled(1 / times), surface, [reference], search=case.search, points=200
    )  # fmt: skip
    errors = points.image / times - case.image_of(points.to_crs(UTM).ground[:, :2])
    return points, float(np.sqrt((errors**2).mean()))


def test_an_enlarged_scene_of_much_noise_is_matched(noisy: Case, tmp_path: Path) -> None:
    scene = enlarged(noisy.scene_file, 2, "cubic", tmp_path)
    points, rms = matched(noisy, scene, noisy.reference_file, 2)
    assert len(points) > 40
    # Single matches of so much noise scatter by more than they claim (0.16 px, 0.10 claimed); all together lie right.
    assert rms < 0.5
    off = points.image / 2 - noisy.image_of(points.to_crs(UTM).ground[:, :2])
    assert np.abs(np.median(off, axis=0)).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "limit"), [
    (NOISY, 0.15),
    (replace(NOISY, scene=View(noise=0.06), reference=View(season=2, noise=0.06, bands="b")), 0.3),
    (replace(NOISY, scene=View(), reference=View()), 0.012),
], ids=["noise", "season", "plain"])  # fmt: skip
def test_enlarged_images_are_matched_as_they_were(tmp_path: Path, setting: Setting, limit: float) -> None:
    case = Case(setting, tmp_path).write()
    scene, reference = (enlarged(one, 2, "cubic", tmp_path) for one in (case.scene_file, case.reference_file))
    own = len(matched(case, case.scene_file, case.reference_file, 1)[0])
    for other in (case.reference_file, reference):
        points, rms = matched(case, scene, other, 2)
        assert len(points) > 0.95 * own
        assert rms < limit


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
