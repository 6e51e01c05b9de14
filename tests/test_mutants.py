"""Deliberate errors: which are made, and where none is."""

from __future__ import annotations

import ast

from mutants import Mutant, mutants_of

SOURCE = b'''"""Text 1."""

HALF: float = 0.5


def far(x: int = 2) -> bool:
    """Return x / 2."""
    if x < 0 and not x:
        raise ValueError(f"{x + 1} is below {0}")
    root = math.sqrt(x)
    log.info("%d", x - 1)
    found.append(-root)
    return max(root, HALF) == 3
'''


def made() -> list[Mutant]:
    return list(mutants_of("a.py", SOURCE))


def test_each_place_is_changed() -> None:
    changes = {(one.line, one.before, one.text) for one in made()}
    assert changes == {
        (3, "0.5", "(1.0)"), (6, "2", "3"), (8, "x < 0 and not x", "(x < 0 or not x)"), (8, "x < 0", "(x >= 0)"),
        (8, "x < 0", "(x <= 0)"), (8, "0", "1"), (8, "not x", "(x)"), (10, "math.sqrt(x)", "(x)"),
        (12, "found.append(-root)", "pass"), (12, "-root", "(root)"),
        (13, "max(root, HALF) == 3", "(max(root, HALF) != 3)"), (13, "3", "4"),
        (13, "max(root, HALF)", "(min(root, HALF))"),
    }  # fmt: skip


def test_a_mutant_is_a_module_that_differs() -> None:
    whole = ast.dump(ast.parse(SOURCE))
    for one in made():
        changed = SOURCE[: one.start] + one.text.encode() + SOURCE[one.end :]
        assert ast.dump(ast.parse(changed)) != whole


def test_a_mutant_tells_where_it_is() -> None:
    assert {(one.function, one.names) for one in made()} == {("", ("HALF",)), ("far", ("far",))}
