"""Page of `ortho reproduce cartosat`: error vectors, and why some rows differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ortho_pipeline.models.base import Array
from ortho_studies.cartosat.truth import SIZE
from ortho_studies.simulation import page as shared
from ortho_studies.simulation.page import Figure, Reason

#: The models whose errors are drawn, and what there is to see.
DRAWN = {
    "rpc affine": "RPC with an affine bias correction: the rest is measurement noise, larger along the track "
    "(down the image) than across.",
    "affine3d geographic": "3D affine model in geographic coordinates: the meridians converge and the parallels "
    "curve, which an affine transformation cannot follow.",
}
#: Why rows differ by more than the factor.
REASONS = (
    Reason(
        "RPC shift, 1 GCP",
        "The error of the single control point affects all others fully, so this row is a single draw: the "
        "paper's point was about 0.4 px off across the track.",
    ),
    Reason(
        "RPC shift + drift, 3 GCPs",
        "Three points leave two redundant measurements in each direction, and the paper does not state their "
        "positions.",
    ),
    Reason(
        "affine3d geographic",
        "An affine transformation cannot represent converging meridians, so this error grows with the square of "
        "the field. Our field is the whole upper left quarter, as the paper states; its numbers suggest a "
        "smaller field with more points near its middle row.",
    ),
    Reason(
        "s0",
        "The paper's nine control points fit its models better than its check points do (s0 0.38 is 0.19 px, "
        "the check points have 0.25 to 0.52 px); ours all have the same noise. If the model itself is wrong "
        "(geographic coordinates, uncorrected slopes of the RPCs), our control points at the edge of the field "
        "show the largest errors.",
    ),
    Reason(
        "extremes",
        "The largest of 60 residuals is a single draw. The paper's are up to four times the RMS and mostly to "
        "one side, so one or two of its points were worse than the others. Our noise is normal for all points.",
    ),
)
INTRODUCTION = (
    "The paper’s images are not public. Ours is a simulated pass over the same place: a circular orbit at 618 km, two "
    "line scanners with the paper’s focal length and pixels looking 26° forward and 5° back, a turning Earth, and "
    "RPCs that the vendor fitted to an attitude which he knows with an error. Each realisation draws the places of the "
    "69 points and their noise. X, Y and Z are geocentric for the geocentric 3D affine model and the pushbroom, as in "
    "the paper, and east, north and height elsewhere."
)


def page(document: Mapping[str, Any], vectors: Mapping[str, tuple[Array, Array]]) -> str:
    """Return the page of a document; `vectors` are `cartosat.error_vectors` of the models in `DRAWN`."""
    figures = [
        Figure(
            shared.draw_vectors(
                f"Errors of 60 check points in fore, {model}", *vectors[model], (SIZE, SIZE), kind="check", bar=1.0
            ),
            f"Errors of 60 check points in the fore image, one realisation. {caption}",
        )
        for model, caption in DRAWN.items()
    ]
    return shared.page(
        document,
        heading="CARTOSAT-1: the paper’s tables and ours",
        introduction=INTRODUCTION,
        figures=figures,
        reasons=REASONS,
    )
