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
        found = fitted if isinstance(fitted, Fit) else None
        parameters, minimum, dimensions = size
        return cls.model_validate(
            {
                "model": model,
                "parameters": parameters,
                "minimum_points": minimum,
                "dimensions": dimensions,
                "error": None if found else fitted,
                "rmse": found.rmses if found else Rmses(control=None, check=None, loo=None),
                "rmse_m": rmse_metres(found) if found else RmsesOnGround(control=None, check=None, loo=None),
                "condition": found and json_value(float(found.condition)),
                "redundancy": found and found.redundancy,
                "sigma0": found and found.sigma0,
                "fitted_as": found and found.model_name,
                "ridge": found and found.ridge,
                "effective_parameters": found and json_value(float(found.effective_parameters)),
                **to_document(found.warnings if found else ()),
                "fit": found,
            }
        )
