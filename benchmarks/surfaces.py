"""What a surface is worth: how far roofs and ground are displaced between the orthos of two scenes, by surface.

    python benchmarks/surfaces.py --town
    python benchmarks/surfaces.py --pleiades

The town is simulated: boxes seen by parallel rays, drawn by NumPy alone. The Pleiades triplet and the DSM that s2p made
of it are fetched by `make real-data`. Displacements are measured by normalised correlation in NumPy, which shares no
code with the matching of this package.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from osgeo import gdal
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests" / "layers"), str(ROOT / "tests" / "warp"), str(ROOT / "tools")]

import orthos  # noqa: E402
from blocks import FLOOR, NORTH, WEST, ZONE, City, Parallel, towards  # noqa: E402
from real_data import data_folder  # noqa: E402

from ortho_pipeline import commands  # noqa: E402
from ortho_pipeline.options import OutputOptions, SurfaceOptions  # noqa: E402
from ortho_pipeline.raster.source import RasterSource  # noqa: E402
from ortho_pipeline.surface.base import Surface  # noqa: E402
from ortho_pipeline.surface.dem import open_dem  # noqa: E402
from ortho_pipeline.surface.flat import FlatSurface  # noqa: E402
from ortho_pipeline.surface.writing import write_dem  # noqa: E402

REAL = data_folder() / "s2p"
#: The stereo surface of the issue: NMAD (m), share of holes; and the cell (m) of a common DEM.
NMAD, HOLES, COARSE = 0.4, 0.05, 30.0
HEIGHTS, ANGLES = (0.0, 3.0, 6.0, 12.0, 24.0), (5.0, 10.0, 20.0)
PIXEL, HOUSE, STREET, HOUSES = 0.5, 30.0, 34.0, 6
#: Pairs of the triplet, and degrees between their views.
_PAIRS = (("img_01", "img_02", 6.4), ("img_02", "img_03", 6.3), ("img_01", "img_03", 12.7))
#: A correlation below this is no match.
LEAST = 0.6


# -- measuring -------------------------------------------------------------------------------------------------------


def displacement(a: np.ndarray, b: np.ndarray, column: int, row: int, half: int, reach: int) -> np.ndarray | None:
    """Return (column, row) by which b shows a chip of a elsewhere, to a fraction of a pixel; None without a match."""
    chip = a[row - half : row + half + 1, column - half : column + half + 1].astype(float)
    around = half + reach
    window = b[row - around : row + around + 1, column - around : column + around + 1].astype(float)
    side = 2 * half + 1
    if chip.shape != (side, side) or window.shape != (2 * around + 1,) * 2 or not (chip.all() and chip.std()):
        return None
    chip = (chip - chip.mean()) / chip.std()
    patches = sliding_window_view(window, (side, side))
    spread = patches.std(axis=(2, 3))
    score = np.einsum("ijkl,kl->ij", patches, chip) / side**2
    with np.errstate(all="ignore"):
        score = np.where((patches.min(axis=(2, 3)) > 0) & (spread > 0), score / spread, -1.0)
    y, x = np.unravel_index(np.argmax(score), score.shape)
    if score[y, x] < LEAST or not (0 < y < 2 * reach and 0 < x < 2 * reach):
        return None
    fine = [_peak(score[y, x - 1 : x + 2]), _peak(score[y - 1 : y + 2, x])]
    return np.array([x, y], dtype=float) - reach + fine


def _peak(three: np.ndarray) -> float:
    bend = three[0] - 2 * three[1] + three[2]
    return float((three[0] - three[2]) / (2 * bend)) if bend < 0 else 0.0


def line(name: str, condition: str, lengths: list[float], tried: int) -> str:
    """Return a row of the table: median and 90 % of the displacements (m)."""
    if not lengths:
        return f"| {name} | {condition} | - | - | 0 of {tried} |"
    median, most = np.median(lengths), np.quantile(lengths, 0.9)
    return f"| {name} | {condition} | {median:.2f} | {most:.2f} | {len(lengths)} of {tried} |"


# -- a simulated town ------------------------------------------------------------------------------------------------


def town() -> tuple[City, list[tuple[float, float, float]]]:
    """Return houses on a lattice, and the middle (m) and height of each roof and of each crossing."""
    step = HOUSE + STREET
    side = STREET + HOUSES * step
    boxes, places = [], []
    for i in range(HOUSES):
        for j in range(HOUSES):
            west, south, height = STREET + i * step, STREET + j * step, HEIGHTS[1 + (i + 2 * j) % 4]
            boxes.append((west, south, west + HOUSE, south + HOUSE, height))
            places.append((west + HOUSE / 2, south + HOUSE / 2, height))
            places.append((west - STREET / 2, south - STREET / 2, 0.0))
    return City(tuple(boxes), side), places


def height_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the heights of the town over its ground, from the rule of the lattice."""
    step = HOUSE + STREET
    i, j = np.floor((x - STREET) / step).astype(int), np.floor((y - STREET) / step).astype(int)
    roof = (x - STREET - i * step <= HOUSE) & (y - STREET - j * step <= HOUSE)
    roof &= (i >= 0) & (j >= 0) & (i < HOUSES) & (j < HOUSES)
    return np.where(roof, np.array(HEIGHTS[1:])[(i + 2 * j) % 4], 0.0)


def photograph(city: City, paint: np.ndarray, angle: float, azimuth: float, seed: int) -> np.ndarray:
    """Return the image of a view: each ray is walked down to the first roof, wall or street."""
    east, north = towards(angle, azimuth)
    count = round(city.side / PIXEL)
    columns, rows = np.meshgrid(np.arange(count) + 0.5, np.arange(count) + 0.5)
    x, y, height = PIXEL * columns, city.side - PIXEL * rows, np.zeros((count, count))
    for level in np.arange(max(HEIGHTS), 0.0, -0.25):
        meets = height_of(x + east * level, y + north * level) >= level
        height = np.where((height == 0) & meets, level, height)
    at_x, at_y = x + east * height, y + north * height
    pixels = map_coordinates(paint, [(city.side - at_y) / PIXEL - 0.5, at_x / PIXEL - 0.5], order=1, mode="nearest")
    noise = np.random.default_rng(seed).normal(0, 3, pixels.shape)
    wall = np.abs(height_of(at_x, at_y) - height) > 0.3
    return np.clip(np.where(wall, 60, pixels) + noise, 1, 255).astype(np.uint8)


def surfaces_of(city: City, folder: Path) -> dict[str, Surface]:
    """Return flat ground, the town averaged to 30 m, as a stereo program has it, and the truth."""
    margin, step = 60.0, PIXEL
    count = int((city.side + 2 * margin) / step)
    x = -margin + step * (np.arange(count) + 0.5)
    heights = FLOOR + height_of(*np.meshgrid(x, city.side - x))
    corner = (WEST - margin, NORTH + margin)
    random = np.random.default_rng(1)
    noise = gaussian_filter(random.normal(size=heights.shape), 2)
    noise *= NMAD / (1.4826 * np.median(np.abs(noise)))
    holes = gaussian_filter(random.normal(size=heights.shape), 3)
    stereo = np.where(holes > np.quantile(holes, 1 - HOLES), -32768.0, heights + noise)
    cell = round(COARSE / step)
    whole = count // cell * cell
    coarse = heights[:whole, :whole].reshape(whole // cell, cell, -1, cell).mean(axis=(1, 3))
    for name, values, size in (("truth", heights, step), ("stereo", stereo, step), ("coarse", coarse, COARSE)):
        write_dem(folder / f"{name}.tif", values, corner, size, f"EPSG:{ZONE}")
    return {
        "bare ground": FlatSurface(FLOOR),
        "mean of 30 m": open_dem(folder / "coarse.tif", "ellipsoid", fill="nearest"),
        "stereo DSM (0.4 m, 5 % holes)": open_dem(folder / "stereo.tif", "ellipsoid", fill="nearest"),
        "true surface": open_dem(folder / "truth.tif", "ellipsoid"),
    }


def town_rows(angles: Sequence[float] = ANGLES) -> Iterator[str]:
    """Yield the rows of the town: two views from opposite sides at the same angle."""
    city, places = town()
    random = np.random.default_rng(7)
    count = round(city.side / PIXEL)
    paint = gaussian_filter(random.normal(size=(count, count)), 1.2)
    paint = 128 + 40 * paint / paint.std()
    with tempfile.TemporaryDirectory() as name:
        folder, grid = Path(name), city.grid(PIXEL)
        surfaces = surfaces_of(city, folder)
        for angle in angles:
            for azimuth in (90.0, 270.0):
                path = folder / f"{azimuth:g}.tif"
                made = gdal.GetDriverByName("GTiff").Create(str(path), count, count, 1, gdal.GDT_Byte)
                made.WriteArray(photograph(city, paint, angle, azimuth, int(azimuth)))
                made.GetRasterBand(1).SetNoDataValue(0)
                made = None
            for label, surface in surfaces.items():
                images = []
                for azimuth in (90.0, 270.0):
                    target, model = folder / "ortho.tif", Parallel(*towards(angle, azimuth), PIXEL, city.side)
                    source = RasterSource(folder / f"{azimuth:g}.tif")
                    orthos.rectify(model, source, surface, grid, target)
                    images.append(gdal.Open(str(target)).ReadAsArray())
                yield from _by_height(label, angle, images, city, places)


def _by_height(
    label: str, angle: float, images: list[np.ndarray], city: City, places: list[tuple[float, float, float]]
) -> Iterator[str]:
    for height in HEIGHTS:
        of_height = [(x, y) for x, y, h in places if h == height]
        found = []
        for x, y in of_height:
            column, row = int(x / PIXEL), int((city.side - y) / PIXEL)
            moved = displacement(*images, column, row, 8, 44)
            if moved is not None:
                found.append(PIXEL * float(np.hypot(*moved)))
        what = "ground" if height == 0 else f"roof {height:g} m"
        yield line(label, f"{what}, views of {angle:g}° from opposite sides", found, len(of_height))


# -- the Pleiades triplet --------------------------------------------------------------------------------------------


def pleiades_rows(pairs: Sequence[int] = (1, 2, 3)) -> Iterator[str]:
    """Yield the rows of the real scenes: s2p's DSM against its mean of 30 m, by the difference of the two.

    The scenes keep their delivered RPCs: what their orientation displaces is common to all places, and taken off.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        heights, coarse, transform = _prepared(REAL / "expected_output" / "triplet" / "dsm.tif", folder)
        rows, columns = heights.shape
        west, north = transform[0], transform[3]
        output = OutputOptions(
            crs="EPSG:32631", resolution=(PIXEL, PIXEL), format="GTiff",
            extent=(west, north - PIXEL * rows, west + PIXEL * columns, north),
        )  # fmt: skip
        for first, second, angle in (_PAIRS[number - 1] for number in pairs):
            for label, dem in (("mean of 30 m", "coarse.tif"), ("DSM of s2p (0.5 m)", "fine.tif")):
                surface = SurfaceOptions(dem=folder / dem, vertical="ellipsoid", fill="mask")
                images = []
                for image in (first, second):
                    path = REAL / "input_triplet" / f"{image}.tif"
                    made = commands.rectify(path, folder / "orthos", surface=surface, output=output, overwrite=True)
                    ortho = gdal.Open(str(made.files["ortho"]))
                    images.append(ortho.GetRasterBand(1).ReadAsArray())
                yield from _by_relief(label, f"{angle:g}° apart", *images, heights, coarse)


def _prepared(dsm: Path, folder: Path) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    """Write a DSM with its holes filled by the nearest height, and its mean of 30 m.

    Returns the heights as they were, the mean at the same samples, and the geotransform.
    """
    dataset = gdal.Open(str(dsm))
    heights, transform = dataset.ReadAsArray(), dataset.GetGeoTransform()
    nearest = distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True)
    filled = heights[tuple(nearest)]
    cell = round(COARSE / transform[1])
    rows, columns = (count // cell * cell for count in heights.shape)
    mean = filled[:rows, :columns].reshape(rows // cell, cell, -1, cell).mean(axis=(1, 3))
    corner = (transform[0], transform[3])
    write_dem(folder / "fine.tif", filled, corner, transform[1], "EPSG:32631")
    write_dem(folder / "coarse.tif", mean, corner, COARSE, "EPSG:32631")
    at = (np.indices(heights.shape).reshape(2, -1) + 0.5) / cell - 0.5
    return heights, map_coordinates(mean, at, order=1, mode="nearest").reshape(heights.shape), transform


def _by_relief(
    label: str, angle: str, a: np.ndarray, b: np.ndarray, heights: np.ndarray, coarse: np.ndarray
) -> Iterator[str]:
    half, reach, classes = 10, 16, (0.0, 2.0, 5.0, 10.0)
    moved: dict[int, list[np.ndarray]] = {number: [] for number in range(len(classes) - 1)}
    tried = dict.fromkeys(moved, 0)
    for row in range(40, heights.shape[0] - 40, 24):
        for column in range(40, heights.shape[1] - 40, 24):
            near = (heights - coarse)[row - half : row + half + 1, column - half : column + half + 1]
            if np.isfinite(near).mean() < 0.6 or np.nanstd(near) > 1.5:
                continue  # s2p leaves single samples open; a place is a roof or ground as a whole, no edge
            number = int(np.searchsorted(classes, abs(np.nanmedian(near)), side="right")) - 1
            if number not in tried:
                continue
            tried[number] += 1
            shift = displacement(a, b, column, row, half, reach)
            if shift is not None:
                moved[number].append(PIXEL * shift)
    # What all have in common is the orientation of the two scenes, not the surface.
    common = np.median(np.concatenate([part for part in moved.values() if part]), axis=0)
    for number, low in enumerate(classes[:-1]):
        lengths = [float(np.hypot(*(one - common))) for one in moved[number]]
        what = f"{low:g} to {classes[number + 1]:g} m off the mean"
        yield line(label, f"{what}, views {angle}", lengths, tried[number])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--town", action="store_true")
    parser.add_argument("--angle", type=float, action="append", help="angles of the town's views; default: all")
    parser.add_argument("--pleiades", action="store_true")
    parser.add_argument("--pair", type=int, action="append", choices=(1, 2, 3), help="pairs of the triplet")
    chosen = parser.parse_args()
    print("| surface | object and views | median (m) | 90 % (m) | matched |\n|---|---|---|---|---|")
    for part, rows in (
        (chosen.town, lambda: town_rows(chosen.angle or ANGLES)),
        (chosen.pleiades, lambda: pleiades_rows(chosen.pair or (1, 2, 3))),
    ):
        if part:
            for text in rows():
                print(text, flush=True)
