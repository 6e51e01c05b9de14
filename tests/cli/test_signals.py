"""Signals end a command whatever it is doing: in a destructor, whose exceptions Python drops, and after its end."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

LOST = """
import os, sys, time
from ortho_pipeline.runtime.signals import ended_by_signals

class Dying:
    def __del__(self):
        os.kill(os.getpid(), int(sys.argv[1]))
        time.sleep(0)

with ended_by_signals():
    try:
        Dying()
        time.sleep(30)
    except BaseException as end:
        print(type(end).__name__)
"""
AFTER = """
import os, sys, time
from ortho_pipeline.runtime.signals import ended_by_signals
with ended_by_signals():
    pass
os.kill(os.getpid(), int(sys.argv[1]))
time.sleep(30)
"""


def run(code, number):
    return subprocess.run(
        [sys.executable, "-c", code, str(int(number))], check=False, capture_output=True, text=True, timeout=25
    )


@pytest.mark.parametrize(
    ("number", "end"),
    [(signal.SIGINT, "KeyboardInterrupt"), (signal.SIGTERM, "Terminated"), (signal.SIGHUP, "Terminated")],
)
def test_a_signal_within_a_destructor_is_not_lost(number, end):
    done = run(LOST, number)
    assert (done.stdout, done.stderr) == (f"{end}\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_command_ends_it_without_a_traceback(number):
    done = run(AFTER, number)
    assert (done.returncode, done.stderr) == (-number, "")
