"""Page of `ortho reproduce ikonos`: figure 4, and where the settings come from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ortho_pipeline.models.base import Array
from ortho_studies.ikonos.experiment import NAMES, TABLE_2
from ortho_studies.ikonos.truth import EXTENT
from ortho_studies.simulation import page as shared
from ortho_studies.simulation.page import Figure, Reason

INTRODUCTION = (
    "The paper’s image is not public. Ours are simulated Geo products of 11 by 11 km over the same city: the scene is "
    "scanned from 681 km, projected along the line of sight to a plane, and off by 10 to 25 m. Each realisation draws "
    "what the paper does not tell: hills, places of the 20 control and 20 check points, azimuth of the satellite, "
    "direction of the scan, the vendor’s error; and the noise."
)
REASONS = (
    Reason(
        "cubic polynomial",
        "Ten unknowns per axis from twenty points: their positions decide how large the cubic terms become "
        "between them.",
    ),
    Reason(
        "2D",
        "The error of models without heights is the relief without a plane, divided by the tangent of the "
        "elevation. With the published heights of the city and a tilt of 20 degrees this is less than in the "
        "paper. Its image had a larger tilt, or its part of the city has more relief.",
    ),
)
_LETTERS = "abcdef"


def page(document: Mapping[str, Any], vectors: Mapping[str, tuple[Array, Array]]) -> str:
    """Return the page of a document; `vectors` are those of `ikonos.error_vectors`."""
    size = (EXTENT, EXTENT)
    figures = [
        Figure(
            shared.draw_vectors(
                f"Errors of the check points, {NAMES[name]}", *vectors[name], size, units="m", kind="check"
            ),
            f"Figure 4 ({letter}): {NAMES[name]}. Measured minus predicted, one realisation; mind the scale.",
        )
        for letter, name in zip(_LETTERS, TABLE_2, strict=True)
    ]
    return shared.page(
        document,
        heading="IKONOS: the paper’s table and ours",
        introduction=INTRODUCTION,
        figures=figures,
        reasons=REASONS,
    )
