"""The outputs of a command as a set: old ones survive a failure, those of an earlier run go."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from ortho_pipeline import commands
from ortho_pipeline.batch.runner import run
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import rectification
from ortho_pipeline.commands.mosaic import assembly
from ortho_pipeline.errors import CrsError, InputError, ReportError
from ortho_pipeline.options import OutputOptions, PointOptions, SurfaceOptions
from ortho_pipeline.report import document as report


def rectify(tiny, folder, points=True, **options):
    control = PointOptions(gcps=tiny.gcps, crs="EPSG:4326", vertical="ellipsoid") if points else PointOptions()
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    return commands.rectify(tiny.image, folder, points=control, surface=surface, output=OutputOptions(**options))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_image_that_changes_meanwhile_is_refused_and_the_old_outputs_stay(tiny, tmp_path, monkeypatch):
    """The pixels would be of one file, and the checksum in the report of another."""
    out = tmp_path / "out"
    rectify(tiny, out)
    before = contents(out)
    warp = rectification.warp_placed

    def meddling(*given):
        found = warp(*given)
        os.utime(tiny.dem, ns=(1, 1))
        return found

    monkeypatch.setattr(rectification, "warp_placed", meddling)
    with pytest.raises(InputError, match="changed during the run"):
        rectify(tiny, out)
    assert contents(out) == before


def test_a_failure_at_the_end_leaves_no_mixture(tiny, tmp_path, monkeypatch):
    out = tmp_path / "out"
    rectify(tiny, out)
    before = contents(out)

    def fail(*_, **__):
        raise ZeroDivisionError

    monkeypatch.setattr(rectification, "_write_models", fail)
    with pytest.raises(ZeroDivisionError):
        rectify(tiny, out, resampling="cubic")
    assert contents(out) == before


def test_a_report_that_fails_does_not_cost_the_ortho(tiny, tmp_path, monkeypatch):
    """Ortho and model are those of a run whose report does not fail; no report of an earlier run stays next to them."""
    stac = {"stac": True, "acquired": "2005-08-03T08:12:31Z", "resampling": "cubic"}
    good, out = tmp_path / "good", tmp_path / "out"
    rectify(tiny, good, **stac)
    rectify(tiny, out)

    def fail(*_, **__):
        raise ZeroDivisionError("no such CRS")

    monkeypatch.setattr(report, "write_report_html", fail)
    result = rectify(tiny, out, **stac)
    assert isinstance(result.failure, ReportError)
    assert "no such CRS" in result.failure.message
    kept = {"tiny_ortho.tif", "tiny_model.json", "tiny_RPC.TXT", "tiny.vrt"}
    assert {path.name for path in out.iterdir()} == {path.name for path in result.files.values()} == kept
    assert (out / "tiny_ortho.tif").read_bytes() == (good / "tiny_ortho.tif").read_bytes()
    assert result.to_json()["error"]["kind"] == "ReportError"


def test_the_command_line_says_that_there_is_no_report(tiny, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise CrsError("'unknown' is not a coordinate system", remedy="give EPSG:n")

    monkeypatch.setattr(report, "build_report", fail)
    given = ["rectify", str(tiny.image), "--dem", str(tiny.dem), "--dem-vertical", "ellipsoid", "-o", str(tmp_path)]
    said = CliRunner().invoke(cli, given)
    assert said.exit_code == 3
    assert "Error: the report could not be made ('unknown' is not a coordinate system)" in said.output
    assert "Remedy: give EPSG:n" in said.output
    assert (tmp_path / "tiny_ortho.tif").is_file()


def test_a_run_keeps_an_ortho_whose_report_fails_and_makes_it_again(tiny, tmp_path, monkeypatch):
    dem = f"surface: {{dem: {tiny.dem.name}, vertical: ellipsoid}}"
    config = tiny.folder / "run.yaml"
    config.write_text(f"output: out\ndefaults:\n  {dem}\nscenes: [{{image: {tiny.image.name}}}]\n")

    def fail(*_, **__):
        raise KeyError("crs")

    with monkeypatch.context() as patched:
        patched.setattr(report, "build_report", fail)
        outcome = run(config, executor="sequential").scenes[0]
        assert (outcome.status, (outcome.error or {})["kind"]) == ("failed", "ReportError")
        assert Path(outcome.files["ortho"]).is_file()
    outcome = run(config, executor="sequential").scenes[0]
    assert (outcome.status, Path(outcome.files["report"]).is_file()) == ("done", True)


def test_the_page_of_a_mosaic_does_not_cost_the_mosaic(tiny, tmp_path, monkeypatch):
    ortho = rectify(tiny, tmp_path / "out").files["ortho"]

    def fail(*_, **__):
        raise KeyError("crs")

    earlier = assembly.mosaic([ortho], tmp_path / "m.tif").files["page"]
    assert earlier.is_file()
    monkeypatch.setattr(assembly, "write_page", fail)
    result = assembly.mosaic([ortho], tmp_path / "m.tif")
    assert isinstance(result.failure, ReportError)
    assert (sorted(result.files), (tmp_path / "m.tif").is_file()) == (["mosaic", "seams"], True)
    assert not earlier.exists(), "it describes another mosaic"


def test_what_an_earlier_run_wrote_and_this_one_does_not_goes(tiny, tmp_path):
    out = tmp_path / "out"
    rectify(tiny, out, stac=True, acquired="2005-08-03T08:12:31Z")
    (out / "tiny_notes.txt").write_text("mine")
    (out / "tiny_ortho.tif.aux.xml").write_text("<PAMDataset/>")
    (out / "tiny_ortho.tif.ovr").write_bytes(b"")
    rectify(tiny, out, points=False)
    left = {path.name for path in out.iterdir()}
    assert left == {"tiny_notes.txt", "tiny_ortho.tif", "tiny_report.json", "tiny_report.html", "tiny_model.json",
                    "tiny_RPC.TXT", "tiny.vrt"}  # fmt: skip


def test_files_that_no_run_of_ours_wrote_are_not_touched(tiny, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "tiny_residuals.geojson").write_text("somebody else's")
    rectify(tiny, out, points=False)
    assert (out / "tiny_residuals.geojson").read_text() == "somebody else's"


@pytest.mark.parametrize("ending", [".aux.xml", ".ovr", ".msk"])
def test_a_side_car_of_nothing_would_attach_to_the_ortho(tiny, tmp_path, ending):
    out = tmp_path / "out"
    out.mkdir()
    (out / f"tiny_ortho.tif{ending}").write_bytes(b"")
    with pytest.raises(InputError, match="attach this old sidecar file"):
        rectify(tiny, out)


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, *(pytest.param(one, marks=pytest.mark.slow) for one in (signal.SIGHUP, signal.SIGINT))]
)
def test_a_signal_ends_the_command_and_leaves_nothing(tiny, tmp_path, number):
    out = tmp_path / "out"
    code = """
import sys, time
from ortho_pipeline.cli import program as cli
from ortho_pipeline.commands import rectification
warp = rectification.warp_placed
def slow(*given):
    found = warp(*given)
    print("ready", flush=True)
    time.sleep(60)
rectification.warp_placed = slow
cli.main()
"""
    command = [sys.executable, "-c", code, "rectify", str(tiny.image), "--dem", str(tiny.dem), "--dem-vertical",
               "ellipsoid", "-o", str(out)]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    assert [path.name for path in out.iterdir()] != []
    process.send_signal(number)
    assert process.wait(30) == (130 if number == signal.SIGINT else 128 + number)
    process.stdout.close()
    assert not out.exists()
