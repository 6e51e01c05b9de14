"""An error is printed once: not again by the destructor of what GDAL dropped."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
{prepare}

class Dropped:
    # The name of the destructor in GDAL's binding.
    def delete_Dataset(self):
        raise RuntimeError("what is told already")
    __del__ = delete_Dataset

class Other:
    def __del__(self):
        raise RuntimeError("the destructor of something else")

Dropped()
Other()
"""
PREPARE = {
    "worker": "from ortho_pipeline.batch.executors import start_worker; start_worker(1)",
    "command": "from ortho_pipeline.runtime import signals; block = signals.ended_by_signals(); block.__enter__()",
}


@pytest.mark.parametrize("kind", PREPARE)
def test_what_is_told_already_is_not_printed_by_a_destructor(kind):
    code = CODE.format(prepare=PREPARE[kind])
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "the destructor of something else" in done.stderr
    assert "what is told already" not in done.stderr
