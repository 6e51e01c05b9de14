"""Parameters that images of a block share: one unknown, with the heights' errors, and its covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.shared.unknowns import SharedUnknowns
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.estimation.observations.prior import Prior


@pytest.fixture(scope="module")
def flights(benchmark_module: Callable[[str], Any]) -> Any:
    return benchmark_module("flights")


@pytest.fixture(scope="module")
def flown(flights: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    """A flight with exact positions and a lens that the tags do not tell, and its adjustment."""
    flight = flights.fly(flights.KINDS["rtk-lens"], 16, 3, Path(tmp_path_factory.mktemp("flight")))
    return flight, _adjusted(flight)


def _adjusted(flight: Any, priors: dict[str, dict[str, Prior]] | None = None, **of_dem: float) -> Any:
    models = {name: scene.model for name, scene in flight.scenes.items()}
    priors = {name: dict(scene.priors) for name, scene in flight.scenes.items()} if priors is None else priors
    return adjust(models, flight.points, priors=priors, heights=DemHeights(flight.dem, **of_dem))


def test_the_camera_is_found_within_its_sigmas(flights, flown):
    flight, fit = flown
    errors = flights.of_camera(flight.kind, fit.shared_priors)
    assert set(errors) == {"focal_length", "x0", "y0", "k1", "k2", "k3", "p1", "p2"}
    assert np.abs(list(errors.values())).max() < 3.5
    focal = fit.shared_priors.records[0]
    assert abs(focal.value / (flights.FOCAL * 1e-6) - 1.0) < 0.005
    assert focal.significant
    assert focal.determined > 0.9
    assert focal.images == 16


def test_all_images_have_the_same_camera(flown):
    _, fit = flown
    values = np.array([[model.interior.focal_length, model.interior.k1] for model in fit.models.values()])
    sigmas = np.array([one.sigma for one in fit.shared_priors.records if one.name in ("focal_length", "k1")])
    # Each image has its own share, a thousandth of the prior's sigma.
    assert (np.ptp(values, axis=0) < 0.05 * sigmas).all()
    of_focal = [k for k, (_, name) in enumerate(fit.parameters) if name == "focal_length"]
    correlated = fit.covariance[np.ix_(of_focal, of_focal)]
    assert correlated / np.outer(fit.sigmas[of_focal], fit.sigmas[of_focal]) == pytest.approx(1.0, abs=1e-3)


def test_the_focal_length_of_each_image_has_the_sigma_of_the_shared_one(flown):
    _, fit = flown
    focal = [k for k, (_, name) in enumerate(fit.parameters) if name == "focal_length"]
    assert fit.sigmas[focal] == pytest.approx(fit.shared_priors.records[0].sigma, rel=0.01)


def test_unknown_heights_of_flight_and_dem_leave_the_focal_length_uncertain(flights, flown):
    flight, fit = flown
    priors = {name: dict(scene.priors) for name, scene in flight.scenes.items()}
    for of in priors.values():
        of["Z_L"] = replace(of["Z_L"], sigma=50.0)
    focal = _adjusted(flight, priors, bias=20.0).shared_priors.records[0]
    # The relief of the ground still shows it.
    assert focal.sigma > 1.1 * fit.shared_priors.records[0].sigma
    assert abs(focal.value - flights.FOCAL * 1e-6) < 3.5 * focal.sigma


def test_two_cameras_are_two_unknowns(flown):
    flight, _ = flown
    priors = {name: dict(scene.priors) for name, scene in flight.scenes.items()}
    for name in list(priors)[::2]:
        priors[name]["focal_length"] = replace(priors[name]["focal_length"], sigma=2e-5)
    fit = _adjusted(flight, priors)
    found = [one for one in fit.shared_priors.records if one.name == "focal_length"]
    assert [one.images for one in found] == [8, 8]
    assert abs(found[0].value - found[1].value) < 4 * np.hypot(found[0].sigma, found[1].sigma)


def test_the_search_for_gross_errors_begins_with_the_stated_camera_where_they_lead_it_away():
    """Seven wrong of 351 measurements did that in a block of seven photos. Without them the camera is found."""

    class LedAway:
        def settled(self, *given: Any) -> Any:
            raise NotConverged("the adjustment did not converge with the parameters of the camera")

    priors: Any = LedAway()
    solved: Any = object()
    near, shared = SharedUnknowns(None, None, priors).near(solved, None)  # type: ignore[arg-type]
    assert near is solved
    assert shared.priors is priors
    # Afterwards it is an error.
    with pytest.raises(NotConverged):
        shared.settled(solved, None)  # type: ignore[arg-type]
