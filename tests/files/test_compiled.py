"""Where no cache can be written, kernels are compiled in memory, and that is said once."""

import subprocess
import sys
from pathlib import Path

SCENE = Path(__file__).parents[2] / "sample_data/ikonos/po_39001_pan_0000000.tif"
#: What numba does where neither the package's folder nor the home can be written: it finds no place for a cache.
READ_ONLY = "import sys; from numba.core import caching; caching.CacheImpl._locator_classes = []\n"


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", READ_ONLY + code], capture_output=True, text=True, check=False)


def test_a_command_runs_where_no_cache_can_be_written() -> None:
    done = run(
        f"sys.argv = ['ortho', 'info', {str(SCENE)!r}]\n"
        "from ortho_pipeline.models import rpc_kernel\n"
        "from ortho_pipeline.models.pushbroom import kernel as pushbroom_kernel\n"
        "from ortho_pipeline.cli.program import main\n"
        "main()"
    )
    assert done.returncode == 0, done.stderr
    (notice,) = [line for line in done.stderr.splitlines() if "compiled" in line]
    assert "NUMBA_CACHE_DIR" in notice


def test_every_kernel_is_made_without_a_cache_and_computes_the_same() -> None:
    done = run(
        "import numpy as np\n"
        "from ortho_pipeline.warp import kernels\n"
        "from ortho_pipeline.warp import lattice_kernel\n"
        "from ortho_pipeline.surface import ray_kernel\n"
        "out = np.empty((1, 1))\n"
        "kernels.heights_at(np.array([[[0.5, 0.25]]]), np.array([[0.0, 4.0], [8.0, 12.0]]), 0, 0, False, out)\n"
        "print(out[0, 0])"
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == 4.0  # 4 u + 8 v
