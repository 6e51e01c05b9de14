"""Prior knowledge of parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a parameter: one more observation, with this mean and sigma in the unit of the parameter.

    Parameters
    ----------
    mean, sigma : float
        Expected value and its standard deviation.
    shared : str
        What the value belongs to, such as a camera. Images of a block with the same prior and the same text have one
        value. Empty: each image has its own.

    Examples
    --------
    >>> Prior(0.0, sigma=0.01)
    Prior(mean=0.0, sigma=0.01, shared='')
    """

    mean: float
    sigma: float
    shared: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and self.sigma > 0):
            raise InputError(
                f"a prior needs a finite mean and a positive sigma, not {self.mean} and {self.sigma}", field="prior"
            )


def priors_at(model: SensorModel, sigmas: Mapping[str, float]) -> dict[str, Prior]:
    """Return priors with the present values of `model` as means.

    Parameters
    ----------
    model : SensorModel
    sigmas : mapping of str to float
        Standard deviations by parameter name; parameters without one get no prior.

    Examples
    --------
    >>> model = op.ImageCorrection.identity(op.read_rpc("sample_data/scene_RPC.TXT"), "shift", (500, 500))
    >>> priors_at(model, {"col_shift": 2.0})
    {'col_shift': Prior(mean=0.0, sigma=2.0, shared='')}
    """
    values = dict(zip(model.param_names, model.params.tolist(), strict=True))
    return {name: Prior(values[name], sigma) for name, sigma in sigmas.items()}
