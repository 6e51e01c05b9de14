"""Which control points a selection keeps, on a layout without symmetry."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.points import Points
from ortho_pipeline.points.selection import select_control

#: Column and row of control points; the middle of their box is (550, 420).
PLACES = {
    "a": (130, 60), "b": (980, 90), "c": (1000, 790), "d": (100, 800), "e": (520, 400), "f": (640, 40), "g": (310, 330),
    "h": (890, 520), "i": (450, 700), "j": (700, 610), "k": (160, 520),
}  # fmt: skip


def points(order: str, checks: str = "") -> Points:
    """Return points in an order, some of them check points."""
    image = np.array([PLACES[name] for name in order], dtype=float)
    ground = np.column_stack([500_000.0 + image[:, 0], 4e6 - image[:, 1], np.zeros(len(order))])
    roles = ["check" if name in checks else "control" for name in order]
    return Points.of(image, ground, "EPSG:32636", ids=list(order)).with_roles(roles)


def kept(order: str, spec: str, checks: str = "") -> str:
    found = select_control(points(order, checks), spec)
    assert found.ids == tuple(order)
    assert set(found.roles) <= {"control", "check"}
    return "".join(sorted(name for name, control in zip(order, found.control, strict=True) if control))


def farthest(names: str, count: int) -> str:
    """Return points of which each is the farthest from those before, and the first from the middle of the box."""
    places = {name: np.array(PLACES[name], dtype=float) for name in names}
    corners = np.array(list(places.values()))
    middle = np.array([(min(axis) + max(axis)) / 2 for axis in corners.T])
    chosen = [max(sorted(places), key=lambda name: np.hypot(*(places[name] - middle)))]
    while len(chosen) < count:
        left = [name for name in sorted(places) if name not in chosen]
        chosen.append(max(left, key=lambda name: min(np.hypot(*(places[name] - places[other])) for other in chosen)))
    return "".join(sorted(chosen))


@pytest.mark.parametrize("order", ["abcdefghijk", "kjihgfedcba", "fkbgdiahcej"])
def test_even_points_are_each_the_farthest_from_those_before(order: str) -> None:
    assert kept(order, "even:1") == "d"
    assert kept(order, "even:2") == "bd"
    assert kept(order, "even:4") == "abcd"
    for count in range(1, len(order) + 1):
        assert kept(order, f"even:{count}") == farthest(order, count)
    # Check points stay what they are.
    assert kept(order, "even:3", checks="ac") == farthest("bdefghijk", 3)


@pytest.mark.parametrize(
    ("group", "names"),
    [("", "agf"), (":1", "agf"), (":2", "bhf"), (":3", "chj"), (":4", "dki"), (":5", "eij")],
)  # fmt: skip
def test_a_cluster_is_nearest_to_its_corner_or_the_middle(group: str, names: str) -> None:
    """Corners of the box of all points, clockwise from the upper left, then its middle (550, 420)."""
    corners = {"": (100, 40), ":1": (100, 40), ":2": (1000, 40), ":3": (1000, 800), ":4": (100, 800), ":5": (550, 420)}
    order = sorted(PLACES, key=lambda name: np.hypot(*np.subtract(PLACES[name], corners[group])))
    for count in range(1, 12):
        assert kept("fkbgdiahcej", f"cluster:{count}{group}") == "".join(sorted(order[:count]))
    assert order[0] == names[0]


def test_a_random_choice_is_that_of_its_seed_in_any_order_of_the_file() -> None:
    choices = {kept("abcdefghijk", f"random:5:{seed}") for seed in range(20)}
    assert len(choices) > 15
    assert {len(choice) for choice in choices} == {5}
    for seed in (0, 3):
        assert kept("fkbgdiahcej", f"random:5:{seed}") == kept("abcdefghijk", f"random:5:{seed}")
    assert kept("abcdefghijk", "random:5") == kept("abcdefghijk", "random:5:0")


def test_named_points_are_kept_alone() -> None:
    assert kept("abcdefghijk", "ids: k, c,e", checks="bd") == "cek"
    with pytest.raises(InputError, match="not a control point: d"):
        kept("abcdefghijk", "ids:a,d", checks="bd")
    with pytest.raises(InputError, match="no point x, z"):
        kept("abcdefghijk", "ids:a,x,z")
    with pytest.raises(InputError, match="names no point"):
        kept("abcdefghijk", "ids: ,")


@pytest.mark.parametrize("spec", ["cluster:3:0", "cluster:3:6", "even", "cluster:", "random:3:-1", "even:2:", "Even:2"])
def test_what_is_no_selection_is_refused(spec: str) -> None:
    with pytest.raises(InputError, match="is not a selection"):
        kept("abcdefghijk", spec)


def test_only_control_points_count() -> None:
    assert kept("abcdefghijk", "even:9", checks="bd") == "acefghijk"
    with pytest.raises(TooFewPoints, match="'even:10' selects 10 points, but the file has 9 control points"):
        kept("abcdefghijk", "even:10", checks="bd")
