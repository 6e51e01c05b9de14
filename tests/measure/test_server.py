"""The server: what is refused, and that nothing of this machine is opened by what a request says."""

from __future__ import annotations

import contextlib
import json
import socket
import time
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ortho_measure.project import Project
from ortho_measure.session import open_session

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions

pytest.importorskip("starlette", reason="the extra 'measure' is not installed")
from ortho_measure.serving.entry import PageEntry
from ortho_measure.serving.guard import MAX_BODY, REPORT_POLICY
from ortho_measure.serving.server import PAGE, application, serve
from starlette.testclient import TestClient

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
FOLDER, HOST, WINDOW = "a-folder-of-tests", "127.0.0.1:4321", "window-one"


@contextlib.contextmanager
def entered(session: Project) -> Iterator[TestClient]:
    """Give a client that has the cookie."""
    entry = PageEntry(FOLDER)
    with TestClient(application(session, entry, {HOST}), base_url=f"http://{HOST}") as client:
        assert client.get(entry.path).status_code == 200
        yield client


@pytest.fixture(scope="module")
def client(reference: Path, tmp_path_factory: pytest.TempPathFactory):
    session = open_session(
        SAMPLE / "scene.tif", tmp_path_factory.mktemp("measure") / "p.geojson",
        surface=SurfaceOptions(dem=SAMPLE / "dem.tif"), match=MatchOptions(reference=(str(reference),)),
    )  # fmt: skip
    with entered(session) as found:
        yield found
    session.close()


def test_the_page_and_its_parts_are_given_with_a_strict_policy(client: TestClient) -> None:
    for name in ("", *PAGE):
        answer = client.get(f"/{FOLDER}/{name}")
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in answer.headers
    assert "http" not in client.get(f"/{FOLDER}/").text.replace("http-equiv", "")


def test_a_port_in_use_is_named() -> None:
    never: Any = None
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of this machine cannot be used") as refused:
            serve(never, SceneOptions(), never, port)
    assert refused.value.field == "port"


@pytest.mark.parametrize("path", ["/", "/wrong/", "/wrong/api/state", f"/{FOLDER}", f"/{FOLDER}x/", f"//{FOLDER}/"])
def test_nothing_is_answered_at_other_places(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404
    assert client.post(path, json={}).status_code == 404


def test_nothing_is_answered_without_the_cookie(client: TestClient) -> None:
    own = client.cookies
    client.cookies = {}
    try:
        paths = ["", "?key=", "?key=x", "app.js", "api/state", "made/report", "tiles/scene-0/0/2/0/1?b=0&l=0,2000"]
        for cookie in ("", "ortho_measure=", "ortho_measure=x; other=1", "x=ortho_measure"):
            for path in paths:
                assert client.get(f"/{FOLDER}/{path}", headers={"cookie": cookie}).status_code == 403
            assert client.post(f"/{FOLDER}/api/state", json={}, headers={"cookie": cookie}).status_code == 403
    finally:
        client.cookies = own
    assert client.get(f"/{FOLDER}/").status_code == 200


def test_an_address_lets_one_browser_in_and_that_one_again() -> None:
    entry = PageEntry()
    path, other = entry.path, PageEntry()
    query = path.split("?")[1].encode()
    assert entry.exchange(other.path.split("?")[1].encode()) is None
    cookie = entry.exchange(query)
    assert cookie is not None
    assert entry.exchange(query) is None
    assert entry.path == f"/{entry.folder}/"
    value, *rules = cookie.split(b"; ")
    assert {*rules} == {f"Path=/{entry.folder}/".encode(), b"HttpOnly", b"SameSite=Strict"}
    assert entry.knows([b"a=b; " + value])
    assert not entry.knows([value[:-1], value + b"x", b""])
    assert not other.knows([value])
    assert query.removeprefix(b"key=") not in cookie
    assert query.decode() not in repr(entry)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:80", f"{HOST}.evil.example", ""])
def test_a_foreign_host_is_refused(client: TestClient, host: str) -> None:
    assert client.get(f"/{FOLDER}/", headers={"host": host}).status_code == 421


def test_another_origin_is_refused(client: TestClient) -> None:
    given = {"window": WINDOW}
    for site in ("cross-site", "same-site"):
        assert client.post(f"/{FOLDER}/api/state", json=given, headers={"sec-fetch-site": site}).status_code == 403
    for origin in ("http://evil.example", "null", "https://127.0.0.1:4321", "http://127.0.0.1:4322"):
        assert client.post(f"/{FOLDER}/api/state", json=given, headers={"origin": origin}).status_code == 403
    assert client.post(f"/{FOLDER}/api/state", json=given, headers={"origin": f"http://{HOST}"}).status_code == 200


def test_a_long_body_is_refused_however_it_comes(client: TestClient) -> None:
    assert client.post(f"/{FOLDER}/api/state", content=b" " * (MAX_BODY + 1)).status_code == 413
    parts = (b" " * 1000 for _ in range(MAX_BODY // 1000 + 2))
    assert client.post(f"/{FOLDER}/api/state", content=parts).status_code == 413


@pytest.mark.parametrize(
    "path",
    ["../session.py", "..%2fsession.py", "%2e%2e/%2e%2e/etc/passwd", "page/../session.py", "/etc/passwd",
     "api/__class__", "api/_band", "api/../begin", "tiles/..%2f..%2fscene/0/1/0/0?l=0,1", "index.html%00"],
)  # fmt: skip
def test_no_path_of_a_request_is_opened(client: TestClient, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    monkeypatch.setattr("io.open", lambda *given, **_: opened.append(given))
    monkeypatch.setattr("builtins.open", lambda *given, **_: opened.append(given))
    for answer in (client.get(f"/{FOLDER}/{path}"), client.post(f"/{FOLDER}/{path}", json={"window": WINDOW})):
        assert answer.status_code in (400, 404, 405)
    assert not opened


@pytest.mark.parametrize(
    ("what", "given"),
    [
        ("begin", {}), ("act", {"window": WINDOW, "action": {"do": "begin", "marks": []}}),
        ("act", {"window": WINDOW, "action": {"do": "put", "mark": {"id": "A", "image": [1e400, 0]}}}),
        ("act", {"window": WINDOW}), ("propose", {}), ("tie", {"number": 0, "image": [1, 2]}),
        ("propose", {"image": [1]}), ("propose", {"image": ["1", 2]}),
        ("predict", {}), ("predict", {"at": "scene-0", "place": [1, 2], "version": -1}),
        ("predict", {"at": "scene-0", "place": [1, 2], "version": 99}), ("predict", {"at": "scene-1", "place": [1, 2]}),
        ("link", {"at": "scene-0", "to": "../x", "place": [1, 2]}), ("link", {"at": "scene-0", "to": "map-0"}),
        ("typed", {"values": [1, 2]}), ("typed", {"values": [1, 2, 3], "crs": "file:///etc/passwd"}),
        ("typed", {"values": [1, 2, 3], "vertical": "/etc/geoid.gtx"}),
        ("typed", {"values": [1, 2, 3], "crs": "+proj=longlat +nadgrids=/etc/passwd"}),
        ("stretch", {"pane": "../x", "bands": [0]}), ("stretch", {"pane": "scene-0", "bands": [5]}), ("act", []),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_one_line_and_changes_nothing(client: TestClient, what: str, given: object) -> None:
    import json

    before = client.post(f"/{FOLDER}/api/state", json={"window": WINDOW}).json()
    answer = client.post(f"/{FOLDER}/api/{what}", content=json.dumps(given))
    assert answer.status_code == 400
    assert answer.json()["error"]["message"]
    assert str(SAMPLE) not in answer.text
    assert client.post(f"/{FOLDER}/api/state", json={"window": WINDOW}).json() == before


def test_the_second_window_reads_until_it_takes_over(client: TestClient) -> None:
    def ask(what: str, window: str, **given: object):
        return client.post(f"/{FOLDER}/api/{what}", json={"window": window, **given})

    action = {"do": "put", "mark": {"id": "A", "image": [1.0, 2.0]}}
    assert ask("begin", WINDOW).json()["writes"]
    assert not ask("begin", "window-two").json()["writes"]
    assert ask("act", "window-two", action=action).status_code == 409
    assert ask("begin", "window-two", take=True).json()["writes"]
    assert ask("act", "window-two", action=action).status_code == 200
    assert ask("act", WINDOW, action=action).status_code == 409
    ask("leave", "window-two")
    # This window still shows the points from before: it must load them again.
    assert ask("act", WINDOW, action={"do": "undo"}).status_code == 409
    assert ask("begin", WINDOW).json()["writes"]
    assert ask("act", WINDOW, action={"do": "undo"}).status_code == 200


def test_no_file_is_looked_for_that_a_request_names(client: TestClient, tmp_path: Path) -> None:
    """A geoid grid that is there is as unknown to the page as one that is not."""
    (tmp_path / "real.gtx").write_bytes(b"x" * 100)
    answers = [
        client.post(f"/{FOLDER}/api/typed", json={"values": [1, 2, 3], "vertical": str(path)}).text
        for path in (tmp_path / "real.gtx", tmp_path / "none.gtx")
    ]
    assert answers[0] == answers[1]
    assert "unknown height datum" in answers[0]


def test_a_tile_is_a_picture_and_nonsense_is_none(client: TestClient) -> None:
    answer = client.get(f"/{FOLDER}/tiles/scene-0/0/2/0/1?b=0&l=0,2000")
    assert answer.headers["content-type"] == "image/png"
    assert answer.content[:4] == b"\x89PNG"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Black and white of one value, far from all pixels.
        assert client.get(f"/{FOLDER}/tiles/scene-0/0/2/0/1?b=0&l=1e12,1e12").status_code == 200
    for wrong in ("scene-0/0/3/0/0?l=0,1", "scene-0/0/1/0/0?l=0,nan", "scene-0/0/1/0/0?l=0",
                  "scene-0/0/1/0/0?b=1,2&l=0,1,2,3", "scene-0/0/131072/0/0?l=0,1",
                  "scene-0/0/1/9999999/0?l=0,1"):  # fmt: skip
        assert client.get(f"/{FOLDER}/tiles/{wrong}").status_code == 400


def put(client: TestClient, truth: Any, features: np.ndarray) -> None:
    """Let the window put one control point for each feature, where it is in truth."""
    for k, (image, ground) in enumerate(zip(features, truth.ground_at(features), strict=True)):
        mark = {"id": f"P{k}", "image": image.tolist(), "ground": ground.tolist(), "role": "control"}
        action = {"do": "put", "mark": {**mark, "how": "manual", "ground_from": "typed"}}
        answer = client.post(f"/{FOLDER}/api/act", json={"window": WINDOW, "action": action})
        assert answer.status_code == 200, answer.text


def test_the_ortho_of_the_points_is_made_and_shown_over_the_reference(
    reference: Path, truth: Any, features: np.ndarray, tmp_path: Path
) -> None:
    session = open_session(
        SAMPLE / "scene.tif", tmp_path / "p.geojson",
        surface=SurfaceOptions(dem=SAMPLE / "dem.tif"), match=MatchOptions(reference=(str(reference),)),
    )  # fmt: skip
    with entered(session) as client:
        ask = partial(client.post, json={"window": WINDOW})
        assert ask(f"/{FOLDER}/api/made").json()["state"] == "none"
        assert client.get(f"/{FOLDER}/made/ortho").status_code == 400
        put(client, truth, features)
        assert client.post(f"/{FOLDER}/api/make", json={"window": "another-window"}).status_code == 409
        told = ask(f"/{FOLDER}/api/make").json()
        while told["state"] == "running":
            time.sleep(0.05)
            told = ask(f"/{FOLDER}/api/made").json()
        assert told["state"] == "done", told
        pictures = [client.get(f"/{FOLDER}/made/{which}").content for which in ("ortho", "reference")]
        # Both pictures are of one size, which stands in the header of a PNG.
        assert pictures[0][16:24] == pictures[1][16:24]
        page = client.get(f"/{FOLDER}/made/report")
        assert "<h1" in page.text
        assert page.headers.get_list("content-security-policy") == [REPORT_POLICY]
        assert client.get(f"/{FOLDER}/made/nonsense").status_code == 404
    session.close()
    made = json.loads((tmp_path / "p_ortho/scene_report.json").read_text())["adjustment"]
    again = commands.fit(SAMPLE / "scene.tif", PointOptions(gcps=tmp_path / "p.geojson")).to_json()
    assert made["parameters"] == again["parameters"]
