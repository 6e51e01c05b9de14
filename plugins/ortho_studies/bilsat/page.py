"""Page of `ortho reproduce bilsat`: figure 2, and why some rows differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ortho_pipeline.models.base import Array
from ortho_studies.bilsat.truth import SIZE
from ortho_studies.simulation import page as shared
from ortho_studies.simulation.page import Figure, Reason

#: Why rows differ by more than the factor.
REASONS = (
    Reason(
        "rigorous cluster",
        "The paper does not state the positions of its three groups. Ours are the points nearest to three "
        "corners; the error elsewhere depends on the size and shape of the group. A residual of 0.04 px from "
        "four points (eight measurements, six unknowns) with noise of 0.7 px is chance.",
    ),
    Reason(
        "projective even:9",
        "The paper's nine points would have 74 % of the squared residuals of all 44 points in its last row (9 x "
        "2.37² of 44 x 1.25²), and twice the residuals of its 20 points. A least-squares fit to nine points of "
        "that quality cannot give this; the row seems to be wrong.",
    ),
    Reason(
        "rigorous even",
        "Four points give eight measurements for six unknowns, eight points give sixteen. With so little "
        "redundancy, a single draw of the noise, as in the paper, has little meaning.",
    ),
    Reason(
        "poly1 even:4",
        "Three unknowns per axis from four points: the residual per axis has one degree of freedom. The check "
        "points have a systematic error of several pixels, which depends on the positions of the four points.",
    ),
    Reason(
        "poly3 even:11",
        "Ten unknowns per axis from eleven points: one degree of freedom. The positions of the eleven points "
        "decide how large the cubic terms become at the edge.",
    ),
    Reason(
        "poly2 even:20",
        "From the paper's own 44 points (0.66 px) we expect 0.55 px for twenty of them, as ours have, not 0.38 "
        "px. It depends on which twenty were used.",
    ),
    Reason("poly2 even:7", "Six unknowns per axis from seven points: one degree of freedom per axis."),
    Reason(
        "rfm1 even:8",
        "Fourteen unknowns from sixteen measurements; the unknowns of height depend on eight heights only. A "
        "single draw has little meaning, and the check points depend on the eight heights.",
    ),
    Reason(
        "rfm",
        "The paper states neither weight nor form of its regularisation. Ours penalises higher terms more than "
        "lower ones. With about as many unknowns as measurements, this decides the result. (The paper's 0.95 of "
        "rfm2 with 32 points does not agree with its 0.49 and 0.44, which give 0.66.)",
    ),
)
INTRODUCTION = (
    "The paper’s image is not public. Ours is a simulated frame over the same relief; each realisation draws the 44 "
    "places, their noise and the error of the ephemeris anew. In the tables, GCP are control points and ICP check "
    "points; even:n are n evenly spread control points, and cluster:n:k n control points in group k."
)


def page(document: Mapping[str, Any], image: Array, residuals: Array) -> str:
    """Return the page of a document; image points and residuals ``(N, 2)`` are those of `bilsat.error_vectors`."""
    vectors = shared.draw_vectors(
        "Error vectors of the rigorous model with 44 points", image, residuals, (SIZE, SIZE), bar=1.0
    )
    caption = (
        "Figure 2: error vectors of the rigorous model with 44 points, measured minus predicted, for one realisation. "
        "They are random, as the paper says of its own."
    )
    return shared.page(
        document,
        heading="BILSAT-1: the paper’s tables and ours",
        introduction=INTRODUCTION,
        figures=[Figure(vectors, caption)],
        reasons=REASONS,
    )
