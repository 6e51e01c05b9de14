"""The fields of a CSM state, read with errors that name them."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np

from ortho_pipeline.plugin import SEMI_MAJOR, Array, InputError

MOST_VALUES = 2_000_000
REMEDY = "write the state again with the program that made it"


class StateFields:
    """The fields of a state, each with an error that names file and field."""

    def __init__(self, fields: dict[str, Any], path: str | PathLike[str]) -> None:
        self.fields, self.path = fields, path

    def error(self, message: str, field: str) -> InputError:
        """Return the error that a field is."""
        return InputError(message, file=self.path, field=field, remedy=REMEDY)

    def numbers(self, field: str, count: int | None = None) -> Array:
        """Return the numbers of a list."""
        value = self.fields.get(field)
        if not isinstance(value, list) or len(value) > MOST_VALUES or (count is not None and len(value) != count):
            raise self.error(f"this must be a list of {count or 'at most ' + str(MOST_VALUES)} numbers", field)
        if not all(isinstance(number, int | float) and not isinstance(number, bool) for number in value):
            raise self.error("this is not a list of numbers", field)
        values = np.array(value, dtype=np.float64)
        if not (np.abs(values) < 1e15).all():
            raise self.error("a number is too large", field)
        return values

    def number(self, field: str, default: float | None = None) -> float:
        """Return a number."""
        value = self.fields.get(field, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
            raise self.error("this must be a number", field)
        return float(value)

    def size(self) -> tuple[int, int]:
        """Return columns and rows."""
        sizes = []
        for field in ("m_nSamples", "m_nLines"):
            value = self.number(field)
            if value != int(value) or not 1 <= value <= 10_000_000:
                raise self.error("this is not an image size", field)
            sizes.append(int(value))
        return sizes[0], sizes[1]

    def heights(self, default: tuple[float, float]) -> tuple[float, float]:
        """Return lowest and highest ellipsoidal height of the ground, within those of mountains."""
        low = max(self.number("m_minElevation", default[0]), default[0])
        high = min(self.number("m_maxElevation", default[1]), default[1])
        return (low, high) if low < high else default

    def radial(self) -> tuple[float, float, float]:
        """Return the terms of a radial distortion; refuse a lens of another kind."""
        terms = self.numbers("m_opticalDistCoeffs")
        if not terms.any():
            return 0.0, 0.0, 0.0
        if self.number("m_distortionType", 0.0) != 0 or len(terms) != 3:
            raise self.error("only radial distortion is supported", "m_distortionType")
        return float(terms[0]), float(terms[1]), float(terms[2])

    def require_earth(self) -> None:
        """Refuse other planets."""
        if abs(self.number("m_majorAxis") - SEMI_MAJOR) > 1.0:
            raise self.error("this is not the ellipsoid of the Earth", "m_majorAxis")
