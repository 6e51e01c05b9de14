"""The whole job on files of a store, each of whose answers takes its time, beside that on files of this machine.

    python benchmarks/far.py --side 12000 --delay 0.05 --pairs 3 --kind s3

The store is a server of the tests on the loopback: every answer comes later by the delay, as from another place. Both
jobs are whole processes that take turns; only their ratio counts.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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
            seconds(str(folder), top)
            ratios = []
            for _ in range(given.pairs):
                public.asked.clear()
                public.times.clear()
                public.sent = 0
                near_s, far_s = seconds(str(folder), top), seconds(far, top)
                ratios.append(far_s / near_s)
                print(
                    f"local {near_s:.2f} s, far {far_s:.2f} s, ratio {ratios[-1]:.2f}: "
                    f"{sum(public.asked.values())} requests, waited {public.rounds:.0f} times the delay, "
                    f"{public.sent / 1e6:.1f} of {size / 1e6:.1f} MB"
                )
        print(f"median ratio {statistics.median(ratios):.2f}")


def seconds(where: str, top: str) -> float:
    """Return the wall time of the job."""
    out = ["-o", tempfile.mkdtemp(dir=top), "--format", "GTiff"]
    heights = ["--dem", f"{where}/dem.tif", "--dem-vertical", "ellipsoid"]
    begin = time.monotonic()
    subprocess.run(
        [sys.executable, "-m", "ortho_pipeline", "rectify", f"{where}/scene.tif", *heights, *out, "--allow-network"],
        check=True, capture_output=True,
    )  # fmt: skip
    return time.monotonic() - begin


if __name__ == "__main__":
    main()
