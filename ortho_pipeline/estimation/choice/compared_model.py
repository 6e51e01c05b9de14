"""One model of a comparison."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import pydantic

from ortho_pipeline.display.notices import to_document
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import rmse_metres
from ortho_pipeline.estimation.records import NoticeDocument, Rmses, RmsesOnGround
from ortho_pipeline.files.json.records import Count, Record, Words
from ortho_pipeline.files.json.values import json_value


class ComparedModel(Record):
    """A model that was fitted, or why it could not be."""

    model: str
    parameters: Count
    minimum_points: Count
    dimensions: Literal[2, 3]
    error: str | None
    rmse: Rmses
    rmse_m: RmsesOnGround
    condition: float | None
    redundancy: int | None
    sigma0: float | None
    fitted_as: str | None
    ridge: float | None
    effective_parameters: float | None
    warnings: tuple[Words, ...]
    notices: tuple[NoticeDocument, ...] = ()
    #: Where it was fitted here; no part of documents.
    fit: Annotated[pydantic.InstanceOf[Fit] | None, pydantic.Field(exclude=True)] = None

    @classmethod
    def of(cls, model: str, size: tuple[int, int, int], fitted: Fit | str) -> Self:
        """Return that of a fit, or of the reason why there is none; `size` as `available_models` has it."""
        fit = fitted if isinstance(fitted, Fit) else None
        parameters, minimum, dimensions = size
        return cls.model_validate(
            {
                "model": model,
                "parameters": parameters,
                "minimum_points": minimum,
                "dimensions": dimensions,
                "error": None if fit else fitted,
                "rmse": fit.rmses if fit else Rmses(control=None, check=None, loo=None),
                "rmse_m": rmse_metres(fit) if fit else RmsesOnGround(control=None, check=None, loo=None),
                "condition": fit and json_value(float(fit.condition)),
                "redundancy": fit and fit.redundancy,
                "sigma0": fit and fit.sigma0,
                "fitted_as": fit and fit.model_name,
                "ridge": fit and fit.ridge,
                "effective_parameters": fit and json_value(float(fit.effective_parameters)),
                **to_document(fit.warnings if fit else ()),
                "fit": fit,
            }
        )
