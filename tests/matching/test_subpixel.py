"""Shifts of parts of a pixel between real images: found without bias, and with a sigma that says how well.

Truth comes from no interpolator of ours: a band is moved by phases of its Fourier transform, or two images are made of
one that is much finer, as means over squares whose grids differ by fine pixels, with all the aliasing of a sensor.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from osgeo import gdal, osr
from trials import fitted, matches

from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.models.map_plane import MapPlane
from ortho_pipeline.surface.flat import FlatSurface

pytestmark = pytest.mark.realdata
Array = NDArray[np.float64]
UTM, CORNER, HEIGHT, FINE = "EPSG:32734", (300000.0, 6300000.0), 100.0, 5.0
#: Rows and columns of an aerial ortho that are valid.
AERIAL = (slice(140, 1040), slice(120, 660))


def band(data: Path, name: str, number: int) -> Array:
    """Return a band of one of the orthos: of Landsat (30 m), or the valid part of an aerial one (5 m)."""
    dataset = gdal.Open(str(data / "homonim" / name))
    pixels = dataset.GetRasterBand(number).ReadAsArray().astype(float)
    pixels = pixels if name.startswith("landsat") else pixels[AERIAL]
    assert (pixels > 0).all()
    return pixels


def shifted(pixels: Array, columns: float, rows: float) -> Array:
    """Return an image whose content lies so many pixels farther to the right and down, by its Fourier transform."""
    mirrored = np.block([[pixels, pixels[:, ::-1]], [pixels[::-1], pixels[::-1, ::-1]]])
    v, u = (np.fft.fftfreq(count) for count in mirrored.shape)
    phase = np.exp(-2j * np.pi * (u * columns + v[:, None] * rows))
    moved: Array = np.fft.ifft2(np.fft.fft2(mirrored) * phase).real
    return moved[: len(pixels), : pixels.shape[1]]


def averaged(pixels: Array, side: int, first: int = 0) -> Array:
    """Return means over squares of `side` fine pixels, the first of which begins at the fine pixel (first, first)."""
    rows, columns = ((count - first) // side for count in pixels.shape)
    part = pixels[first : first + rows * side, first : first + columns * side]
    means: Array = part.reshape(rows, side, columns, side).mean(axis=(1, 3))
    return means


def write(path: Path, pixels: Array, pixel: float) -> None:
    """Write an image of 16 bits at the corner."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *pixels.shape[::-1], 1, gdal.GDT_UInt16)
    crs = osr.SpatialReference()
    crs.SetFromUserInput(UTM)
    dataset.SetSpatialRef(crs)
    dataset.SetGeoTransform((CORNER[0], pixel, 0.0, CORNER[1], 0.0, -pixel))
    dataset.WriteArray(np.clip(np.rint(pixels * 50.0), 1, 65535).astype(np.uint16))
    dataset = None


def found(folder: Path, scene: Array, reference: Array, pixels: tuple[float, float] = (10.0, 10.0)) -> Fit:
    """Return the shift of a scene over flat ground, matched with a reference that begins at the same corner."""
    for name, image, pixel in zip(("scene", "reference"), (scene, reference), pixels, strict=True):
        write(folder / f"{name}.tif", image, pixel)
    size = scene.shape[1], scene.shape[0]
    model = MapPlane(UTM, CORNER, (pixels[0], pixels[0]), size, HEIGHT, (0.0, 0.0), (50.0, 150.0))
    surface, references = FlatSurface(HEIGHT), [folder / "reference.tif"]
    return fitted(model, matches(folder / "scene.tif", model, surface, references, search=8 * pixels[0]), "shift", size)


def check(fit: Fit, shift: tuple[float, float], exact: float = 0.005) -> None:
    """Check the shift of the scene (px), which is the negative of that of the reference's content."""
    error = fit.values + shift
    assert (np.abs(error) <= exact).all(), error
    assert (np.abs(error) <= 2.0 * fit.sigmas).all(), error / fit.sigmas
    assert (fit.sigmas < 0.006).all(), fit.sigmas


LANDSAT, EAST, WEST = "landsat8_byte.tif", "ngi_rgb_byte_1.tif", "ngi_rgb_byte_2.tif"


@pytest.mark.slow
def test_a_quarter_of_a_pixel_is_a_quarter(real: Path, tmp_path: Path) -> None:
    """By cubic convolution it was 0.267 ± 0.001."""
    pixels = band(real, LANDSAT, 4)
    check(found(tmp_path, pixels, shifted(pixels, 0.25, 0.25)), (0.25, 0.25))


def test_a_quarter_of_a_pixel_of_images_with_aliasing_is_a_quarter(real: Path, tmp_path: Path) -> None:
    pixels = band(real, EAST, 1)
    check(found(tmp_path, averaged(pixels, 4), averaged(pixels, 4, 1), (4 * FINE, 4 * FINE)), (-0.25, -0.25))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "number"), [(LANDSAT, 4), (LANDSAT, 5), (EAST, 1), (WEST, 2)])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_shifts_from_a_tenth_to_nine_tenths(real: Path, tmp_path: Path, name: str, number: int, noise: float) -> None:
    """With noise the sigma judges alone; of 14 errors in units of it one may be beyond 2."""
    random = np.random.default_rng(number)
    pixels = band(real, name, number)[:500]
    errors = []
    for shift in ((0.1, 0.9), (0.2, 0.0), (0.3, 0.3), (0.4, 0.6), (0.5, 0.5), (0.0, 0.7), (0.8, 0.8)):
        scene, reference = (one + random.normal(0, noise, pixels.shape) for one in (pixels, shifted(pixels, *shift)))
        fit = found(tmp_path, scene, reference)
        if not noise:
            check(fit, shift)
        errors.append((fit.values + shift) / fit.sigmas)
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert (np.abs(errors) > 2.0).sum() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.6, -1.0])
def test_gain_and_offset_move_nothing(real: Path, tmp_path: Path, gain: float) -> None:
    pixels = band(real, EAST, 1)[:500]
    check(found(tmp_path, pixels, gain * shifted(pixels, 0.25, 0.3) + (20.0 if gain > 0 else 257.0)), (0.25, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("sides", [(4, 2), (6, 2), (6, 3), (2, 4), (2, 6), (3, 6), (4, 6), (6, 4), (5, 5)])
def test_references_of_other_resolutions(real: Path, tmp_path: Path, sides: tuple[int, int]) -> None:
    """A reference of a third of the resolution is known to a part of its own pixels."""
    pixels = band(real, EAST, 1)
    fit = found(tmp_path, averaged(pixels, sides[0]), averaged(pixels, sides[1], 1), (FINE * sides[0], FINE * sides[1]))
    error = fit.values - 1.0 / sides[0]
    assert (np.abs(error) <= 2.0 * fit.sigmas).all(), error / fit.sigmas
    assert (np.abs(error) <= 0.005 * max(1.0, sides[1] / sides[0])).all(), error
