"""The attack of `make faults`, reduced: write limits, kills, a full disk, little memory, changed inputs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FAULTS = Path(__file__).parent / "attack" / "faults.py"


@pytest.mark.parametrize(
    "words",
    [
        ("--only", "export rpc-txt", "--limits", "4", "--kills", "5", "--disks", "1", "--memory", "0"),
        pytest.param(
            (
                "--only",
                "rectify STAC",
                "--limits",
                "1",
                "--kills",
                "1",
                "--disks",
                "1",
                "--memory",
                "0",
                "--changes",
                "1",
            ),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_no_fault_leaves_a_broken_or_mixed_set(words):
    counts = [word for name in ("--workers", "--changes") if name not in words for word in (name, "0")]
    # As after nohup and in the background of a shell: the attack has the signals as they are by default nevertheless.
    deaf = ["bash", "-c", 'trap \'\' HUP INT TERM; exec "$0" "$@"', sys.executable, str(FAULTS)]
    done = subprocess.run([*deaf, *words, *counts], check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_no_fault_leaves_a_broken_or_mixed_set_of_any_command():
    words = ("--limits", "40", "--kills", "40", "--workers", "6", "--disks", "20", "--memory", "0", "--changes", "8")
    done = subprocess.run([sys.executable, str(FAULTS), *words], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
