"""The flag ``--open``: the report in the browser of the machine, or a note; its path is the last line in any case."""

from __future__ import annotations

import json
import webbrowser
from pathlib import Path

import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli


def points_of(tiny) -> list[str]:
    return [str(tiny.image), "--gcps", str(tiny.gcps), "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the addresses that a browser was asked to open."""
    found: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(found.append(address)) or True)
    return found


def test_the_report_is_opened_and_its_path_is_the_last_line(tiny, tmp_path, opened, monkeypatch):
    words = ["rectify", *points_of(tiny), "--dem", str(tiny.dem), "--dem-vertical", "ellipsoid"]
    words += ["-o", str(tmp_path / "out")]
    page = tmp_path / "out" / f"{Path(tiny.image).stem}_report.html"
    plain = CliRunner().invoke(cli, words)
    assert (plain.exit_code, plain.stdout.splitlines()[-1], opened) == (0, f"Report: {page}", [])
    done = CliRunner().invoke(cli, [*words, "--open"])
    assert (done.stdout.splitlines()[-1], opened) == (f"Report: {page}", [page.resolve().as_uri()])
    as_json = CliRunner().invoke(cli, [*words, "--open", "--json"])
    assert json.loads(as_json.stdout)["files"]["html"] == str(page)
    assert len(opened) == 2

    def nothing(address: str) -> bool:
        raise webbrowser.Error("could not locate runnable browser")

    for without in (lambda address: False, nothing):
        monkeypatch.setattr(webbrowser, "open", without)
        done = CliRunner().invoke(cli, [*words, "--open"])
        assert done.exit_code == 0
        assert done.stderr.count("Note: there is no browser on this machine.") == 1
        assert done.output.splitlines()[-1] == f"Report: {page}"


def test_without_a_page_there_is_nothing_to_open(tiny, tmp_path, opened):
    points = [str(tmp_path / "m.geojson"), "--reference", str(tiny.image), "--height", "500"]
    for words, flag in (
        (["compare", *points_of(tiny)], "-o DIR"),
        (["match", str(tiny.image), "-o", *points], "--report FILE.html"),
    ):
        done = CliRunner().invoke(cli, [*words, "--open"])
        assert done.exit_code == 2
        assert f"--open needs a report: add {flag}." in done.stderr
    assert opened == []
