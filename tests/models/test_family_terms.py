"""Classical models as they are made: their terms counted by combinatorics, and the chain of simpler ones."""

from __future__ import annotations

import math

import pytest

from ortho_pipeline.models import families
from ortho_pipeline.models.families import _polynomial, _rational, _solid, complete, exponents, points_needed


def degrees(terms: tuple[str, ...]) -> list[int]:
    return [int(exponents(term).sum()) for term in terms]


@pytest.mark.parametrize("axes", ["XY", "XYZ"])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_all_terms_up_to_an_order_are_there_once(order: int, axes: str) -> None:
    terms = complete(order, axes)
    assert len(set(terms)) == len(terms) == math.comb(order + len(axes), order)
    assert degrees(terms) == sorted(degrees(terms))
    assert degrees(terms)[-1] == order
    assert terms[: 1 + len(axes)] == ("1", *axes)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_polynomials_of_the_plane(order: int) -> None:
    made = _polynomial(order)
    assert made.name == f"poly{order}"
    assert made.dimensions == 2
    assert made.parameters == (order + 1) * (order + 2)
    assert made.minimum_points == (order + 1) * (order + 2) // 2
    assert made.simpler == ((f"poly{order - 1}",) if order > 1 else ())
    assert made.description.startswith(
        "2D polynomial of the " + (["first", "second", "third", "fourth", "fifth"][order - 1])
    )
    assert ("IKONOS eq." in made.formula) == (order <= 3)
    assert f"eq. {order + 1}" in made.formula or order > 3
    assert ("small distortions" in made.suits) == (order <= 2)
    assert made == families()[order]


@pytest.mark.parametrize("order", [1, 2, 3])
def test_polynomials_of_space(order: int) -> None:
    made = _solid(order)
    assert (made.name, made.dimensions) == (f"poly3d{order}", 3)
    assert made.parameters == 2 * math.comb(order + 3, 3)
    assert made.simpler == ((f"poly3d{order - 1}",) if order > 1 else ("affine2d",))
    assert ("many points" in made.suits) == (order == 3)
    assert made in families()
    assert not made.regularised


@pytest.mark.parametrize(("order", "common"), [(1, False), (2, False), (3, False), (2, True), (3, True)])
def test_rational_functions(order: int, common: bool) -> None:
    made, count = _rational(order, common), math.comb(order + 3, 3)
    assert made.name == f"rfm{order}" + "-common" * common
    assert made.den == complete(order)[1:], "the constant of a denominator is 1"
    assert made.parameters == 2 * count + (count - 1) * (1 if common else 2)
    expected = {"rfm1": "dlt", "rfm2": "rfm1", "rfm3": "rfm2", "rfm2-common": "dlt", "rfm3-common": "rfm2-common"}
    assert made.simpler == (expected[made.name],)
    assert made.regularised
    assert ("one denominator" in made.description) == common
    assert made in families()


def test_rational_functions_alone_are_regularised() -> None:
    """Perspective needs none: its denominators are of the first order and common."""
    assert {family.name for family in families() if family.regularised} == {
        "rfm1", "rfm2", "rfm3", "rfm2-common", "rfm3-common",
    }  # fmt: skip


def test_points_give_two_equations_and_each_axis_needs_its_own() -> None:
    assert points_needed(("col_1", "col_X", "col_Y", "row_1")) == 3
    assert points_needed(("col_1", "row_1", "den_X", "den_Y", "den_Z")) == 3
    assert points_needed(("col_1", "row_1")) == 1
