"""Scenes of four simulated sensors whose orthos are known to err, and by how much: true errors beside predicted ones.

The cameras and the terrain are those of the plugins' simulations, which share no code with models, fits or the warp. A
pixel of an ortho is followed as the warp makes it: its height from a DEM with errors of a known size and correlation
length, its image point from the fitted model. The true camera's ray of that image point meets the true terrain
somewhere else: that is the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyproj
from ortho_studies.bilsat import truth as bilsat
from ortho_studies.cartosat import truth as cartosat
from ortho_studies.ikonos import truth as ikonos
from ortho_studies.ikonos.experiment import vendor_rpc
from ortho_studies.orbview3 import truth as orbview3

from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.models import RPC, ImageCorrection, SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.quality.accuracy import Budget, Parts, parts_at, predictive
from ortho_pipeline.warp.quality.error_ellipse import circular_error
from ortho_pipeline.warp.quality.sight import Sight

SENSORS = ("ikonos", "cartosat", "orbview3", "bilsat")
#: UTM zone of each simulated place.
ZONES = {"ikonos": 32639, "cartosat": 32755, "orbview3": 32636, "bilsat": 32636}


@dataclass(frozen=True)
class Field:
    """Errors of a DEM (m): a sum of waves with a Gaussian correlation, as a function of the place on the map."""

    sigma: float
    waves: np.ndarray  # (n, 3): cycles east and north times 2 pi, phase

    @classmethod
    def draw(cls, random: np.random.Generator, sigma: float, length: float, count: int = 400) -> Field:
        """Draw one whose correlation is exp(-d^2 / (2 length^2))."""
        waves = np.column_stack([random.normal(0, 1 / length, (count, 2)), random.uniform(0, 2 * np.pi, count)])
        return cls(sigma, waves)

    def __call__(self, xy: np.ndarray) -> np.ndarray:
        """Return the errors ``(n,)`` at places ``(n, 2)``."""
        phase = xy @ self.waves[:, :2].T + self.waves[:, 2]
        return self.sigma * np.sqrt(2 / len(self.waves)) * np.cos(phase).sum(axis=1)


@dataclass(frozen=True)
class Truth:
    """A scene: what is delivered of it, and the truth."""

    rpc: RPC
    points: Points
    size: tuple[int, int]
    meet: Callable[[np.ndarray], np.ndarray]  # image (n, 2) -> lon, lat, height
    terrain: Callable[[Any, Any], np.ndarray]
    zone: int


def scene_of(sensor: str, seed: int, count: int, *, bent: bool) -> Truth:
    """Return a scene with `count` control points; its vendor's errors are more than a shift if they are `bent`."""
    random = np.random.default_rng([seed, 17])
    zone = ZONES[sensor]
    if sensor == "ikonos":
        # Of the errors of its attitude nobody knows; on the plane of the product they are a shift, and little else.
        scene = ikonos.GeoScene.make(seed, points=count, off_nadir_deg=random.uniform(5, 30))
        points = scene.measure(seed).select(np.arange(count))
        points = points.with_roles(["control"] * count)
        return Truth(vendor_rpc(scene), points, (scene.columns, scene.rows), scene.meet, scene.terrain, zone)
    if sensor == "cartosat":
        bias = cartosat.RpcBias(*random.normal(0, 5, 2), *(random.normal(0, 2e-4, 3) if bent else (0.0, 0.0, 0.0)))
        pair = cartosat.StereoPair.make(seed=seed, points=count)
        camera, sigma = pair.cameras["fore"], 0.3
        points = pair.measure(seed, sigma_column=sigma, sigma_row={"fore": sigma, "aft": sigma})["fore"]
        return Truth(
            pair.rpc("fore", bias), points, (pair.size, pair.size), lambda image: camera.meet(image, pair.hills),
            pair.hills, zone,
        )  # fmt: skip
    if sensor == "orbview3":
        coast, believed = orbview3.Coast(), orbview3.scanner("471890")
        true = orbview3.with_attitude_error(believed, seed)
        error = true.error.copy()
        error[:, 2 if bent else 1 :] = 0.0
        if not bent:
            error[2] = 0.0
        true = replace(true, error=error)
        points = orbview3.measure(true, orbview3.places(count, coast, seed), seed)
        size = orbview3.COLUMNS, orbview3.LINES
        return Truth(orbview3.vendor_rpc(believed), points, size, lambda image: true.meet(image, coast), coast, zone)
    scene = bilsat.BilsatScene.make(points=count, seed=seed, off_nadir_deg=random.uniform(5, 25))
    turn = random.normal(0, 2e-4) if bent else 0.0
    believed = scene.camera.misaligned(*random.normal(0, 3e-4, 2), turn, 1.0, 0.0)
    size = (scene.camera.width, scene.camera.height)
    return Truth(
        _rpc_of(believed, scene.hills), scene.measure(seed), size,
        lambda image: scene.camera.meet(image, scene.hills), scene.hills, zone,
    )  # fmt: skip


class _Camera(SensorModel):
    """A camera as its vendor believes it, so that an RPC can be fitted to it."""

    kind = "believed"

    def __init__(self, camera: Any, domain: tuple[np.ndarray, np.ndarray]) -> None:
        object.__setattr__(self, "camera", camera)
        object.__setattr__(self, "box", domain)

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return self.box

    def ground_to_image(self, ground: Any) -> np.ndarray:
        return self.camera.project(ground)


def _rpc_of(camera: Any, hills: Any) -> RPC:
    corners = np.array([(c, r) for c in (0.0, 0.5, 1.0) for r in (0.0, 0.5, 1.0)]) * (camera.width, camera.height)
    seen = camera.meet(corners, hills)
    low, high = np.append(seen[:, :2].min(axis=0), hills.low - 50), np.append(seen[:, :2].max(axis=0), hills.high + 50)
    centre, half = (low + high) / 2, (high - low) / 2 * [1.05, 1.05, 1.0]
    box = (*(centre - half)[:2], *(centre + half)[:2])
    return fit_rpc(_Camera(camera, (centre, half)), box, (float(low[2]), float(high[2]))).rpc


@dataclass(frozen=True)
class Trial:
    """Errors ``(n, 2)`` east and north (m) of pixels of an ortho, and what was predicted of each."""

    errors: np.ndarray
    parts: Parts
    fit: Fit

    @property
    def normalised(self) -> np.ndarray:
        """Errors over their predicted standard deviations ``(n, 2)``."""
        return self.errors / np.sqrt(self.parts.total[:, :2])

    @property
    def within(self) -> np.ndarray:
        """Which errors are within their ce90 ``(n,)``."""
        return np.hypot(*self.errors.T) <= circular_error(self.parts.total)


def trial(sensor: str, seed: int, *, places: int = 60) -> Trial:
    """Draw a scene: shift and affine in turn, 10 to 30 control points, a DEM that errs 1 to 12 m over 50 m to 3 km."""
    random = np.random.default_rng([seed, SENSORS.index(sensor)])
    kind = "affine" if seed % 2 else "shift"
    truth = scene_of(sensor, seed, int(random.integers(10, 31)), bent=kind == "affine")
    sigma = float(np.exp(random.uniform(np.log(1.0), np.log(12.0))))
    errors = Field.draw(random, sigma, float(np.exp(random.uniform(np.log(50.0), np.log(3000.0)))))
    middle = (truth.size[0] / 2, truth.size[1] / 2)
    made = fit(ImageCorrection.identity(truth.rpc, kind, middle), truth.points, robust=False)
    return follow(truth, made, sigma, errors, random.uniform(0.02, 0.98, (places, 2)) * truth.size)


def follow(truth: Truth, made: Fit, sigma: float, errors: Field, image: np.ndarray) -> Trial:
    """Follow the pixels of the ortho in which the places of `image` are seen, about."""
    to_map = pyproj.Transformer.from_crs(4326, truth.zone, always_xy=True)
    xy = np.stack(to_map.transform(*truth.meet(image)[:, :2].T), axis=1)

    def dem(places: np.ndarray) -> np.ndarray:
        return truth.terrain(*to_map.transform(*places.T, direction="INVERSE")) + errors(places)

    heights = dem(xy)
    rise = np.stack([dem(xy + half) - dem(xy - half) for half in ([0.5, 0.0], [0.0, -0.5])], axis=1)
    grid = Grid(pyproj.CRS.from_epsg(truth.zone), xy[:, 0].min(), xy[:, 1].max(), 1.0, 1.0, 4_000_000, 4_000_000)
    sight = Sight(made.model, grid)
    columns, rows = xy[:, 0] - grid.left, grid.top - xy[:, 1]
    shown = truth.meet(sight.image(columns, rows, heights))
    there = np.stack(to_map.transform(*shown[:, :2].T), axis=1)
    parts = parts_at(
        Budget(covariance=predictive(made.covariance, made.degrees_of_freedom), heights=sigma),
        sight,
        columns,
        rows,
        heights,
        slopes=np.einsum("ni,nij->nj", rise, np.linalg.inv(sight.metres(columns, rows, heights))),
    )
    return Trial(there - xy, parts, made)


def pooled(trials: list[Trial]) -> dict[str, float]:
    """Return the spread of normalised errors per axis, and the share within ce90."""
    ratio = np.concatenate([one.normalised for one in trials])
    within = np.concatenate([one.within for one in trials])
    east, north = np.sqrt((ratio**2).mean(axis=0))
    return {"east": float(east), "north": float(north), "within": float(within.mean()), "pixels": len(ratio)}
