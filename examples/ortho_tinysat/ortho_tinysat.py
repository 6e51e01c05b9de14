"""Sensor plugin for TinySat-1: an image `scene.tif` with its flight in `scene.tinysat.json` next to it."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ortho_pipeline.plugin import (
    Export,
    Format,
    InputError,
    Prior,
    Scene,
    Sensor,
    SensorModel,
    geocentric,
    hookimpl,
    place,
)


@dataclass(frozen=True, eq=False)
class StraightScanner(SensorModel):
    """A line scanner that flies straight on: one row every `line_period`, one column every `pixel_angle`."""

    kind: ClassVar[str] = "tinysat"
    crs: ClassVar[str] = "EPSG:4979"  # of the ground: longitude, latitude (degrees), ellipsoidal height (m) on WGS84
    param_names: ClassVar[tuple[str, ...]] = ("roll", "delay")

    position: tuple[float, float, float]  # ECEF metres, when the middle row is taken
    velocity: tuple[float, float, float]  # ECEF metres per second
    size: tuple[int, int]  # columns, rows
    pixel_angle: float  # radians
    line_period: float  # seconds
    box: tuple[tuple[float, float], ...]  # lowest and highest longitude, latitude (degrees), ellipsoidal height (m)
    roll: float = 0.0  # radians, positive to the right of the flight
    delay: float = 0.0  # seconds by which the clock is late

    def __post_init__(self) -> None:
        for name, shape in (("position", (3,)), ("velocity", (3,)), ("box", (3, 2))):
            if np.shape(getattr(self, name)) != shape or not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} must have the shape {shape} and finite numbers")

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.array(self.box).T
        return (low + high) / 2, (high - low) / 2

    def ground_to_image(self, ground) -> np.ndarray:
        position, velocity = np.array(self.position), np.array(self.velocity)
        speed = np.linalg.norm(velocity)
        forward = velocity / speed
        down = -position + position @ forward * forward
        down /= np.linalg.norm(down)
        look = geocentric(np.asarray(ground, dtype=float)) - position
        angle = np.arctan2(look @ np.cross(down, forward), look @ down) - self.roll
        time = look @ forward / speed + self.delay
        columns, rows = self.size
        return np.stack([columns / 2 + angle / self.pixel_angle, rows / 2 + time / self.line_period], axis=1)

    @property
    def params(self) -> np.ndarray:
        return np.array([self.roll, self.delay])

    def with_params(self, params) -> "StraightScanner":
        return replace(self, roll=float(params[0]), delay=float(params[1]))


@hookimpl
def ortho_models() -> Mapping[str, type[SensorModel]]:
    return {StraightScanner.kind: StraightScanner}


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    yield Sensor("tinysat", "TinySat-1 level 1A scenes", recognises, open_scene, {"mounting": "roll angle, degrees"})


def recognises(dataset: Any) -> bool:
    return flight_file(dataset).is_file()


def flight_file(dataset: Any) -> Any:
    return place(dataset.GetDescription().removesuffix(".tif") + ".tinysat.json")


def open_scene(dataset: Any, *, mounting: str = "0") -> Scene:
    path, size = flight_file(dataset), (dataset.RasterXSize, dataset.RasterYSize)
    try:
        roll = float(np.radians(float(mounting)))
    except ValueError as error:
        raise InputError(f"{mounting!r} is no angle", field="mounting", remedy="degrees, such as 0.1") from error
    try:
        flight = json.loads(path.read_text())
        model = StraightScanner(size=size, roll=roll, **flight["camera"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"not a TinySat-1 flight: {error}", file=path, remedy="ask for the delivery again") from error
    known = {"roll": Prior(roll, np.radians(0.05)), "delay": Prior(0.0, 0.1)}
    facts = {"acquired": flight.get("acquired", "unknown")}
    return Scene("tinysat", dataset.GetDescription(), *size, {"tinysat": model}, str(path), facts=facts, priors=known)


@hookimpl
def ortho_formats() -> Iterable[Format]:
    yield Format("tinysat", "TinySat-1 flight with roll and delay", "_flight.json", write_flight)


def write_flight(export: Export, path: Path) -> float:
    if not isinstance(export.model, StraightScanner):
        raise InputError("only TinySat-1 has such a flight", field="formats", remedy="take another format")
    path.write_text(json.dumps({"camera": export.model.to_dict()}))
    return 0.0
