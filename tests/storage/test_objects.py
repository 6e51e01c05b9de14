"""Stores of objects: real servers on the loopback, and a way to them on which things go wrong."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import random
import shutil
import socket
from collections import Counter
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal
from servers import FaultyWay, installed_server, moto_server, on_a_faulty_way, running, serving

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import export, rectify
from ortho_pipeline.errors import InputError, OrthoError, StorageError
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.stores import objects
from ortho_pipeline.stores.objects import PART, Conflict, Objects

gdal.UseExceptions()
QUICK: dict[str, Any] = {
    "max_retries": 4, "retry_timeout": timedelta(seconds=10),
    "backoff": {"init_backoff": timedelta(milliseconds=2), "max_backoff": timedelta(milliseconds=20), "base": 2},
}  # fmt: skip
Address = tuple[str, int]


@pytest.fixture(scope="module")
def moto() -> Iterator[Address]:
    with moto_server("bucket") as address:
        yield address


@pytest.fixture(scope="module")
def s3rver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    """The second server, by other people in another language: ``npm install s3rver``, its ``.bin`` in PATH."""
    fixed = ["-d", str(tmp_path_factory.mktemp("s3rver")), "-a", "127.0.0.1", "--configure-bucket", "bucket", "-s"]
    with installed_server("s3rver", lambda port: [*fixed, "-p", str(port)]) as port:
        yield "127.0.0.1", port


@pytest.fixture(params=["moto", "s3rver"])
def server(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Address:
    address: Address = request.getfixturevalue(request.param)
    at(f"http://{address[0]}:{address[1]}", monkeypatch)
    return address


def at(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let S3 be at this address, for us and for GDAL."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    monkeypatch.setenv("AWS_S3_ENDPOINT", address.removeprefix("http://"))
    monkeypatch.setenv("AWS_HTTPS", "NO")
    monkeypatch.setenv("AWS_VIRTUAL_HOSTING", "FALSE")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "S3RVER")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "S3RVER")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    monkeypatch.setattr(objects, "RETRIES", QUICK)


def test_objects_are_written_read_listed_and_removed(server: Address) -> None:
    store = Objects("s3://bucket/some/prefix", allow_network=True)
    content = store.put("folder/a.txt", b"hello")
    assert content.sha256 == hashlib.sha256(b"hello").hexdigest()
    assert store.read("folder/a.txt", 100)[0] == b"hello"
    assert store.put("empty", b"").size == 0
    assert store.read("empty", 0)[0] == b""
    assert dict(store.names()) == {"folder/a.txt": 5, "empty": 0}
    with pytest.raises(InputError, match="5 bytes"):
        store.read("folder/a.txt", 4)
    store.delete("folder/a.txt")
    store.delete("folder/a.txt")
    with pytest.raises(FileNotFoundError):
        store.read("folder/a.txt", 100)
    assert not store.exists("folder/a.txt")
    store.delete("empty")


def test_what_is_stored_in_parts_is_checked_too(
    server: Address, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(objects, "PART", 5 << 20)  # the smallest that S3 takes
    data = np.random.default_rng(1).bytes((10 << 20) + 17)
    path = tmp_path / "large"
    path.write_bytes(data)
    store = Objects("s3://bucket/parts", allow_network=True)
    content = store.put("large", path)
    assert content.version.strip('"') in content.tags
    back = tmp_path / "back"
    assert store.fetch("large", back, 1 << 30).sha256 == content.sha256
    assert back.read_bytes() == data


@pytest.mark.parametrize("size", [PART, 2 * PART, 2 * PART + 17])
def test_a_part_that_ends_with_what_is_read_is_a_whole_one(server: Address, tmp_path: Path, size: int) -> None:
    """With parts as large as they are in use, the tag is the one that the store computes."""
    path = tmp_path / "large"
    path.write_bytes(np.random.default_rng(1).bytes(size))
    store = Objects("s3://bucket/whole", allow_network=True)
    content = store.put("large", path)
    assert store.stated("large")[1].strip('"') in content.tags
    assert store.fetch("large", tmp_path / "back", 1 << 30).tags == content.tags


def test_of_two_that_write_one_object_one_is_told(moto: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    at(f"http://{moto[0]}:{moto[1]}", monkeypatch)
    store = Objects("s3://bucket/conditions", allow_network=True)
    first = store.put("lease", b"mine", new=True)
    with pytest.raises(Conflict):
        store.put("lease", b"yours", new=True)
    second = store.put("lease", b"yours", replacing=first.version)
    with pytest.raises(Conflict):
        store.put("lease", b"mine again", replacing=first.version)
    assert store.read("lease", 100)[0] == b"yours"
    assert second.version != first.version


def test_nothing_is_asked_without_leave_and_no_secret_is_told(moto: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="off by default"):
        Objects("s3://bucket/x", allow_network=False)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = f"http://127.0.0.1:{free.getsockname()[1]}"
    at(nobody, monkeypatch)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "the-secret")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "the-key")
    with pytest.raises(StorageError) as caught:
        Objects("s3://bucket/x", allow_network=True).read("a", 10)
    assert not {"the-secret", "the-key", "127.0.0.1"} & set(
        str(caught.value).replace("/", " ").replace(":", " ").split()
    )


class EncryptedStore(FaultyWay):
    """S3 with keys of its own: ETags are no checksums, and an upload whose SHA-256 is another is refused."""

    def __init__(self, target: Address) -> None:
        super().__init__(target, 1, share=0.0)
        self.own_tags: dict[str, str] = {}

    def answer(self, handler: Any) -> None:
        """Verify what is uploaded as S3 does."""
        body = handler.rfile.read(int(handler.headers.get("Content-Length") or 0))
        stated = handler.headers.get("x-amz-checksum-sha256")
        if handler.command == "PUT" and stated != base64.b64encode(hashlib.sha256(body).digest()).decode():
            return self.say(handler, 400, [], b"<Error><Code>BadDigest</Code></Error>")
        handler.rfile = io.BytesIO(body)
        if "If-Match" in handler.headers:
            handler.headers.replace_header("If-Match", self.own_tags[handler.headers["If-Match"]])
        return super().answer(handler)

    def say(self, handler: Any, status: int, headers: list[tuple[str, str]], data: bytes, *, cut: bool = False) -> None:
        """Answer with ETags that say nothing of the content."""
        told = []
        for key, value in headers:
            given = value
            if key.lower() == "etag":
                given = f'"{hashlib.md5(value.encode()).hexdigest()}"'
                self.own_tags[given] = value
            told.append((key, given))
        super().say(handler, status, told, data, cut=cut)


def test_encrypted_objects_are_checked_by_the_store_and_by_what_is_noted(
    moto: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bits that turn on the way there are found by the store, those that turn on the way back by us."""
    with running(EncryptedStore(moto)) as kms:
        kms_at = "127.0.0.1", int(kms.address.rpartition(":")[2])
        with on_a_faulty_way(kms_at, 2, share=0.0) as way:
            at(way.address, monkeypatch)
            secret = random.Random(1).randbytes(2000)
            with pytest.raises(StorageError, match="HTTP status 400"):
                Objects("s3://bucket/kms", allow_network=True).put("undeclared", secret)
            monkeypatch.setenv("AWS_SERVER_SIDE_ENCRYPTION", "aws:kms")
            store = Objects("s3://bucket/kms", allow_network=True)
            assert store.put("a", secret).sha256 == hashlib.sha256(secret).hexdigest()
            assert store.read("a", 2000)[0] == secret
            lease = store.put("lease", b"mine", new=True)
            assert store.put("lease", b"still", replacing=lease.version).sha256 == hashlib.sha256(b"still").hexdigest()
            with pytest.raises(Conflict):
                store.put("lease", b"yours", new=True)
            way.KINDS, way.share = ("flipped request",), 1.0
            with pytest.raises(StorageError):
                store.put("b", bytes(1000))
            assert not Objects("s3://bucket/kms", allow_network=True).exists("b")
            for kind in ("flipped", "truncated"):
                # What is cut at the same place each time is no less wrong for that.
                way.KINDS = (kind,)
                with pytest.raises(StorageError, match="checksum"):
                    store.read("a", 2000)


# -- a way on which things go wrong ------------------------------------------------------------------------------------


def faulty_run(target: Address, seed: int, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Write and read objects; what is read is right or an error, what is in the store after a success is right."""
    chance = random.Random(seed)
    outcomes: Counter[str] = Counter()
    direct = f"http://{target[0]}:{target[1]}"
    with on_a_faulty_way(target, seed, share=chance.choice((0.1, 0.3, 0.6))) as way:
        for number in range(3):
            name = f"run{seed}/{number}"
            data = chance.randbytes(chance.choice((0, 1, 1000, 50_000)))
            at(way.address, monkeypatch)
            store = Objects("s3://bucket/faults", allow_network=True)
            stored = False
            try:
                conditional = chance.random() < 0.3
                store.put(name, data, new=conditional)
                stored = True
                assert store.read(name, 1 << 20)[0] == data
                outcomes["whole"] += 1
            except OrthoError as error:
                outcomes[type(error).__name__] += 1
            if stored:
                at(direct, monkeypatch)
                assert Objects("s3://bucket/faults", allow_network=True).read(name, 1 << 20)[0] == data
    return outcomes + way.met


@pytest.mark.parametrize("first", [0, 4, 8])
def test_objects_are_whole_and_right_or_there_is_an_error(
    moto: Address, first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: Counter[str] = Counter()
    for seed in range(first, first + 4):
        found += faulty_run(moto, seed, monkeypatch)
    assert found["whole"] > 0
    assert sum(found[kind] for kind in FaultyWay.KINDS) > 0


@pytest.mark.slow
def test_three_hundred_runs_with_faults(server: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    found: Counter[str] = Counter()
    for seed in range(1000, 1300):
        found += faulty_run(server, seed, monkeypatch)
    assert set(FaultyWay.KINDS) <= set(found)
    assert found["whole"] > 600
    print(dict(found))


# -- commands ----------------------------------------------------------------------------------------------------------


def test_an_ortho_from_a_bucket_to_a_bucket(
    moto: Address, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Image, DEM and points are read where they lie; outputs are uploaded, their record last."""
    at(f"http://{moto[0]}:{moto[1]}", monkeypatch)
    store = Objects("s3://bucket/in", allow_network=True)
    for path in (tiny.image, tiny.dem):
        store.put(path.name, path)
    scene = SceneOptions(allow_network=True)
    given = SurfaceOptions(dem="s3://bucket/in/dem.tif", vertical="ellipsoid")
    with pytest.raises(InputError, match="off by default"):
        rectify(tiny.image, "s3://bucket/out/", surface=SurfaceOptions(dem=str(tiny.dem), vertical="ellipsoid"))
    made = rectify("s3://bucket/in/tiny.tif", "s3://bucket/out/", surface=given, scene=scene)
    local = rectify(tiny.image, tmp_path / "out", surface=SurfaceOptions(dem=str(tiny.dem), vertical="ellipsoid"))
    assert made.files["ortho"] == "s3://bucket/out/tiny_ortho.tif"
    out = Objects("s3://bucket/out", allow_network=True)
    ortho = tmp_path / "there.tif"
    out.fetch("tiny_ortho.tif", ortho, 1 << 30)
    np.testing.assert_array_equal(
        gdal.Open(str(ortho)).ReadAsArray(), gdal.Open(str(local.files["ortho"])).ReadAsArray()
    )
    record = json.loads(out.read("tiny_delivery.json", 1 << 20)[0])
    listed = {one["name"]: one["sha256"] for one in record["files"]}
    assert set(listed) | {"tiny_delivery.json"} == {name for name, _ in out.names()}
    assert listed["tiny_ortho.tif"] == hashlib.sha256(ortho.read_bytes()).hexdigest()


def test_orthos_of_a_bucket_are_a_mosaic_in_a_bucket(
    moto: Address, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`ortho mosaic`, and the plots of a report, read and write where `ortho rectify -o s3://...` wrote."""
    at(f"http://{moto[0]}:{moto[1]}", monkeypatch)
    runner, surface = CliRunner(), SurfaceOptions(dem=str(tiny.dem), vertical="ellipsoid")

    def ortho(*words: str, code: int = 0) -> str:
        result = runner.invoke(cli, list(words))
        assert result.exit_code == code, result.output
        return str(result.output)

    whole = rectify(tiny.image, tmp_path / "whole", surface=surface, output=OutputOptions(resolution=5.0, align=True))
    left, bottom, right, top = (round(value) for value in whole.document["report"]["ortho"]["extent"])
    for name, box in (("a", (left, bottom, left + 1000, top)), ("b", (left + 800, bottom, right, top))):
        image = tiny.image.with_name(f"{name}.tif")
        shutil.copy(tiny.image, image)
        output = OutputOptions(resolution=5.0, extent=tuple(map(float, box)))
        for folder in (tmp_path / name, f"s3://bucket/orthos/{name}"):
            rectify(image, folder, surface=surface, output=output, scene=SceneOptions(allow_network=True))
    there = [f"s3://bucket/orthos/{name}/{name}_ortho.tif" for name in "ab"]
    assert "--allow-network" in ortho("mosaic", *there, "-o", str(tmp_path / "no.tif"), code=2)
    assert "--allow-network" in ortho("mosaic", str(tmp_path / "a/a_ortho.tif"), "-o", "s3://bucket/m.tif", code=2)
    assert "in its folder" in ortho("mosaic", *there, "-o", str(tmp_path / "m.vrt"), "--allow-network", code=2)
    made = json.loads(ortho("mosaic", *there, "-o", "s3://bucket/all/m.tif", "--allow-network", "--json"))
    here = json.loads(ortho("mosaic", *(str(tmp_path / f"{one}/{one}_ortho.tif") for one in "ab"),
                            "-o", str(tmp_path / "m.tif"), "--json"))  # fmt: skip
    assert made["files"] == {
        kind: path.replace(str(tmp_path), "s3://bucket/all") for kind, path in here["files"].items()
    }
    assert made["mosaic"] == here["mosaic"]
    store = Objects("s3://bucket/all", allow_network=True)
    for name in ("m.tif", "m.json"):
        assert store.read(name, 1 << 30)[0] == (tmp_path / name).read_bytes()
    assert {name for name, _ in store.names()} == {"m.tif", "m.json", "m.html", "m_delivery.json"}
    # Without points there is nothing to plot: an empty delivery.
    ortho("report", "s3://bucket/orthos/a/a_report.json", "--plots", "s3://bucket/plots", "--allow-network")
    assert [name for name, _ in Objects("s3://bucket/plots", allow_network=True).names()] == ["a_report_delivery.json"]


def test_outputs_that_could_not_be_uploaded_are_those_of_the_record_or_have_none(
    moto: Address, tiny: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make() -> None:
        formats = ("rpc-txt", "rpb", "gcp")
        export(tiny.image, "s3://bucket/half", formats=formats, scene=SceneOptions(allow_network=True))

    with on_a_faulty_way(moto, 1, share=0.0) as way:
        way.KINDS = ("500",)
        at(way.address, monkeypatch)
        make()
        # The first requests go well: the old record is removed, and a file or two are uploaded.
        way.share, way.asked, way.good = 1.0, 0, 3
        with pytest.raises(StorageError):
            make()
        way.share = 0.0
        store = Objects("s3://bucket/half", allow_network=True)
        assert not store.exists("tiny_delivery.json")
        make()
        # None goes well: what was there before is there.
        way.share, way.good = 1.0, 0
        with pytest.raises(StorageError):
            make()
        way.share = 0.0
        listed = json.loads(store.read("tiny_delivery.json", 1 << 20)[0])["files"]
        assert len(listed) == 2
        for one in listed:
            assert store.read(one["name"], 1 << 30)[1].sha256 == one["sha256"]


def test_a_crop_of_a_large_image_reads_little_more_than_its_share(tmp_path: Path) -> None:
    """A twentieth of a COG over HTTP: the windows that the output needs, and no more than 12 % of the bytes."""
    side = 2400
    noise = np.random.default_rng(1).integers(0, 4000, (side, side), dtype=np.uint16)
    plain = gdal.GetDriverByName("MEM").Create("", side, side, 1, gdal.GDT_UInt16)
    plain.WriteArray(noise)
    cog = ["COMPRESS=DEFLATE", "BLOCKSIZE=128"]
    gdal.Translate(str(tmp_path / "large.tif"), plain, format="COG", creationOptions=cog)
    size = (tmp_path / "large.tif").stat().st_size
    part = int(side * 0.05**0.5)
    with serving(tmp_path) as public:
        # What fails in passing is asked for again, by GDAL too; but not one of several ranges that it asks for at
        # once, of which it then reads all once more, in pieces.
        public.faults["large.tif"] = lambda _, number: 503 if number == 2 else None
        source = RasterSource(f"{public.address}/large.tif", allow_network=True)
        read = source.read(500, 500, part, part)
        np.testing.assert_array_equal(read[0], noise[500 : 500 + part, 500 : 500 + part])
        assert public.sent < 0.12 * size


class WithoutTags:
    """A web server that gives no ETag."""

    address, changed = "", "Wed, 21 Oct 2015 07:28:00 GMT"

    def answer(self, handler: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Length", "5")
        handler.send_header("Last-Modified", self.changed)
        handler.end_headers()


def test_of_a_server_without_tags_the_date_of_the_last_change_counts() -> None:
    with running(WithoutTags()) as server:
        folder = Objects(server.address, allow_network=True)
        before = folder.stated("a.tif")
        assert before == folder.stated("a.tif")
        server.changed = "Wed, 21 Oct 2015 07:28:01 GMT"
        assert folder.stated("a.tif") != before
