"""What the adjustment of one image starts from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ortho_pipeline.estimation.problem import Prior
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel


@dataclass(frozen=True)
class Start:
    """What the adjustment of one image starts from: its scene, the model and its name, and what is known of it."""

    scene: Scene
    model: SensorModel
    name: str
    source: str
    priors: Mapping[str, Prior] = field(default_factory=dict)
