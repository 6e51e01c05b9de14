"""How soon what is wrong is answered, and what is right is let in: seconds, and the counts that the tests hold.

python benchmarks/answers.py        prints the slowest of each; exit code 1 if one is slower than its bound
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from fit import scanner
from ortho_ikonos.metadata import read_metadata
from ortho_orbview3.label import read_label

from ortho_pipeline.batch.config import read_config
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.host.contract import model_faults
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.points import read_points

HEADER = b"id,col,row,x,y,h\n"
POINTS = (
    b"x" * 10_000_000, b"9" * 33_000_000, HEADER + b"a," + b"1" * 10_000_000 + b",2,3,4,5\n",
    HEADER + b'a,"1,2,3,4,5\n', b"\x89PNG\r\n\x1a\n", bytes(1000),
)  # fmt: skip
LABELS = (
    "".join(f"/*{k}=1;" for k in range(20_000)).encode(), b"a = (" + b"1," * 90_000, b'"' * 199_999, b"<" * 199_999,
)  # fmt: skip
METADATA = (b"x" * 10_000_000, b"\xff\xfe" + b"a\0" * 100, bytes(1000), b"", b"=" * 5000)
CONFIGS = (b"[" * 100_000, b"[" + b"1," * 400_000, b"x" * 5_000_001, b"x: " + b"1" * 5000, b"a: [1, 2\n")


def seconds(job: Callable[[], object], rounds: int = 3) -> float:
    """Return the least CPU time of some rounds: other processes only ever add to it."""
    taken = []
    for _ in range(rounds):
        begin = time.process_time()
        job()
        taken.append(time.process_time() - begin)
    return min(taken)


def refused(read: Callable[[Path], object], path: Path) -> None:
    """Read a file that has to be refused."""
    try:
        read(path)
    except InputError:
        return
    raise SystemExit(f"{path} is not refused")


def main() -> int:
    """Measure and print."""
    slow = 0

    def said(name: str, taken: float, bound: float) -> None:
        nonlocal slow
        slow += taken > bound
        print(f"{name:52s} {1e3 * taken:8.1f} ms   {'SLOWER than' if taken > bound else 'bound'} {1e3 * bound:.0f} ms")

    def points(path: Path) -> object:
        return read_points(path, crs="EPSG:4979")

    with tempfile.TemporaryDirectory(prefix="ortho_bench_") as folder:
        for name, suffixes, contents, read, bound in (
            ("hostile point files", (".csv", ".txt", ".points", ".geojson", ".pts"), POINTS, points, 1.0),
            ("hostile labels of OrbView-3", (".pvl",), LABELS, read_label, 1.0),
            ("odd metadata of IKONOS", ("_metadata.txt",), METADATA, read_metadata, 1.0),
            ("wrong pipeline files", (".yaml",), CONFIGS, read_config, 5.0),
        ):  # fmt: skip
            taken = []
            for content in contents:
                for suffix in suffixes:
                    path = Path(folder) / f"a{suffix}"
                    path.write_bytes(content)
                    taken.append(seconds(lambda path=path, read=read: refused(read, path)))  # type: ignore[misc]
            said(f"{name}, the slowest of {len(taken)}", max(taken), bound)
    rpc = export_rpc(scanner()).rpc
    said("what the host asks of a model of a scene (an RPC)", seconds(lambda: list(model_faults(rpc)), 20), 0.02)
    model = pushbroom_of_metadata(
        [[32.8, 40.0], [33.1, 40.0], [33.1, 39.8], [32.8, 39.8]], 12_000, 12_000, altitude=618e3, along_deg=26.0,
        across_deg=0.0, focal_length=1.945, pixel_size=7e-6, heights=(0.0, 1500.0),
    )  # fmt: skip
    said("what the host asks of a model of a scene (a pushbroom)", seconds(lambda: list(model_faults(model)), 20), 0.02)
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
