"""How far matching searches for a scene: the radius and rotation that its user or its metadata state, or a default."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import MatchOptions

#: Search radius (m) for a model of unknown accuracy, and its limit as a share of the scene's shorter side.
DEFAULT_SEARCH, _PART = 100.0, 0.25
#: Search radius in sigmas that a scene states, and its lower limit in pixels.
_SIGMAS, _LEAST = 3.0, 8.0
#: Largest rotation (degrees) of a pose that only metadata give.
POSE_DEG = 5.0


@dataclass(frozen=True)
class Search:
    """The search radius for a scene, and its source.

    Parameters
    ----------
    distance : float
        Metres on the ground.
    source : str
    known : bool
        Whether the user or the scene states it.
    """

    distance: float
    source: str
    known: bool = True


def search_of(scene: Scene, options: MatchOptions, pixel: float) -> Search:
    """Return the search radius (m): of the user, from the accuracy that the scene states, or a default.

    Parameters
    ----------
    pixel : float
        Size (m) of a pixel on the ground.
    """
    if options.search is not None:
        least = 2.0 * pixel  # as far as chips are moved in any case
        return Search(options.search, "as requested") if options.search >= least else Search(least, "two pixels")
    stated = _stated(scene, pixel)
    if stated is not None:
        sigma, source = stated
        return Search(max(_SIGMAS * sigma, _LEAST * pixel), f"{_SIGMAS:.0f} times {metres(sigma)}, {source}")
    part = _PART * min(scene.width, scene.height) * pixel
    if part < DEFAULT_SEARCH:
        return Search(part, f"default, as the scene states no accuracy; {_PART:.0%} of its side", known=False)
    return Search(DEFAULT_SEARCH, "default, as the scene states no accuracy", known=False)


def rotation_of(scene: Scene, options: MatchOptions) -> float:
    """Return the largest rotation (degrees) of the model: of the user, or `POSE_DEG` if it is a pose.

    An RPC comes from an adjusted pose, so no rotation is assumed.
    """
    if options.search_rotation is not None:
        return options.search_rotation
    return POSE_DEG if set(scene.model.param_names) & set(scene.priors) else 0.0


def _stated(scene: Scene, pixel: float) -> tuple[float, str] | None:
    """Return the standard deviation (m) of a scene's model and its source; None if it is not stated."""
    model = scene.model
    sigma = model.stated_accuracy
    if sigma is not None:
        return sigma, "the errors that the RPC states (ERR_BIAS, ERR_RAND)"
    if scene.accuracy is not None:
        return scene.accuracy * math.sqrt(2), "the accuracy in the metadata"
    names = model.param_names
    known = {name: prior.sigma for name, prior in scene.priors.items() if math.isfinite(prior.sigma)}
    if names and set(names) <= set(known):
        centre = model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), model.reference_height)
        spread = model.param_partials(centre)[0] * np.array([known[name] for name in names])
        if np.isfinite(spread).all():
            return float(np.linalg.norm(spread)) * pixel, "the sigmas of the parameters in the metadata"
    return None


def default_search(search: Search) -> list[Notice]:
    """Return a notice if neither user nor scene states the search radius."""
    if search.known:
        return []
    text = f"no stated accuracy for this scene's model; searched within {metres(search.distance)}"
    return [Notice("search-by-default", text, search_m=search.distance)]
