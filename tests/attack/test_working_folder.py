"""Deliveries with code and settings of every imported library: `cd delivery; ortho …` opens none of them.

What is opened, executed and connected to is told by the system (strace), not by this package.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import hostile
import pytest
from deliveries import DELIVERIES, URL
from deliveries import deliver as deliver_data

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
    "numba's caches": {"__pycache__/tile_kernel.warp_block-1.py311.nbi": "cos\nsystem\n(S'touch EXECUTED'\ntR."},
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
    "GDAL's settings of a folder": {".gdalrc": "[configoptions]\n", "gdal.conf": "", "gdal_data/gdalvrt.xsd": ""},
    "PROJ's grids": {"egm96_15.gtx": "", "us_nga_egm96_15.tif": "", "conus": "", "null": "", "proj_data/proj.db": ""},
    "fsspec": {".config/fsspec/conf.json": "{}", "fsspec.json": "{}"},
    "stores": {".aws/sso/cache/a.json": "{}", ".azure/config": "", ".config/gcloud/credentials.db": "", ".s3cfg": ""},
    "certificates": {".pki/nssdb/cert9.db": "", "cert.pem": "", "ca-bundle.crt": "", ".curlrc": "insecure\n"},
    "environment files": {".env": "GDAL_DRIVER_PATH=.\nPYTHONSTARTUP=evil.py\n", ".envrc": "touch EXECUTED\n"},
    "projects of Python": {
        "setup.cfg": "[options]\n",
        "setup.py": _CODE,
        "pyproject.toml": "[tool.x]\n",
        "tox.ini": "",
    },
    "tests": {"conftest.py": _CODE, "pytest.ini": "[pytest]\n", "mypy.ini": "", "ruff.toml": ""},
    "distributions": {
        "ortho_pipeline-9.dist-info/entry_points.txt": "[ortho_pipeline]\nevil = evil\n",
        "ortho_pipeline-9.dist-info/METADATA": "Name: ortho-pipeline\nVersion: 9\n",
        "evil.egg-info/entry_points.txt": "[ortho_pipeline]\nevil = evil\n",
        "evil.egg-link": ".",
    },
    "pluggy": {"pluggy.py": _CODE, "plugins/evil.py": _CODE, "hooks.py": _CODE},
    "rasters of others": {"rasterio.py": _CODE, "odc/__init__.py": _CODE, ".rasterio": "", "rioxarray.py": _CODE},
    "servers": {"aiohttp.py": _CODE, "starlette.py": _CODE, "uvicorn.py": _CODE, "logging.ini": "[loggers]\n"},
    "pages": {"jinja2/__init__.py": _CODE, "templates/report.html.j2": "{{ evil }}", "report.html.j2": "{{ evil }}"},
    "readers": {"rich.py": _CODE, "click.py": _CODE, "pydantic/__init__.py": _CODE, "pystac.py": _CODE},
    "sqlite": {".sqliterc": ".shell touch EXECUTED\n", "spatialite.so": "", "mod_spatialite.so": ""},
    "interpreters": {".python-version": "3.6\n", "python311.zip": "", "python311._pth": ".\n", "__init__.py": _CODE},
    "start-up files": {".pythonrc.py": _CODE, ".pythonstartup": _CODE, ".pdbrc": "import os\n", ".inputrc": ""},
    "threads": {"libgomp.so.1": "", "libopenblas.so": "", "libtbb.so.12": "", ".numba_config": ""},
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


#: Runs commands in one process, each in a folder of its own; says how each ended.
_COMMANDS = """
import json, os, sys
from ortho_pipeline.cli import program
for folder, words in json.loads(open(sys.argv[1]).read()):
    os.chdir(folder)
    sys.argv = ["ortho", *words]
    sys.stderr.write(f"== {folder} {words}\\n")
    try:
        program.main()
        code = 0
    except SystemExit as end:
        code = end.code
    assert code in (0, 1, 2, 3), (folder, words, code)
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace, which tells what is opened, is not on this machine")
@pytest.mark.parametrize("kind", ["data", "rasters"])
def test_no_data_of_a_delivery_lead_elsewhere(tmp_path: Path, sample: Path, kind: str) -> None:
    """Neither what its texts name, nor what lies next to the delivery, is opened; nothing is run, nobody asked."""
    place = tmp_path / "place"
    place.mkdir()
    secret = hostile.raster(place / "secret.tif", hostile.SECRET)
    shutil.copy(sample / "scene_RPC.TXT", place / "secret.tif_RPC.TXT")
    shutil.copy(sample / "gcps.csv", place / "secret.csv")

    def copy(folder: Path) -> None:
        for name in ("scene.tif", "scene_RPC.TXT", "dem.tif"):
            shutil.copy(sample / name, folder)

    if kind == "data":
        jobs = [
            (place / str(number), deliver_data(place / str(number), name, secret, copy))
            for number, name in enumerate(DELIVERIES)
        ]
    else:
        made = hostile.write(place / "rasters", secret, URL)
        jobs = [(place / "rasters" / name, ("info", str(file))) for name, file in made.items()]
        assert len(jobs) + len(DELIVERIES) + len(PLANTED) >= 60
    list_of_jobs, script, log = tmp_path / "jobs.json", tmp_path / "commands.py", tmp_path / "log"
    list_of_jobs.write_text(json.dumps([(str(folder), words) for folder, words in jobs]))
    script.write_text(_COMMANDS)
    home = tmp_path / "home"
    home.mkdir()
    done = subprocess.run(
        ["strace", "-f", "-qq", "-s", "300", "-e",
         "trace=open,openat,openat2,chdir,execve,connect,sendto,sendmmsg", "-o", str(log),
         sys.executable, "-P", str(script), str(list_of_jobs)],
        cwd=tmp_path, env={**os.environ, "HOME": str(home)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Traceback" not in done.stderr
    assert "bug in ortho-pipeline" not in done.stderr
    assert "Unknown" not in done.stderr  # every command reads what it is given
    assert not re.search(r"(connect|sendto|sendmmsg)\(.*AF_INET", log.read_text(errors="replace"))
    assert outside(log, place, tmp_path) == []
    assert not list(place.rglob("EXECUTED"))


def outside(log: Path, place: Path, start: Path) -> list[str]:
    """Return what was opened of the deliveries' surroundings by a command of another folder, and what was run."""
    found, here = [], start
    for line in log.read_text(errors="replace").splitlines():
        if entered := re.search(r'chdir\("([^"]+)"\) = 0', line):
            here = Path(entered[1])
        elif opened := re.search(r'open(?:at2?)?\((?:AT_FDCWD, )?"([^"]+)".* = \d', line):
            path = (here / opened[1]).resolve()  # where a link leads
            if place in path.parents and here != path and here not in path.parents:
                found.append(f"{here.name}: {path}")
        elif "execve(" in line and " = 0" in line and "python" not in line:
            found.append(line)
    return found


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
