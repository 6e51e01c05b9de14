"""What a call leaves behind in its process, and in those that are forked from it."""

import subprocess
import sys
from pathlib import Path

from osgeo import gdal

from ortho_pipeline import OutputOptions, SurfaceOptions, rectify

CODE = """
import os, signal, sys
from ortho_pipeline import OutputOptions, SurfaceOptions, rectify
from ortho_pipeline.errors import OrthoError

def make(name, threads):
    output = OutputOptions(threads=threads, resolution=(20.0, 20.0))
    return rectify({image!r}, f"{folder}/{{name}}", surface=SurfaceOptions(height=500), output=output)

make("parent", 2)
if not os.fork():
    signal.alarm(60)  # it waited without end
    try:
        make("child", 2)
    except OrthoError as error:
        print("refused:", error, flush=True)
    make("alone", 1)
    print("made", flush=True)
    os._exit(0)
sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""


def test_a_forked_child_is_refused_gdal_threads_at_once_and_works_with_one(tiny, tmp_path: Path) -> None:
    code = CODE.format(image=str(tiny.image), folder=tmp_path)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    refused, *_, made = done.stdout.splitlines()
    assert refused.startswith("refused: this process was forked")
    assert "spawn" in done.stdout
    assert made == "made"
    assert not list((tmp_path / "child").glob("*.tif"))
    assert list((tmp_path / "alone").glob("*.tif"))


def test_a_job_leaves_gdals_cache_as_large_as_it_was(tiny, tmp_path: Path) -> None:
    before, seen = gdal.GetCacheMax(), set[int]()
    try:
        gdal.SetCacheMax(987_654_321)
        output = OutputOptions(resolution=(40.0, 40.0))
        progress = lambda stage, share: seen.add(gdal.GetCacheMax())  # noqa: E731
        rectify(str(tiny.image), str(tmp_path), surface=SurfaceOptions(height=500), output=output, progress=progress)
        assert gdal.GetCacheMax() == 987_654_321
        assert min(seen) < 200_000_000
    finally:
        gdal.SetCacheMax(before)
