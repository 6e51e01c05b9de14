"""Simulated flights of three small photos, as those of the sample: are the sigmas of blocks with matched ties true?"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pyproj
import pytest

from ortho_pipeline.commands import block
from ortho_pipeline.options import BlockOptions, MatchOptions, SurfaceOptions

pytestmark = pytest.mark.slow
SAMPLE = Path(__file__).parents[2] / "sample_data"
FLIGHTS = 8
#: The centre of a photo and places near its corners, px.
PLACES = np.array([[240.0, 160.0], [40.0, 40.0], [440.0, 40.0], [40.0, 280.0], [440.0, 280.0]])


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    """The program that made the sample's photos."""
    sys.path.insert(0, str(SAMPLE))
    spec = importlib.util.spec_from_file_location("sample_photos", SAMPLE / "photos.py")
    made = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = made
    spec.loader.exec_module(made)
    sys.path.remove(str(SAMPLE))
    return made


@pytest.fixture(scope="module")
def flights(maker, tmp_path_factory) -> list[tuple[list[Path], list]]:
    """Photos over the terrain of the sample's DEM, with other images, poses and errors; and their true cameras."""
    lon, lat, _ = maker.CENTRE
    x, y = pyproj.Transformer.from_crs("EPSG:4326", maker.MAP_CRS, always_xy=True).transform(lon, lat)
    terrain = maker.Terrain(
        maker.MAP_CRS, round(x, -2), round(y, -2), maker.LAKE_LEVEL, maker.RELIEF, maker.SEEDS["terrain"]
    )
    found = []
    for flight in range(FLIGHTS):
        random, folder = np.random.default_rng(1000 + flight), tmp_path_factory.mktemp("flight")
        landscape = maker.Landscape(terrain, maker.PIXEL, seed=100 + flight)
        paths, cameras = [folder / f"photo{number}.jpg" for number in range(3)], []
        for number, path in enumerate(paths):
            place = np.array([lon + (number - 1) * maker.BASE / 88_800.0, lat, 850.0 + maker.ABOVE])
            angles = np.add([90.0, -90.0, 0.0], random.normal(0, 1.5, 3))
            cameras.append(maker.Pinhole(place, maker.turn_of(place, *angles)))
            pixels = maker.render(cameras[-1], terrain, landscape, seed=500 + 10 * flight + number)
            stated = place + random.normal(0, maker.POSITION, 3) / (88_800.0, 111_000.0, 1.0)
            maker.write(path, pixels, stated, angles + random.normal(0, maker.ANGLE, 3))
        found.append((paths, cameras))
    return found


def ground_of(camera, height: float) -> np.ndarray:
    """Return lon, lat, h where a true camera sees a height."""
    back = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    origin, lines = camera.rays(PLACES)
    up, ecef = origin[0] / np.linalg.norm(origin[0]), origin.copy()
    for _ in range(8):
        apart = np.stack(back.transform(*ecef.T), axis=1)[:, 2] - height
        ecef = ecef - lines * (apart / (lines @ up))[:, None]
    return np.stack(back.transform(*ecef.T), axis=1)


def spread(flights, folder: Path, monkeypatch, **match: int) -> tuple[float, float]:
    """Return the RMS error (px per axis), and the RMS of errors over their sigmas, of the images of all flights."""
    fits, solve = [], block.adjust_block
    monkeypatch.setattr(block, "adjust_block", lambda *words, **more: fits.append(solve(*words, **more)) or fits[-1])
    errors, squares = [], []
    for paths, cameras in flights:
        surface = SurfaceOptions(dem=SAMPLE / "dem.tif")
        block.adjust(paths, folder, BlockOptions(ties="auto"), match=MatchOptions(**match), surface=surface)
        for image, (model, camera) in enumerate(zip(fits[-1].models.values(), cameras, strict=True)):
            ground = ground_of(camera, 850.0)
            off, partials = model.ground_to_image(ground) - PLACES, model.param_partials(ground)
            covariance = partials @ fits[-1].cofactors.of_image(image) @ partials.swapaxes(1, 2)
            errors.append(off)
            squares.append((off * np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).sum(axis=1) / 2)
    monkeypatch.undo()
    return float(np.sqrt(np.mean(np.square(errors)))), float(np.sqrt(np.mean(squares)))


def test_sigmas_of_small_photos_are_true_by_default_and_too_small_with_crowded_ties(flights, tmp_path, monkeypatch):
    """The squares of eight flights have a mean that is known to a third."""
    error, apart = spread(flights, tmp_path / "apart", monkeypatch)
    worse, crowded = spread(flights, tmp_path / "crowded", monkeypatch, points=500)
    print(f"error {error:.2f} px, over its sigma {apart:.2f}; with crowded ties {worse:.2f} px, {crowded:.2f}")
    assert 0.6 < apart < 1.2
    assert crowded > 1.4 * apart
    assert error < worse
