"""Sentences of errors and notices: one of a thing is not called by its plural."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.choice.comparison import compare
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.imaging.registration import Transform
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points, read_points
from ortho_pipeline.points.selection import select_control

ROOT = Path(__file__).resolve().parents[1]
#: What sentences count.
NOUNS = [
    "points",
    "images",
    "scenes",
    "bands",
    "cells",
    "parameters",
    "rays",
    "files",
    "pairs",
    "measurements",
    "edges",
    "groups",
    "errors",
    "models",
    "cameras",
    "components",
    "plots",
    "coefficients",
    "orthos",
]
#: "1 points", and "none of 1 points"; but "1 x 2 points", "1.1 points" and "of 21 points" are right.
ONE_OF_MANY = re.compile(rf"(?<![\d.x])(?<!x )\b1 (?:\w+ ){{0,2}}(?:{'|'.join(NOUNS)})\b")


def one(count: int = 1) -> Points:
    camera = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
    terrain = Terrain("EPSG:32636", 531100.0, 4122700.0)
    return simulate_points(camera, terrain, control=count, check=0, seed=5).measured


def refused(action) -> str:
    with pytest.raises(InputError) as caught:
        action()
    return str(caught.value)


def test_a_number_and_what_it_counts() -> None:
    assert counted(1, "control point") == "1 control point"
    assert counted(0, "control point") == "0 control points"
    assert counted(2, "leaf", "leaves") == "2 leaves"
    assert counted(1, "point does", "points do") == "1 point does"
    assert counted(np.int64(1), "point") == "1 point"


def test_one_point_is_no_plural(tmp_path: Path) -> None:
    point, model = one(), fit_family("affine3d", one(20), size=(1000, 1000)).model
    table = tmp_path / "points.csv"
    table.write_text("x,y,h,col,row\n7\n")
    said = [
        refused(lambda: fit_family("affine3d", point, size=(1000, 1000))),
        refused(lambda: fit(ImageCorrection.identity(model, "affine", (0.0, 0.0)), point)),
        refused(lambda: select_control(point, "even:4")),
        refused(lambda: read_points(table, crs="EPSG:4326", vertical="ellipsoid")),
        refused(lambda: Transform.fit("affine", np.zeros((1, 2)), np.zeros((1, 2)))),
        repr(point),
        repr(fit(ImageCorrection.identity(model, "shift", (0.0, 0.0)), point)),
        *(row.error or "" for row in compare(point, ("affine3d", "poly2"), size=(1000, 1000)).rows),
    ]
    assert not [text for text in said if ONE_OF_MANY.search(text)]
    assert any("1 control point does not determine" in text for text in said)
    assert any("this line has 1 cell, but there are 5 columns" in text for text in said)
    with pytest.raises(TooFewPoints, match="1 tie point does not"):
        Transform.fit("affine", np.zeros((1, 2)), np.zeros((1, 2)))


def bare_counts(source: str) -> list[str]:
    """Return the places of f-strings in which a number stands before a plural, whatever it is."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.JoinedStr):
            continue
        for value, text in zip(node.values, node.values[1:], strict=False):
            if not isinstance(value, ast.FormattedValue) or not isinstance(text, ast.Constant):
                continue
            noun = re.match(
                rf" (?:(?:control|check|tie|more|finite|gross) ){{0,2}}({'|'.join(NOUNS)})\b", str(text.value)
            )
            name = ast.unparse(value.value)
            # Of a constant it is known that it is not one; words are not numbers.
            if (
                noun
                and not name.lstrip("_").isupper()
                and re.match(r"(int|len|sum)\(|.*(count|number|_n\b|\['n'\])", name)
            ):
                found.append(f"line {node.lineno}: {{{name}}}{str(text.value)[:30]}")
    return found


def test_counts_in_sentences_are_counted() -> None:
    assert bare_counts("f'{len(rows)} points'") == ["line 1: {len(rows)} points"]
    sources = [*(ROOT / "ortho_pipeline").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    found = {str(path.relative_to(ROOT)): bare_counts(path.read_text(encoding="utf-8")) for path in sources}
    assert not {name: places for name, places in found.items() if places}
