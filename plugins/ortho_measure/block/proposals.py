r"""Proposals in several images: a click in one image is searched in the others, rendered into its pixels.

The method is that for a reference (`ortho_measure.proposals`), with the other image as the reference. Both are related
by the heights of the DEM. A height error :math:`\delta` moves the match by :math:`\delta\,u` along the epipolar
direction, so the search extends along it. The tie is correct in spite of this error, as in `imaging.ties`.
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

#: Height difference (m) for the epipolar direction, and step (px) for derivatives.
_HEIGHT, _STEP = 20.0, 4.0
#: Search range of heights in standard deviations.
_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class ProposalPair:
    """Two images that show the same ground, with their present models.

    Parameters
    ----------
    first, second : SceneGeometry
    """

    first: SceneGeometry
    second: SceneGeometry

    def carried(self, image: Array) -> Array:
        """Return the positions in the second image of points ``(N, 2)`` of the first, through the surface."""
        return self.second.image_of(self.first.ground_of(image))

    def derivatives(self, image: Array) -> Array:
        """Return the derivatives of `carried` ``(2, 2)`` at a position."""
        steps = np.array([(-_STEP, 0.0), (_STEP, 0.0), (0.0, -_STEP), (0.0, _STEP)])
        there = self.carried(image + steps)
        return np.column_stack([there[1] - there[0], there[3] - there[2]]) / (2 * _STEP)

    def parallax(self, image: Array) -> float:
        """Return the parallax: pixels of the first image per metre of height."""
        ground = self.first.ground_of(image[None])
        higher = ground + np.array([0.0, 0.0, _HEIGHT])
        apart = self.second.image_of(higher) - self.second.image_of(ground)
        own = self.first.image_of(higher) - self.first.image_of(ground)
        moved = np.linalg.solve(self.derivatives(image), apart[0]) - own[0]
        return float(np.linalg.norm(moved)) / _HEIGHT

    def proposal(self, image: Array, radius: float, sigma_height: float, click: Array | None = None) -> dict[str, Any]:
        """Return the position in the second image of a point of the first, as JSON values.

        They are `image` with `covariance`, `own` (the part of the covariance from the first image) and `score`, or the
        `reason` why there is no match; `seen` states whether the second image covers the place.

        Parameters
        ----------
        radius : float
            Search radius (px) for the errors of both models.
        click : (2,), optional
            A click in the second image; then the search is near it.
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
        # Half of the variance of a match comes from each chip.
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
    """Search for clicks in all images of a block.

    Parameters
    ----------
    places : tuple of SceneGeometry
        With the present models.
    labels : tuple of str
    reaches : tuple of float
        Search radius (px) of each image.
    sigma_height : float
        Standard deviation of the heights (m).
    referenced : bool
        Whether there are references.
    """

    places: tuple[SceneGeometry, ...]
    labels: tuple[str, ...]
    reaches: tuple[float, ...]
    sigma_height: float
    referenced: bool

    def of_click(self, number: int, image: Sequence[float], known: Mapping[str, Sequence[float]]) -> dict[str, Any]:
        """Return matches of a click in an image, in the other images and the references.

        Parameters
        ----------
        number : int
            Number of the image.
        known : mapping of label to (column, row)
            Earlier clicks of the point; with any, the first of them is searched near the click.

        Returns
        -------
        dict
            `rays` by label: the `covariance` of the click itself; for the others as `ProposalPair.proposal`. `ground`:
            as `ortho_measure.proposals.proposal_of` for the references, null without any.
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
        """Return matches of a ground position of the reference in all images: `rays` as in `of_click`."""
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
