"""What a command reads: which scene, which files, and that it ends cleanly when one of them is missing."""

from __future__ import annotations

import functools
import http.server
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import pytest

from ortho_pipeline import commands, files
from ortho_pipeline.errors import TooFewPoints
from ortho_pipeline.options import PointOptions, SurfaceOptions

# -- checksums during the work ----------------------------------------------------------------------------------------


def test_no_thread_outlives_a_command_that_fails(tiny, tmp_path):
    began: list[threading.Thread] = []

    def slow(path: Path, stop: threading.Event) -> str:
        began.append(threading.current_thread())
        assert stop.wait(60), "an error stops the checksums"
        raise CancelledError

    # Points that are read, and do not determine the correction.
    (tmp_path / "one.csv").write_text("id,col,row,x,y,h\n1,20,20,20.0,-30.0,0\n")
    with pytest.raises(TooFewPoints):
        commands.rectify(
            tiny.image, tmp_path / "out",
            points=PointOptions(gcps=tmp_path / "one.csv", crs="EPSG:4326", vertical="ellipsoid", correction="affine"),
            surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), digest=slow,
        )  # fmt: skip
    assert len(began) == 1
    assert not began[0].is_alive()


def test_a_checksum_stops_between_pieces(tmp_path):
    path = tmp_path / "zeros"
    path.write_bytes(bytes(3_000_000))
    stop = threading.Event()
    assert files.sha256(path, stop) == files.sha256(path)
    stop.set()
    with pytest.raises(CancelledError):
        files.sha256(path, stop)


class _Served(http.server.SimpleHTTPRequestHandler):
    """Answers at once, but for the first question about the DEM after its beginning was read: another opening."""

    read, again = False, 0

    def log_message(self, *_: Any) -> None: ...

    def send_head(self) -> Any:
        if self.path.endswith(".tif"):
            if type(self).read:
                type(self).again += 1
                time.sleep(0.8 if type(self).again == 1 else 0.0)
            type(self).read |= self.command == "GET"
        return super().send_head()


@pytest.fixture
def served(tiny: Any) -> Iterator[str]:
    _Served.read, _Served.again = False, 0
    handler = functools.partial(_Served, directory=str(tiny.folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"/vsicurl/http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


#: The command line in an interpreter that takes its time to end, so that what a thread does meanwhile surely matters.
_LATE = """
import time
from ortho_pipeline.cli.program import main
class Late:
    def __del__(self, sleep=time.sleep):
        sleep(1.6)
late = Late()
main()
"""


def test_bad_control_and_a_dem_of_the_network_end_with_a_message(tiny, tmp_path, served):
    # Without GDAL's cache every opening asks again, so that a thread which opens the DEM is surely still at it when
    # the control points turn out to be none: they come through a pipe, while the server takes its time.
    environment = {**os.environ, "CPL_VSIL_CURL_NON_CACHED": served.rsplit(":", 1)[0]}
    points = tmp_path / "points.csv"
    os.mkfifo(points)
    command = [
        sys.executable, "-c", _LATE, "rectify", str(tiny.image), "-o", str(tmp_path / "out"), "--gcps",
        str(points), "--dem", f"{served}/dem.tif", "--dem-vertical", "ellipsoid", "--allow-network",
    ]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as running:
        while running.poll() is None and not _Served.again:
            time.sleep(0.01)
        while running.poll() is None:
            try:
                writer = os.open(points, os.O_WRONLY | os.O_NONBLOCK)
            except OSError:  # nobody reads yet
                time.sleep(0.01)
                continue
            os.write(writer, b"no table\n")
            os.close(writer)
            break
        _, said = running.communicate()
    assert "points.csv" in said
    assert "terminate" not in said
    assert running.returncode == 2
