"""The page of a run: what failed first, then the least accurate; the same bytes for the same results."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.batch.plan import plan
from ortho_pipeline.batch.runner import run
from ortho_pipeline.batch.summary import summarise
from ortho_pipeline.report.page.run import write_run_page

HOSTILE = '<script>alert("x")</script>'
MADE = {
    "software": {"gdal": "3.99"},
    "inputs": [{"role": "pipeline file", "path": "june.yaml", "bytes": 10, "sha256": "c0ffee"}],
}


def scene(
    name: str, rmse: float | None = None, *, error: str | None = None, ortho: Path | None = None
) -> dict[str, Any]:
    files = {} if ortho is None else {"ortho": str(ortho), "html": str(ortho.with_name("a b_report.html"))}
    facts = {
        "sensor": "rpc", "model": "rpc+shift", "rmse_px": {"check": rmse, "loo": 9.0 if rmse is None else None},
        "rmse_m": {"check": None if rmse is None else 2 * rmse}, "warnings": ["look"],
    }  # fmt: skip
    failed = None if error is None else {"message": error, "file": "x.tif", "field": None, "remedy": "give a DEM"}
    return {"name": name, "status": "done", "seconds": 1.0, "files": files, "facts": facts, "error": failed}


@pytest.fixture
def ortho(tmp_path: Path) -> Path:
    path = tmp_path / "scenes" / "ortho.tif"
    path.parent.mkdir()
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 64, 32, 1)
    dataset.WriteArray(np.arange(64 * 32, dtype=np.uint8).reshape(32, 64))
    del dataset
    return path


def test_what_failed_stands_first_and_then_the_least_accurate(tmp_path, ortho):
    scenes = [scene("good", 0.2, ortho=ortho), scene("bad", 3.0), scene(HOSTILE, error=f"{HOSTILE} is no DEM")]
    untested = scene("untested")
    untested["facts"]["rmse_px"]["loo"] = None
    write_run_page(tmp_path / "index.html", "june", [*scenes, untested], MADE)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    rows = re.findall(r"<tr[ >].*?</tr>", page.split("<tbody>")[1], re.DOTALL)
    assert ["Failed" in rows[0], "untested" in rows[1], "bad" in rows[2], "good" in rows[3]] == [True] * 4
    assert ">4 scenes: 3 orthos (2 tested, 1 of unknown accuracy); 1 failed</p>" in page
    assert "2 tested at check points: RMSE 0.40 to 6.00 m." in page
    # What to look at stands in the row, gravest first, and that nothing tests a scene is the first of all.
    assert "No point tests the accuracy of this result." in rows[1]
    assert "Add check points, or an orthoimage" in rows[1]
    assert "Look." in rows[2]
    assert "<th>tested at</th>" in page
    write_run_page(tmp_path / "part.html", "june", [{**scene("late"), "status": "missing", "facts": {}}], MADE)
    assert "this scene is not made yet" in (tmp_path / "part.html").read_text(encoding="utf-8")
    assert "Give a DEM." in rows[0]
    assert page.count("<script") == 1
    assert [text in page for text in ("<th>pipeline file</th>", "3.99", "c0ffee")] == [True] * 3
    assert 'href="scenes/a%20b_report.html"' in rows[3]
    assert rows[3].count("data:image/png;base64,") == 1


def test_check_points_that_contradict_have_another_mark_than_a_formality(tmp_path):
    few = {"code": "few-check-points", "text": "6 check points: few"}
    formal, apart = scene("formal", 0.2), scene("apart", 7.2)
    formal["facts"]["notices"], formal["facts"]["rmse_points"] = [few], {"check": 6}
    apart["facts"]["notices"] = [
        few,
        {
            "code": "checks-apart",
            "text": "3 of 6 check points contradict",
            "count": 6,
            "off": 3,
            "points": ["a", "b", "c"],
        },
    ]
    untested = scene("untested")
    untested["facts"]["rmse_px"]["loo"] = None
    write_run_page(tmp_path / "index.html", "june", [formal, untested, apart], MADE)
    rows = re.findall(r"<tr[ >].*?</tr>", (tmp_path / "index.html").read_text().split("<tbody>")[1], re.DOTALL)
    assert '<li class="stop">' in rows[0]
    assert "Error:</b> 3 of 6" in rows[0]
    # Before what nothing tests, and out of the span of RMSEs.
    assert ["untested" in rows[1], '<li class="look">' in rows[2], "6 check points<" in rows[2]] == [True] * 3
    page = (tmp_path / "index.html").read_text()
    assert ">3 scenes: 3 orthos (1 tested, 1 with errors, 1 of unknown accuracy)</p>" in page
    assert "1 tested at check points: RMSE 0.40 m." in page


def test_the_headline_counts_orthos_and_not_scenes(tmp_path):
    untested, failed = scene("untested"), scene("failed", error="no DEM")
    untested["facts"]["rmse_px"]["loo"] = None
    for scenes, head in (
        ([scene("one", 0.2), scene("two", 0.3), failed], "3 scenes: 2 tested orthos; 1 failed"),
        ([untested], "1 scene: 1 ortho of unknown accuracy"),
        ([failed], "1 scene: 1 failed"),
    ):
        write_run_page(tmp_path / "index.html", "june", scenes, MADE)
        assert f">{head}</p>" in (tmp_path / "index.html").read_text()


def test_the_same_results_are_the_same_page_and_cost_no_pixel(tmp_path, ortho, monkeypatch):
    page = tmp_path / "index.html"
    write_run_page(page, "june", [scene("one", 0.2, ortho=ortho)], MADE)
    first, made = page.read_bytes(), page.stat().st_mtime_ns
    found = {**scene("one", 0.2, ortho=ortho), "status": "unchanged", "seconds": 0.0}
    monkeypatch.setattr("ortho_pipeline.report.page.run.preview_png", pytest.fail)
    write_run_page(page, "june", [found], MADE)
    assert (page.read_bytes(), page.stat().st_mtime_ns) == (first, made)
    monkeypatch.undo()
    write_run_page(page, "june", [scene("one", 0.3, ortho=ortho)], MADE)
    assert page.read_bytes() != first
    write_run_page(page, "june", [scene("one", 0.2, ortho=ortho)], {**MADE, "software": {"gdal": "3.100"}})
    assert "3.100" in page.read_text()


def test_the_page_names_the_pipeline_file_that_was_planned(tmp_path, ortho):
    file = tmp_path / "june.yaml"
    file.write_text(f"scenes: [{{image: {ortho.relative_to(tmp_path)}}}]\noutput: out\n")
    parsed = hashlib.sha256(file.read_bytes()).hexdigest()
    planned = plan(file)
    file.write_text("scenes: []\n")
    run(planned, executor="sequential")
    page = (tmp_path / "out" / "index.html").read_bytes()
    assert parsed.encode() in page
    # No command: with other executors the page is the same.
    assert b"ortho run" not in page
    file.unlink()
    run(planned, executor="processes", workers=1)
    assert (tmp_path / "out" / "index.html").read_bytes() == page
    summarise(planned)
    assert (tmp_path / "out" / "index.html").read_bytes() == page
