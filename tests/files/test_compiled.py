"""numba's caches: where none can be written, kernels are compiled in memory, and that is said once."""

import itertools
import os
import pickle
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.folders import cache_folder
from ortho_pipeline.runtime.compilation import cache_folders
from ortho_pipeline.stores import local_cache

KERNELS = [
    path
    for path in sorted((Path(__file__).parents[2] / "ortho_pipeline").rglob("*.py"))
    if "@compiled" in path.read_text(encoding="utf-8")
]
SCENE = Path(__file__).parents[2] / "sample_data/ikonos/po_39001_pan_0000000.tif"
#: Nothing can be kept below a file.
NOWHERE = {"NUMBA_CACHE_DIR": os.fspath(Path(__file__))}
ONE = """
from ortho_pipeline.runtime.compiled import compiled
@compiled
def double(x):
    return 2 * x
"""
#: Hits of the cache are told by numba.
TOLD = "import numba; from one import double; print(double(21), sum(double.stats.cache_hits.values()))"


def run(code: str, folder: Path | None = None, **surroundings: str) -> subprocess.CompletedProcess[str]:
    """Run Python, which finds modules in a folder; where nothing else is said, no kernel can be kept."""
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **(surroundings or NOWHERE)}
    code = f"import sys; sys.path.insert(0, {str(folder)!r})\n{code}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)


def cached(folder: Path, code: str = TOLD, **surroundings: str) -> str:
    """Return what Python prints that keeps kernels in ``cache`` below a folder of its modules."""
    done = run(code, folder, NUMBA_CACHE_DIR=str(folder / "cache"), **surroundings)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_a_command_runs_where_no_cache_can_be_written() -> None:
    done = run(
        f"sys.argv = ['ortho', 'info', {str(SCENE)!r}]\n"
        "from ortho_pipeline.runtime import compiled\n"
        "from ortho_pipeline.models import rpc_kernel\n"
        "from ortho_pipeline.models.pushbroom import kernel as pushbroom_kernel\n"
        "compiled.compiled(lambda number: number + 1)(1)\n"
        "compiled.compiled(lambda number: number + 2)(1)\n"
        "from ortho_pipeline.cli.program import main\n"
        "main()"
    )
    assert done.returncode == 0, done.stderr
    (notice,) = [line for line in done.stderr.splitlines() if "compiled" in line.lower()]
    assert "NUMBA_CACHE_DIR" in notice
    assert "nobody else can write" in notice


def test_every_kernel_is_made_without_a_cache_and_computes_the_same() -> None:
    done = run(
        "import numpy as np\n"
        "from ortho_pipeline.warp import tile_kernel\n"
        "from ortho_pipeline.warp import lattice_kernel\n"
        "from ortho_pipeline.surface import ray_kernel\n"
        "out = np.empty((1, 1))\n"
        "dem = tile_kernel.DemWindow(np.array([[0.0, 4.0], [8.0, 12.0]]), 0, 0, False)\n"
        "tile_kernel.heights_at(np.array([[[0.5, 0.25]]]), dem, out)\n"
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
        "kernel.projected(points, *tables, limits, np.ones((9, 2)), np.ones((9, 2, 3)))\n"
        "kernel.image_to_ground(np.ones((9, 2)), heights, *tables, limits, 1e-9, 1e-5, 25, points)\n"
        "for one in (kernel.project, kernel.projected, kernel.image_to_ground):\n"
        "    print(''.join(one.inspect_asm().values()).count('divpd'))\n"
    )
    projecting, partials, inverse = map(int, done.stdout.split())
    assert projecting >= 2
    assert partials >= 4
    assert inverse >= 5


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
    made = "from ortho_pipeline.runtime.compiled import compiled, inlined\n"
    below = made + "@inlined\ndef step(x):\n    return x + {}\n"
    between = made + "from below import step\n@compiled\ndef twice(x):\n    return step(step(x))\n"
    above = made + "from between import twice\n@compiled\ndef run(x):\n    return twice(x)\n"
    (tmp_path / "between.py").write_text(between)
    (tmp_path / "above.py").write_text(above)
    found = []
    for added in (1, 1, 20):
        (tmp_path / "below.py").write_text(below.format(added))
        code = "import numba; from above import run; print(run(0), sum(run.stats.cache_hits.values()))"
        found.append(cached(tmp_path, code))
    assert found == ["2 0\n", "2 1\n", "40 0\n"]


def test_kernels_of_a_version_whose_types_are_gone_are_compiled_anew(tmp_path: Path) -> None:
    """An index names the types of arguments; numba could not read one that names a type which was renamed."""
    text = (
        "from typing import NamedTuple\nfrom ortho_pipeline.runtime.compiled import compiled\n"
        "class {0}(NamedTuple):\n    x: int\n@compiled\ndef double(record):\n    return 2 * record.x\n"
    )
    found = []
    for name in ("Before", "Before", "After"):
        (tmp_path / "typed.py").write_text(text.format(name))
        code = f"from typed import {name}, double; print(double({name}(21)), sum(double.stats.cache_hits.values()))"
        found.append(cached(tmp_path, code))
    assert found == ["42 0\n", "42 1\n", "42 0\n"]


def test_code_that_another_process_kept_for_other_types_is_not_taken(tmp_path: Path) -> None:
    """Two processes that compile a kernel for two types at once may name one file for both; -1 was returned."""
    (tmp_path / "one.py").write_text(ONE.replace("2 * x", "int(x[0])"))
    code = f"""
import numpy as np
from pathlib import Path
from one import double
from ortho_pipeline.runtime.compiled import compiled
again = lambda value, kind: compiled(double.py_func)(np.array([value], kind))  # as in another process
print(again(-1, 'i2'))
folder = Path({str(tmp_path / "cache")!r})
(file,) = folder.glob('*/*.nbc')
signed = file.read_bytes()
print(again(65535, 'u2'))
[file.write_bytes(signed) for file in folder.glob('*/*.nbc')]
print(again(65535, 'u2'))
"""
    assert cached(tmp_path, code).split() == ["-1", "65535", "65535"]


def test_a_cache_that_is_damaged_or_whose_disk_is_full_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text(ONE)
    code = f"""
import resource
from pathlib import Path
from one import double
from ortho_pipeline.runtime.compiled import compiled
again = lambda value: compiled(double.py_func)(value)  # as in another process
print(again(1))
for ending in ('nbi', 'nbc'):
    (file,) = Path({str(tmp_path / "cache")!r}).glob('*/*.' + ending)
    whole = file.read_bytes()
    for size in (0, len(whole) // 2):
        file.write_bytes(whole[:size])
        print(again(2), file.stat().st_size == len(whole))
resource.setrlimit(resource.RLIMIT_FSIZE, (9, 9))
print(again(2.5))
print(again(2.5j))
"""
    told = cached(tmp_path, code)
    assert told.count("4 True\n") == 4, told
    assert "5.0\n5j\n" in told
    assert told.count("cannot be written (File too large)") == 1


def test_every_kernel_keeps_its_own_code_whatever_its_module_is_called(tmp_path: Path) -> None:
    """Files lie next to each other, and kernels of two rooms have the same module and name."""
    for room, factor in (("near", 2), ("far", 3)):
        (tmp_path / room).mkdir()
        (tmp_path / room / "one.py").write_text(ONE.replace("2 * x", f"{factor} * x"))
    code = "from near.one import double as first; from far.one import double as second; print(first(1), second(1))"
    assert cached(tmp_path, code) == "2 3\n"
    assert len(list((tmp_path / "cache").glob("*/*.nbi"))) == 2


def test_threads_that_call_a_kernel_first_compile_it_once(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text(ONE)
    code = (
        "from concurrent.futures import ThreadPoolExecutor; from one import double\n"
        "with ThreadPoolExecutor(8) as pool: print(sum(pool.map(double, range(1000))), len(double.signatures))"
    )
    assert cached(tmp_path, code) == "999000 1\n"


# -- whose code is taken -----------------------------------------------------------------------------------------------


class Planted:
    """Runs a program when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def plant(folder: Path, mark: Path) -> None:
    """Replace what is kept in a folder by what makes a folder `mark` when it is loaded."""
    for path in folder.iterdir():
        path.write_bytes(pickle.dumps(Planted(mark)))


def test_settings_of_numba_in_the_working_folder_end_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They could name a folder of kernels, or modules that are imported."""
    (tmp_path / "one.py").write_text(ONE)
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: cache\nopt: 0\n")
    monkeypatch.chdir(tmp_path)
    done = run("from one import double; double(1)", tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert "InputError" in done.stderr
    assert f"{tmp_path}/.numba_config.yaml" in done.stderr
    assert not (tmp_path / "cache").exists()
    assert run("from one import double; print('numba' in sys.modules)", tmp_path).stdout == "False\n"


@pytest.mark.parametrize(
    "surroundings",
    [
        {"XDG_CACHE_HOME": "caches", "HOME": "~"},
        {"XDG_CACHE_HOME": "", "HOME": "~"},  # as without a home and an entry in passwd
        {"XDG_CACHE_HOME": "", "HOME": "."},
        {"NUMBA_CACHE_DIR": "kernels", "HOME": "~"},
    ],
)
def test_no_folder_of_caches_is_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, surroundings: dict[str, str]
) -> None:
    for name in ("NUMBA_CACHE_DIR", "ORTHO_CACHE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in surroundings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)
    cache_folders.own.cache_clear()
    assert cache_folder() is None
    assert cache_folders.own()[0] is None
    assert "NUMBA_CACHE_DIR" in cache_folders.own()[1]
    with pytest.raises(InputError, match="ORTHO_CACHE"):
        local_cache.folder()
    assert list(tmp_path.iterdir()) == []
    cache_folders.own.cache_clear()


def others(how: str, folder: Path) -> None:
    """Let others write to a folder, in one of the ways in which that happens."""
    match how:
        case "folder":
            folder.chmod(0o777)
        case "sticky folder":
            folder.chmod(0o1777)
        case "group":
            folder.chmod(0o770)
        case "file":
            folder.chmod(0o755)
            for path in folder.iterdir():
                path.chmod(0o666)
        case "folder above":
            folder.parent.chmod(0o777)
        case "link":
            for path in folder.iterdir():
                path.rename(path.with_suffix(".moved"))
                path.symlink_to(path.with_suffix(".moved"))
        case "owner of files":
            for path in folder.iterdir():
                os.chown(path, 4321, -1)
        case "owner of the folder":
            os.chown(folder, 4321, -1)


@pytest.mark.parametrize(
    "how",
    ["folder", "sticky folder", "group", "file", "folder above", "link", "owner of files", "owner of the folder"],
)
def test_folders_to_which_others_can_write_are_known(tmp_path: Path, how: str) -> None:
    if how.startswith("owner") and os.geteuid():
        pytest.skip("only root can give files to somebody else")
    folder = tmp_path / "cache" / "kernels"
    folder.mkdir(parents=True, mode=0o700)
    (folder / "one.nbi").write_bytes(b"")
    assert cache_folders.fault_of(folder, os.geteuid()) == ""
    others(how, folder)
    assert "others can write to" in cache_folders.fault_of(folder, os.geteuid())


def test_kernels_to_which_others_can_write_are_not_loaded(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text(ONE)
    assert cached(tmp_path) == "42 0\n"
    (folder,) = (tmp_path / "cache").iterdir()
    plant(folder, tmp_path / "loaded")
    others("file", folder)
    before = sorted(folder.iterdir())
    told = cached(tmp_path)
    assert told.startswith("42 0\n")
    assert "others can write to" in told
    assert not (tmp_path / "loaded").exists()
    assert sorted(folder.iterdir()) == before


def test_a_folder_for_all_has_one_folder_for_each_user(tmp_path: Path) -> None:
    """As /tmp: nobody can rename or remove what is another's."""
    (tmp_path / "one.py").write_text(ONE)
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(0o1777)
    assert cached(tmp_path) == "42 0\n"
    (folder,) = (tmp_path / "cache").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert cache_folders.fault_of(folder, os.geteuid()) == ""


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can compile for others")
def test_what_root_has_compiled_is_read_by_others_and_what_they_compile_is_not_kept_there(tmp_path: Path) -> None:
    """As in an image of a container that is run by another user, or whose files are read-only: no need to compile."""
    # The folders of pytest, and of its workers, are for their owner alone.
    own = itertools.takewhile(lambda folder: folder.name.startswith(("pytest-", "popen-")), tmp_path.parents)
    for above in (tmp_path, *own):
        above.chmod(0o755)
    (tmp_path / "one.py").write_text(ONE)
    assert cached(tmp_path) == "42 0\n"
    (folder,) = (tmp_path / "cache").iterdir()
    folder.chmod(0o755)
    # Modules are loaded, and numba is ready to compile, while Python's files can be read.
    another = f"import os, numba; numba.njit(lambda x: x)(1); from one import double; os.setuid(4321)\n{TOLD}"
    told = cached(tmp_path, another + "; print(double(0.5), sum(double.stats.cache_hits.values()))")
    assert told.startswith("42 1\n1.0 1\n")
    assert "not cached" in told
    assert len(list(folder.iterdir())) == 2
    folder.chmod(0o777)  # open to others, it is left alone
    assert cached(tmp_path, another).startswith("42 0\n")
