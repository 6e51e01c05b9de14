"""numba's caches: where none can be written, kernels are compiled in memory, and that is said once."""

import ast
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = [
    path
    for path in sorted((Path(__file__).parents[2] / "ortho_pipeline").rglob("*.py"))
    if "@compiled" in path.read_text(encoding="utf-8")
]
SCENE = Path(__file__).parents[2] / "sample_data/ikonos/po_39001_pan_0000000.tif"
#: What numba does where neither the package's folder nor the home can be written: it finds no place for a cache.
READ_ONLY = "import sys; from numba.core import caching; caching.CacheImpl._locator_classes = []\n"
#: And nobody has compiled before.
NOWHERE = READ_ONLY + "from ortho_pipeline.files import compiled; from ortho_pipeline.files.kernels import compiler\n"
NOWHERE += "compiler._SharedPlace._locator_classes = ()\n"


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", NOWHERE + code], capture_output=True, text=True, check=False)


def test_a_command_runs_where_no_cache_can_be_written() -> None:
    done = run(
        f"sys.argv = ['ortho', 'info', {str(SCENE)!r}]\n"
        "from ortho_pipeline.models import rpc_kernel\n"
        "from ortho_pipeline.models.pushbroom import kernel as pushbroom_kernel\n"
        "compiled.compiled(lambda number: number + 1)(1)\n"
        "compiled.compiled(lambda number: number + 2)(1)\n"
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


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="looks for instructions of x86-64")
def test_kernels_of_rpcs_are_vector_instructions() -> None:
    """A branch in their loops, or arrays that may overlap, and they take one point at a time: half as fast."""
    done = run(
        "import numpy as np\n"
        "from ortho_pipeline.models import rpc_kernel as kernel\n"
        "points, tables = np.ones((9, 3)), (np.zeros(5), np.ones(5), np.ones((4, 20)))\n"
        "heights, limits = np.ones(9), np.ones(3)\n"
        "kernel.project(points, *tables, limits, np.ones((9, 2)))\n"
        "start = np.ones((2, 6)), limits, 1e-9, 1e-5, 25\n"
        "kernel.image_to_ground(np.ones((9, 2)), heights, *tables, *start, points)\n"
        "for one in (kernel.project, kernel.image_to_ground):\n"
        "    print(''.join(one.inspect_asm().values()).count('divpd'))\n"
    )
    projecting, inverse = map(int, done.stdout.split())
    assert projecting >= 2
    assert inverse >= 11


@pytest.mark.slow
def test_a_plain_job_compiles_one_kernel_and_no_function_of_the_warp_twice(tmp_path: Path) -> None:
    """A first run compiled all five kernels, and helpers again for each constant that they were called with."""
    done = run(
        "import collections\n"
        "from numba.core import event\n"
        "class Heard(event.Listener):\n"
        "    def on_start(self, event): found[event.data['dispatcher'].py_func.__qualname__] += 1\n"
        "    def on_end(self, event): pass\n"
        "found = collections.Counter()\n"
        "event.register('numba:compile', Heard())\n"
        "from ortho_pipeline.commands.rectification import rectify\n"
        "from ortho_pipeline.options import SurfaceOptions\n"
        f"rectify({str(SCENE)!r}, {str(tmp_path)!r}, surface=SurfaceOptions(height=700))\n"
        "print(*(f'{name}={count}' for name, count in found.items()))"
    )
    times = dict(pair.split("=") for line in done.stdout.splitlines()[-1:] for pair in line.split())
    assert times.get("warp_block") == times.get("_row_bilinear") == "1", done.stderr
    assert not {"_row_cubic", "_row_lanczos", "_row_average"} & set(times)
    assert {name for name in ("_bent", "_span", "_next_whole", "dem_height_at") if times[name] != "1"} == set()


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
        code = "import numba; from above import run; print(run(0), sum(run.stats.cache_hits.values()))"
        command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {code}"]
        found.append(subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True).stdout)
    assert found == ["2 0\n", "2 1\n", "40 0\n"]


def test_kept_code_is_loaded_without_what_only_compiling_needs(tmp_path: Path) -> None:
    """numba loads SciPy's linear algebra and a hundred modules of its own before it looks into the cache."""
    (tmp_path / "one.py").write_text(
        "from ortho_pipeline.files.compiled import compiled\n"
        "@compiled\ndef total(x):\n    sum = 0.0\n    for k in range(x.size):\n        sum += x[k]\n    return sum\n"
    )
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import numba, numpy as np; from one import total\n"
        "def say(x): print(total(x), sum(total.stats.cache_hits.values()), 'scipy.linalg' in sys.modules)\n"
        "say(np.ones(3))\n"
        "if len(sys.argv) > 1: say(np.ones(4, 'f4'))\n"  # the same process can still compile
    )
    surroundings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    found = [
        subprocess.run(
            [sys.executable, "-c", code, *more], env=surroundings, capture_output=True, text=True, check=True
        )
        for more in ((), ("compile",))
    ]
    assert [one.stdout for one in found] == ["3.0 0 True\n", "3.0 1 False\n4.0 1 True\n"]


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_kernels_use_nothing_that_is_missing_when_they_are_loaded(path: Path) -> None:
    """A symbol that is not there ends the process when the code is linked."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        assert not isinstance(node, ast.Dict | ast.Set | ast.DictComp | ast.SetComp | ast.MatMult), path
        if isinstance(node, ast.Attribute):
            assert ast.unparse(node).removeprefix("np.") not in ("dot", "vdot", "linalg", "matmul"), path
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("hash", "dict", "set", "frozenset"), path


def test_what_was_compiled_before_is_taken_from_where_nothing_can_be_written(tmp_path: Path) -> None:
    """As in an image of a container that is run by another user, or whose files are read-only: no need to compile."""
    (tmp_path / "one.py").write_text(
        "import two\nfrom ortho_pipeline.files.compiled import compiled\n@compiled\ndef double(x):\n    return 2 * x\n"
    )
    # A module of which nothing was compiled, as most are that a job does not need: nothing is said of it.
    (tmp_path / "two.py").write_text(
        "from ortho_pipeline.files.compiled import compiled\n@compiled\ndef half(x):\n    return x / 2\n"
    )
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import numba; from one import double\n"
        "print(double(21), sum(double.stats.cache_hits.values()), double(0.5), sum(double.stats.cache_hits.values()))"
    )
    surroundings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    elsewhere = (
        "from numba.core import caching\n"
        "class Home(caching.UserWideCacheLocator):\n"
        f"    def get_cache_path(self): return {str(tmp_path / 'home')!r}\n"
        "caching.CacheImpl._locator_classes = [Home]\n"
    )

    def output(before: str) -> str:
        command = [sys.executable, "-c", before + code.replace(", double(0.5)", "" if before else ", 1.0")]
        done = subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True)
        return done.stdout + done.stderr

    assert output("") == "42 0 1.0 0\n"
    kept = {path.name: path.read_bytes() for path in (tmp_path / "cache").rglob("*.nb*")}
    for before in (READ_ONLY, elsewhere):
        assert output(before) == "42 1 1\n"
    assert {path.name: path.read_bytes() for path in (tmp_path / "cache").rglob("*.nb*")} == kept
    # Code that is not there is compiled, and kept where that is possible.
    code = code.replace("double(21)", "double(0.25)")
    told = output(READ_ONLY)
    assert told.startswith("0.5 0 0\n")
    assert "cannot be kept" in told
    assert output(elsewhere) == "0.5 0 0\n"
    assert output(elsewhere) == "0.5 1 1\n"
