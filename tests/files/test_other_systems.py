"""What Unix and Linux alone have is not needed: modules, functions, flags and files of the system are taken away.

The commands run in processes of their own, with those of `ortho run` started by them.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline.batch.stack.dates import dated_orthos
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control.ties import names_of
from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import Location
from ortho_pipeline.runtime.compilation import cache_folders
from ortho_pipeline.stores.delivery import address_of

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"

#: Python imports the module `sitecustomize` at start-up. Windows locks bytes of a file; here `lockf` does that.
WITHOUT = """
import builtins, errno, os, signal, subprocess, sys, types  # subprocess asks for msvcrt: before there is one
GONE = {"fcntl", "resource"}
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in GONE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
for name in GONE:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())
del os.sched_getaffinity, os.O_NOFOLLOW, os.O_CLOEXEC, os.O_NONBLOCK, os.pwrite
del signal.SIGHUP, signal.SIGALRM, signal.setitimer
def look(event, words):
    if event == "open" and str(words[0]).startswith("/proc"):
        caller = sys._getframe(1)
        while "pathlib" in caller.f_code.co_filename:
            caller = caller.f_back
        # Libraries know for themselves which systems have these files.
        if "__main__" in caller.f_globals["__name__"] or caller.f_globals["__name__"].startswith("ortho_"):
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", words[0])
sys.addaudithook(look)
def locking(descriptor, mode, count):
    os.lockf(descriptor, os.F_TLOCK, count)
sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=locking)
"""


def environment(folder: Path) -> dict[str, str]:
    (folder / "without").mkdir(exist_ok=True)
    (folder / "without" / "sitecustomize.py").write_text(WITHOUT)
    path = os.pathsep.join([str(folder / "without"), os.environ.get("PYTHONPATH", "")])
    return {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def ortho(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "ortho_pipeline", *map(str, words)]
    done = subprocess.run(
        line, check=False, capture_output=True, text=True, cwd=folder, env=environment(folder), timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done


def test_what_is_taken_away_is_gone(tmp_path: Path) -> None:
    code = (
        "import os, signal\n"
        "gone = [name for name in ('sched_getaffinity', 'O_NOFOLLOW') if not hasattr(os, name)]\n"
        "for name in ('fcntl', 'resource'):\n"
        "    try: __import__(name)\n"
        "    except ImportError: gone.append(name)\n"
        "try: open('/proc/self/statm')\n"
        "except OSError: gone.append('/proc')\n"
        "print(len(gone), hasattr(signal, 'setitimer'))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=environment(tmp_path))
    assert done.stdout.split() == [b"5", b"False"]


def test_locks_keep_others_out(tmp_path: Path) -> None:
    """One alone, or several who share it; the file itself stays as it is, and so does what a link leads to."""
    code = (
        "import os, subprocess, sys\n"
        "from ortho_pipeline.files import Lock\n"
        "def tried(shared):\n"
        "    try: Lock('lock', shared=shared, wait=False); return 'got'\n"
        "    except BlockingIOError: return 'held'\n"
        "def others():\n"
        "    lines = [[sys.executable, __file__, kind] for kind in ('', 'shared')]\n"
        "    return [subprocess.check_output(line, text=True).strip() for line in lines]\n"
        "if len(sys.argv) > 1: print(tried(sys.argv[1] == 'shared')); sys.exit()\n"
        "alone = Lock('lock'); os.write(alone.descriptor, b'mine'); print(others()); alone.close()\n"
        "first, second = Lock('lock', shared=True), Lock('lock', shared=True, wait=False); print(others())\n"
        "first.close(); second.close(); print(others())\n"
        "os.symlink('lock', 'link')\n"
        "try: Lock('link')\n"
        "except OSError as error: print(error.strerror)\n"
    )
    (tmp_path / "held.py").write_text(code)
    line = [sys.executable, str(tmp_path / "held.py")]
    done = subprocess.run(line, check=True, capture_output=True, text=True, cwd=tmp_path, env=environment(tmp_path))
    assert done.stdout.splitlines() == [
        "['held', 'held']", "['held', 'got']", "['got', 'got']", "a symbolic link is not followed",
    ]  # fmt: skip
    assert (tmp_path / "lock").read_bytes() == b"mine"


def test_without_users_no_folder_of_kernels_is_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "geteuid")
    assert cache_folders.own.__wrapped__() == (None, "this system does not say which user a file belongs to")
    assert cache_folders.of_root.__wrapped__() is None


def test_the_sample_job_a_match_and_a_run_of_two_scenes(tmp_path: Path) -> None:
    """The ortho has the pixels that a system with all of it makes, and so has that of a worker."""
    for name in ("scene.tif", "scene_RPC.TXT", "dem.tif", "gcps.geojson"):
        shutil.copy(SAMPLE / name, tmp_path)
    for ending in (".tif", "_RPC.TXT"):
        shutil.copy(SAMPLE / f"scene{ending}", tmp_path / f"again{ending}")
    extent = 530600, 4122000, 530900, 4122300
    job = "scene.tif", "--gcps", "gcps.geojson", "--dem", "dem.tif", "-te", *extent
    ortho(tmp_path, "rectify", *job, "-o", "here")
    inside = [str(tmp_path / word) if str(word) in os.listdir(tmp_path) else str(word) for word in job]
    assert CliRunner().invoke(cli, ["rectify", *inside, "-o", str(tmp_path / "there")]).exit_code == 0
    pixels = read(tmp_path / "there" / "scene_ortho.tif")
    assert np.array_equal(read(tmp_path / "here" / "scene_ortho.tif"), pixels)
    match = (
        "match",
        "scene.tif",
        "--reference",
        SAMPLE / "reference.tif",
        "--dem",
        "dem.tif",
        "-o",
        "m.geojson",
        "--match-points",
        60,
    )
    assert json.loads(ortho(tmp_path, *match, "--json").stdout)["matching"]["kept"] > 30
    (tmp_path / "pipeline.yaml").write_text(
        "defaults:\n  surface: {dem: dem.tif}\n  points: {gcps: gcps.geojson}\n"
        f"  output: {{extent: {list(extent)}}}\n"
        "scenes:\n- {image: scene.tif}\n- {image: again.tif}\n"
    )
    ortho(tmp_path, "run", "pipeline.yaml", "--executor", "processes", "--workers", 2)
    for name in ("scene", "again"):
        (made,) = (tmp_path / "out" / name).glob("*_ortho.tif")
        assert np.array_equal(read(made), pixels)


def read(path: Path) -> np.ndarray:
    return gdal.Open(str(path)).ReadAsArray()


def test_folders_with_blanks_and_umlauts_and_lines_that_end_as_on_windows(tmp_path: Path) -> None:
    """The ortho has the pixels of the same job in a plain folder."""
    odd, plain = tmp_path / "Straße Nr. 1" / "Übung (2)", tmp_path / "plain"
    pipeline = (
        "scenes:\n- image: {0}.tif\n  points: {{gcps: points.csv}}\n"
        "defaults:\n  surface: {{dem: dem.tif}}\n  output: {{extent: [530600, 4122000, 530900, 4122300]}}\n"
    )
    made = []
    for folder, name, ends in ((odd, "Grün ß", "\r\n"), (plain, "scene", "\n")):
        folder.mkdir(parents=True)
        shutil.copy(SAMPLE / "scene.tif", folder / f"{name}.tif")
        shutil.copy(SAMPLE / "dem.tif", folder)
        texts = {
            f"{name}_RPC.TXT": (SAMPLE / "scene_RPC.TXT").read_text(),
            "points.csv": (SAMPLE / "gcps.csv").read_text(),
        }
        for file, text in {**texts, "pipeline.yaml": pipeline.format(name)}.items():
            (folder / file).write_bytes(text.replace("\n", ends).encode())
        done = CliRunner().invoke(cli, ["run", str(folder / "pipeline.yaml"), "--executor", "sequential"])
        assert done.exit_code == 0, done.output
        report = json.loads((folder / "out" / name / f"{name}_report.json").read_text())
        assert report["adjustment"]["rmse"]["control"]["n"] > 5
        made.append(read(folder / "out" / name / f"{name}_ortho.tif"))
    assert np.array_equal(*made)


@pytest.mark.parametrize("name", ["C:/data/scene.tif", "C:\\data\\scene.tif", "d:/delivery.zip/a.tif", "c:scene.tif"])
def test_a_drive_letter_begins_no_address(name: str) -> None:
    location = Location(name)
    assert not any((location.is_address, location.is_far, location.is_item, location.is_on_web))
    assert address_of(name) is None


def test_names_that_differ_in_case_alone_are_one_name(tmp_path: Path) -> None:
    """Windows and macOS would write the outputs of both into one file."""
    for name in ("a.tif", "A.tif"):
        shutil.copy(SAMPLE / "reference.tif", tmp_path / name)
    with pytest.raises(InputError, match=r"two images are called [aA]\b"):
        dated_orthos([tmp_path])
    assert len({one.lower() for one in names_of([tmp_path / "a.tif", tmp_path / "sub" / "A.tif"])}) == 2
    (tmp_path / "pipeline.yaml").write_text(
        "scenes:\n- image: a.tif\n- image: A.tif\ndefaults: {surface: {height: 0}}\n"
    )
    done = CliRunner().invoke(cli, ["run", str(tmp_path / "pipeline.yaml"), "--dry-run"])
    assert done.exit_code == 2
    assert "have the same scene name" in done.output
