"""A disk that cannot be read in the middle of a file (EIO): the file is named, and nothing is left of the outputs."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
SAMPLE = HERE.parents[1] / "sample_data"


@pytest.fixture(scope="module")
def bad_blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile what is preloaded so that reads of a part of a file fail."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or platform.libc_ver()[0] != "glibc":
        pytest.skip("reads fail by a library that is preloaded, which takes a C compiler and glibc")
    made = tmp_path_factory.mktemp("preloaded") / "read_errors.so"
    words = [compiler, "-shared", "-fPIC", "-O1", "-o", str(made), str(HERE / "read_errors.c"), "-ldl"]
    subprocess.run(words, check=True, capture_output=True)
    return made


def copied(folder: Path) -> Path:
    folder.mkdir()
    for name in ("scene.tif", "scene_RPC.TXT", "dem.tif", "gcps.geojson"):
        shutil.copyfile(SAMPLE / name, folder / name)
    return folder


def ended(
    words: list[str], preloaded: Path, file: Path, share: float, width: float
) -> subprocess.CompletedProcess[str]:
    """Run a command for which a part of a file, from a share of its length, cannot be read."""
    size = file.stat().st_size
    bad = {"BAD_FILE": str(file), "BAD_FROM": str(int(share * size)), "BAD_TO": str(int((share + width) * size) + 1)}
    return subprocess.run(
        [sys.executable, "-m", "ortho_pipeline", *words], check=False, capture_output=True, text=True, timeout=120,
        env={**os.environ, **bad, "LD_PRELOAD": str(preloaded)},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "share"),
    [("scene.tif", 0.9), *(pytest.param(name, 0.5, marks=pytest.mark.slow) for name in ("dem.tif", "scene_RPC.TXT"))],
)
def test_a_bad_block_is_an_error_that_names_the_file(bad_blocks, tmp_path, name, share):
    folder = copied(tmp_path / "in")
    words = ["rectify", str(folder / "scene.tif"), "--gcps", str(folder / "gcps.geojson"), "--dem",
             str(folder / "dem.tif"), "-o", str(tmp_path / "out")]  # fmt: skip
    done = ended(words, bad_blocks, folder / name, share, 0.02)
    assert done.returncode == 2, (done.returncode, done.stderr)
    assert name in done.stderr
    assert "Remedy" in done.stderr
    assert "Traceback" not in done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.parent != folder]


def test_an_rpc_beside_an_image_is_not_passed_over_for_its_tag(bad_blocks, tmp_path):
    """GDAL took the tag without a word, which may be another RPC than the one next to it."""
    folder = copied(tmp_path / "in")
    image = folder / "scene.tif"
    words = ["export", str(image), "--format", "tag", "--height", "900", "-o", str(tmp_path / "tagged")]
    made = ended(words, bad_blocks, image, 2.0, 0.0)
    assert made.returncode == 0, made.stderr
    tagged = next((tmp_path / "tagged").glob("*.tif"))
    beside = tagged.with_name(f"{tagged.stem}_RPC.TXT")
    shutil.copyfile(folder / "scene_RPC.TXT", beside)
    done = ended(["info", str(tagged)], bad_blocks, beside, 0.5, 0.02)
    assert done.returncode == 2, done.stdout
    assert beside.name in done.stderr
    assert "--rpc tag" in done.stderr
    assert ended(["info", str(tagged), "--rpc", "tag"], bad_blocks, beside, 0.5, 0.02).returncode == 0
