"""The eight swaps of coordinates that produce a hint, on a model whose relief and place make each of them visible."""

from __future__ import annotations

import re

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.coordinate_swaps import SWAPS, refuse_swapped
from ortho_pipeline.models import RPC
from ortho_pipeline.points import Points

ROWS = 2000.0


@pytest.fixture(scope="module")
def model() -> RPC:
    """One metre a pixel, 31 degrees off nadir: three times the height is 600 px."""
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 3]], row[[2, 3]] = (1.0, 0.3), (-1.0, 0.05)
    return RPC(1000.0, 1000.0, -20.0, -30.0, 500.0, 1000.0, 1000.0, 0.011, 0.009, 500.0, col, one, row, one)


def make_points(model: RPC, image: np.ndarray, ground: np.ndarray) -> Points:
    count = len(image)
    return Points(
        ids=tuple(map(str, range(count))), image=image, ground=ground, roles=np.full(count, "control"),
        sigma_image=np.ones(count), sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS.from_epsg(4326), source="p.csv",
    )  # fmt: skip


def truth(model: RPC) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    centre, half = model.domain
    ground = centre + half * random.uniform(-0.8, 0.8, (12, 3))
    return model.ground_to_image(ground) + random.normal(2, 0.5, (12, 2)), ground


#: How each mistake is made: the inverse of what SWAPS undoes.
MISTAKES = {
    "ground x and y": lambda image, ground: (image, ground[:, [1, 0, 2]]),
    "column and row are": lambda image, ground: (image[:, ::-1], ground),
    "x and y, and column": lambda image, ground: (image[:, ::-1], ground[:, [1, 0, 2]]),
    "rows are negative": lambda image, ground: (image * [1, -1], ground),
    "from the bottom": lambda image, ground: (image * [1, -1] + [0, ROWS], ground),
    "in feet": lambda image, ground: (image, ground / [1, 1, 0.3048]),
    "sign of x": lambda image, ground: (image, ground * [-1, 1, 1]),
    "sign of y": lambda image, ground: (image, ground * [1, -1, 1]),
}


def test_there_are_eight():
    assert len(SWAPS) == len(MISTAKES) == 8


@pytest.mark.parametrize("hint", MISTAKES)
def test_a_swap_is_named(model, hint):
    points = make_points(model, *MISTAKES[hint](*truth(model)))
    with pytest.raises(InputError, match=hint) as caught:
        refuse_swapped(model, points, int(ROWS))
    assert caught.value.remedy.startswith("give ")
    # The model is 2 px off along both axes.
    left = float(re.search(r"with this corrected, they are ([\d.]+) px off", str(caught.value))[1])
    assert left == pytest.approx(2 * np.sqrt(2), abs=0.5)


def test_right_points_pass(model):
    refuse_swapped(model, make_points(model, *truth(model)), int(ROWS))


def test_a_bad_model_is_not_taken_for_a_swap(model):
    """Points 300 px off in a way that no swap explains pass on, to be fitted or refused by the adjustment."""
    image, ground = truth(model)
    refuse_swapped(model, make_points(model, image + np.array([250.0, -170.0]), ground), int(ROWS))


def test_points_of_another_place_are_told_to_check_their_crs(model):
    image, ground = truth(model)
    with pytest.raises(InputError, match="outside the model's domain") as caught:
        refuse_swapped(model, make_points(model, image, ground + np.array([77.0, 71.0, 0.0])), int(ROWS))
    assert caught.value.field == "CRS"


def test_points_without_heights_are_compared_at_the_reference_height(model):
    _, ground = truth(model)
    level = ground * [1.0, 1.0, 0.0] + [0.0, 0.0, model.reference_height]
    unknown = ground * [1.0, 1.0, np.nan]
    refuse_swapped(model, make_points(model, model.ground_to_image(level), unknown), int(ROWS))
    with pytest.raises(InputError, match="column and row are"):
        refuse_swapped(model, make_points(model, model.ground_to_image(level)[:, ::-1], unknown), int(ROWS))
