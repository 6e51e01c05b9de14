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
        "Ten unknowns per axis from twenty points: where they lay decides how far cubic terms swing between them.",
    ),
    Reason(
        "2D",
        "Models without heights are off by what a plane does not explain of the relief, over the tangent of the "
        "elevation. With the published heights of the city and 20 degrees of tilt that is less than in the paper: its "
        "image was tilted by more, or its part of the city is more bent.",
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
