"""What the reproductions of all papers share."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.experiments.page import Figure, Reason, draw_curve, draw_vectors, page, text
from ortho_pipeline.experiments.tables import Curve, Number, Statement, is_within, make_document, within_factor

NUMBERS = (
    Number(1, "affine", "X", 2.0),
    Number(1, "affine", "mean", -10.0),
    Number(1, "own", "X"),
    Number(2, "never fitted", "X", 1.0),
)
FOUND = np.column_stack(
    [np.linspace(1.9, 2.1, 11), np.linspace(-16.0, -14.4, 11), np.linspace(0.0, 1.0, 11), np.full(11, np.nan)]
)


@pytest.fixture
def document():
    return make_document(
        "A paper", sensor="none", units="m", settings={"noise_m": 1.0}, settings_text="11 realisations",
        numbers=NUMBERS, found=FOUND, titles={1: "First", 2: "Second", 3: "Without rows"},
        statements=[Statement("A is better than B.", True, "1 < 2"), Statement("B is better.", False, "2 > 1")],
        curves=[Curve("Over points", "points", "m", {"a": ([1, 2, 3], [3.0, None, 1.0]), "b": ([1, 2], [1.0, 1.01])})],
        notes=["Said <b>once</b>."],
    )  # fmt: skip


def test_rows_hold_the_paper_and_the_spread_of_ours(document):
    assert [table["table"] for table in document["tables"]] == [1, 2]
    first, mean, own = document["tables"][0]["rows"]
    assert first["median"] == pytest.approx(2.0)
    assert (first["p5"], first["p95"]) == pytest.approx((1.91, 2.09))
    # Negative numbers are compared by their ratio, and what has no number of the paper is not counted.
    assert not is_within(mean)
    assert is_within(mean, 1.6)
    assert is_within(own)
    (never,) = document["tables"][1]["rows"]
    assert never["median"] is None
    assert never["failed"] == 11
    assert document["summary"]["rows"] == 3
    assert document["summary"]["within"] == 1
    assert within_factor(document, 1.6) == pytest.approx(2 / 3)
    assert document["summary"]["single_realisation"]["median"] == pytest.approx(2 / 3)


def test_text_marks_what_does_not_agree(document):
    said = text(document)
    assert said.count("\n!") == 3
    assert "1 of 3 rows (33.3 %)" in said
    assert "1 of 2 statements of the paper hold" in said


def test_page_explains_what_does_not_agree(document):
    vectors = draw_vectors(
        "vectors", np.array([[1.0, 2.0], [8.0, 3.0]]), np.array([[1.0, 0.0], [0.0, 2.0]]), (10, 5), units="m"
    )
    html = page(
        document, heading="Paper and ours", introduction="Simulated.", figures=[Figure(vectors, "Figure 1")],
        reasons=[Reason("affine mean", "The bias is drawn.")],
    )  # fmt: skip
    assert "The bias is drawn." in html
    assert "Beyond the factor without a cause" in html
    assert "Does not hold" in html
    assert "&lt;b&gt;once" in html
    assert html.count("<svg") == 2
    assert "2 metres" in html


def test_curves_skip_what_has_no_value(document):
    drawing = draw_curve(document["curves"][0])
    paths = [given for what, given in drawing.items if what == "path"]
    assert [len(path["lines"][0]) for path in paths] == [2, 2]
    named = {given["text"] for what, given in drawing.items if what == "text"}
    assert {"a", "b", "points", "m"} <= named
