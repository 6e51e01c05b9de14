"""The gallery: chips of the scene next to those of the reference, those that fit worst first."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.display.numbers import px
from ortho_pipeline.estimation.records import Pair
from ortho_pipeline.raster.verified_writing import png_bytes
from ortho_pipeline.report.gallery.matches import MatchPoint, in_words, shown
from ortho_pipeline.report.records import SceneReport

if TYPE_CHECKING:
    from ortho_pipeline.imaging.matching import Matches

#: How many kept and how many rejected matches are shown.
_WORST, _REJECTED = 24, 8
#: Pairs of chips next to each other in the picture that holds them all.
_COLUMNS = 4
#: Percentiles of both chips that are black and white.
_STRETCH = (2.0, 98.0)


@dataclass(frozen=True)
class ChipPair:
    """A pair of chips: `scene` and `reference` are their corners in the picture, `cross` and `found` the place in each.

    All in pixels of the picture, from the corner of the chip for `cross` and `found`; `found` is None where nothing was
    measured.
    """

    id: str
    kind: str
    score: float | None
    residual: float | None
    reason: str | None
    scene: tuple[int, int]
    reference: tuple[int, int]
    cross: Pair
    found: Pair | None

    @property
    def alt(self) -> str:
        """What is to be seen, in words."""
        said = [f"{self.id}: {self.kind}"]
        if self.score is not None:
            said.append(f"score {self.score:.2f}")
        if self.residual is not None:
            said.append(f"residual {px(self.residual)}")
        if self.reason is not None:
            said.append(self.reason)
        return ", ".join(said)


@dataclass(frozen=True)
class Gallery:
    """Tiles in the order of the page, the picture (PNG in base64) with its size, and the side of a chip in it, px."""

    worst: tuple[ChipPair, ...]
    rejected: tuple[ChipPair, ...]
    picture: str
    size: tuple[int, int]
    side: int
    factor: int
    kept: int
    tried_rejected: int


def gallery(report: SceneReport, matches: Matches) -> Gallery | None:
    """Return the kept matches with the largest residuals, and the rejected ones with the highest scores.

    Parameters
    ----------
    report : SceneReport
        Of the scene that was matched.
    matches : Matches
        What `report.matching` was made of: its candidates are these, in this order.
    """
    found = list(enumerate(shown(report)))
    kept = [(k, one) for k, one in found if one.candidate.reason is None]
    rejected = [(k, one) for k, one in found if one.candidate.reason is not None]
    # What was never rendered near its place cannot be shown.
    both = [(k, one) for k, one in rejected if np.isfinite(matches.target[k]).any()]
    worst = sorted(kept, key=lambda pair: (-pair[1].length, pair[0]))[:_WORST]
    best = sorted(both, key=lambda pair: (-_score(pair[1]), pair[0]))[:_REJECTED]
    if not worst and not best:
        return None
    order = [*worst, *best]
    picture = _picture(matches, [k for k, _ in order])
    tiles = [_tile(matches, k, one, place) for place, (k, one) in enumerate(order)]
    return Gallery(
        tuple(tiles[: len(worst)]),
        tuple(tiles[len(worst) :]),
        base64.b64encode(png_bytes(picture)).decode(),
        (picture.shape[2], picture.shape[1]),
        matches.scene.shape[1],
        matches.factor,
        len(kept),
        len(rejected),
    )


def _score(one: MatchPoint) -> float:
    return -1.0 if one.candidate.score is None else one.candidate.score


def _corners(place: int, side: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the corners of scene and reference of a pair in the picture; chips are a pixel apart."""
    row, column = divmod(place, _COLUMNS)
    left, top = 2 * column * (side + 1), row * (side + 1)
    return (left, top), (left + side + 1, top)


def _tile(matches: Matches, index: int, one: MatchPoint, place: int) -> ChipPair:
    side = matches.scene.shape[1]
    scene, reference = _corners(place, side)
    column, row = (float(value) for value in side / 2 + matches.found[index])
    reason = one.candidate.reason
    inside = 0 <= column <= side and 0 <= row <= side
    kinds = {"control": "control", "check": "check", "out": "rejected by the adjustment"}
    return ChipPair(
        id=one.candidate.id if one.point is None else one.point.id,
        kind="rejected" if reason is not None else kinds[one.kind],
        # Of what was not measured it is no correlation.
        score=one.candidate.score if np.isfinite(matches.found[index]).all() else None,
        residual=None if one.residual is None else one.length,
        reason=None if reason is None else in_words(reason),
        scene=scene,
        reference=reference,
        cross=(side / 2, side / 2),
        found=(column, row) if inside else None,
    )


def _picture(matches: Matches, order: list[int]) -> NDArray[np.uint8]:
    """Return all chips as grey and alpha ``(2, rows, columns)``."""
    side = matches.scene.shape[1]
    rows, columns = math.ceil(len(order) / _COLUMNS), min(len(order), _COLUMNS)
    found = np.zeros((2, rows * (side + 1) - 1, 2 * columns * (side + 1) - 1), dtype=np.uint8)
    for place, index in enumerate(order):
        corners = _corners(place, side)
        for (left, top), chip in zip(corners, (matches.scene[index], matches.target[index]), strict=True):
            found[:, top : top + side, left : left + side] = stretched(chip)
    return found


def stretched(chip: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a chip as grey and alpha, transparent where it shows nothing."""
    seen = np.isfinite(chip)
    low, high = np.percentile(chip[seen], _STRETCH) if seen.any() else (0.0, 1.0)
    with np.errstate(invalid="ignore"):
        grey = np.clip((chip - low) / max(high - low, 1e-12), 0.0, 1.0) * 255.0
    return np.stack([np.where(seen, grey, 0.0), np.where(seen, 255.0, 0.0)]).astype(np.uint8)
