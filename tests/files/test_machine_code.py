"""Kernels that were compiled before are called without numba, with the same results; what may be wrong is not taken.

They run with any version of numba, so that they tell whether it can be added to `machine_code.TESTED`.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline.files.kernels import machine_code

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="machine code is kept on Linux and x86-64 alone"
)

KERNELS = """
from typing import NamedTuple
import numpy as np
from ortho_pipeline.files.compiled import compiled, inlined
from two import scaled

class Table(NamedTuple):
    values: np.ndarray
    left: int
    share: float
    turned: bool
    names: tuple

@inlined
def total(values):
    found = 0.0
    for value in values.ravel():
        found += value
    return found

@compiled
def look(table, window, weights, out, void):
    work = np.empty(window.shape[0], dtype=window.dtype)
    for k in range(work.size):
        work[k] = window[k, 0] + (0 if void is None else 1)
    for k in range(out.size):
        out[k] = scaled(total(table.values)) * table.share + table.left + table.names[1]
    return total(work), weights.size, table.turned

@compiled
def refused(count):
    return np.empty(count).size

@compiled
def later(x):
    return 2 * x
"""
CALLS = """
import sys; sys.path.insert(0, {folder!r})
from ortho_pipeline.files.kernels import machine_code; machine_code.TESTED = ("",)
import numpy as np
from one import Table, later, look, refused
values = np.arange(24.0).reshape(2, 3, 4)
held = values[0].copy(); held.flags.writeable = False
for k, array in enumerate((values, held, np.asfortranarray(values), values[::2], values[:, ::2])[:{arrays}]):
    for kind in ("u2", "f4", "u1")[:{arrays}]:
        out, table = np.empty(3), Table(array, 7, np.float64(0.5), kind == "u1", (1, 2.5))
        window = np.arange(12, dtype=kind).reshape(4, 3)[:, k % 3:]
        print(look(table, window, np.ones(5, bool), out, None if k % 2 else 1), out)
print("numba" in sys.modules)
"""


def written(folder: Path) -> Path:
    (folder / "one.py").write_text(KERNELS)
    (folder / "two.py").write_text(
        "from ortho_pipeline.files.compiled import inlined\n@inlined\ndef scaled(x):\n    return 3 * x\n"
    )
    return folder


def run(folder: Path, more: str = "", arrays: int = 1, **settings: str) -> str:
    """Return what is printed for some types of arrays; the last line of `CALLS` tells whether numba was loaded."""
    surroundings = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1", **settings}
    code = CALLS.format(folder=str(folder), arrays=arrays) + more
    done = subprocess.run([sys.executable, "-c", code], env=surroundings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_was_compiled_is_called_without_numba_and_computes_the_same(tmp_path: Path) -> None:
    first, second = run(written(tmp_path), arrays=5), run(tmp_path, arrays=5)
    assert first.splitlines()[-1] == "True"
    assert second == first.removesuffix("True\n") + "False\n"


def test_kernels_that_are_not_kept_are_compiled_beside_those_that_are(tmp_path: Path) -> None:
    """numba is loaded into a process that has its libraries already."""
    first = run(written(tmp_path))
    more = "print(later(21), 'numba' in sys.modules); print(look(table, window, np.ones(5, bool), out, 1), out)"
    lines = run(tmp_path, more).splitlines()
    assert lines[-3:-1] == ["False", "42 True"]
    assert lines[-1] == first.splitlines()[-2]


def test_an_error_of_a_kernel_is_the_same(tmp_path: Path) -> None:
    more = "print(refused(3))\ntry: refused(-1)\nexcept ValueError as error: print(error)\n"
    first, second = run(written(tmp_path), more), run(tmp_path, more)
    assert first.splitlines()[-3:] == ["True", "3", "negative dimensions not allowed"]
    assert second.splitlines()[-3:] == ["False", "3", "negative dimensions not allowed"]


def test_threads_share_what_was_loaded(tmp_path: Path) -> None:
    more = (
        "from concurrent.futures import ThreadPoolExecutor\n"
        "with ThreadPoolExecutor(8) as pool: print(sum(pool.map(later, range(1000))), 'numba' in sys.modules)"
    )
    assert run(written(tmp_path), more).splitlines()[-1] == "999000 True"
    assert run(tmp_path, more).splitlines()[-1] == "999000 False"


@pytest.mark.parametrize("name", ["one.py", "two.py"])
def test_it_is_compiled_again_when_a_module_that_it_was_made_from_changes(tmp_path: Path, name: str) -> None:
    first = run(written(tmp_path))
    path = tmp_path / name
    path.write_text(path.read_text().replace("3 * x", "30 * x").replace("table.share +", "table.share * 10 +"))
    changed = run(tmp_path)
    assert changed.splitlines()[-1] == "True"
    assert changed != first
    assert run(tmp_path) == changed.removesuffix("True\n") + "False\n"


def test_the_home_of_a_user_takes_what_the_folder_of_a_package_does_not(tmp_path: Path) -> None:
    (written(tmp_path) / "__pycache__").write_text("a file, where nobody can write a folder")
    home = {"NUMBA_CACHE_DIR": "", "HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home" / ".cache")}
    assert run(tmp_path, **home).splitlines()[-1] == "True"
    assert len(list((tmp_path / "home" / ".cache" / "ortho-pipeline").rglob("*.kernel"))) == 1
    assert run(tmp_path, **home).splitlines()[-1] == "False"


def test_threads_that_keep_a_kernel_at_once_keep_it_in_one_place(tmp_path: Path) -> None:
    """One used to take away the other's file, which then went to the next folder, or could not be written at all."""
    more = (
        "import threading\nfrom concurrent.futures import ThreadPoolExecutor\n"
        "together, write = threading.Barrier(4), machine_code.Path.replace\n"
        "def waits(*given):\n    together.wait(20)\n    return write(*given)\n"
        "machine_code.Path.replace = waits\n"
        "keep = lambda _: machine_code.keep(look.py_func, ('kind',), b'code', 'wrapper', {}, ['one'])\n"
        "with ThreadPoolExecutor(4) as pool: list(pool.map(keep, range(4)))\n"
    )
    home = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home" / ".cache")}
    before = run(written(tmp_path), **home)
    assert run(tmp_path, more, **home).startswith(before.removesuffix("True\n"))
    assert not (tmp_path / "home").exists()
    assert not list(tmp_path.rglob("*.part"))
    assert len(list((tmp_path / "cache").rglob("*.kernel"))) == 2


def test_settings_of_numba_are_another_machine(tmp_path: Path) -> None:
    run(written(tmp_path))
    assert run(tmp_path, NUMBA_CPU_NAME="x86-64").splitlines()[-1] == "True"
    assert run(tmp_path, NUMBA_CPU_NAME="x86-64").splitlines()[-1] == "False"
    assert run(tmp_path, NUMBA_DISABLE_JIT="1").splitlines()[-1] == "True"


def test_a_damaged_file_is_not_taken(tmp_path: Path) -> None:
    first = run(written(tmp_path))
    kept = sorted((tmp_path / "cache").rglob("*.kernel"))
    assert len(kept) == 1
    whole = [path.read_bytes() for path in kept]
    for damaged in (
        lambda data: b"",
        lambda data: data[: len(data) // 2],
        lambda data: data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
        lambda data: b"[]" + data[data.index(b"\n") :],
        lambda data: b"{}" + data[data.index(b"\n") :],
    ):
        for path, data in zip(kept, whole, strict=True):
            path.write_bytes(damaged(data))
        assert run(tmp_path) == first
        # And made whole again.
        assert [path.read_bytes() for path in kept] == whole


def test_it_is_not_kept_with_versions_of_numba_that_are_not_tested(tmp_path: Path) -> None:
    written(tmp_path)
    code = CALLS.replace('("",)', '("none",)').format(folder=str(tmp_path), arrays=1)
    surroundings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", code], env=surroundings, capture_output=True, check=True)
    assert not list((tmp_path / "cache").rglob("*.kernel"))


def test_arguments_of_other_types_are_of_another_kind() -> None:
    array = np.zeros((3, 4))
    held = array.copy()
    held.flags.writeable = False
    apart = [
        1, 1.0, True, None, np.float32(1), np.uint8(1), np.uint16(1), (1, 2), (1, 2.0), (1, (2,)), (1, 2, 3),
        array, array.T, array[:, ::2], array[0], held, array.astype("f4"), array.astype("u2"), array.astype("i8"),
        array.astype(">f8"),
    ]  # fmt: skip
    kinds = [machine_code.kind((value,)) for value in apart]
    assert None not in kinds
    assert len(set(kinds)) == len(apart)
    assert machine_code.kind((1, 2)) != machine_code.kind(((1, 2),))
    for unknown in (1 << 63, "text", [1], 1j, (1, "text")):
        assert machine_code.kind((unknown,)) is None
