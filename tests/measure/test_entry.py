"""Who gets in: one browser with an address that works once, and nobody who reads the process list."""

from __future__ import annotations

import http.cookiejar
import json
import os
import re
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from urllib import error, request

import pytest
from ortho_measure.serving.entry import private_file

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
BROWSER = """#!{python}
import json, os, sys
line = open("/proc/self/cmdline", "rb").read().decode().split("\\0")
text = open(sys.argv[1].removeprefix("file://")).read() if sys.argv[1].startswith("file:") else ""
mode = os.stat(sys.argv[1].removeprefix("file://")).st_mode if text else 0
with open({seen!r} + ".part", "w") as file:
    json.dump({{"line": line, "text": text, "mode": mode}}, file)
os.rename({seen!r} + ".part", {seen!r})
"""


class Person:
    """Somebody on this machine who asks the server; keeps cookies as a browser does."""

    def __init__(self) -> None:
        self.cookies = http.cookiejar.CookieJar()
        self._opener = request.build_opener(request.HTTPCookieProcessor(self.cookies))

    def status(self, address: str, body: dict | None = None) -> int:
        """Return the status of an answer."""
        data = None if body is None else json.dumps(body).encode()
        try:
            with self._opener.open(request.Request(address, data), timeout=60) as answer:
                return int(answer.status)
        except error.HTTPError as refused:
            return int(refused.code)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="no process list in /proc")
def test_who_reads_the_process_list_does_not_get_in(reference: Path, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn", reason="the extra 'measure' is not installed")
    script, seen = tmp_path / "browser", tmp_path / "seen.json"
    script.write_text(BROWSER.format(python=sys.executable, seen=str(seen)))
    script.chmod(0o700)
    process = subprocess.Popen(
        [sys.executable, "-m", "ortho_pipeline", "measure", str(SAMPLE / "scene.tif"), "--reference", str(reference),
         "--dem", str(SAMPLE / "dem.tif"), "-o", str(tmp_path / "p.geojson")],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "BROWSER": f"{script} %s"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        printed = process.stdout.readline().split()[-1]
        for _ in range(600):
            if seen.exists():
                break
            time.sleep(0.05)
        browser = json.loads(seen.read_text())
        assert printed not in " ".join(browser["line"])
        # Another user knows the process list and the port. Neither the page nor its API is for them.
        other, base = Person(), "/".join(printed.split("/")[:4])
        known = [word for word in browser["line"] if word.startswith("http")]
        for address in [*known, f"{base}/", base, f"{base}/api/state"]:
            assert other.status(address) in (403, 404)
        action = {"do": "put", "mark": {"id": "evil", "image": [1.0, 2.0]}}
        assert other.status(f"{base}/api/act", {"window": "window-evil", "action": action}) == 403
        # The browser is told by a file that nobody else can read.
        assert stat.S_IMODE(browser["mode"]) == 0o600
        (address,) = re.findall(r'<meta http-equiv="refresh" content="0; url=([^"]+)">', browser["text"])
        own = Person()
        assert own.status(address) == 200
        assert own.status(f"{base}/api/state", {"window": "window-own"}) == 200
        cookie = next(iter(own.cookies))
        assert cookie.path == f"/{base.split('/')[3]}/"
        assert cookie.has_nonstandard_attr("HttpOnly")
        assert cookie.get_nonstandard_attr("SameSite") == "Strict"
        # The address has been used: it lets nobody else in, and its owner only by the cookie.
        assert other.status(address) == 403
        assert other.status(printed) == 403
        assert own.status(printed) == 200
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert not [path.name for path in tmp_path.iterdir() if path.suffix == ".html"], "the file of the address is left"


def test_an_address_is_written_to_no_file_that_others_could_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, other = tmp_path / "p.geojson", tmp_path / "other"
    other.write_text("of somebody else")
    path = tmp_path / "p.geojson.open.html"
    # What is there already is not written through, nor into.
    path.symlink_to(other)
    with private_file("http://127.0.0.1:1/a-secret", points) as written:
        assert written == path
        assert "a-secret" in path.read_text()
        assert not path.is_symlink()
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not path.exists()
    assert other.read_text() == "of somebody else"
    # A file system without owners, and a folder that nobody can write to.
    with monkeypatch.context() as changed:
        changed.setattr(os, "geteuid", lambda: 12345)
        with private_file("http://127.0.0.1:1/a-secret", points) as written:
            assert written is None
            assert path.read_text() == ""
    assert not path.exists()
    with private_file("http://127.0.0.1:1/a-secret", tmp_path / "missing" / "p.geojson") as written:
        assert written is None
