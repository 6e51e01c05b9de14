"""Ground of known truth for tests of matching: texture and relief that repeat at their rims, so that filters are exact.

Nothing here knows of the matcher, of its pyramid or of the warp. A texture is a periodic array of texels; a sensor sees
it through a box and a Gaussian, which are applied to its Fourier transform, and samples it by cubic B-splines. So what
an image shows at a place is the same function of the place in every image, whatever its grid, without aliasing.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

# Benchmarks run without the paths of pytest.
sys.path.append(str(Path(__file__).resolve().parents[2] / "tools"))

from real_data import data_folder

Array = NDArray[np.float64]
Texture = NDArray[np.float32]

#: Texels of the periodic ground, along each side, and of one sample of its relief.
SIZE, CELL = 2048, 8
#: Different parcels, each of which has a life of its own through the seasons.
PARCELS = 16
REAL = data_folder()
STRIPS = ("05_0182", "05_0184", "06_0251", "06_0253")
#: Real images whose pixels become texels, with the band (from 0) of the tone and of the other band.
PICTURES = (
    *((f"orthority/ngi/3324c_2015_1004_{strip}_RGB.tif", 1, 0) for strip in STRIPS),
    ("orthority/rpc/qb2_basic1b.tif", 0, 0),
    ("s2p/input_triplet/img_01.tif", 0, 0),
    ("shareloc/image/phr_gizeh/img1.tif", 0, 0),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Land:
    """A periodic ground; coordinates (u, v) are texels to the right and downwards from the corner of the first.

    Parameters
    ----------
    tones : dict of str to ndarray (SIZE, SIZE)
        Brightness, about 0 to 1, in the bands ``a`` and ``b``.
    parcels : ndarray (SIZE, SIZE) of uint8
    relief : ndarray (SIZE / CELL, SIZE / CELL)
        Heights with mean 0 and standard deviation 1; bilinear between the centres of samples.
    """

    tones: dict[str, Texture]
    parcels: NDArray[np.uint8]
    relief: Array
    _seen: dict[object, Texture] = field(default_factory=dict)

    def seen(self, band: str, season: int, box: float, blur: float) -> Texture:
        """Return B-spline coefficients of the ground as a sensor sees it whose pixels are `box` texels wide.

        Season 0 is the tone as it is; in every other one each kind of parcel has a curve of its own, often inverted
        or not monotonic. `blur` is the sigma of a Gaussian in texels.
        """
        key = (band, season, box, blur)
        if key not in self._seen:
            while len(self._seen) >= 3:
                self._seen.pop(next(iter(self._seen)))
            self._seen[key] = _coefficients(self._dressed(band, season), box, blur)
        return self._seen[key]

    def _dressed(self, band: str, season: int) -> Texture:
        tone = self.tones[band]
        if not season:
            return tone
        random = np.random.default_rng([season, 77])
        levels = np.linspace(-0.2, 1.2, 64)
        curves = np.empty((PARCELS, 64), dtype=np.float32)
        for parcel in range(PARCELS):
            slope = random.choice([-0.9, -0.5, 0.4, 0.8, 1.0])
            bend = random.choice([0.0, 0.0, 0.8])
            curves[parcel] = 0.5 + slope * (levels - 0.5) + bend * ((levels - 0.5) ** 2 - 0.08) + random.normal(0, 0.08)
        place = np.clip((tone + 0.2) * (63 / 1.4), 0, 62.999)
        low = place.astype(np.uint8)
        share = place - low
        return curves[self.parcels, low] * (1 - share) + curves[self.parcels, low + 1] * share

    def heights(self, u: Array, v: Array) -> Array:
        """Return the relief (standard deviation 1) at texel coordinates of any shape."""
        return bilinear(self.relief, u / CELL, v / CELL)


def bilinear(samples: np.ndarray, u: Array, v: Array) -> Array:
    """Interpolate a periodic array between the centres of its samples; (u, v) in samples from its corner."""
    return map_coordinates(samples, [np.asarray(v) - 0.5, np.asarray(u) - 0.5], order=1, mode="grid-wrap", output=float)


def sample(coefficients: Texture, u: Array, v: Array) -> Texture:
    """Return values at texel coordinates from B-spline coefficients."""
    place = [np.asarray(v) - 0.5, np.asarray(u) - 0.5]
    return map_coordinates(coefficients, place, order=3, mode="grid-wrap", prefilter=False, output=np.float32)


def _coefficients(tone: Texture, box: float, blur: float) -> Texture:
    """Filter by a box and a Gaussian and turn into coefficients of the cubic B-spline, in one pass through Fourier."""
    rows, columns = scipy.fft.fftfreq(len(tone)), scipy.fft.rfftfreq(len(tone))

    def along(frequency: Array) -> Texture:
        lens = np.sinc(frequency * box) * np.exp(-2 * (np.pi * blur * frequency) ** 2)
        return (lens * 3 / (2 + np.cos(2 * np.pi * frequency))).astype(np.float32)

    spectrum = scipy.fft.rfft2(tone)
    spectrum *= along(rows)[:, None]
    spectrum *= along(columns)
    return scipy.fft.irfft2(spectrum, s=tone.shape).astype(np.float32)


def correlation(roughness: str, distance: Array) -> Array:
    """Return the correlation of errors at distances over their length, 1/e at 1: exponential, matern, gaussian."""
    if roughness == "exponential":
        return np.exp(-distance)
    if roughness == "matern":
        return (1.0 + 2.1461932206 * distance) * np.exp(-2.1461932206 * distance)
    return np.exp(-(distance**2))


def field_of(random: np.random.Generator, size: int, length: float, roughness: str = "gaussian") -> Array:
    """Return a periodic Gaussian field, sigma 1, whose `correlation` falls over a length."""
    noise = random.normal(0, 1, (size, size))
    if roughness != "gaussian":
        steps = np.minimum(np.arange(size), size - np.arange(size)) / length
        spectrum = scipy.fft.fft2(correlation(roughness, np.hypot(steps[:, None], steps))).real
        return scipy.fft.ifft2(scipy.fft.fft2(noise) * np.sqrt(np.maximum(spectrum, 0.0))).real
    smooth = gaussian_filter(noise, length / 2, mode="wrap", truncate=5)
    # What a filter leaves of white noise is known: the sample's own deviation would take away the field's mean level.
    kernel = np.zeros(2 * int(5 * length / 2 + 0.5) + 3)
    kernel[len(kernel) // 2] = 1
    return smooth / (gaussian_filter(kernel, length / 2, truncate=5, mode="constant") ** 2).sum()


def fractal(random: np.random.Generator, size: int, power: float) -> tuple[Texture, Texture]:
    """Return two periodic fields, mean 0 and sigma 1, whose amplitudes fall with this power of the frequency."""
    shape = (size, size)
    spectrum = (random.standard_normal(shape, np.float32) + 1j * random.standard_normal(shape, np.float32)).astype("c8")
    frequency = np.hypot(scipy.fft.fftfreq(size)[:, None], scipy.fft.fftfreq(size)).astype(np.float32)
    frequency[0, 0] = 1
    spectrum *= frequency**-power
    spectrum[0, 0] = 0
    both = scipy.fft.ifft2(spectrum)
    return both.real / both.real.std(), both.imag / both.imag.std()


@lru_cache(maxsize=2)
def land(kind: str, seed: int = 0) -> Land:
    """Return a ground: 'country', 'woods', 'town', 'real' (of real images), 'roofs', 'chessboard' or 'water'."""
    random = np.random.default_rng([seed, 11])
    relief = fractal(random, SIZE // CELL, 2.0)[0].astype(float)
    # Rays meet a facet of the relief once: the finest of its waves are too steep for that.
    relief = gaussian_filter(relief, 1.5, mode="wrap")
    relief = (relief - relief.mean()) / relief.std()
    parcels, tone = _country(random)
    makers = {
        "country": lambda: _two_bands(random, parcels, tone),
        "woods": lambda: _two_bands(random, parcels, _woods(random)),
        "town": lambda: _two_bands(random, parcels, _with_roofs(random, tone, 2200)),
        "real": _pictures,
        "roofs": lambda: _two_bands(None, parcels, _terraces()),
        "chessboard": lambda: _two_bands(None, parcels, _chessboard()),
        "water": lambda: _two_bands(None, parcels, np.full((SIZE, SIZE), 0.1, np.float32)),
    }
    return Land(makers[kind](), parcels, relief)


def _country(random: np.random.Generator) -> tuple[NDArray[np.uint8], Texture]:
    """Return parcels and a tone: fields with furrows, hedges, roads, woods, and noise of all scales."""
    v, u = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32)
    bend = 25 * np.sin(2 * np.pi / SIZE * (2 * u + v)) + 25 * np.sin(2 * np.pi / SIZE * (v - u) + 1)
    # A turn by 27 degrees that keeps the period; lengths are 2.24 times as long here.
    along, across = (2 * u + v + bend) % SIZE, (2 * v - u + bend) % SIZE
    del u, v, bend
    edges = np.concatenate([[0], np.sort(random.uniform(0, SIZE, 14)), [SIZE]])
    strip = (np.searchsorted(edges, across.ravel(), "right") - 1).clip(0, 14).reshape(across.shape).astype(np.uint8)
    counts = random.integers(8, 26, 15)
    place = (along / SIZE + random.uniform(0, 1, 15)[strip].astype(np.float32)) * counts[strip].astype(np.float32)
    number = place.astype(np.int16) % counts[strip]
    tone = random.uniform(0.15, 0.85, (15, 26)).astype(np.float32)[strip, number]
    parcels = random.integers(0, PARCELS, (15, 26)).astype(np.uint8)[strip, number]
    furrows = random.choice([0.0, 0.0, 0.05, 0.1], (15, 26)).astype(np.float32)[strip, number]
    tone += furrows * np.sin(across * np.float32(2 * np.pi / 16))
    inside = np.abs(place - np.rint(place)) * (SIZE / counts[strip])
    beside = np.minimum(across - edges[strip], edges[strip + 1] - across)
    fine, coarse = fractal(random, SIZE, 1.0)
    tone += 0.09 * fine
    wood = coarse > 1.2
    tone[inside < 4] = 0.15 + 0.05 * fine[inside < 4]
    tone[wood] = 0.2 + 0.15 * fine[wood]
    tone[(beside < 6) & (strip % 2 == 0)] = 0.7
    return parcels, tone


def _woods(random: np.random.Generator) -> Texture:
    # Crowns, stands and clearings: a bit finer than the amplitudes of most landscapes, which fall with the frequency.
    fine, coarse = fractal(random, SIZE, 0.9)[0], fractal(random, SIZE, 1.4)[0]
    return (0.4 + 0.12 * fine + 0.08 * coarse).astype(np.float32)


def _with_roofs(random: np.random.Generator, tone: Texture, count: int) -> Texture:
    """Return the tone with houses of many sizes, each with a shadow."""
    tone = tone.copy()
    places = random.integers(0, SIZE - 60, (count, 2))
    sizes, bright = random.integers(5, 36, (count, 2)), random.uniform(0.3, 1.1, (count, 2))
    for (row, column), (height, width), (left, right) in zip(places, sizes, bright, strict=True):
        tone[row + 3 : row + height + 5, column + 4 : column + width + 6] = 0.05
        tone[row : row + height, column : column + width // 2] = left
        tone[row : row + height, column + width // 2 : column + width] = 0.8 * right
    return tone


def _terraces() -> Texture:
    """Return equal roofs in equal rows, everywhere: nothing tells one from its neighbour."""
    one = np.full((64, 32), 0.3, np.float32)
    one[6:30, 4:24], one[6:30, 14:24], one[30:34, 6:26] = 0.9, 0.6, 0.05
    return np.tile(one, (SIZE // 64, SIZE // 32))


def _chessboard() -> Texture:
    v, u = np.indices((SIZE // 32, SIZE // 32))
    return np.kron((u + v) % 2, np.ones((32, 32))).astype(np.float32)


def _two_bands(random: np.random.Generator | None, parcels: NDArray[np.uint8], tone: Texture) -> dict[str, Texture]:
    """Return the bands: in the other one kinds of parcels are brighter or darker and less, or more, pronounced."""
    if random is None:
        return {"a": tone, "b": tone}
    gain, level = random.uniform(0.5, 1.2, PARCELS).astype("f4"), random.normal(0, 0.12, PARCELS).astype("f4")
    other = 0.5 + gain[parcels] * (tone - 0.5) + level[parcels] + 0.03 * fractal(random, SIZE, 0.8)[0]
    return {"a": tone, "b": other.astype(np.float32)}


def has_pictures() -> bool:
    """Whether the real images are on this machine."""
    return all((REAL / name).exists() for name, _, _ in PICTURES)


def _pictures() -> dict[str, Texture]:
    """Return a patchwork of real images, in all eight positions of a square, of as many different ones as there are."""
    from osgeo import gdal

    patch, found = 512, []
    for name, tone, other in PICTURES:
        dataset = gdal.Open(str(REAL / name))
        bands = [_levelled(dataset.GetRasterBand(band + 1).ReadAsArray()) for band in (tone, other)]
        rows, columns = bands[0].shape
        for row in range(0, rows - patch + 1, patch):
            found += [
                [band[row : row + patch, column : column + patch] for band in bands]
                for column in range(0, columns - patch + 1, patch)
            ]
    side = SIZE // patch
    tones = {name: np.empty((SIZE, SIZE), np.float32) for name in "ab"}
    for k in range(side * side):
        row, column = divmod(k, side)
        again, which = divmod(k, len(found))
        position = (which + 3 * again) % 8
        for name, picture in zip("ab", found[which], strict=True):
            turned = np.rot90(picture[:, ::-1] if position > 3 else picture, position % 4)
            tones[name][row * patch : (row + 1) * patch, column * patch : (column + 1) * patch] = turned
    return tones


def _levelled(pixels: np.ndarray) -> Texture:
    low, high = np.percentile(pixels, (2, 98))
    return np.clip((pixels - low) / (high - low) * 0.8 + 0.1, -0.1, 1.1).astype(np.float32)
