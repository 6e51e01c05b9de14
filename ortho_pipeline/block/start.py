"""An image of a block before it is adjusted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel


@dataclass(frozen=True)
class Start:
    """An image before its adjustment: its scene, the model with its name and source, and priors of its parameters."""

    scene: Scene
    model: SensorModel
    name: str
    source: str
    priors: Mapping[str, Prior] = field(default_factory=dict)

    @property
    def accuracy(self) -> float | None:
        """Standard deviation (m, each axis in plan) in its metadata; None of an adjusted model."""
        if self.scene.adjusted is not None:
            return None
        first = self.name.split("+")[0] == next(iter(self.scene.models), None)
        return self.model.stated_accuracy or (self.scene.accuracy if first else None)
