r"""Proposals in several images: what one shows at a click is looked for in another, rendered into its pixels.

As for a reference (`measure.proposals`), with the other image for one. The heights of the DEM bring both together:
where they are wrong by :math:`\delta` the match lies :math:`\delta\,u` along the epipolar direction, and so far it is
searched; the tie is right all the same, as in `imaging.ties`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ortho_measure.places import SceneGeometry
from ortho_measure.proposals import NEAR, proposal_of, propose
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.imaging.matching import OtherScene
from ortho_pipeline.models.base import Array

#: Height (m) over which the epipolar direction is asked for, and pixels over which derivatives are.
_HEIGHT, _STEP = 20.0, 4.0
#: Heights are searched within so many of their standard deviations.
_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class ProposalPair:
    """An image and another one that shows the same ground, by their models as they are now.

    Parameters
    ----------
    first, second : SceneGeometry
    """

    first: SceneGeometry
    second: SceneGeometry

    def carried(self, image: Array) -> Array:
        """Return where the second image has what the first has at ``(N, 2)``, with the ground on the surface."""
        return self.second.image_of(self.first.ground_of(image))

    def derivatives(self, image: Array) -> Array:
        """Return those of `carried` ``(2, 2)`` at a place."""
        steps = np.array([(-_STEP, 0.0), (_STEP, 0.0), (0.0, -_STEP), (0.0, _STEP)])
        there = self.carried(image + steps)
        return np.column_stack([there[1] - there[0], there[3] - there[2]]) / (2 * _STEP)

    def parallax(self, image: Array) -> float:
        """Return by how many px of the first image a metre of height moves what the second shows."""
        ground = self.first.ground_of(image[None])
        higher = ground + np.array([0.0, 0.0, _HEIGHT])
        apart = self.second.image_of(higher) - self.second.image_of(ground)
        own = self.first.image_of(higher) - self.first.image_of(ground)
        moved = np.linalg.solve(self.derivatives(image), apart[0]) - own[0]
        return float(np.linalg.norm(moved)) / _HEIGHT

    def proposal(self, image: Array, radius: float, sigma_height: float, click: Array | None = None) -> dict[str, Any]:
        """Return where the second image shows what the first has at a place, as JSON values.

        `image` with `covariance`, `own` the part of it that the place in the first image errs by, `score`, or the
        `reason` why there is no match; `seen` tells whether the second image shows the place at all.

        Parameters
        ----------
        radius : float
            How far (px) the models may be off against each other.
        click : (2,), optional
            A click in the second image, near which it is then.
        """
        there = self.carried(image[None])[0]
        inside = bool(np.isfinite(there).all() and ((there >= 0) & (there <= self.second.view.size)).all())
        if not inside and click is None:
            return {"seen": False, "reason": "the other image does not cover this place", "image": None}
        jacobian = self.derivatives(image)
        if not (np.isfinite(jacobian).all() and np.isfinite(there).all()):
            return {"seen": inside, "reason": "the DEM does not cover this place", "image": None}
        local = replace(self.first, references=(OtherScene(self.second.view.intensity, self.second.model),))
        if click is not None:
            local = local.moved(np.linalg.solve(jacobian, there - click))
            reach = float(NEAR)
        else:
            reach = radius + _SIGMAS * sigma_height * self.parallax(image)
        match = propose(local, image.tolist(), reach)
        if match.reason or not np.isfinite(match.shift).all():
            return {"seen": True, "reason": match.reason, "score": match.score, "image": None}
        place = self.second.image_of(local.ground_of(image[None] + match.shift))[0]
        # The error of a match is that of both chips, half and half.
        own = match.covariance / 2
        document: dict[str, Any] = json_value(
            {
                "seen": True,
                "reason": "" if np.isfinite(place).all() else "the DEM does not cover this place",
                "image": json_position(place),
                "covariance": _three(jacobian @ own @ jacobian.T),
                "own": _three(own),
                "score": match.score,
                "scattered": match.scattered,
            }
        )
        return document


@dataclass(frozen=True, eq=False)
class TieSearch:
    """Looks for clicks in all images of a block.

    Parameters
    ----------
    places : tuple of SceneGeometry
        By the models as they are now.
    labels : tuple of str
    reaches : tuple of float
        How far (px) models may be off.
    sigma_height : float
        Of the heights (m).
    referenced : bool
        Whether there are references.
    """

    places: tuple[SceneGeometry, ...]
    labels: tuple[str, ...]
    reaches: tuple[float, ...]
    sigma_height: float
    referenced: bool

    def of_click(self, number: int, image: Sequence[float], known: Mapping[str, Sequence[float]]) -> dict[str, Any]:
        """Return what the other images and the references show at a click in an image.

        Parameters
        ----------
        number : int
            Of the image.
        known : mapping of label to (column, row)
            Where the point was clicked already: with any, the first of them is looked for about the click.

        Returns
        -------
        dict
            `rays` by label: of the click itself its `covariance`; of the others as `Pair.proposal`. `ground`: as
            `measure.proposals.proposal_of` for the references, null without any.
        """
        labels, click = self.labels, np.asarray(image, dtype=float)
        rays: dict[str, Any] = {}
        before = next((label for label in labels if label in known and label != labels[number]), None)
        if before is not None:
            pair = ProposalPair(self.places[labels.index(before)], self.places[number])
            rays[labels[number]] = pair.proposal(np.asarray(known[before], dtype=float), 0.0, 0.0, click)
            return {"rays": rays, "ground": None}
        own = []
        for other, label in enumerate(labels):
            if other != number:
                pair = ProposalPair(self.places[number], self.places[other])
                rays[label] = pair.proposal(click, self.reaches[number], self.sigma_height)
                if rays[label]["image"] is not None:
                    own.append(rays[label]["own"])
        rays[labels[number]] = {
            "seen": True,
            "reason": "",
            "image": click.tolist(),
            "covariance": np.mean(own, axis=0).tolist() if own else None,
        }
        ground = proposal_of(self.places[number], click, None, self.reaches[number]) if self.referenced else None
        return {"rays": json_value(rays), "ground": ground}

    def of_ground(self, ground: Sequence[float]) -> dict[str, Any]:
        """Return where all images show a ground of the reference, by matching: `rays` as `of_click` has them."""
        place, rays = np.asarray(ground, dtype=float), {}
        for known, label, reach in zip(self.places, self.labels, self.reaches, strict=True):
            there = known.image_of(place)[0]
            if not (np.isfinite(there).all() and ((there >= 0) & (there <= known.view.size)).all()):
                rays[label] = {"seen": False, "reason": "this image does not cover this place", "image": None}
            elif not self.referenced:
                rays[label] = {"seen": True, "reason": "there is no reference image", "image": None}
            else:
                match = proposal_of(known, None, place, reach)
                rays[label] = {**match, "image": None if match["reason"] else match["image"], "seen": True}
        return {"rays": rays, "ground": None}


def _three(covariance: Array) -> list[float]:
    (column, both), (_, row) = covariance.tolist()
    return [column, row, both]
