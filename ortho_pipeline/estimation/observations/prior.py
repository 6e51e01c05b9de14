"""A parameter that is known beforehand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel


@dataclass(frozen=True)
class Prior:
    """A parameter known beforehand: one more observation with this mean and sigma, in the parameter's unit."""

    mean: float
    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and self.sigma > 0):
            raise InputError(
                f"a prior needs a finite mean and a positive sigma, not {self.mean} and {self.sigma}", field="prior"
            )


def priors_at(model: SensorModel, sigmas: Mapping[str, float]) -> dict[str, Prior]:
    """Return priors that hold parameters at their values in `model`, with these sigmas by name."""
    values = dict(zip(model.param_names, model.params.tolist(), strict=True))
    return {name: Prior(values[name], sigma) for name, sigma in sigmas.items()}
