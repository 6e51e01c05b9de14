"""The whole job on files of a slow store, compared with the same job on files of this machine.

    python benchmarks/far.py --side 12000 --delay 0.05 --pairs 3 --kind s3

The store is a server of the tests on the loopback: every answer comes later by the delay, as from another place. Both
jobs are whole processes that take turns; only their ratio counts.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from osgeo import gdal
from warp import Job

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "storage"))
from servers import serving

gdal.UseExceptions()


def main() -> None:
    """Make scene and DEM as COGs, run both jobs in turn, and print each ratio."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--side", type=int, default=12_000)
    parser.add_argument("--delay", type=float, default=0.05, help="seconds")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--kind", choices=("http", "s3"), default="s3")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top) / "bucket"
        folder.mkdir()
        job = Job(Path(top), given.side).make()
        for path, name in ((job.image, "scene.tif"), (job.dem, "dem.tif")):
            gdal.Translate(str(folder / name), str(path), format="COG", creationOptions=["COMPRESS=DEFLATE"])
        size = sum(path.stat().st_size for path in folder.iterdir())
        with serving(folder.parent, given.delay) as public:
            os.environ |= {"AWS_S3_ENDPOINT": public.address.removeprefix("http://"), "AWS_HTTPS": "NO",
                           "AWS_VIRTUAL_HOSTING": "FALSE", "AWS_NO_SIGN_REQUEST": "YES"}  # fmt: skip
            far = "s3://bucket" if given.kind == "s3" else f"{public.address}/bucket"
            work(str(folder), top)
            ratios = []
            for _ in range(given.pairs):
                public.asked.clear()
                public.times.clear()
                public.sent = 0
                near, there = work(str(folder), top), work(far, top)
                ratios.append(there.wall / near.wall)
                print(
                    f"local {near.wall:.2f} s ({near.cpu:.2f} s CPU), far {there.wall:.2f} s ({there.cpu:.2f} s CPU), "
                    f"ratio {ratios[-1]:.2f}; {sum(public.asked.values())} requests, "
                    f"waited {public.rounds:.0f} times the delay, {public.sent / 1e6:.1f} of {size / 1e6:.1f} MB read, "
                    f"{there.made / 1e6:.1f} MB made"
                )
        print(f"median ratio {statistics.median(ratios):.2f}")


class Took(NamedTuple):
    """Wall and CPU seconds of a job, and the bytes of its outputs."""

    wall: float
    cpu: float
    made: int


def work(where: str, top: str) -> Took:
    """Make the ortho, and return what it took."""
    folder = Path(tempfile.mkdtemp(dir=top))
    heights = ["--dem", f"{where}/dem.tif", "--dem-vertical", "ellipsoid"]
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "ortho_pipeline", "rectify", f"{where}/scene.tif", *heights, "-o", str(folder)]
    subprocess.run([*command, "--allow-network"], check=True, capture_output=True)
    wall, after = time.monotonic() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    made = sum(path.stat().st_size for path in folder.iterdir())
    shutil.rmtree(folder)
    return Took(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, made)


if __name__ == "__main__":
    main()
