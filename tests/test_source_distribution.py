"""The source distribution has all that a packager needs, and what is installed from it works without the repository."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
#: What serves the repository alone.
LEFT = {".ci", ".github", ".gitattributes", ".gitignore", ".pre-commit-config.yaml"}

pytestmark = pytest.mark.slow


def run(*command: object, cwd: Path) -> str:
    # The repository is on no path of what runs.
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=clean, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    """The folder of the unpacked source distribution."""
    folder = tmp_path_factory.mktemp("sdist")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        packed.extractall(folder, filter="data")
    (found,) = (path for path in folder.iterdir() if path.is_dir())
    return found


def test_no_image_of_the_repository_has_a_sidecar_of_gdal():
    """GDAL writes such files next to images that it looks at; this one gave the raw scene a geotransform."""
    assert not run("git", "ls-files", "*.aux.xml", cwd=ROOT)


def test_it_has_what_the_repository_has(unpacked):
    tracked = run("git", "ls-files", cwd=ROOT).splitlines()
    missing = [name for name in tracked if Path(name).parts[0] not in LEFT and not (unpacked / name).exists()]
    assert not missing
    stray = [path for path in unpacked.rglob("*") if path.suffix in (".pyc", ".nbi", ".nbc", ".kernel")]
    assert not stray


def test_what_is_installed_from_it_works(unpacked, tmp_path):
    wheels, home = tmp_path / "wheels", tmp_path / "venv"
    pip = (sys.executable, "-m", "pip")
    run(*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", wheels, unpacked, cwd=tmp_path)
    run(sys.executable, "-m", "venv", "--without-pip", home, cwd=tmp_path)
    python = home / "bin" / "python"
    run(*pip, "--python", python, "install", "-q", "--no-deps", "--no-index", *wheels.glob("*.whl"), cwd=tmp_path)
    site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip()
    Path(site, "needs.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    where = run(python, "-c", "import ortho_pipeline as op; print(op.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(home)

    ortho, sample = home / "bin" / "ortho", unpacked / "sample_data"
    assert not json.loads(run(ortho, "doctor", "--json", cwd=tmp_path)).get("broken")
    sensors = json.loads(run(ortho, "sensors", "--json", cwd=tmp_path))
    bundled = {path.name.removeprefix("ortho_") for path in (ROOT / "plugins").glob("ortho_*")}
    assert {one["name"] for one in sensors["sensors"]} >= bundled - {"csm", "measure", "stereo", "studies"}
    assert all(f"\n  {name} " in run(ortho, "--help", cwd=tmp_path) for name in ("measure", "reproduce", "simulate"))
    made = json.loads(run(ortho, "simulate", "bilsat", "--size", 256, "-o", "simulated", "--json", cwd=tmp_path))
    assert (tmp_path / made["files"]["image"]).is_file()
    page = "import importlib.resources as r; print(r.files('ortho_measure').joinpath('page', 'index.html').is_file())"
    assert run(python, "-c", page, cwd=tmp_path).strip() == "True"
    assert not sensors["broken"]
    words = ("--gcps", sample / "gcps.geojson", "--dem", sample / "dem.tif", "-o", "out", "--json")
    made = json.loads(run(ortho, "rectify", sample / "scene.tif", *words, cwd=tmp_path))
    assert made["report"]["adjustment"]["rmse"]["check"]["total"] == pytest.approx(0.19, abs=0.01)
    assert (tmp_path / "out" / "scene_report.html").stat().st_size > 100_000
