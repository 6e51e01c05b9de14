"""Google's store by what its XML API promises: versions that are numbers, conditions on them, ETags that may be MD5.

No server of others was found that writes by this API (fake-gcs-server and gcp-storage-emulator read by it, and write
by the other one, in JSON); what is asked here is what `obstore` and GDAL ask of the true store.
"""

from __future__ import annotations

import base64
import hashlib
import http.server
import json
import threading
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from servers import rectify_within, running

from ortho_pipeline.batch.records import RunRecord
from ortho_pipeline.batch.shared.leases import Lease, Leases, Lost
from ortho_pipeline.commands import rectify
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import SurfaceOptions
from ortho_pipeline.stores import objects
from ortho_pipeline.stores.objects import PART, Conflict, Objects

XML = 'xmlns="http://doc.s3.amazonaws.com/2006-03-01"'


class GoogleStore:
    """Objects in memory behind the XML API: PUT, GET with ranges, HEAD, DELETE, lists, and uploads in parts."""

    address = ""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.objects: dict[str, tuple[bytes, int, str]] = {}
        self.parts: dict[str, dict[int, bytes]] = {}
        self.generation = 1_700_000_000_000_000
        self.conditions: list[str] = []

    def answer(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        path, _, query = handler.path.partition("?")
        name, asked = urllib.parse.unquote(path.lstrip("/")), urllib.parse.parse_qs(query, keep_blank_values=True)
        body = handler.rfile.read(int(handler.headers.get("Content-Length") or 0))
        with self.lock:
            status, headers, data = self._answered(handler, name, asked, body)
        handler.send_response(status)
        for key, value in headers.items():
            handler.send_header(key, value)
        if "Content-Length" not in headers:
            handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        if handler.command != "HEAD":
            handler.wfile.write(data)

    def _answered(self, handler: Any, name: str, asked: dict[str, list[str]], body: bytes) -> Any:
        if handler.command in ("PUT", "POST"):
            return self._written(handler, name, asked, body)
        if handler.command == "DELETE":
            return (204 if self.objects.pop(name, None) else 404), {}, b""
        if "/" not in name.strip("/"):
            return 200, {}, self._listed(name.strip("/"), asked.get("prefix", [""])[0], asked.get("delimiter", [""])[0])
        if name not in self.objects:
            return 404, {}, b""
        data, generation, tag = self.objects[name]
        headers = {"ETag": tag, "x-goog-generation": str(generation), "Last-Modified": "Wed, 21 Oct 2015 07:28:00 GMT"}
        wanted = handler.headers.get("Range")
        if wanted:
            first, _, last = wanted.removeprefix("bytes=").partition("-")
            begin, end = int(first), min(int(last or len(data) - 1), len(data) - 1)
            return 206, headers | {"Content-Range": f"bytes {begin}-{end}/{len(data)}"}, data[begin : end + 1]
        return 200, headers | {"Content-Length": str(len(data))}, data

    def _written(self, handler: Any, name: str, asked: dict[str, list[str]], body: bytes) -> Any:
        if "uploads" in asked:
            self.parts[name] = {}
            told = f"<InitiateMultipartUploadResult {XML}><UploadId>{len(self.parts)}</UploadId>"
            return 200, {}, f"{told}</InitiateMultipartUploadResult>".encode()
        if "partNumber" in asked:
            self.parts[name][int(asked["partNumber"][0])] = body
            return 200, {"ETag": f'"{hashlib.md5(body).hexdigest()}"'}, b""
        condition = handler.headers.get("x-goog-if-generation-match")
        if condition is not None:
            self.conditions.append(condition)
            if int(condition) != self.objects.get(name, (b"", 0, ""))[1]:
                return 412, {}, b""
        self.generation += 1
        if "uploadId" in asked:
            # The ETag of what is stored in parts is no checksum.
            whole = b"".join(data for _, data in sorted(self.parts.pop(name).items()))
            tag = f'"-{base64.b64encode(str(self.generation).encode()).decode()}"'
            self.objects[name] = whole, self.generation, tag
            told = f"<CompleteMultipartUploadResult {XML}><ETag>{tag}</ETag></CompleteMultipartUploadResult>"
            return 200, {"x-goog-generation": str(self.generation)}, told.encode()
        tag = f'"{hashlib.md5(body).hexdigest()}"'
        self.objects[name] = body, self.generation, tag
        return 200, {"ETag": tag, "x-goog-generation": str(self.generation)}, b""

    def _listed(self, bucket: str, prefix: str, delimiter: str) -> bytes:
        found, folders = "", set()
        for name, (data, _, tag) in sorted(self.objects.items()):
            key = name.removeprefix(f"{bucket}/")
            if key == name or not key.startswith(prefix):
                continue
            if delimiter and delimiter in key[len(prefix) :]:
                folders.add(prefix + key[len(prefix) :].partition(delimiter)[0] + delimiter)
                continue
            found += (
                f"<Contents><Key>{key}</Key><Size>{len(data)}</Size><ETag>{tag}</ETag>"
                "<LastModified>2015-10-21T07:28:00.000Z</LastModified></Contents>"
            )
        shared = "".join(f"<CommonPrefixes><Prefix>{name}</Prefix></CommonPrefixes>" for name in sorted(folders))
        told = f"<Name>{bucket}</Name><Prefix>{prefix}</Prefix><IsTruncated>false</IsTruncated>"
        return f"<ListBucketResult {XML}>{told}{found}{shared}</ListBucketResult>".encode()


@pytest.fixture
def google(monkeypatch: pytest.MonkeyPatch) -> Iterator[GoogleStore]:
    """A store, for us and for GDAL by the one variable that both read, and an account that needs no token."""
    with running(GoogleStore()) as store:
        monkeypatch.setenv("CPL_GS_ENDPOINT", f"{store.address}/")
        monkeypatch.setenv("GS_NO_SIGN_REQUEST", "YES")
        account = {"disable_oauth": True, "client_email": "", "private_key": "", "private_key_id": ""}
        monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT_KEY", json.dumps(account))
        monkeypatch.setattr(objects, "RETRIES", {"max_retries": 2})
        gdal.VSICurlClearCache()
        yield store


def test_objects_are_written_on_conditions_read_and_removed(google: GoogleStore) -> None:
    store = Objects("gs://box/some", allow_network=True)
    data = np.random.default_rng(1).bytes(PART + 1000)
    store.put("large", data)
    assert store.read("large", 1 << 30)[0] == data
    lease = store.put("lease", b"mine", new=True)
    with pytest.raises(Conflict):
        store.put("lease", b"yours", new=True)
    # The same content again is another version: what tells versions apart is their number, not their content.
    renewed = store.put("lease", b"mine", replacing=lease.version)
    assert renewed.version != lease.version
    with pytest.raises(Conflict):
        store.put("lease", b"late", replacing=lease.version)
    assert store.read("lease", 100)[1].version == renewed.version
    assert google.conditions == ["0", "0", lease.version, lease.version]
    assert set(store.names()) == {("large", len(data)), ("lease", 4)}
    store.delete("large")
    assert not store.exists("large")


def test_leases_are_renewed_and_taken_over(google: GoogleStore) -> None:
    mine, yours = (Leases("gs://box/run", allow_network=True) for _ in range(2))
    lease = mine.take("a")
    assert isinstance(lease, Lease)
    lease.renew()
    seen = yours.take("a")
    assert isinstance(seen, str)
    taken = yours.take("a", seen)
    assert isinstance(taken, Lease)
    with pytest.raises(Lost):
        lease.renew()
    taken.finish(RunRecord(name="s", key="", status="failed"))
    assert mine.finished() == {"a"}


def test_an_ortho_from_a_bucket_to_a_bucket(google: GoogleStore, tiny: Any, tmp_path: Path) -> None:
    rectify_within("gs://box", tiny, tmp_path)
    with pytest.raises(InputError, match="network"):
        rectify("gs://box/in/tiny.tif", tmp_path / "no", surface=SurfaceOptions(height=0.0))
