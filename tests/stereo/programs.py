"""Environments of the real stereo programs, from the package index: ``python tests/stereo/programs.py`` makes them.

They are in the folder of the variable ORTHO_STEREO_PROGRAMS, by default in the user's cache. Tests of programs that
are not there are skipped. CARS needs Python 3.10 to 3.12.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(
    os.environ.get("ORTHO_STEREO_PROGRAMS", Path.home() / ".cache" / "ortho-pipeline-tests" / "stereo-programs")
)
#: Each environment, with what is installed in it.
PACKAGES = {"readers": ("rpcm", "shareloc"), "cars": ("cars==1.3.*",)}


def executable(environment: str, name: str = "python") -> Path:
    """Return a program of an environment; skip the test if that is not there."""
    path = FOLDER / environment / "bin" / name
    if not path.exists():
        pytest.skip(f"{', '.join(PACKAGES[environment])} is not installed (python tests/stereo/programs.py)")
    return path


def answer(environment: str, script: str, request: Any) -> Any:
    """Run a script in an environment; it gets `request`, and its `answer` is returned, both as JSON."""
    code = f"import json, sys\nrequest = json.load(sys.stdin)\n{script}\nprint('ANSWER', json.dumps(answer))"
    done = subprocess.run(
        [executable(environment), "-c", code], input=json.dumps(request), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.rpartition("ANSWER ")[2])


if __name__ == "__main__":
    for name, packages in PACKAGES.items():
        if not (FOLDER / name).exists():
            subprocess.run([sys.executable, "-m", "venv", FOLDER / name], check=True)
        subprocess.run([FOLDER / name / "bin" / "pip", "install", "--quiet", *packages], check=True)
        print(FOLDER / name)
