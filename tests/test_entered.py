"""Which tests are chosen for a function, by records of what tests enter."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from entered import Entered

KERNELS = """
STEP = 2
HALF = STEP / 2

@inlined
def small(x):
    return x * HALF

@compiled
def large(x):
    return small(x)

def run(x):
    return large(x)

class Grid:
    side = STEP
    def width(self):
        return self.side
"""


@pytest.fixture
def entered(tmp_path: Path) -> Entered:
    """A package of one module, and what three tests enter of it."""
    (tmp_path / "ortho_pipeline").mkdir()
    (tmp_path / "ortho_pipeline" / "a.py").write_text(KERNELS)
    (tmp_path / "map").mkdir()
    tests = {
        "test_run": [1.0, ["ortho_pipeline/a.py:run"]],
        "test_small": [2.0, ["ortho_pipeline/a.py:small"]],
        "test_width": [3.0, ["ortho_pipeline/a.py:Grid.width"]],
    }
    (tmp_path / "map" / "test_a.py.json").write_text(json.dumps({"digest": "", "setup": [], "tests": tests}))
    return Entered(tmp_path / "map", tmp_path)


def test_a_function_has_the_tests_that_enter_it(entered: Entered) -> None:
    assert entered.by("ortho_pipeline/a.py:run", ["run"]) == {"test_run"}


def test_a_compiled_function_has_those_of_its_callers_too(entered: Entered) -> None:
    assert entered.by("ortho_pipeline/a.py:small", ["small"]) == {"test_small", "test_run"}
    assert entered.by("ortho_pipeline/a.py:large", ["large"]) == {"test_run"}


def test_a_constant_has_the_tests_of_what_uses_it_or_a_constant_made_of_it(entered: Entered) -> None:
    assert entered.by("ortho_pipeline/a.py:", ["HALF"]) == {"test_small", "test_run"}
    assert entered.by("ortho_pipeline/a.py:", ["STEP"]) == {"test_small", "test_run", "test_width"}
