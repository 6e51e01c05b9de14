"""Azure's store by its own fake, Azurite (``npm install azurite``, its ``.bin`` in PATH): written, read, rectified."""

from __future__ import annotations

import base64
import hashlib
import hmac
import urllib.request
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from servers import installed_server, on_a_faulty_way, rectify_within

from ortho_pipeline.errors import StorageError
from ortho_pipeline.stores import objects
from ortho_pipeline.stores.objects import PART, Conflict, Objects

#: Account and key of every Azurite, as its documentation has them.
ACCOUNT = "devstoreaccount1"
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
Address = tuple[str, int]


@pytest.fixture(scope="module")
def azurite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("azurite")
    fixed = ["--skipApiVersionCheck", "--silent", "--disableTelemetry", "--location", str(folder)]
    with installed_server(
        "azurite-blob", lambda port: ["--blobHost", "127.0.0.1", "--blobPort", str(port), *fixed]
    ) as port:
        make_container(port, "box")
        yield "127.0.0.1", port


def make_container(port: int, name: str) -> None:
    """Make a container by a request that is signed as the service asks (Shared Key)."""
    date = datetime.now(UTC).strftime("%a, %d %b %Y %H:%M:%S GMT")
    headers = f"x-ms-date:{date}\nx-ms-version:2021-08-06"
    signed = "PUT" + "\n" * 12 + f"{headers}\n/{ACCOUNT}/{ACCOUNT}/{name}\nrestype:container"
    signature = hmac.new(base64.b64decode(KEY), signed.encode(), hashlib.sha256).digest()
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/{ACCOUNT}/{name}?restype=container", method="PUT",
        headers={
            "x-ms-date": date, "x-ms-version": "2021-08-06", "Content-Length": "0",
            "Authorization": f"SharedKey {ACCOUNT}:{base64.b64encode(signature).decode()}",
        },
    )  # fmt: skip
    urllib.request.urlopen(request).close()


def at(address: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let Azure be at this address, for us and for GDAL, by the one variable that both read."""
    endpoint = f"http://{address[0]}:{address[1]}/{ACCOUNT}"
    monkeypatch.setenv(
        "AZURE_STORAGE_CONNECTION_STRING",
        f"DefaultEndpointsProtocol=http;AccountName={ACCOUNT};AccountKey={KEY};BlobEndpoint={endpoint}",
    )
    monkeypatch.setattr(objects, "RETRIES", {"max_retries": 2})


def test_objects_are_written_on_conditions_read_and_removed(azurite: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    at(azurite, monkeypatch)
    store = Objects("az://box/some", allow_network=True)
    data = np.random.default_rng(1).bytes(PART + 1000)
    store.put("large", data)
    assert store.read("large", 1 << 30)[0] == data
    lease = store.put("lease", b"mine", new=True)
    with pytest.raises(Conflict):
        store.put("lease", b"yours", new=True)
    renewed = store.put("lease", b"still", replacing=lease.version)
    with pytest.raises(Conflict):
        store.put("lease", b"late", replacing=lease.version)
    assert store.read("lease", 100)[1].version == renewed.version
    assert set(store.names()) == {("large", len(data)), ("lease", 5)}
    store.delete("large")
    assert not store.exists("large")


def test_what_is_stored_is_read_back_where_an_etag_is_no_checksum(
    azurite: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    with on_a_faulty_way(azurite, 1, share=1.0) as way:
        way.KINDS = ("flipped request",)
        at(("127.0.0.1", int(way.address.rpartition(":")[2])), monkeypatch)
        with pytest.raises(StorageError, match="the content differs") as told:
            Objects("az://box/wrong", allow_network=True).put("a", bytes(1000))
    at(azurite, monkeypatch)
    # The request to remove it has its name in its body, and is turned as well.
    assert ("could not be removed" in str(told.value)) == Objects("az://box/wrong", allow_network=True).exists("a")


def test_an_ortho_from_a_container_to_a_container(
    azurite: Address, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at(azurite, monkeypatch)
    rectify_within("az://box", tiny, tmp_path)
