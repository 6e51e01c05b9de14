"""Edges of known spread: Gaussians seen through square pixels, counted by sub-pixels and not by the model's formula."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal
from scipy.special import ndtr

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging import resolution
from ortho_pipeline.imaging.edge import APERTURE, Segment, analyse_edge, edge_response

Array = np.ndarray


def edge_image(
    sigma: float,
    angle_deg: float,
    *,
    size: int = 64,
    levels: tuple[float, float] = (200.0, 800.0),
    noise: float = 5.0,
    seed: int = 0,
    pixel: float = 1.0,
    margin: float = 8.0,
) -> tuple[Array, Segment]:
    """Return an edge whose normal is turned by `angle_deg` from the row, and its ends.

    Each pixel is the mean of 16 x 16 places in a square of the side `pixel`, blurred by a Gaussian.
    """
    turn, centre = math.radians(angle_deg), size / 2 + 0.13
    pixels = levels[0] + (levels[1] - levels[0]) * _seen(sigma, turn, size, pixel)
    pixels += np.random.default_rng(seed).normal(0.0, noise, pixels.shape)
    along = np.array([-math.sin(turn), math.cos(turn)])
    along *= (size / 2 - margin) / np.abs(along).max()
    first, last = (centre - along).tolist(), (centre + along).tolist()
    return pixels, ((first[0], first[1]), (last[0], last[1]))


@functools.cache
def _seen(sigma: float, turn: float, size: int, pixel: float) -> Array:
    """Return the share of each pixel that lies on the bright side."""
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    centre = size / 2 + 0.13
    places = ((np.arange(16) + 0.5) / 16 - 0.5) * pixel
    seen = np.zeros((size, size))
    for dx in places:
        for dy in places:
            distance = (x + dx - centre) * math.cos(turn) + (y + dy - centre) * math.sin(turn)
            seen += ndtr(distance / sigma) if sigma > 0 else distance > 0
    return seen / 256


def nudged(segment: Segment, by: float = 1.5) -> Segment:
    (x1, y1), (x2, y2) = segment
    return (x1 + by, y1 - by), (x2 - by / 2, y2 + by / 2)


# -- the width -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("angle", [4.0, 11.0, -23.0, 38.0, 64.0, 97.0, 160.0])
def test_width_of_a_gaussian_is_recovered_to_5_per_cent(sigma, angle):
    pixels, segment = edge_image(sigma, angle)
    edge = analyse_edge(pixels, nudged(segment))
    # The point spread without the pixel's aperture, and the line spread with it.
    assert edge.psf_sigma == pytest.approx(sigma, rel=0.05)
    assert edge.sigma == pytest.approx(math.hypot(sigma, APERTURE), rel=0.05)
    assert edge.fwhm == pytest.approx(2.3548 * math.hypot(sigma, APERTURE), rel=0.05)
    assert edge.overshoot == 0.0
    assert edge.contrast == pytest.approx(600.0, rel=0.01)
    assert edge.noise == pytest.approx(5.0, rel=0.2)


def test_errors_are_as_large_as_claimed():
    """Over seeds, (estimate - truth) / claimed error has a spread of about one (0.7 to 1.4 for 40 repeats)."""
    ratios = []
    for seed in range(40):
        pixels, segment = edge_image(0.8, 12.0, size=44, noise=20.0, seed=seed)
        edge = analyse_edge(pixels, segment)
        ratios.append((edge.psf_sigma - 0.8) / edge.sigma_error)
    assert 0.7 < np.std(ratios) < 1.4
    assert abs(np.mean(ratios)) < 0.6


def test_a_perfect_sensor_has_the_aperture_of_its_pixel():
    pixels, segment = edge_image(0.0, 7.0, noise=1.0)
    edge = analyse_edge(pixels, segment)
    assert edge.fwhm == pytest.approx(1.0, abs=0.1)
    assert edge.psf_sigma < 0.1
    # Point-sampled pixels have no aperture at all, and show less.
    pixels, segment = edge_image(0.0, 7.0, noise=1.0, pixel=0.01)
    assert analyse_edge(pixels, segment).fwhm < 0.7


def test_staggered_lines_blur_but_not_to_two_pixels():
    """Pixels twice as large as their distance have an effective resolution between one and two of them."""
    sharp = analyse_edge(*edge_image(0.4, 9.0, noise=2.0))
    staggered = analyse_edge(*edge_image(0.4, 9.0, noise=2.0, pixel=2.0))
    assert staggered.fwhm == pytest.approx(2.0, abs=0.15)
    assert sharp.fwhm == pytest.approx(1.2, abs=0.1)


def test_falling_turned_and_mirrored_edges_have_one_width():
    pixels, ((x1, y1), (x2, y2)) = edge_image(0.9, 14.0, noise=0.0)
    reference = analyse_edge(pixels, ((x1, y1), (x2, y2)))
    falling = analyse_edge(1000.0 - pixels, ((x2, y2), (x1, y1)))
    transposed = analyse_edge(pixels.T, ((y1, x1), (y2, x2)))
    for other in (falling, transposed):
        assert other.psf_sigma == pytest.approx(reference.psf_sigma, rel=1e-3)
    assert (reference.profile, transposed.profile) == ("along the row", "along the column")
    assert reference.angle_deg == pytest.approx(14.0, abs=0.2)
    assert np.allclose(np.array(transposed.segment), np.array(reference.segment)[:, ::-1], atol=0.02)


def test_sharpening_is_seen_as_overshoot():
    from scipy.ndimage import gaussian_filter

    pixels, segment = edge_image(0.9, 14.0, noise=1.0)
    sharpened = pixels + 1.0 * (pixels - gaussian_filter(pixels, 1.5))
    edge = analyse_edge(sharpened, segment)
    assert edge.overshoot > 0.05
    assert edge.fwhm < analyse_edge(pixels, segment).fwhm


def test_response_is_the_integral_of_its_pixel():
    """Against a count of sub-pixels, for several angles and widths."""
    for sigma, turn in ((0.3, 0.0), (0.3, 1e-4), (0.5, 0.4), (1.2, math.pi / 4), (0.05, 0.2)):
        distance = np.linspace(-4, 4, 41)
        u = (np.arange(400) + 0.5) / 400 - 0.5
        inside = (u[:, None] * math.cos(turn) + u[None, :] * math.sin(turn)).ravel()
        counted = np.array([ndtr((d + inside) / sigma).mean() for d in distance])
        assert edge_response(distance, sigma, math.cos(turn), math.sin(turn)) == pytest.approx(counted, abs=2e-5)


# -- what is refused -------------------------------------------------------------------------------------------------


def test_nodata_beside_the_edge_is_left_out():
    pixels, segment = edge_image(0.8, 12.0)
    reference = analyse_edge(pixels, segment)
    holed = pixels.copy()
    holed[20:24] = np.nan
    assert analyse_edge(holed, segment).psf_sigma == pytest.approx(reference.psf_sigma, rel=0.05)
    holed[:, 32:] = np.nan
    with pytest.raises(InputError, match=r"no value|on one side"):
        analyse_edge(holed, segment)


@pytest.mark.parametrize("angle", [0.0, 90.0, 45.0, 0.2, 26.565])
def test_an_edge_along_the_pixel_grid_is_refused(angle):
    """A row of an edge with a slope of 1/2 repeats the distances of the row above it."""
    with pytest.raises(InputError, match="pixels at too few distances") as caught:
        analyse_edge(*edge_image(0.5, angle))
    assert "3 to 15 degrees" in caught.value.remedy


def test_what_is_no_edge_is_refused():
    noise = np.random.default_rng(0).normal(100.0, 5.0, (64, 64))
    inside = ((20.0, 5.0), (25.0, 60.0))
    for pixels in (noise, np.full((64, 64), 7.0), noise + 12.0 * (np.arange(64) > 22)):
        with pytest.raises(InputError, match=r"not an edge|too little contrast|no step|not straight|too uncertain"):
            analyse_edge(pixels, inside)
    for segment in (((-3.0, 5.0), (25.0, 60.0)), ((20.0, 5.0), (25.0, 65.0)), ((math.nan, 5.0), (25.0, 60.0))):
        with pytest.raises(InputError):
            analyse_edge(noise, segment)
    with pytest.raises(InputError, match="crosses only 5 lines"):
        analyse_edge(noise, ((20.0, 5.0), (21.0, 10.0)))
    with pytest.raises(InputError, match="crosses only 0 lines"):
        analyse_edge(noise, ((20.0, 5.0), (20.0, 5.0)))


# -- images ----------------------------------------------------------------------------------------------------------


def fields(sigma: float, noise: float = 6.0) -> Array:
    """Return an image of six rectangles, turned by 17 degrees, on even ground."""
    size, fine = 220, 4
    at = (np.arange(size * fine) + 0.5) / fine
    x, y = np.meshgrid(at, at)
    turn = math.radians(17.0)
    u, v = x * math.cos(turn) + y * math.sin(turn), -x * math.sin(turn) + y * math.cos(turn)
    seen = np.zeros_like(u)
    for k, (left, top) in enumerate(((60, -20), (130, -10), (50, 50), (120, 60), (80, 120), (150, 110))):
        across, down = (
            ndtr((along - low) / sigma) * ndtr((low + side - along) / sigma)
            for low, side, along in ((left, 48, u), (top, 44, v))
        )
        seen += (0.5 + 0.1 * k) * across * down
    pixels = seen.reshape(size, fine, size, fine).mean(axis=(1, 3))
    return 300.0 + 700.0 * pixels + np.random.default_rng(1).normal(0.0, noise, pixels.shape)


def write(path: Path, *bands: Array, nodata: float | None = None) -> Path:
    dataset = gdal.GetDriverByName("GTiff").Create(
        str(path), bands[0].shape[1], bands[0].shape[0], len(bands), gdal.GDT_UInt16
    )
    for k, band in enumerate(bands):
        dataset.GetRasterBand(k + 1).WriteArray(np.rint(band).astype(np.uint16))
        if nodata is not None:
            dataset.GetRasterBand(k + 1).SetNoDataValue(nodata)
    del dataset
    return path


def test_edges_of_an_image_are_found(tmp_path):
    image = write(tmp_path / "fields.tif", np.full((220, 220), 9.0), fields(0.8))
    edges = resolution.measure(image, band=2)
    assert len(edges) >= 12
    assert np.median([edge.psf_sigma for edge in edges]) == pytest.approx(0.8, rel=0.05)
    middles = np.array([np.mean(edge.segment, axis=0) for edge in edges])
    apart = np.hypot(*(middles[:, None] - middles[None]).transpose(2, 0, 1)) + 99 * np.eye(len(edges))
    assert apart.min() > 5
    assert [edge.fwhm for edge in resolution.measure(image, band=2)] == [edge.fwhm for edge in edges]


def test_edges_are_not_measured_across_nodata(tmp_path):
    pixels = fields(0.8)
    pixels[:, 100:] = 0.0
    edges = resolution.measure(write(tmp_path / "half.tif", pixels, nodata=0.0))
    assert edges
    assert max(max(x for x, _ in edge.segment) for edge in edges) < 100
    assert np.median([edge.psf_sigma for edge in edges]) == pytest.approx(0.8, rel=0.06)


def test_command(tmp_path):
    image = write(tmp_path / "fields.tif", fields(1.0))
    done = CliRunner().invoke(cli, ["edge", str(image), "-o", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["schema_version"] == 1
    assert document["median"]["all"]["psf_sigma_px"] == pytest.approx(1.0, rel=0.05)
    assert document["median"]["all"]["n"] == len(document["edges"])
    assert set(document["files"]) == {"json", "svg"}
    saved = json.loads((tmp_path / "out" / "fields_edges.json").read_text())
    assert saved["edges"] == document["edges"]
    assert (tmp_path / "out" / "fields_edge.svg").read_text().startswith("<svg")
    best = ",".join(str(value) for end in document["edges"][0]["edge"] for value in end)
    given = CliRunner().invoke(cli, ["edge", str(image), "--edge", best])
    assert given.exit_code == 0, given.output
    assert "1 edge)" in given.stdout
    assert "include the aperture of the pixel" in given.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--edge", "1,2,3"), "is not an edge"),
        (("--edge", "1,2,3,inf"), "is not an edge"),
        (("--edge", "5,5,500,40"), "is outside the image"),
        (("--edge", "5,205,40,215"), "too little contrast"),
        (("--band", "2"), "has 1 band"),
    ],
)
def test_command_says_what_to_correct(tmp_path, arguments, said):
    image = write(tmp_path / "fields.tif", fields(1.0))
    done = CliRunner().invoke(cli, ["edge", str(image), *arguments, "--json"])
    assert done.exit_code == 2
    error = json.loads(done.stdout)["error"]
    assert said in error["message"]
    assert error["remedy"]


@pytest.mark.parametrize("levels", [(20.0, 280.0), (-30.0, 200.0)])
def test_saturated_edges_are_refused(tmp_path, levels):
    """Pixels of an 8-bit image that are clipped at 0 or 255 make an edge of 1 px look like one of 0.85 px."""
    pixels, segment = edge_image(1.0, 8.0, levels=levels, noise=2.0)
    path = tmp_path / "bright.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *pixels.shape[::-1], 1)
    dataset.WriteArray(np.clip(np.rint(pixels), 0, 255).astype(np.uint8))
    del dataset
    with pytest.raises(InputError, match="next to the edge are saturated"):
        resolution.measure(path, edge=segment)
    with pytest.raises(InputError, match="no suitable edge"):
        resolution.measure(path)


def test_saturated_edges_of_few_bits_are_refused(tmp_path):
    """Clipped at 2047, an edge of 0.6 px would look like one of 0.45 px."""
    pixels, segment = edge_image(0.6, 8.0, levels=(300.0, 2500.0), noise=2.0)
    path = tmp_path / "bright.tif"
    size = pixels.shape[::-1]
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, 1, gdal.GDT_UInt16, ["NBITS=11"])
    dataset.WriteArray(np.clip(np.rint(pixels), 0, 2047).astype(np.uint16))
    del dataset
    with pytest.raises(InputError, match="next to the edge are saturated"):
        resolution.measure(path, edge=segment)


def test_an_image_without_edges_is_an_error(tmp_path):
    flat = np.random.default_rng(0).normal(500.0, 5.0, (100, 100))
    for pixels in (flat, np.full((100, 100), 3.0), np.zeros((3, 3))):
        with pytest.raises(InputError, match="no suitable edge"):
            resolution.measure(write(tmp_path / "flat.tif", pixels))


@pytest.mark.slow
@pytest.mark.realdata
def test_a_pleiades_crop_is_resolved_to_two_of_its_pixels(real):
    """Pleiades Pan is delivered at 0.5 m and resolves some 0.7 m at best; edges of houses are not all sharp."""
    edges = resolution.measure(real / "shareloc" / "image" / "phr_gizeh" / "img1.tif")
    assert len(edges) > 5
    assert 1.3 < np.median([edge.fwhm for edge in edges]) < 2.5
