"""Where no cache can be written, kernels are compiled in memory, and that is said once."""

import os
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
        "from ortho_pipeline.warp import block_kernel\n"
        "from ortho_pipeline.warp import lattice_kernel\n"
        "from ortho_pipeline.surface import ray_kernel\n"
        "out = np.empty((1, 1))\n"
        "dem = block_kernel.DemWindow(np.array([[0.0, 4.0], [8.0, 12.0]]), 0, 0, False)\n"
        "block_kernel.heights_at(np.array([[[0.5, 0.25]]]), dem, out)\n"
        "print(out[0, 0])"
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == 4.0  # 4 u + 8 v


def test_kept_code_is_made_again_when_a_function_of_another_module_changes(tmp_path: Path) -> None:
    """numba's own cache gave the old value: it looks at the module of the caller alone."""
    made = "from ortho_pipeline.files.compiled import compiled, inlined\n"
    below = made + "@inlined\ndef step(x):\n    return x + {}\n"
    between = made + "from below import step\n@compiled\ndef twice(x):\n    return step(step(x))\n"
    above = made + "from between import twice\n@compiled\ndef run(x):\n    return twice(x)\n"
    (tmp_path / "between.py").write_text(between)
    (tmp_path / "above.py").write_text(above)
    surroundings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    found = []
    for added in (1, 1, 20):
        (tmp_path / "below.py").write_text(below.format(added))
        code = "from above import run; print(run(0), sum(run.stats.cache_hits.values()))"
        command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {code}"]
        found.append(subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True).stdout)
    assert found == ["2 0\n", "2 1\n", "40 0\n"]
