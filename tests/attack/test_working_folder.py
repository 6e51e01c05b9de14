"""Deliveries with code and settings of every imported library: `cd delivery; ortho …` opens none of them.

What is opened, executed and connected to is told by the system (strace), not by this package.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ORTHO = Path(sys.executable).parent / "ortho"
#: Writes a file when it is run, if anything runs it.
_CODE = "open('EXECUTED', 'a').write(__file__)\n"
_HOME = "~"
#: Kind of delivery -> the files in it that nothing may open. A row is all that another kind needs.
PLANTED: dict[str, dict[str, str]] = {
    "sitecustomize": {"sitecustomize.py": _CODE},
    "usercustomize": {"usercustomize.py": _CODE},
    "modules of Python": {f"{name}.py": _CODE for name in ("pickle", "json", "threading", "socket", "signal", "runpy")},
    "spawned processes": {"multiprocessing/__init__.py": _CODE, "multiprocessing/spawn.py": _CODE},
    "libraries": {f"{name}.py": _CODE for name in ("numpy", "scipy", "numba", "yaml", "pyproj", "shapely", "dask")},
    "bindings of GDAL": {"osgeo/__init__.py": _CODE, "gdal.py": _CODE, "_gdal.py": _CODE},
    "this package": {"ortho_pipeline/__init__.py": _CODE, "ortho_pipeline/cli/__init__.py": _CODE},
    "plugins": {"evil-1.0.dist-info/entry_points.txt": "[ortho_pipeline]\nevil = evil\n", "evil.py": _CODE},
    "path files": {"evil.pth": "import os; open('EXECUTED', 'a')\n", "pyvenv.cfg": "home = .\n"},
    "numba's caches": {"__pycache__/block_kernel.warp_block-1.py311.nbi": "cos\nsystem\n(S'touch EXECUTED'\ntR."},
    "matplotlib": {"matplotlibrc": "backend: module://evil\n", ".config/matplotlib/matplotlibrc": "backend: agg\n"},
    "dask": {".config/dask/evil.yaml": "distributed: {worker: {preload: evil.py}}\n", "dask.yaml": "a: 1\n"},
    "pip": {"pip.conf": "[global]\nindex-url = http://127.0.0.1:1/\n", ".config/pip/pip.conf": "[global]\n"},
    "GDAL's settings": {"gdalrc": "[configoptions]\n", ".gdal/gdalrc": "[configoptions]\nCPL_DEBUG=ON\n"},
    "GDAL's plugins": {"gdalplugins/gdal_evil.so": "", "gdal_evil.so": "", "gdalplugins/drivers.ini": "[order]\n"},
    "GDAL's drivers in Python": {"gdal_evil.py": '# gdal: DRIVER_NAME = "EVIL"\n' + _CODE},
    "GDAL's tables": {"gdalvrt.xsd": "", "stateplane.csv": "", "esri_extra.wkt": "", "cubewerx_extra.wkt": ""},
    "PROJ": {"proj.ini": "[general]\nnetwork = on\n", "proj.db": "", "proj/proj.ini": "[general]\nnetwork = on\n"},
    "PROJ's folder of the user": {".local/share/proj/proj.ini": "[general]\n", ".local/share/proj/proj.db": ""},
    "credentials": {".aws/credentials": "[default]\n", ".aws/config": "[default]\n", ".netrc": "", ".boto": ""},
    "shells": {".bashrc": "touch EXECUTED\n", ".profile": "touch EXECUTED\n", "uname": "#!/bin/sh\ntouch EXECUTED\n"},
    "libraries of the system": {"libgdal.so": "", "libproj.so": "", "libc.so.6": "", "libm.so.6": ""},
    "a home in the delivery": {
        f"{_HOME}/.gdal/gdalrc": "[configoptions]\n",
        f"{_HOME}/.local/share/proj/proj.ini": "[general]\nnetwork = on\n",
        f"{_HOME}/.config/dask/evil.yaml": "a: 1\n",
        f"{_HOME}/.cache/ortho-pipeline/kernels-0/one.nbi": "cos\nsystem\n(S'touch EXECUTED'\ntR.",
    },
}
COMMANDS: dict[str, list[str]] = {
    "info": ["info", "scene.tif"],
    "fit": ["fit", "scene.tif", "--gcps", "gcps.geojson"],
    "rectify": ["rectify", "scene.tif", "--height", "800", "-o", "out", "-tr", "40"],
}
#: Without a home, Python's own look at the user's packages comes before any of ours: docs in SECURITY.md.
SURROUNDINGS = {"a home": {}, "no home": {"HOME": _HOME, "XDG_CACHE_HOME": "caches", "XDG_DATA_HOME": ".local/share"}}


def deliver(folder: Path, sample: Path) -> Path:
    """Make a delivery of a scene and of all that is planted."""
    folder.mkdir()
    for name in ("scene.tif", "scene_RPC.TXT", "gcps.geojson", "dem.tif"):
        shutil.copy(sample / name, folder)
    for files in PLANTED.values():
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
    return folder


def traced(words: list[str], folder: Path, log: Path, **surroundings: str) -> str:
    """Return what the system is asked for by `ortho` and its processes; it has to succeed."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA_", "XDG_", "PYTHON"))}
    done = subprocess.run(
        ["strace", "-f", "-qq", "-s", "300", "-e", "trace=open,openat,execve,connect,sendto", "-o", str(log),
         str(ORTHO), *words],
        cwd=folder, env={**environment, **surroundings}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return log.read_text(errors="replace")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace, which tells what is opened, is not on this machine")
@pytest.mark.parametrize("surroundings", SURROUNDINGS)
@pytest.mark.parametrize("command", ["info", "fit", "rectify"])
def test_nothing_that_is_planted_in_a_delivery_is_opened(
    tmp_path: Path, sample: Path, command: str, surroundings: str
) -> None:
    folder = deliver(tmp_path / "delivery", sample)
    before = {path for path in folder.rglob("*") if path.is_file()}
    log = traced(COMMANDS[command], folder, tmp_path / "log", **SURROUNDINGS[surroundings])
    opened = {os.path.normpath(folder / name) for name in re.findall(r'open(?:at)?\((?:AT_FDCWD, )?"([^"]+)"', log)}
    planted = {str(folder / name): kind for kind, files in PLANTED.items() for name in files}
    assert {name: kind for name, kind in planted.items() if name in opened} == {}
    assert not (folder / "EXECUTED").exists()
    made = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file() and path not in before}
    assert {path for path in made if path.parts[0] != "out"} == set()
    programs = re.findall(r'execve\("([^"]+)"', log)
    assert all(Path(program).name == "ortho" or "python" in program for program in programs), programs
    assert not re.search(r"(connect|sendto)\(.*AF_INET", log)


def test_child_processes_and_libraries_take_nothing_from_the_working_folder(tmp_path: Path) -> None:
    """A child that multiprocessing spawns looked for modules in the working folder first."""
    delivery, script = tmp_path / "delivery", tmp_path / "script.py"
    (delivery / "multiprocessing").mkdir(parents=True)
    (delivery / "multiprocessing" / "__init__.py").write_text(_CODE)
    script.write_text(
        "import os; from ortho_pipeline.files.folders import ignore_working_folder\n"
        "if __name__ == '__main__':\n"
        "    ignore_working_folder()\n"
        "    import multiprocessing as m; p = m.get_context('spawn').Process(target=print, args=('spawned',))\n"
        "    p.start(); p.join(); print(p.exitcode, os.environ['HOME'], 'XDG_DATA_HOME' in os.environ)\n"
    )
    surroundings = {**os.environ, "HOME": _HOME, "XDG_DATA_HOME": "data"}
    surroundings.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(
        [sys.executable, str(script)], cwd=delivery, env=surroundings, capture_output=True, text=True, check=False
    )
    assert done.stdout == "spawned\n0 /nonexistent False\n", done.stderr
    assert not (delivery / "EXECUTED").exists()
