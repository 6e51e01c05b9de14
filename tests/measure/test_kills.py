"""The real server, killed at random moments while a client acts: no more than the action under way is lost."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib import error, request

import pytest

pytest.importorskip("uvicorn", reason="the extra 'measure' is not installed")

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
WINDOW = "window-of-tests"


def started(output: Path, reference: Path, *images: Path) -> tuple[subprocess.Popen[str], Callable[..., dict]]:
    """Start the server, and return it with what asks it as the page does."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ortho_pipeline", "measure", str(SAMPLE / "scene.tif"), *map(str, images),
         "--reference", str(reference), "--dem", str(SAMPLE / "dem.tif"), "-o", str(output), "--no-browser"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    address = process.stdout.readline().split()[-1]
    browser = request.build_opener(request.HTTPCookieProcessor())
    browser.open(address, timeout=60).close()

    def ask(what: str, **given: object) -> dict:
        body = json.dumps({"window": WINDOW, **given}).encode()
        asked = request.Request(f"{address.split('?')[0]}api/{what}", body, {"content-type": "application/json"})
        with browser.open(asked, timeout=60) as answer:
            return json.loads(answer.read())

    return process, ask


def put(number: int) -> dict:
    place = [100.0 + 37 * number % 800, 120.0 + 53 * number % 760]
    mark = {"id": f"P{number}", "image": place, "ground": [33.35 + 1e-5 * number, 37.25, 900.0], "role": "control"}
    return {"do": "put", "mark": {**mark, "how": "manual", "ground_from": "typed"}}


def tie(number: int) -> dict:
    """Return a point of two images, whose models know nothing of each other's clicks."""
    place = [100.0 + 37 * number % 800, 120.0 + 53 * number % 760]
    rays = {"scene": {"image": place}, "second": {"image": [place[0] + 3.0, place[1] - 5.0]}}
    return {"do": "put", "mark": {"id": f"P{number}", "role": "tie", "rays": rays}}


def check_kills(
    folder: Path, reference: Path, count: int, *images: Path, action: Callable[[int], dict] = put
) -> None:  # fmt: skip
    chosen, output, least, most = random.Random(5), folder / "p.geojson", 0, 0
    of_each = 1 + len(images)
    for turn in range(count + 1):
        process, ask = started(output, reference, *images)
        try:
            names = [mark["id"] for mark in ask("begin")["state"]["marks"]]
            assert least <= len(names) <= most, "an action that was answered is lost, or one was made up"
            assert names == [f"P{number}" for number in range(len(names))]
            if output.exists():
                assert len(json.loads(output.read_text())["features"]) <= of_each * len(names)
            if turn == count:
                return
            least = most = len(names)
            threading.Timer(chosen.uniform(0.0, 1.0), process.send_signal, [signal.SIGKILL]).start()
            try:
                while True:
                    most += 1  # sent, and not yet answered
                    ask("act", action=action(most - 1))
                    least += 1
            except (error.URLError, OSError, HTTPException, ValueError):
                pass
        finally:
            process.kill()
            process.wait()
            time.sleep(0.01)


@pytest.mark.slow
def test_killed_fifty_times_no_answered_action_is_lost(reference: Path, tmp_path: Path) -> None:
    check_kills(tmp_path, reference, 50)


@pytest.mark.slow
def test_a_block_killed_fifty_times_loses_no_answered_action(reference: Path, stereo: Any, tmp_path: Path) -> None:
    check_kills(tmp_path, reference, 50, stereo.path, action=tie)
