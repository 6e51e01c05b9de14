"""Simulated flights of a drone: blocks of photos whose EXIF and XMP are wrong, with ties and a DEM.

python benchmarks/flights.py                     20 flights of 30 photos of each kind
python benchmarks/flights.py --photos 100        larger ones
python benchmarks/flights.py --kinds rtk,focal   some kinds

The truth is in ECEF, by PROJ and the formulas of this file; it shares no code with the sensor models. The estimator
sees the photos' tags, the ties and the DEM only. "naive" are the orthos by the tags alone, on the same DEM. "apart" are
pairs of photos whose orthos are more than 1 px from each other on the mean of their overlap; "warned" those of them
with a sigma above 0.5 px, which `ortho adjust` warns of; "silent" are not warned of and beyond chance. "beyond" is the
share of pairs outside their 95 % ellipse (5 % is right). "wrong" are flights with a silent pair, or farther off than
they claim.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyproj
from osgeo import gdal, osr

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.relative.joins import Join, joins_of
from ortho_pipeline.block.shared.priors import SharedPriors
from ortho_pipeline.commands.block_results.orthos import corrected
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.surface.dem import DemSurface, open_dem

gdal.UseExceptions()
Array = np.ndarray
#: The camera: columns, rows, focal length (px). Flying height over the mean ground, and overlaps along and across.
COLUMNS, ROWS, FOCAL, ABOVE, OVERLAPS = 1368, 912, 915.0, 100.0, (0.75, 0.6)
MIDDLE, GROUND_HEIGHT = (33.1, 39.4), 900.0
#: Standard deviation (px) of ties, share of ties with a gross error in one ray, its size (px), sigma of the DEM (m).
TIE, OUTLIERS, GROSS, DEM_SIGMA = 0.3, 0.1, 30.0, 0.3
#: Side of a cell of the DEM (m).
CELL = 2.0
PARTS = {"plan": ("X_L", "Y_L"), "up": ("Z_L",), "tilt": ("omega", "phi"), "head": ("kappa",)}
#: Pairs are apart beyond this (px), and warned of above this sigma (px). A pair is beyond chance with this squared
#: error in sigmas (0.1 %), and outside its 95 % ellipse with this. A flight is off by no more sigmas than `FAR`.
APART, WEAK, CHANCE, ELLIPSE, FAR = 1.0, 0.5, 13.8, 5.99, 4.0
#: Tangent of the largest angle off the axis that a photo shows; its corners are at 0.93.
WIDEST = 1.5
#: Pairs are judged with so many common places or more.
COMMON = 80
TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
TO_MAP = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32636", always_xy=True)


@dataclass(frozen=True)
class Kind:
    """Errors of a flight: sigmas of positions (m) and angles (degrees), the focal length, and the tags that state them.

    `datum` (m) is what the altitudes of all photos are off by. The true lens has the distortion `k1` and its principal
    point off the middle (px); tags do not tell them.
    """

    position: float = 3.0
    angle: float = 3.0
    focal: float = 1.0
    datum: float = 0.0
    k1: float = 0.0
    middle: tuple[float, float] = (0.0, 0.0)
    tags: dict[str, str] = field(default_factory=lambda: {"Camera:GPSXYAccuracy": "3", "Camera:GPSZAccuracy": "3"})
    options: dict[str, str] = field(default_factory=lambda: {"vertical": "ellipsoid"})


_RTK = {"drone-dji:RtkStdLon": "0.02", "drone-dji:RtkStdLat": "0.02", "drone-dji:RtkStdHgt": "0.02"}
#: A maker's calibration: focal lengths 0.2 % too long, pixels 0.18 % higher than wide, a point 2 and 3 px off, no lens.
_MAKER = f"2018-09-07;{FOCAL * 1.002},{FOCAL * 1.002 / 1.0018},-2,3,0,0,0,0,0"
KINDS = {
    "exif": Kind(),
    "rtk": Kind(position=0.02, tags=_RTK),
    "focal": Kind(focal=1.02),
    "rtk-focal": Kind(position=0.02, focal=1.02, tags=_RTK),
    "datum": Kind(datum=30.0, options={}),
    "lens": Kind(focal=1.02, k1=-0.03, middle=(8.0, -5.0)),
    "rtk-maker": Kind(position=0.02, tags=_RTK | {"drone-dji:DewarpData": _MAKER}),
    "rtk-lens": Kind(position=0.02, focal=1.02, k1=-0.03, middle=(8.0, -5.0), tags=_RTK),
}


@dataclass(frozen=True)
class Flight:
    """The truth of a flight: positions in ECEF, rotations from ECEF to x right, y down, z forward; ties; the DEM."""

    positions: Array
    turns: Array
    points: BlockPoints
    scenes: dict[str, Scene]
    dem: DemSurface
    waves: Array
    kind: Kind


def height(waves: Array, lon: Array, lat: Array) -> Array:
    """Return ellipsoidal heights of rolling ground."""
    east, north = (lon - MIDDLE[0]) * 86_000.0, (lat - MIDDLE[1]) * 111_000.0
    return GROUND_HEIGHT + sum(a * np.sin((east * x + north * y) / size + at) for a, x, y, size, at in waves)


def to_ecef(lonlath: Array) -> Array:
    return np.stack(TO_ECEF.transform(*np.asarray(lonlath).T), axis=-1)


def east_north_down(lon: float, lat: float) -> Array:
    """Return the rows north, east, down in ECEF."""
    sl, cl, sp, cp = (f(np.radians(a)) for a in (lon, lat) for f in (np.sin, np.cos))
    return np.array([[-sp * cl, -sp * sl, cp], [-sl, cl, 0.0], [-cp * cl, -cp * sl, -sp]])


def turn_of(place: Array, yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation from ECEF to x right, y down, z forward of a gimbal (degrees; ZYX, forward right down)."""
    sy, cy, sp, cp, sr, cr = (f(np.radians(a)) for a in (yaw, pitch, roll) for f in (np.sin, np.cos))
    body = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    return np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]) @ body.T @ east_north_down(place[0], place[1])


def seen(kind: Kind, position: Array, turn: Array, ground: Array) -> Array:
    """Return pixels of ground in ECEF; NaN outside the photo."""
    x, y, z = turn @ (ground - position).T
    square = (x**2 + y**2) / z**2
    scale = FOCAL * (1.0 + kind.k1 * square) / z
    image = np.stack([COLUMNS / 2 + kind.middle[0] + scale * x, ROWS / 2 + kind.middle[1] + scale * y], axis=1)
    # The polynomial of the distortion bends far rays back into the photo; no lens does.
    inside = (z > 0) & (square < WIDEST**2) & (image > 0).all(axis=1) & (image < (COLUMNS, ROWS)).all(axis=1)
    image[~inside] = np.nan
    return image


def fly(kind: Kind, photos: int, seed: int, folder: Path) -> Flight:
    """Fly strips to and fro, and write the photos with their wrong tags."""
    random = np.random.default_rng(seed)
    waves = np.column_stack(
        [random.uniform(2, 6, 5), *random.normal(0, 0.7, (2, 5)), random.uniform(40, 120, 5), random.uniform(0, 6, 5)]
    )
    steps = np.array([ROWS, COLUMNS]) * (1 - np.array(OVERLAPS)) * ABOVE / FOCAL
    strips = max(1, round(np.sqrt(photos / 1.2)))
    poses, tags = [], []
    for number in range(photos):
        strip, along = number % strips, number // strips
        north = (along - photos / strips / 2) * steps[0] + random.normal(0, 1)
        east = (strip - strips / 2) * steps[1] + random.normal(0, 1)
        place = np.array([MIDDLE[0] + east / 86_000.0, MIDDLE[1] + north / 111_000.0, GROUND_HEIGHT + ABOVE])
        angles = np.add([180.0 * (strip % 2), -90.0, 0.0], random.normal(0, 2, 3))
        poses.append((place, turn_of(place, *angles)))
        off = np.add(random.normal(0, kind.position, 3), [0.0, 0.0, kind.datum])
        tags.append((place + off / (86_000.0, 111_000.0, 1.0), angles + random.normal(0, kind.angle, 3)))
    positions, turns = to_ecef(np.array([place for place, _ in poses])), np.array([turn for _, turn in poses])
    names = [f"p{k:03d}" for k in range(photos)]
    scenes = {
        name: write_photo(folder / f"{name}.tif", place, angles, kind)
        for name, (place, angles) in zip(names, tags, strict=True)
    }
    points = ties(kind, positions, turns, waves, list(scenes), random)
    return Flight(positions, turns, points, scenes, write_dem(folder / "dem.tif", waves, random), waves, kind)


def write_photo(path: Path, place: Array, angles: Array, kind: Kind) -> Scene:
    """Write a photo without pixels but with tags, and open it by these."""
    made = gdal.GetDriverByName("GTiff").Create(str(path), COLUMNS, ROWS, 1, options=["SPARSE_OK=TRUE"])
    yaw, pitch, roll = angles
    xmp = {
        "drone-dji:GpsLatitude": f"{place[1]:.9f}", "drone-dji:GpsLongitude": f"{place[0]:.9f}",
        "drone-dji:AbsoluteAltitude": f"{place[2]:.4f}", "drone-dji:RelativeAltitude": f"{ABOVE:.2f}",
        "drone-dji:GimbalYawDegree": f"{yaw:.4f}", "drone-dji:GimbalPitchDegree": f"{pitch:.4f}",
        "drone-dji:GimbalRollDegree": f"{roll:.4f}", "drone-dji:CalibratedFocalLength": f"{FOCAL * kind.focal:.4f}",
        **kind.tags,
    }  # fmt: skip
    values = " ".join(f'{name}="{value}"' for name, value in xmp.items())
    packet = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
        f'xmlns:Camera="http://pix4d.com/camera/1.0/" {values}/></rdf:RDF></x:xmpmeta>'
    )
    made.SetMetadata([packet], "xml:XMP")
    made = None
    return open_scene(path, SceneOptions(sensor="photo", sensor_options=kind.options))


def ties(
    kind: Kind, positions: Array, turns: Array, waves: Array, names: list[str], random: np.random.Generator
) -> BlockPoints:
    """Return ties with errors, some of them gross; about 40 for each photo."""
    spread = 1.2 * np.abs(positions - positions.mean(axis=0)).max() + ABOVE / 2
    lonlat = np.array(MIDDLE) + random.uniform(-spread, spread, (60 * len(names), 2)) / (86_000.0, 111_000.0)
    ground = to_ecef(np.column_stack([lonlat, height(waves, *lonlat.T)]))
    images = np.array([seen(kind, position, turn, ground) for position, turn in zip(positions, turns, strict=True)])
    visible = np.isfinite(images).all(axis=2)
    shown = np.flatnonzero(visible.sum(axis=0) >= 2)[: 15 * len(names)]
    image, point = np.nonzero(visible[:, shown])
    measured = images[image, shown[point]] + random.normal(0, TIE, (len(image), 2))
    count = len(shown)
    order = random.permutation(len(image))
    one_each = order[np.unique(point[order], return_index=True)[1]]
    gross = one_each[random.random(count) < OUTLIERS]
    measured[gross] += random.uniform(-GROSS, GROSS, (len(gross), 2))
    return BlockPoints(
        ids=tuple(f"t{k}" for k in range(count)),
        ground=np.full((count, 3), np.nan),
        roles=np.full(count, "tie"),
        sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS.from_epsg(4326),
        images=tuple(names),
        point=point.astype(np.int64),
        image=image.astype(np.int64),
        measured=measured,
        sigma_image=np.full(len(image), TIE),
        source="simulated",
    )


def write_dem(path: Path, waves: Array, random: np.random.Generator) -> DemSurface:
    """Write the ground with errors as a DEM, and open it."""
    x, y = TO_MAP.transform(*MIDDLE)
    size, cell = 500, CELL
    columns, rows = np.meshgrid(np.arange(size) + 0.5 - size / 2, np.arange(size) + 0.5 - size / 2)
    lon, lat = TO_MAP.transform(x + cell * columns, y - cell * rows, direction="INVERSE")
    made = gdal.GetDriverByName("GTiff").Create(str(path), size, size, 1, gdal.GDT_Float32)
    made.SetGeoTransform((x - cell * size / 2, cell, 0, y + cell * size / 2, 0, -cell))
    system = osr.SpatialReference()
    system.ImportFromEPSG(32636)
    made.SetProjection(system.ExportToWkt())
    made.WriteArray(height(waves, lon, lat) + random.normal(0, DEM_SIGMA, lon.shape))
    made = None
    return open_dem(path, "ellipsoid", fill="mask").with_sigma(DEM_SIGMA)


# -- the result compared with the truth ------------------------------------------------------------------------------


def places_of(flight: Flight) -> Array:
    """Return lon, lat ``(n, 2)`` of places all over what the photos show, one for each cell of the DEM.

    A join tells of the mean over the whole overlap, in which the error of each cell has the same share. At places at
    random some cells count several times and others never: the variance of the mean grows by 4/9 of that of a cell over
    the number of places.
    """
    metres = np.array([86_000.0, 111_000.0])
    photos = np.column_stack(TO_ECEF.transform(*flight.positions.T, direction="INVERSE"))[:, :2]
    low, high = (photos.min(axis=0) * metres - ABOVE, photos.max(axis=0) * metres + ABOVE)
    east, north = np.meshgrid(*(np.arange(*ends, CELL) for ends in zip(low, high, strict=True)))
    return np.column_stack([east.ravel(), north.ravel()]) / metres


def off_by(flight: Flight, models: Any, dem: DemSurface | None = None) -> Array:
    """Return how far (m, east and north) each ortho is from the true ground: ``(photos, n, 2)``; NaN where unseen.

    It is where a model shows a ground point, from where the photo has it, turned into metres by the true photo. Orthos
    are over the true ground, or over a DEM.
    """
    lonlat = places_of(flight)
    steps = np.array([[0.0, 0.0], [1.0 / 86_000.0, 0.0], [0.0, 1.0 / 111_000.0]])
    places = [np.column_stack([lonlat + step, height(flight.waves, *(lonlat + step).T)]) for step in steps]
    shown, ground = places[0], [to_ecef(place) for place in places]
    if dem is not None:
        shown = np.column_stack([lonlat, dem.heights(lonlat, "EPSG:4979")])
    found = np.full((len(flight.scenes), len(lonlat), 2), np.nan)
    for photo, (name, position, turn) in enumerate(zip(flight.scenes, flight.positions, flight.turns, strict=True)):
        at, east, north = (seen(flight.kind, position, turn, place) for place in ground)
        by_metre = np.stack([east - at, north - at], axis=2)
        rows = np.flatnonzero(np.isfinite(by_metre).all(axis=(1, 2)))
        away = models[name].ground_to_image(shown[rows]) - at[rows]
        found[photo, rows] = -np.linalg.solve(by_metre[rows], away[:, :, None])[:, :, 0]
    return found


def figures(off: Array) -> tuple[float, float]:
    """Return the RMS (px per axis) of orthos, and of neighbours on the ground that both show."""
    pixel = ABOVE / FOCAL
    counts = np.isfinite(off[:, :, 0]).sum(axis=0)
    mean = np.nansum(off, axis=0) / np.maximum(counts, 1)[:, None]
    apart = (off - mean)[:, counts > 1] * np.sqrt(counts / np.maximum(counts - 1, 1))[None, counts > 1, None]
    return float(np.sqrt(np.nanmean(off**2))) / pixel, float(np.sqrt(2 * np.nanmean(apart**2))) / pixel


def pairs_of(flight: Flight, joins: Sequence[Join], off: Array) -> dict[str, float]:
    """Return how many pairs of photos there are, apart, warned of, silent, and outside their ellipse.

    And the sums of their squared errors (px) and of these in sigmas.
    """
    names = list(flight.scenes)
    counts = dict.fromkeys(("pairs", "apart", "warned", "silent", "outside", "square", "in_sigmas"), 0.0)
    for join in joins:
        between = off[names.index(join.first)] - off[names.index(join.second)]
        between = between[np.isfinite(between).all(axis=1)] / join.pixel
        if len(between) < COMMON:
            continue
        mean = between.mean(axis=0)
        size, square = float(np.hypot(*mean)), float(mean @ np.linalg.solve(join.covariance, mean))
        weak = join.sigma > WEAK
        counts["pairs"] += 1
        counts["apart"] += size > APART
        counts["warned"] += size > APART and weak
        counts["silent"] += size > APART and not weak and square > CHANCE
        counts["outside"] += square > ELLIPSE
        counts["square"] += size**2 / 2
        counts["in_sigmas"] += square / 2
    return counts


def of_block(flight: Flight, fit: BlockFit) -> float:
    """Return the error of the mean position of the block over its sigma, the worst of east, north, up."""
    worst = 0.0
    for axis, parameter in enumerate(("X_L", "Y_L", "Z_L")):
        picked = np.array([name == parameter for _, name in fit.parameters]) / len(flight.scenes)
        errors = []
        for name, position in zip(flight.scenes, flight.positions, strict=True):
            model = fit.models[name]
            axes = east_north_down(*model.origin[:2])[[1, 0, 2]] * np.array([[1.0], [1.0], [-1.0]])
            errors.append(model.exterior[axis] - (axes @ (position - to_ecef(np.array([model.origin]))[0]))[axis])
        worst = max(worst, abs(np.mean(errors)) / float(np.sqrt(picked @ fit.covariance @ picked)))
    return worst


def over_sigmas(flight: Flight, fit: BlockFit) -> dict[str, list[float]]:
    """Return errors of positions and angles over their sigmas, by parameter."""
    found: dict[str, list[float]] = {}
    sigmas = np.sqrt(np.diag(fit.covariance))
    columns = {key: k for k, key in enumerate(fit.parameters)}
    for name, position, turn in zip(flight.scenes, flight.positions, flight.turns, strict=True):
        model = fit.models[name]
        lon, lat, origin = model.origin
        axes = east_north_down(lon, lat)[[1, 0, 2]] * np.array([[1.0], [1.0], [-1.0]])
        place = axes @ (position - to_ecef(np.array([[lon, lat, origin]]))[0])
        rotation = np.diag([1.0, -1.0, -1.0]) @ turn @ axes.T
        angles = (
            np.arctan2(-rotation[2, 1], rotation[2, 2]),
            np.arcsin(rotation[2, 0]),
            np.arctan2(-rotation[1, 0], rotation[0, 0]),
        )
        for parameter, truth in zip(("X_L", "Y_L", "Z_L", "omega", "phi", "kappa"), (*place, *angles), strict=True):
            k = columns[name, parameter]
            error = dict(zip(model.param_names, model.params.tolist(), strict=True))[parameter] - truth
            if parameter in ("omega", "phi", "kappa"):
                error = (error + np.pi) % (2 * np.pi) - np.pi
            found.setdefault(parameter, []).append(error / sigmas[k])
    return found


def trial(kind: Kind, photos: int, seed: int) -> dict[str, Any]:
    """Fly, adjust and compare."""
    with tempfile.TemporaryDirectory() as folder:
        flight = fly(kind, photos, seed, Path(folder))
        models = {name: scene.model for name, scene in flight.scenes.items()}
        priors = {name: scene.priors for name, scene in flight.scenes.items()}
        naive = figures(off_by(flight, models))
        try:
            fit = adjust(models, flight.points, priors=priors, heights=DemHeights(flight.dem))
        except OrthoError as error:
            return {"naive": naive, "error": f"{type(error).__name__}: {error}"[:100].splitlines()[0]}
        off = off_by(flight, fit.models)
        found, shift = figures(off), of_block(flight, fit)
        pairs = pairs_of(flight, joins_of(fit), off)
        over = pairs_of(flight, joins_of(fit, fit.adjusted_dem), off_by(flight, fit.models, corrected(flight.dem, fit)))
        shared = fit.shared_priors
        return {
            "naive": naive, "found": found, "shift": shift,
            "wrong": pairs["silent"] + over["silent"] > 0 or shift > FAR,
            "spread": over_sigmas(flight, fit), "pairs": pairs, "over": over,
            "camera": {} if shared is None else of_camera(kind, shared),
        }  # fmt: skip


def of_camera(kind: Kind, shared: SharedPriors) -> dict[str, float]:
    """Return the errors of the parameters of the camera over their sigmas."""
    pixel = 1e-6
    truth = {"focal_length": FOCAL * pixel, "x0": kind.middle[0] * pixel, "y0": -kind.middle[1] * pixel, "k1": kind.k1}
    truth["pitch_y"] = pixel
    sigmas = np.sqrt(np.diag(shared.left)) * shared.sigmas
    rows = zip(shared.parameters, shared.means, sigmas, strict=True)
    return {one.name: float((mean - truth.get(one.name, 0.0)) / sigma) for one, mean, sigma in rows}


def pairs_told(each: list[dict[str, float]]) -> str:
    """Return what the pairs of several flights say together."""
    sums = {key: sum(one[key] for one in each) for key in each[0]}
    count = max(sums["pairs"], 1)
    return (
        f"{sums['pairs']:.0f} pairs: {sums['apart']:.0f} apart, {sums['warned']:.0f} warned, {sums['silent']:.0f} "
        f"silent; beyond {sums['outside'] / count:.1%}; RMS {np.sqrt(sums['square'] / count):.2f} px, error over sigma "
        f"{np.sqrt(sums['in_sigmas'] / count):.2f}"
    )


def told(good: list[dict[str, Any]]) -> str:
    """Return what flights of a kind say together."""

    def over(key: str, names: tuple[str, ...]) -> str:
        values = [np.ravel(one[key][name]) for one in good for name in names if name in one[key]]
        return f"{np.sqrt(np.mean(np.concatenate(values) ** 2)):.2f}" if values else "-"

    ortho, apart, naive_ortho, naive_apart = (
        np.median([one[key][k] for one in good]) for key in ("found", "naive") for k in (0, 1)
    )
    pairs = "\n".join(
        f"  over {heights}: {pairs_told([one[key] for one in good])}"
        for key, heights in (("pairs", "true heights"), ("over", "the adjusted DEM"))
    )
    spread = ", ".join(f"{part} {over('spread', of)}" for part, of in PARTS.items())
    camera = ", ".join(f"{name} {over('camera', (name,))}" for name in good[0]["camera"])
    return (
        f"  orthos {ortho:.2f} px (naive {naive_ortho:.1f}), neighbours {apart:.2f} px (naive {naive_apart:.1f})\n"
        f"{pairs}\n"
        f"  error over sigma: {spread}, "
        f"block {np.sqrt(np.mean([one['shift'] ** 2 for one in good])):.2f} (worst of three axes); "
        f"camera {camera}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=30)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first flight")
    parser.add_argument("--kinds", default=",".join(KINDS))
    given = parser.parse_args()
    for name in given.kinds.split(","):
        trials = [trial(KINDS[name], given.photos, seed) for seed in range(given.first, given.first + given.flights)]
        good = [one for one in trials if "found" in one]
        print(f"{name}: {len(good)} of {len(trials)} converged, {sum(one['wrong'] for one in good)} wrong")
        for message in sorted({one["error"] for one in trials if "error" in one}):
            print(f"  {message}")
        if good:
            print(told(good), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
