"""What notices tell people: their code, and a remedy that is possible."""

from __future__ import annotations

from types import SimpleNamespace

import jinja2
import numpy as np
from click.testing import CliRunner

from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.block import _warnings
from ortho_pipeline.display.drawing import Drawing
from ortho_pipeline.report.network.drawing import _draw_pairs
from ortho_pipeline.report.page.advice import shortened, signal_lines, signals


def test_the_code_follows_the_text():
    lines = signal_lines(signals([], [{"code": "left-out", "text": "G03 was left out"}], tested=False))
    assert lines[0] == "Warning: No point tests the accuracy of this result [untested]"
    assert lines[2] == "Warning: G03 was left out [left-out]"


def test_many_notices_of_one_kind_are_few_lines():
    kinds = ("datum-unknown", "left-out", "from-sensor")
    found = signals([], [{"code": code, "text": f"image {n}: {code}"} for n in range(9) for code in kinds])
    lines = [str(line) for line in signal_lines(found)]
    unknown = [line for line in lines if line.endswith("[datum-unknown]")]
    assert unknown[:3] == [f"Warning: Image {n}: datum-unknown [datum-unknown]" for n in range(3)]
    assert unknown[3:] == ["Warning: 6 more of this kind [datum-unknown]"]
    assert lines[lines.index(unknown[3]) + 1].startswith("  Remedy: ")
    assert sum(line.endswith("[left-out]") for line in lines) == 4
    # Texts that have no code of their own can be of different kinds.
    assert sum(line.endswith("[from-sensor]") for line in lines) == 9


def test_four_notices_of_one_kind_are_all_shown():
    lines = signal_lines(signals([], [{"code": "left-out", "text": f"G{n}"} for n in range(4)]))
    assert [line for line in lines if line.startswith("Warning")] == [f"Warning: G{n} [left-out]" for n in range(4)]


def test_the_page_of_a_block_counts_gross_errors_which_its_table_lists():
    """Dozens of rejected ties filled the list of notices."""
    found = signals([], [{"code": code, "text": f"{n}"} for n in range(9) for code in ("left-out", "no-rpc")])
    short = shortened(found, "left-out")
    assert [one.text for one in short if one.code == "left-out"] == ["0", "1", "2", "6 more of this kind"]
    assert [one.text for one in short if one.code == "no-rpc"] == [f"{n}" for n in range(9)]


def test_rejected_control_is_named_before_rejected_ties():
    """In the order of the file, control points came after ties, and were not shown."""
    points = SimpleNamespace(
        ids=("t1", "t2", "c1"),
        tie=np.array([True, True, False]),
        image=np.zeros(0, int),
        measured=np.zeros((0, 2)),
        control=np.array([False]),
    )
    rejected = [GrossError(point=name, what="point", image=None, reason="gross error") for name in points.ids]
    fit = SimpleNamespace(points=points, warnings=(), rejected=rejected, parameters=(), object_rms=lambda: None)
    points.images = ()
    start = SimpleNamespace(scene=SimpleNamespace(notices=(), width=9, height=9))
    named = [one.fields["point"] for one in _warnings(fit, {"a": start}) if one.code == "left-out"]
    assert named == ["c1", "t1", "t2"]


def test_a_page_says_once_what_to_do_about_notices_of_one_kind():
    loader = jinja2.PackageLoader("ortho_pipeline", "report/templates")
    environment = jinja2.Environment(loader=loader, autoescape=True)
    environment.filters["coded"] = str
    shown = [{"code": "uncertain-at-edge", "text": f"image {name}"} for name in "ab"]
    found = signals([], [*shown, {"code": "left-out", "text": "G03 was left out"}])
    listed = environment.get_template("signals.html.j2").module.listed(found, {"look": "Warning"}, "")
    rows = [row for row in str(listed).splitlines() if row.startswith("<li")]
    assert ["to-do" in row for row in rows] == [False, True, True]
    assert [text in row for text, row in zip(("Image a", "Image b", "G03"), rows, strict=True)] == [True] * 3


def test_heights_that_are_off_are_the_remedy_of_a_weak_join():
    weak = {"code": "weak-join", "text": "the relative position is weak"}
    (given,) = signals([], [{**weak, "dem_unused": True}])
    assert given.to_do.startswith("Use the heights of the DEM")
    (absent,) = signals([], [{**weak, "dem_unused": False}])
    assert absent.to_do.startswith("Give control points")


def test_a_weak_pair_is_drawn_although_its_images_lie_on_each_other():
    pair = SimpleNamespace(first="a", second="b", points=9, angle_deg=30.0, sigma_px=15.0, weak=True)
    report = SimpleNamespace(network=SimpleNamespace(pairs=[pair]))
    places = {"a": SimpleNamespace(tolist=lambda: [50.0, 50.0]), "b": SimpleNamespace(tolist=lambda: [52.0, 50.0])}
    drawing = Drawing(100.0, 100.0, "a map", "map")
    _draw_pairs(drawing, report, places)
    assert 'class="weak"' in drawing.svg()
    pair.weak = False
    drawing = Drawing(100.0, 100.0, "a map", "map")
    _draw_pairs(drawing, report, places)
    assert "<line" not in drawing.svg()


def test_a_family_in_place_of_a_model_file_leads_to_the_right_option(tmp_path):
    words = ["rectify", "sample_data/scene.tif", "--model", "dlt", "--height", "800", "-o", str(tmp_path)]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 2
    assert "--fit-model NAME (affine2d, " in done.output
