"""Proposals: the sub-pixel position of a click, with score and covariance, by the functions of the matcher.

The chip of the scene around the click is searched in the reference, which is rendered into the pixels of the scene at
that place. Repeated least-squares matching measures the shift. The covariance of least-squares matching is too small by
an unknown factor. So the neighbours of the chip are also measured, and the scatter of their shifts gives the factor.
Errors common to all neighbours (of the reference or the heights) are not included; the residuals of the fit show them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_measure.places import SceneGeometry
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.imaging.matching import REASONS
from ortho_pipeline.imaging.matching.chip_search import MEASURED, SIDE, doubts, found_again
from ortho_pipeline.imaging.matching.chips import Renderer, scene_chips
from ortho_pipeline.imaging.matching.least_squares import Measured, measure
from ortho_pipeline.imaging.matching.targets import chip_factor
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import DEFAULT_SIGMA_IMAGE

#: Search radius in chip px: if both positions are clicked, and the largest.
NEAR, FARTHEST = 6, 48
#: Least number of neighbours for a scatter.
_FEWEST = 4
#: Lower limit of the standard deviation of a match (px per axis).
_LEAST = 0.02
_ROUNDS = 3
#: Neighbours of a chip, in chip sides, the nearest first; `_NEIGHBOURS` of them are measured.
_AROUND = np.array(
    sorted(((x, y) for y in range(-2, 3) for x in range(-2, 3) if x or y), key=lambda step: step[0] ** 2 + step[1] ** 2)
)
_NEIGHBOURS = 8


@dataclass(frozen=True, eq=False)
class Proposal:
    """A match of one place.

    Parameters
    ----------
    shift : (2,)
        Position of the match in the reference minus the click, px. NaN without a match.
    covariance : (2, 2)
        px^2.
    score : float
        Correlation of the chips, -1 to 1.
    reason : str
        Why the match is not reliable, in words; empty if it is.
    scattered : int
        Number of neighbours behind the covariance; 0 if it is that of a manual measurement.
    """

    shift: Array
    covariance: Array
    score: float
    reason: str
    scattered: int


def propose(places: SceneGeometry, image: Sequence[float], radius: float) -> Proposal:
    """Match the scene at an image point with the references, within a radius (px).

    Parameters
    ----------
    places : SceneGeometry
        With a model that projects the wanted ground approximately to the click.
    """
    factor = chip_factor(places.view, places.references, np.asarray(image, dtype=float)[None])
    reach = int(np.clip(np.ceil(radius / factor), NEAR, FARTHEST))
    origin = np.round(np.asarray(image, dtype=float) - SIDE * factor / 2).astype(int)[None]
    scene = scene_chips(places.view, origin, SIDE, factor)
    wide = _rendered(places, origin, 2 * reach, factor)
    match = found_again(scene, wide, reach)
    around = scene_chips(places.view, origin - reach * factor, SIDE + 2 * reach, factor)
    doubt = str(doubts(match, wide, around, reach)[0])
    if not np.isfinite(wide).any():
        return _nothing("the reference has no data here")
    shift, measured = match.shift[0] * factor, None
    for _ in range(_ROUNDS):
        measured = _measured(places, origin, shift, factor, scene)
        if not np.isfinite(measured.shift).all():
            return _nothing(REASONS[doubt or "not measured"], float(match.score[0]))
        shift = shift + measured.shift[0] * factor
        if np.abs(measured.shift).max() < 0.02:
            break
    assert measured is not None
    covariance, scattered = _covariance(places, origin, shift, factor, measured)
    return Proposal(shift, covariance, float(measured.correlation[0]), REASONS.get(doubt, ""), scattered)


def proposal_of(places: SceneGeometry, click: Array | None, ground: Array | None, radius: float) -> dict[str, Any]:
    """Return a match for a click, as JSON values: its `image` and `ground`, score and covariance, or the `reason`.

    Parameters
    ----------
    click : (2,), optional
        px of the scene.
    ground : (3,), optional
        Clicked or entered: its image is searched within `NEAR` of the click, or without a click within `radius` px of
        the predicted position. Without a ground, the ground of the click is searched within `radius` px.

    Raises
    ------
    InputError
        If neither is given.
    """
    if ground is not None:
        expected = places.image_of([ground])[0]
        if click is None and not np.isfinite(expected).all():
            raise InputError("this place is outside the scene", field="ground", remedy="click it in the scene")
        about = expected if click is None else click
        match = propose(places.moved(about - expected), about.tolist(), radius if click is None else NEAR)
        place, on_ground = about - match.shift, ground
    elif click is None:
        raise InputError("no position to match", field="image")
    else:
        match = propose(places, click.tolist(), radius)
        place, on_ground = click, np.full(3, np.nan)
        if np.isfinite(match.shift).all():
            on_ground = places.ground_of([click + match.shift])[0]
    reason = match.reason or ("" if np.isfinite(on_ground).all() else "the DEM does not cover this place")
    (column, both), (_, row) = match.covariance
    document: dict[str, Any] = json_value(
        {
            "image": json_position(place),
            "ground": json_position(on_ground),
            "score": match.score,
            "covariance": json_position([column, row, both]),
            "scattered": match.scattered,
            "reason": reason,
        }
    )
    return document


def _rendered(places: SceneGeometry, origins: NDArray[np.int_], radius: int, factor: int) -> NDArray[np.float32]:
    renderer = Renderer(places.view, places.references, origins - radius * factor, SIDE + 2 * radius, factor)
    return renderer.render(np.arange(len(origins)))


def _measured(
    places: SceneGeometry, origins: NDArray[np.int_], shift: Array, factor: int, scene: NDArray[np.float32]
) -> Measured:
    """Measure the remaining shift (px) with the reference rendered at the present shift."""
    wide = _rendered(places.moved(-shift), origins, MEASURED, factor)
    return measure(scene, wide, np.zeros((len(origins), 2)))


def _covariance(
    places: SceneGeometry, origin: NDArray[np.int_], shift: Array, factor: int, measured: Measured
) -> tuple[Array, int]:
    """Return the covariance ``(2, 2)`` px^2 of a match, and the number of neighbours behind it."""
    own = measured.covariance[0] * factor**2
    origins = origin + _AROUND * SIDE * factor
    inside = ((origins >= 0) & (origins + SIDE * factor <= places.view.size)).all(axis=1)
    origins = origins[inside][:_NEIGHBOURS]
    scene = scene_chips(places.view, origins, SIDE, factor)
    full = np.flatnonzero(np.isfinite(scene).all(axis=(1, 2)))
    neighbours = _measured(places, origins[full], shift, factor, scene[full]) if len(full) else None
    good = np.zeros(0, dtype=int) if neighbours is None else np.flatnonzero(np.isfinite(neighbours.shift).all(axis=1))
    if neighbours is None or len(good) < _FEWEST:
        return np.eye(2) * DEFAULT_SIGMA_IMAGE**2, 0
    offsets, stated = neighbours.shift[good] * factor, neighbours.covariance[good] * factor**2
    # Relative to the median, because neighbours on other ground (a roof, a tree) may be far off.
    distance = squared_distances(offsets - np.median(offsets, axis=0), stated)
    # The median of chi-squared with two degrees of freedom is 2 log 2; the sample median removes part of the scatter.
    size = float(np.median(distance)) / (2 * np.log(2)) * len(good) / (len(good) - 1)
    grown = own * max(size, 1.0)
    return grown + np.eye(2) * max(0.0, _LEAST**2 - float(np.linalg.eigvalsh(grown)[0])), len(good)


def _nothing(reason: str, score: float = 0.0) -> Proposal:
    return Proposal(np.full(2, np.nan), np.full((2, 2), np.nan), score, reason, 0)
