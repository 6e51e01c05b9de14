"""Bundle adjustment and intersection of real Pleiades images, compared with the results of other programs."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.intersection import intersect
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import DegeneratePoints
from ortho_pipeline.exchange.rpc import read_rpc, rpc_of_dataset
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models import RPC, ImageCorrection

pytestmark = pytest.mark.realdata
#: Half of the windows that are compared, and how far a match may lie from where the RPCs put it (px).
_HALF, _REACH = 16, 4


def rpc_of(path: Path) -> RPC:
    return rpc_of_dataset(gdal.Open(str(path)))[0]


def ties(measured: dict[str, np.ndarray]) -> BlockPoints:
    """Return tie points that were all measured in all images; a row of NaN is no measurement."""
    count = len(next(iter(measured.values())))
    seen = np.concatenate(list(measured.values()))
    good = np.isfinite(seen).all(axis=1)
    return BlockPoints(
        ids=tuple(map(str, range(count))), ground=np.full((count, 3), np.nan), roles=np.array(["tie"] * count),
        sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS(4326), images=tuple(measured),
        point=np.tile(np.arange(count), len(measured))[good],
        image=np.repeat(np.arange(len(measured)), count)[good], measured=seen[good],
        sigma_image=np.full(int(good.sum()), 0.2),
    )  # fmt: skip


class Triplet:
    """The three images of the s2p example, its matches of the first two, and its surface."""

    def __init__(self, folder: Path) -> None:
        paths = {str(k): folder / "s2p" / "input_triplet" / f"img_0{k}.tif" for k in (1, 2, 3)}
        self.rpcs = {name: rpc_of(path) for name, path in paths.items()}
        self.pixels = {name: gdal.Open(str(path)).ReadAsArray().astype(float) for name, path in paths.items()}
        matches = np.loadtxt(folder / "s2p" / "expected_output" / "units" / "matches_on_rpc_roi.txt")
        # The program counts from the centre of the first pixel.
        self.matches = {"1": matches[:, :2] + 0.5, "2": matches[:, 2:] + 0.5}
        surface = gdal.Open(str(folder / "s2p" / "expected_output" / "triplet" / "dsm.tif"))
        self.surface, self.place = surface.ReadAsArray(), surface.GetGeoTransform()

    def above_surface(self, ground: np.ndarray) -> float:
        """Return the median of heights above the surface that the other program made (UTM 31N, ellipsoidal)."""
        x, y, h = ground_transform("EPSG:4979", "EPSG:32631")(ground).T
        column, row = (x - self.place[0]) / self.place[1], (y - self.place[3]) / self.place[5]
        inside = (column >= 0) & (row >= 0) & (column < self.surface.shape[1]) & (row < self.surface.shape[0])
        apart = h[inside] - self.surface[row[inside].astype(int), column[inside].astype(int)]
        assert np.isfinite(apart).sum() > 150
        return float(np.nanmedian(apart))

    def in_third(self) -> np.ndarray:
        """Find the matches in the third image by phase correlation with the second, near where the RPCs put them."""
        from skimage.registration import phase_cross_correlation

        two = {name: self.rpcs[name] for name in ("1", "2")}
        ground = intersect(two, ties(self.matches)).ground
        expected = self.rpcs["3"].ground_to_image(ground)
        found = np.full(expected.shape, np.nan)
        for k, (from_, to) in enumerate(zip(self.matches["2"], expected, strict=True)):
            here, there = np.floor(from_).astype(int), np.floor(to).astype(int)
            one, other = (_window(self.pixels[name], at) for name, at in (("2", here), ("3", there)))
            if one is None or other is None:
                continue
            shift, error, _ = phase_cross_correlation(one, other, upsample_factor=50, normalization=None)
            # The same place of the ground lies at `from_` in one window and `shift` before it in the other.
            if np.abs(shift).max() < _REACH and error < 0.6:
                found[k] = there + (from_ - here) - shift[::-1]
        return found


def _window(pixels: np.ndarray, at: np.ndarray) -> np.ndarray | None:
    column, row = at
    if column < _HALF or row < _HALF or column + _HALF > pixels.shape[1] or row + _HALF > pixels.shape[0]:
        return None
    part = pixels[row - _HALF : row + _HALF, column - _HALF : column + _HALF]
    return (part - part.mean()) * np.outer(np.hanning(2 * _HALF), np.hanning(2 * _HALF))


@cache
def triplet(folder: Path) -> Triplet:
    return Triplet(folder)


def corrected(rpcs: dict[str, RPC], correction: str = "shift") -> dict[str, Any]:
    return {name: ImageCorrection.identity(rpc, correction, (512.0, 512.0)) for name, rpc in rpcs.items()}


def lengths(residuals: np.ndarray) -> float:
    return float(np.nanmedian(np.hypot(*residuals.T)))


def test_pleiades_matches_meet_to_a_third_of_a_pixel(real: Path) -> None:
    data = triplet(real)
    two = {name: data.rpcs[name] for name in ("1", "2")}
    points = ties(data.matches)
    before = intersect(two, points)
    assert lengths(before.residuals) == pytest.approx(0.33, abs=0.05)
    after = adjust(corrected(two), points)
    assert lengths(after.residuals[after.used_rays]) < 0.1
    assert "no control points" in after.gauge
    # What ties take away is across the epipolar lines; along them, where heights are, they hardly say anything.
    assert data.above_surface(after.ground) == pytest.approx(data.above_surface(before.ground), abs=0.3)


def test_pleiades_triplet_lies_on_the_surface_of_another_program(real: Path) -> None:
    """That surface is the mean of those of the pairs 1-2 and 2-3, which lie some 4 m apart (a pixel along the epipolar
    lines at 6.4 degrees), so only rays of all three images can be expected on it."""
    data = triplet(real)
    pairs = {"1": data.matches["1"], "2": data.matches["2"], "3": data.in_third()}
    assert np.isfinite(pairs["3"]).all(axis=1).mean() > 0.4
    points = ties(pairs).select(np.isfinite(pairs["3"]).all(axis=1))
    before = intersect(data.rpcs, points)
    assert abs(data.above_surface(before.ground)) < 1.5
    for correction in ("shift", "shift-drift", "affine"):
        after = adjust(corrected(data.rpcs, correction), points)
        assert lengths(after.residuals[after.used_rays]) < 0.25 * lengths(before.residuals)
        assert data.above_surface(after.ground) == pytest.approx(data.above_surface(before.ground), abs=0.3)
        assert "10 px" in after.gauge


def test_ventoux_parallax(real: Path) -> None:
    """Points of the left crop at three heights are seen in the right one where the data's notes say."""
    folder = real / "shareloc"
    left, right = (read_rpc(folder / "rpc" / "phr_ventoux" / f"{side}_image.geom") for side in ("left", "right"))
    heights = np.array([0.0, 700.0, 1500.0])
    wanted = np.array([[4906.5, 5195.7], [5034.3, 4727.7], [5180.4, 4192.9]])
    image = np.full((3, 2), 5000.0)
    ground = left.image_to_ground(image, heights)
    np.testing.assert_allclose(right.ground_to_image(ground), wanted, rtol=0, atol=0.1)
    # And back: the intersection of these rays is where they came from, a tenth of a pixel being some 0.2 m of height.
    points = ties({"left": image + 1e-9 * np.arange(3)[:, None], "right": wanted})
    found = intersect({"left": left, "right": right}, points)
    np.testing.assert_allclose(found.ground[:, 2], heights, atol=0.3)
    assert lengths(found.residuals) < 0.1


def test_ventoux_with_a_survey_of_half_a_metre_that_says_nothing_of_it(real: Path) -> None:
    """Real RPCs of half-metre pixels with simulated points: the set-up in which good control was refused."""
    folder = real / "shareloc" / "rpc" / "phr_ventoux"
    rpcs = {side: read_rpc(folder / f"{side}_image.geom") for side in ("left", "right")}
    start = {name: ImageCorrection.identity(rpc, "shift", (5000.0, 5000.0)) for name, rpc in rpcs.items()}
    held, refused, unscaled = [], 0, []
    for seed in range(6):
        random = np.random.default_rng(seed)
        truth = {name: model.with_params(random.normal(0, 8, 2)) for name, model in start.items()}
        ground = rpcs["left"].image_to_ground(random.uniform(2000, 18000, (39, 2)), random.uniform(300, 1500, 39))
        seen = np.concatenate([model.ground_to_image(ground) for model in truth.values()])
        assert np.isfinite(seen).all()
        metres = np.array([1 / 80_000, 1 / 111_000, 1.0])
        known = ground + random.normal(0, 0.5, (39, 3)) * metres * (np.arange(39) < 9)[:, None]
        points = BlockPoints(
            ids=tuple(map(str, range(39))), ground=known,
            roles=np.array(["control"] * 9 + ["check"] * 30), sigma_ground=np.zeros((39, 3)), crs=pyproj.CRS(4326),
            images=tuple(truth), point=np.tile(np.arange(39), 2), image=np.repeat([0, 1], 39),
            measured=seen + random.normal(0, 0.3, seen.shape), sigma_image=np.full(78, 0.5),
        )  # fmt: skip
        try:
            found = adjust(start, points)
        except DegeneratePoints:
            refused += 1
            continue
        wanted = np.concatenate([model.params for model in truth.values()])
        held.append(np.abs(found.values - wanted) < 1.96 * found.sigmas)
        unscaled.append((found.ground - ground)[9:] / metres / found.ground_sigmas[9:])
    assert refused == 0
    # Six blocks whose shifts share the errors of their control: 0.95 to a tenth, and all points to some hundredths.
    assert np.mean(held) >= 0.75
    assert 0.88 <= np.mean(np.abs(unscaled) < 1.96) <= 0.99
