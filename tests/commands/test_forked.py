"""Processes that are forked after an ortho was made, as multiprocessing does by default before Python 3.14."""

import subprocess
import sys
from pathlib import Path

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
