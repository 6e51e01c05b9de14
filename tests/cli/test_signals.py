"""Signals end a command whatever it is doing: in a destructor, whose exceptions Python drops, and after its end."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from osgeo import gdal

from ortho_pipeline.runtime.signals import called_by_gdal

LOST = """
import os, sys, time
from ortho_pipeline.runtime.signals import ended_by_signals

class Dying:
    def __del__(self):
        os.kill(os.getpid(), int(sys.argv[1]))
        time.sleep(0)

with ended_by_signals():
    try:
        Dying()
        time.sleep(30)
    except BaseException as end:
        print(type(end).__name__)
"""
AFTER = """
import os, sys, time
from ortho_pipeline.runtime.signals import ended_by_signals
with ended_by_signals():
    pass
os.kill(os.getpid(), int(sys.argv[1]))
time.sleep(30)
"""
WRITING = """
import os, sys
import numpy as np
import pyproj
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.runtime.signals import ended_by_signals

def progress(text, share):
    os.kill(os.getpid(), int(sys.argv[1]))

grid = Grid(pyproj.CRS("EPSG:32632"), 500000.0, 6000000.0, 1.0, 1.0, 20, 20)
with ended_by_signals():
    try:
        with RasterWriter(
            sys.argv[2], grid, Profile(1, np.dtype("uint8"), "nodata", 0.0), progress=progress
        ) as writer:
            writer.write(0, 0, np.ones((1, 20, 20), np.uint8), None)
    except BaseException as end:
        print(type(end).__name__, os.listdir(os.path.dirname(sys.argv[2])))
"""


def run(code, number, *further):
    return subprocess.run(
        [sys.executable, "-c", code, str(int(number)), *map(str, further)],
        check=False,
        capture_output=True,
        text=True,
        timeout=25,
    )


@pytest.mark.parametrize(
    ("number", "end"),
    [(signal.SIGINT, "KeyboardInterrupt"), (signal.SIGTERM, "Terminated"), (signal.SIGHUP, "Terminated")],
)
def test_a_signal_within_a_destructor_is_not_lost(number, end):
    done = run(LOST, number)
    assert (done.stdout, done.stderr) == (f"{end}\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_command_ends_it_without_a_traceback(number):
    done = run(AFTER, number)
    assert (done.returncode, done.stderr) == (-number, "")


@pytest.mark.parametrize(("number", "end"), [(signal.SIGINT, "KeyboardInterrupt"), (signal.SIGTERM, "Terminated")])
def test_a_signal_while_gdal_writes_is_no_error_of_the_output(number, end, tmp_path):
    done = run(WRITING, number, tmp_path / "ortho.tif")
    assert (done.stdout, done.stderr) == (f"{end} []\n", "")


def test_an_error_in_a_progress_function_of_gdal_is_raised(tmp_path):
    source = gdal.GetDriverByName("MEM").Create("", 20, 20)

    def report(share):
        raise ZeroDivisionError("in the progress function")

    with pytest.raises(ZeroDivisionError, match="in the progress function"), called_by_gdal(report) as advance:
        gdal.GetDriverByName("GTiff").CreateCopy(str(tmp_path / "a.tif"), source, callback=advance)
