"""DIMAP metadata of version 2 and of Pleiades' version 1 as a file of strangers."""

from __future__ import annotations

from os import PathLike

import numpy as np

from ortho_pipeline.plugin import Array, XmlFields

#: Bytes of a file.
MAX_SIZE = 5_000_000
#: Coefficients that a polynomial may have.
MOST_TERMS = 10
__all__ = ["MAX_SIZE", "MOST_TERMS", "DimapFile"]


class DimapFile(XmlFields):
    """DIMAP metadata whose rigorous model may be left for their RPC."""

    def __init__(self, path: PathLike[str]) -> None:
        super().__init__(path, remedy="use the RPC", limit=MAX_SIZE)

    def polynomial(self, field: str) -> Array:
        """Return the coefficients, lowest power first, of a polynomial with its degree."""
        terms = self.numbers(f"{field}/COEFFICIENTS", None)
        if len(terms) > MOST_TERMS or len(terms) != self.number(f"{field}/DEGREE") + 1:
            raise self.error("the number of coefficients does not match the degree", field)
        return np.array(terms)
