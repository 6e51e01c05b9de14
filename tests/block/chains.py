"""Chains of overlapping frames over rough ground, with truth that the estimator never sees, and a DEM with errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models import FrameCamera, ImageCorrection
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points.heights.spot_heights import SpotHeights
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface, open_dem
from ortho_pipeline.surface.writing import write_dem

CRS = "EPSG:32636"
EAST, NORTH, LEVEL = 500_000.0, 4_100_000.0, 200.0
WIDTH, HEIGHT, PIXEL = 250, 200, 0.9
ORIGIN = (WIDTH / 2, HEIGHT / 2)
#: How far (m) a DEM reaches beyond the ties.
_MARGIN = 150.0


@dataclass(frozen=True)
class Chain:
    """How a chain of frames is flown.

    `errors` are how far (px) the vendor's models are off, uniformly in each axis; normally distributed if `normal`.
    Ties are of two images each if `pairwise`, as a matcher of pairs makes them, else of all that show them. The shares
    `trees` and `roofs` of them are 15 m, and 3 to 12 m, above the ground. A `sensor` is a frame, a pushbroom in orbit
    that looks to alternate sides, or the RPC of one.
    """

    images: int = 6
    strips: int = 1
    convergence_deg: float = 3.0
    tilt_deg: float = 12.0
    overlap: float = 0.56
    relief: float = 40.0
    ties: int = 200
    errors: float = 6.0
    normal: bool = False
    noise: float = 0.1
    pairwise: bool = True
    trees: float = 0.0
    roofs: float = 0.0
    sensor: str = "frame"

    @property
    def base(self) -> float:
        """Distance of neighbouring frames, metres."""
        return (1 - self.overlap) * WIDTH * PIXEL

    @property
    def altitude(self) -> float:
        """Height of flight above the ground, at which neighbouring rays converge as they should."""
        return self.base / max(math.tan(math.radians(self.convergence_deg)), 1e-4)


@dataclass(frozen=True, eq=False)
class Block:
    """A flown chain: the models as the vendor has them and as they are, ties, their true ground."""

    flown: Chain
    start: dict[str, ImageCorrection]
    truth: dict[str, ImageCorrection]
    points: BlockPoints
    ground: Array
    terrain: Terrain


class Terrain:
    """Smooth ground of random waves, `relief` metres up and down."""

    def __init__(self, relief: float, random: np.random.Generator) -> None:
        self.relief = relief
        azimuths, lengths = random.uniform(0, 2 * np.pi, 6), random.uniform(250.0, 900.0, 6)
        self.waves = 2 * np.pi / lengths[:, None] * np.column_stack([np.cos(azimuths), np.sin(azimuths)])
        self.phases = random.uniform(0, 2 * np.pi, 6)

    def heights(self, xy: Array) -> Array:
        apart = np.asarray(xy)[..., :2] - (EAST, NORTH)
        return np.asarray(LEVEL + self.relief / 2.5 * np.sin(apart @ self.waves.T + self.phases).sum(axis=-1))


def camera(flown: Chain, along: float, across: float) -> FrameCamera:
    """Return the frame whose middle ray meets the level so many metres east and north, looking north."""
    tilt, distance = math.radians(flown.tilt_deg), flown.altitude / math.cos(math.radians(flown.tilt_deg))
    pitch = 1e-5
    interior = Interior(WIDTH, HEIGHT, pitch * distance / PIXEL, pitch, pitch)
    place = EAST + along, NORTH + across - distance * math.sin(tilt), LEVEL + flown.altitude
    return FrameCamera(
        interior, np.array([*place, tilt, 0.0, 0.0]), frame="map", ground_crs=CRS,
        heights=(LEVEL - 3 * flown.relief - 50.0, LEVEL + 3 * flown.relief + 50.0), free=(),
    )  # fmt: skip


def scanner(flown: Chain, along: float, across: float, place: int) -> SensorModel:
    """Return the pushbroom, or its RPC, whose middle ray meets the level so many metres east and north."""
    lon, lat, _ = ground_transform(CRS, GEODETIC)(np.array([[EAST + along, NORTH + across, LEVEL]]))[0]
    margin = 3 * flown.relief + 50.0
    off_nadir_deg = flown.tilt_deg + (place % 2 - 0.5) * flown.convergence_deg
    model = LineScanner.over(
        lon, lat, LEVEL, image_width=WIDTH, image_height=HEIGHT, gsd=PIXEL, off_nadir_deg=off_nadir_deg,
        heading_deg=0.0, heights=(LEVEL - margin, LEVEL + margin),
    )  # fmt: skip
    return export_rpc(model).rpc if flown.sensor == "rpc" else model


def to_image(model: SensorModel, ground: Array) -> Array:
    """Return the image points of ground ``(N, 3)`` in `CRS`."""
    return model.ground_to_image(ground_transform(CRS, model.crs)(ground))


def to_ground(model: SensorModel, image: Array, heights: Array) -> Array:
    """Return the ground ``(N, 3)`` in `CRS` of image points at heights."""
    return ground_transform(model.crs, CRS)(model.image_to_ground(image, heights))


def fly(flown: Chain, seed: int) -> Block:
    """Return a chain, its ties, and the truth."""
    random = np.random.default_rng(seed)
    terrain = Terrain(flown.relief, random)
    start, truth = {}, {}
    row = flown.images // flown.strips
    for number in range(flown.images):
        strip, place = divmod(number, row)
        east, north = place * flown.base, strip * 0.7 * HEIGHT * PIXEL
        frame = camera(flown, east, north) if flown.sensor == "frame" else scanner(flown, east, north, place + strip)
        off = random.normal(0, flown.errors, 2) if flown.normal else random.uniform(-flown.errors, flown.errors, 2)
        start[f"i{number}"] = ImageCorrection.identity(frame, "shift", ORIGIN)
        truth[f"i{number}"] = start[f"i{number}"].with_params(off)
    low = np.array([-0.5 * WIDTH, -0.5 * HEIGHT]) * PIXEL
    high = np.array([(row - 1) * flown.base, (flown.strips - 1) * 0.7 * HEIGHT * PIXEL]) - low
    ground = np.zeros((0, 3))
    while len(ground) < flown.ties:
        plan = np.array([EAST, NORTH]) + random.uniform(low, high, (2 * flown.ties, 2))
        some = np.column_stack([plan, terrain.heights(plan) + _above(flown, random, len(plan))])
        seen = sum(_inside(to_image(model, some)).astype(int) for model in truth.values())
        ground = np.concatenate([ground, some[seen >= 2]])[: flown.ties]
    point, image, measured = [], [], []
    shown = np.stack([_inside(to_image(model, ground)) for model in truth.values()], axis=1)
    if flown.pairwise:
        shown = _paired(shown, random)
    for number, model in enumerate(truth.values()):
        at = to_image(model, ground)
        inside = np.flatnonzero(shown[:, number])
        point.append(inside)
        image.append(np.full(len(inside), number))
        measured.append(at[inside] + random.normal(0, flown.noise, (len(inside), 2)))
    points = BlockPoints(
        ids=tuple(f"t{k}" for k in range(len(ground))), ground=np.full((len(ground), 3), np.nan),
        roles=np.full(len(ground), "tie"), sigma_ground=np.zeros((len(ground), 3)), crs=pyproj.CRS(CRS),
        images=tuple(start), point=np.concatenate(point), image=np.concatenate(image),
        measured=np.concatenate(measured), sigma_image=np.full(sum(map(len, measured)), flown.noise),
    )  # fmt: skip
    return Block(flown, start, truth, points, ground, terrain)


def _above(flown: Chain, random: np.random.Generator, count: int) -> Array:
    """Return how far ``(n,)`` ties are above the ground, m."""
    if not (flown.trees or flown.roofs):
        return np.zeros(count)
    of = random.random(count)
    roofs = (of >= flown.trees) & (of < flown.trees + flown.roofs)
    return 15.0 * (of < flown.trees) + roofs * random.uniform(3.0, 12.0, count)


def _paired(shown: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return which images ``(N, images)`` tie each point: two of those that show it, by chance neighbours."""
    found = np.zeros_like(shown)
    for one, mask in zip(found, shown, strict=True):
        which = np.flatnonzero(mask)
        begin = int(random.integers(len(which) - 1))
        one[which[begin : begin + 2]] = True
    return found


def _inside(image: Array) -> np.ndarray:
    return np.asarray(((image >= 0) & (image <= (WIDTH, HEIGHT))).all(axis=1))


def with_control(block: Block, image: str = "i0", count: int = 6, sigma: float = 0.1, seed: int = 9) -> BlockPoints:
    """Return the ties with some of those in an image as control, of which the ground is known."""
    random, points = np.random.default_rng(seed), block.points
    mine = np.unique(points.point[points.image == points.images.index(image)])
    chosen = random.choice(mine, count, replace=False)
    ground, roles, sigmas = points.ground.copy(), points.roles.copy(), points.sigma_ground.copy()
    ground[chosen] = block.ground[chosen] + random.normal(0, sigma, (count, 3))
    roles[chosen], sigmas[chosen] = "control", sigma
    return BlockPoints(
        ids=points.ids, ground=ground, roles=roles, sigma_ground=sigmas, crs=points.crs, images=points.images,
        point=points.point, image=points.image, measured=points.measured, sigma_image=points.sigma_image,
    )  # fmt: skip


def dem(
    block: Block,
    path: Path,
    seed: int,
    *,
    white: float = 0.0,
    bias: float = 0.0,
    correlated: float = 0.0,
    length: float = 1000.0,
    cell: float = 10.0,
    trees: float = 0.0,
    void: float = 0.0,
    lake: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> DemSurface:
    """Return a DEM of the ground under a chain: with white errors, a common one, and one that is alike over a length.

    `trees` is the part of the cells that stand 15 m higher; `void` metres in the west have no height, and `lake` metres
    there are level, 5 m below the ground; `shift` moves the DEM to the east and north, metres.
    """
    random = np.random.default_rng(10_000 + seed)
    low, high = block.ground[:, :2].min(axis=0) - _MARGIN, block.ground[:, :2].max(axis=0) + _MARGIN
    columns, rows = (int(n) for n in np.ceil((high - low) / cell))
    x, y = np.meshgrid(low[0] + (np.arange(columns) + 0.5) * cell, high[1] - (np.arange(rows) + 0.5) * cell)
    heights = block.terrain.heights(np.stack([x - shift[0], y - shift[1]], axis=-1))
    # Between cells errors average: two thirds of the sigma are left on average in each direction.
    heights += 1.5 * white * random.normal(0, 1, heights.shape) + bias
    if correlated:
        heights += correlated * field(heights.shape, length / cell, random)
    heights += 15.0 * (random.random(heights.shape) < trees)
    if lake:
        heights[x < low[0] + _MARGIN + lake] = LEVEL - 5.0
    if void:
        heights[x < low[0] + _MARGIN + void] = -32768.0
    write_dem(path, heights, (float(low[0]), float(high[1])), cell, CRS)
    return open_dem(path, "ellipsoid", override=True)


def spots_of(block: Block, part: float, sigma: float, random: np.random.Generator, wrong: int = 0) -> SpotHeights:
    """Return heights of a part of the ties; some are of clouds."""
    rows = random.choice(len(block.ground), round(part * len(block.ground)), replace=False)
    ground = ground_transform(CRS, GEODETIC)(block.ground[rows])
    ground[:, 2] += sigma * random.normal(0, 1, len(rows))
    ground[:wrong, 2] += 800.0
    ids = tuple(f"s{k}" for k in range(len(rows)))
    return SpotHeights(ground, np.full(len(rows), sigma), np.zeros(len(rows)), ids)


def field(shape: tuple[int, int], length: float, random: np.random.Generator) -> Array:
    """Return a field of errors of sigma 1 whose correlation falls with exp(-d / length), lengths in cells."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    # Exact on a coarse lattice, and between its nodes as smooth as they are.
    step = max(int(length / 4), max(shape) // 40, 1)
    nodes = np.mgrid[: shape[0] + step : step, : shape[1] + step : step]
    places = nodes.reshape(2, -1).T
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    root = np.linalg.cholesky(np.exp(-apart / length) + 1e-9 * np.eye(len(places)))
    values = (root @ random.normal(0, 1, len(places))).reshape(nodes.shape[1:])
    i, j = y // step, x // step
    fy, fx = (y % step) / step, (x % step) / step
    above = values[i, j] * (1 - fx) + values[i, j + 1] * fx
    below = values[i + 1, j] * (1 - fx) + values[i + 1, j + 1] * fx
    return np.asarray(above * (1 - fy) + below * fy)


def apart(block: Block, fit: BlockFit, first: str, second: str) -> Array:
    """Return how far (px east, north) two images put the same ground from each other, at true ground in both.

    What an image shows of true ground is laid out with its adjusted model at the true height. The mean over the ties
    that both images show.
    """
    found = []
    points = block.points
    mine = [set(points.point[points.image == points.images.index(name)].tolist()) for name in (first, second)]
    ground = block.ground[sorted(mine[0] & mine[1])]
    for name in (first, second):
        seen = to_image(block.truth[name], ground)
        found.append(to_ground(fit.models[name], seen, ground[:, 2])[:, :2])
    return np.asarray((found[1] - found[0]).mean(axis=0) / PIXEL)


def apart_over(block: Block, fit: BlockFit, surface: Surface, first: str, second: str) -> Array:
    """Return how far (px east, north) two orthos over a surface put the same ground from each other.

    The mean over a grid between the ties that both images show, by the rays of the adjusted models.
    """
    points, found = block.points, []
    mine = [set(points.point[points.image == points.images.index(name)].tolist()) for name in (first, second)]
    ties = block.ground[sorted(mine[0] & mine[1])]
    x, y = (np.linspace(ties[:, axis].min(), ties[:, axis].max(), 25) for axis in (0, 1))
    plan = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    ground = np.column_stack([plan, block.terrain.heights(plan)])
    for name in (first, second):
        seen, height = to_image(block.truth[name], ground), ground[:, 2]
        for _ in range(8):
            place = to_ground(fit.models[name], seen, height)
            height = surface.heights(place[:, :2], CRS)
        found.append(place[:, :2])
    return np.asarray((found[1] - found[0]).mean(axis=0) / PIXEL)


def neighbours(block: Block) -> list[tuple[str, str]]:
    """Return the pairs of frames that follow each other in a strip."""
    row = block.flown.images // block.flown.strips
    return [(f"i{k}", f"i{k + 1}") for k in range(block.flown.images - 1) if (k + 1) % row]


def misfits(block: Block, fit: BlockFit) -> Array:
    """Return how far (px) neighbours are from each other."""
    return np.array([float(np.hypot(*apart(block, fit, *pair))) for pair in neighbours(block)])


def dense(linear: Linear) -> tuple[Array, Array]:
    """Return the rows of all equations by parameters, then points that take part, and their misfits."""
    problem, points, numbers = linear.problem, linear.problem.points, linear.ordering.numbers
    place = np.full(len(points), -1)
    place[numbers] = problem.size + 3 * np.arange(len(numbers))
    design, misfits = [], []
    for ray in linear.ordering.rays:
        rows = np.zeros((2, problem.size + 3 * len(numbers)))
        of_image = problem.columns.of_image(points.image[ray])
        rows[:, of_image] = linear.by_params[ray][:, : len(of_image)]
        rows[:, place[points.point[ray]] + np.arange(3)] = linear.by_point[ray]
        design.append(rows)
        misfits.append(linear.misfits.rays[ray])
    for point in linear.ordering.grounded:
        rows = np.zeros((3, problem.size + 3 * len(numbers)))
        rows[:, place[point] + np.arange(3)] = linear.ground_by_point[point]
        design.append(rows)
        misfits.append(linear.misfits.ground[point])
    known = linear.pseudo_design
    design.append(np.pad(known, ((0, 0), (0, 3 * len(numbers)))))
    misfits.append(linear.misfits.pseudo)
    return np.concatenate(design), np.concatenate(misfits)
