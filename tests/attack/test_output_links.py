"""No command writes through a symbolic link that somebody put in place of an output."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import append_line, confined, together, whole_or_nothing, write_text

POINTS = "--gcps gcps.geojson"
FORMATS = "rpc-txt,rpb,tag,vrt,geom,rpc-xml,gcp,gcp-tag,geolocation"
EXTRAS = "--stac --acquired 2005-08-03T08:12:31Z --angles --accuracy-raster"
#: Every command that writes files, with what its outputs are called.
COMMANDS = {
    "rectify": f"ortho rectify scene.tif {POINTS} --dem dem.tif -tr 100 100 {EXTRAS} -o out",
    "compare": f"ortho compare scene.tif {POINTS} --models rpc+shift,affine3d -o out",
    "export": f"ortho export scene.tif {POINTS} --dem dem.tif --format {FORMATS} -o out",
    "adjust": "ortho adjust cartosat/BANDF.tif cartosat/BANDA.tif --points cartosat/points.csv -o out",
    "intersect": "ortho intersect cartosat/BANDF.tif cartosat/BANDA.tif --points cartosat/points.csv -o out/ground.csv",
    "mosaic": "ortho mosaic west/scene_ortho.tif east/scene_ortho.tif -o out/mosaic.tif",
    "report": "ortho report west/scene_report.json --plots out",
    "init": "ortho init orbview3 -o orbview3/pipeline.yaml",
    "match": "ortho match scene.tif --reference reference.tif --dem dem.tif -o out/m.geojson --report out/m.html",
    "ties": "ortho ties cartosat/BANDF.tif cartosat/BANDA.tif --dem cartosat/dem.tif -o out/ties.csv",
    "edge": "ortho edge scene.tif -o out",
    "register": "ortho register red.tif nir.tif -o out",
    "simulate": "ortho simulate orbview3 --seed 1 -o out",
    "reproduce": "ortho reproduce orbview3 --realisations 3 -o out",
}
SLOW = ("compare", "adjust", "mosaic", "report", "match", "ties", "edge", "register", "simulate", "reproduce")
ORTHOS = {
    name: f"ortho rectify scene.tif {POINTS} --height 800 -t_srs EPSG:32636 -tr 100 100 -te {box} -o {name}"
    for name, box in (("west", "530000 4121500 532000 4123500"), ("east", "531000 4121500 533000 4123500"))
}


def called(line: str) -> tuple[int, str]:
    done = CliRunner().invoke(cli, shlex.split(line)[1:], prog_name="ortho")
    return done.exit_code, done.output


@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in COMMANDS]
)
def test_a_link_in_place_of_any_output_is_refused(sample, tmp_path, monkeypatch, command):
    work, victim = tmp_path / "work", tmp_path / "victim"
    shutil.copytree(sample, work, symlinks=True)
    monkeypatch.chdir(work)
    if command in ("mosaic", "report"):
        for line in ORTHOS.values():
            assert called(line)[0] == 0
    for band in ("red.tif", "nir.tif") if command == "register" else ():
        shutil.copy(work / "scene.tif", work / band)
    line, out = COMMANDS[command], work / ("orbview3" if command == "init" else "out")
    before = set(out.iterdir()) if out.exists() else set()
    code, said = called(line)
    assert code == 0, said
    written = sorted(set(out.iterdir()) - before)
    assert written
    for path in written:
        for other in written:
            other.unlink(missing_ok=True)
        victim.write_text("precious")
        path.symlink_to(victim)
        code, said = called(line)
        assert code == 2, (path, said)
        assert "this is a symbolic link" in " ".join(said.split()), said
        assert victim.read_text() == "precious", path
        assert set(out.iterdir()) - before == {path}
        path.unlink()
        # Not made by way of a link that leads nowhere yet, either.
        victim.unlink()
        path.symlink_to(victim)
        assert called(line)[0] == 2
        assert not victim.exists()
        path.unlink()


WRITERS: dict[str, Callable[[Path], None]] = {
    "text": lambda path: write_text(path, "new"),
    "line": lambda path: append_line(path, "new"),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
@pytest.mark.parametrize("target", ["beside", "nowhere", "loop"])
def test_every_writer_refuses_a_link_in_place_of_its_file(tmp_path, write, target):
    path, beside = tmp_path / "a.txt", tmp_path / "beside"
    beside.write_text("precious")
    path.symlink_to({"beside": beside, "nowhere": tmp_path / "nowhere", "loop": path}[target])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match="this is a symbolic link"):
        write(path)
    assert sorted(tmp_path.iterdir()) == before
    assert beside.read_text() == "precious"


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_link_to_the_folder_that_the_user_names_is_followed(tmp_path, write):
    (tmp_path / "disk").mkdir()
    (tmp_path / "linked").symlink_to("disk")
    write(tmp_path / "linked" / "a.txt")
    assert (tmp_path / "disk" / "a.txt").read_text().strip() == "new"


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_in_a_folder_of_outputs_no_link_is_followed(tmp_path, write):
    """Not even one that stays inside: outputs of one scene would replace those of another."""
    (tmp_path / "disk" / "one").mkdir(parents=True)
    (tmp_path / "linked").symlink_to("disk")
    (tmp_path / "disk" / "two").symlink_to("one")
    (tmp_path / "disk" / "up").symlink_to(tmp_path)
    for folder in (tmp_path / "linked", tmp_path / "disk"):
        with confined(folder):
            write(folder / "one" / "a.txt")
            for way in ("two", "up"):
                with pytest.raises(InputError, match="this is a symbolic link"):
                    write(folder / way / "b.txt")
            with pytest.raises(InputError, match="outside the output folder"):
                write(tmp_path / "c.txt")
    assert sorted(path.name for path in tmp_path.rglob("*.txt")) == ["a.txt"]


def test_a_link_that_appears_during_the_work_is_replaced(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    with together(tmp_path / "out", "a"), whole_or_nothing(tmp_path / "out" / "a.txt") as temporary:
        (tmp_path / "out" / "a.txt").symlink_to(victim)
        temporary.write_text("new")
    assert victim.read_text() == "precious"
    assert not (tmp_path / "out" / "a.txt").is_symlink()
    assert (tmp_path / "out" / "a.txt").read_text() == "new"
