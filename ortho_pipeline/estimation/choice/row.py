"""One model of a comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ortho_pipeline.display.notices import to_document
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import rmse_metres
from ortho_pipeline.files.json.values import json_value


@dataclass(frozen=True)
class Row:
    """One model of a comparison: its fit, or the reason why there is none."""

    model: str
    parameters: int
    minimum_points: int
    dimensions: int
    fit: Fit | None = None
    error: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the row of ``ortho compare --json`` (docs/formats.md)."""
        row: dict[str, Any] = {
            "model": self.model,
            "parameters": self.parameters,
            "minimum_points": self.minimum_points,
            "dimensions": self.dimensions,
            "error": self.error,
        }
        which = ("control", "check", "loo")
        if self.fit is None:
            unknown = ("condition", "redundancy", "sigma0", "fitted_as", "ridge", "effective_parameters")
            nothing = dict.fromkeys(which)
            return {**row, "rmse": nothing, "rmse_m": dict(nothing), **dict.fromkeys(unknown), **to_document(())}
        return {
            **row,
            "rmse": self.fit.rmses,
            "rmse_m": rmse_metres(self.fit),
            "condition": json_value(float(self.fit.condition)),
            "redundancy": self.fit.redundancy,
            "sigma0": self.fit.sigma0,
            "fitted_as": self.fit.model_name,
            "ridge": self.fit.ridge,
            "effective_parameters": json_value(float(self.fit.effective_parameters)),
            **to_document(self.fit.warnings),
        }
