"""Requests that a page with the right cookie could send, mutated: each is answered, and what is stored opens again.

python tests/measure/hostile_requests.py [COUNT] [SEED]
"""

from __future__ import annotations

import copy
import json
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ortho_measure.project import Project
from ortho_measure.serving.entry import PageEntry
from ortho_measure.serving.server import application
from starlette.testclient import TestClient

HOST, WINDOW = "127.0.0.1:4321", "window-of-tests"
#: Values of other kinds, sizes and meanings than a page sends. Texts in <> are written into the JSON as they are.
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 7, 0.5, -0.0, 1e-300, 5e-324, 1e6, 1e8, 1e12, 1e150, 1e200, 1.7e308, -1e200, 900,
    90.0, -90.0, 180.0, 360.0, 2**31 - 1, 2**31, 2**53, 2**63 - 1, 2**63, -(2**63), 10**30, 10**400,
    "", "A", "P0", "P1", "é\u2028", "\ud800", "\x00", "\x1b[2J", "x" * 70, "../../etc/passwd", "file:///etc/passwd",
    "EPSG:4326", "EPSG:32636", "EPSG:3857", "EPSG:2193", "EPSG:5041", "EPSG:4978", "EPSG:999999", "EPSG:5773", "egm96",
    "+proj=longlat", "scene-0", "scene-1", "reference-0", "map-0", "scene-", "control", "check", "tie", "typed",
    "reference", "file", "shift", "affine", "drift", "undo", "begin", [], {}, [[]], [None], [0, 0], [1, 2, 3],
    [1e200, 1e200, 0], [1e-200, 1e-200, 0], [1e-12, 1e12, 0.5], [33.35, 900.0, 900.0], [33.35, 90.0, 900.0],
    [0.0, 0.0, 0.0], {"": 0}, {"scene": {"image": [1.0, 2.0]}}, [0] * 1000,
    {"scene": {"image": [1.0, 2.0]}, "second": {"image": [1.0, 2.0]}}, "<NaN>", "<Infinity>", "<1e999>",
    "<" + "9" * 5000 + ">", "<" + "[" * 3000 + "]" * 3000 + ">",
)  # fmt: skip


class Person:
    """Asks as the page does, and often otherwise.

    Parameters
    ----------
    labels : list of str
        Of the images, if there are several.
    """

    def __init__(self, seed: int, labels: list[str]) -> None:
        self._random, self._labels = random.Random(seed), labels

    def request(self) -> tuple[str, bytes | None]:
        """Return a path, and the body of a POST or None for a GET."""
        chosen = self._random
        if chosen.random() < 0.1:
            return self._tile(), None
        what, given = self._valid()
        given = {"window": WINDOW, **given}
        if chosen.random() < 0.75:
            for _ in range(chosen.choice((1, 1, 1, 2, 4))):
                given = self._mutated(given)
        text = json.dumps(given)
        for value in (one for one in VALUES if isinstance(one, str) and one.startswith("<")):
            text = text.replace(json.dumps(value), value[1:-1])
        data = text.encode()
        if chosen.random() < 0.02:
            place = chosen.randrange(len(data))
            data = data[:place] + bytes([chosen.randrange(256)]) + data[place + 1 :]
        return f"api/{what}", data

    def _place(self) -> list[float]:
        return [self._random.uniform(0, 1000), self._random.uniform(0, 1000)]

    def _ground(self) -> list[float]:
        return [33.35 + self._random.uniform(-0.01, 0.01), 37.25 + self._random.uniform(-0.01, 0.01), 900.0]

    def _measured(self) -> dict[str, Any]:
        known = {"image": self._place(), "how": self._random.choice(("manual", "matched"))}
        kind = self._random.randrange(3)
        return known | ({}, {"sigma_image": 0.4}, {"covariance": [0.1, 0.2, 0.05], "score": 0.9})[kind]

    def _mark(self) -> dict[str, Any]:
        chosen = self._random
        mark: dict[str, Any] = {
            "id": f"P{chosen.randrange(12)}", "ground": self._ground(), "role": chosen.choice(("control", "check")),
            "sigma_xy": 0.3, "sigma_h": 0.5, "sigma_common": 0.0, "group": chosen.choice((None, 0, 1)),
            "off": False, "note": "", "ground_from": chosen.choice(("typed", "reference", "file")),
        }  # fmt: skip
        if not self._labels:
            return mark | self._measured()
        mark["role"] = chosen.choice(("control", "check", "tie"))
        return mark | {"rays": {label: self._measured() for label in self._labels if chosen.random() < 0.8}}

    def _valid(self) -> tuple[str, dict[str, Any]]:
        chosen = self._random
        mark, pane = self._mark(), chosen.choice(("scene-0", "reference-0", "map-0", "scene-1"))
        actions = [
            {"do": "put", "mark": mark}, {"do": "put", "mark": mark}, {"do": "put", "mark": mark, "was": mark["id"]},
            {"do": "remove", "id": mark["id"]}, {"do": "undo"}, {"do": "redo"},
            {"do": "correct", "correction": chosen.choice(("shift", "shift-drift", "affine", "none", None))},
        ]  # fmt: skip
        rare: list[tuple[str, dict[str, Any]]] = [
            ("begin", {"take": False}), ("leave", {}), ("compare", {}), ("save", {}), ("made", {}),
            ("propose", {"image": self._place(), "ground": None}), ("make", {"number": 99}),
            ("tie", {"number": 0, "image": self._place(), "known": dict.fromkeys(self._labels[1:], self._place())}),
            ("tie", {"ground": self._ground()}), ("propose", {"image": None, "ground": self._ground()}),
            ("stretch", {"pane": pane, "bands": [0], "version": 0, "box": [0, 0, 100, 100]}),
        ]  # fmt: skip
        usual: list[tuple[str, dict[str, Any]]] = [
            ("state", {}), ("predict", {"version": 0, "at": pane, "place": self._place()}),
            ("predict", {"version": 0, "ground": self._ground()}),
            ("link", {"version": 0, "at": pane, "to": "map-0", "place": self._place()}),
            ("typed", {"values": self._ground(), "crs": "EPSG:4326", "vertical": None}),
        ]  # fmt: skip
        luck = chosen.random()
        if luck < 0.6:
            return "act", {"action": chosen.choice(actions)}
        return chosen.choice(usual if luck < 0.95 else rare)

    def _mutated(self, document: dict[str, Any]) -> dict[str, Any]:
        changed = copy.deepcopy(document)
        places = [(holder, key) for holder, key in _places(changed) if holder is not changed or key != "window"]
        if not places:
            return {**changed, "action": self._random.choice(VALUES)}
        holder, key = self._random.choice(places)
        luck = self._random.random()
        if luck < 0.1:
            del holder[key]
        elif luck < 0.2 and isinstance(holder, dict):
            holder[self._random.choice(("x", "do", "at", "image", "source", "rays", "mark", "was", "version"))] = (
                self._random.choice(VALUES)
            )
        elif luck < 0.3 and isinstance(holder[key], float):
            holder[key] *= self._random.choice((-1.0, 1e-9, 10.0, 1e5, 1e30))
        else:
            holder[key] = copy.deepcopy(self._random.choice(VALUES))
        return changed

    def _tile(self) -> str:
        chosen = self._random
        parts = ["tiles", chosen.choice(("scene-0", "map-0")), "0", str(2 ** chosen.randrange(8)), "0", "0"]
        query = ["b=0", "l=0,2000"]
        if chosen.random() < 0.7:
            odd = (
                "",
                "-1",
                "1e3",
                "65536",
                "131072",
                "3",
                "9" * 30,
                "9" * 5000,
                "..",
                "%00",
                "%2e%2e",
                "٣",
                "made",
                "nan",
                "²",
            )
            parts[chosen.randrange(len(parts))] = chosen.choice(odd)
        if chosen.random() < 0.4:
            query[chosen.randrange(2)] = chosen.choice(
                (
                    "b=",
                    "b=1,1,1",
                    "b=" + "9" * 5000,
                    "l=",
                    "l=nan,1",
                    "l=1e400,0",
                    "l=0,-1e308",
                    "l=1e-300,0",
                    "b=²",
                    "l=1e12,-1e12",
                    "%ff=%ff",
                )
            )
        return "/".join(parts) + "?" + "&".join(query)


def _places(holder: Any) -> Iterator[tuple[Any, Any]]:
    for key, value in holder.items() if isinstance(holder, dict) else enumerate(holder):
        yield holder, key
        if isinstance(value, dict | list):
            yield from _places(value)


def check(opening: Callable[[], Project], count: int, seed: int, between: int) -> Counter[int]:
    """Send requests to a project, which is opened anew after so many; return how often each status was answered."""
    answered: Counter[int] = Counter()
    session = opening()
    person = Person(seed, list(getattr(getattr(session, "images", None), "labels", ())))
    while True:
        entry = PageEntry()
        with TestClient(
            application(session, entry, {HOST}), base_url=f"http://{HOST}", raise_server_exceptions=False
        ) as client:
            client.get(entry.path)
            for _ in range(min(between, count - answered.total())):
                path, body = person.request()
                before = len(session.journal.actions)
                if body is None:
                    answer = client.get(f"/{entry.folder}/{path}")
                else:
                    answer = client.post(f"/{entry.folder}/{path}", content=body)
                answered[answer.status_code] += 1
                if path == "api/leave":  # a page that is loaded again
                    client.post(f"/{entry.folder}/api/begin", json={"window": WINDOW})
                assert answer.status_code < 500, (path, None if body is None else body[:600])
                stored = len(session.journal.actions) - before
                assert stored == (path == "api/act" and answer.status_code == 200), (path, body, answer.text[:600])
        marks, now = session.marks, session.state()["marks"]
        session.close()
        session = opening()
        assert session.marks == marks
        assert [mark["id"] for mark in session.state()["marks"]] == [mark["id"] for mark in now]
        if answered.total() >= count:
            session.close()
            return answered


if __name__ == "__main__":
    from conftest import opened_projects

    with tempfile.TemporaryDirectory() as place:
        many, first = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000, int(sys.argv[2]) if len(sys.argv) > 2 else 1
        for number, project in enumerate(opened_projects(Path(place))):
            print(dict(sorted(check(project, many // 2, first + number, 500).items())), flush=True)
