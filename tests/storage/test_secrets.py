"""Credentials come by the usual chains and go nowhere: not into outputs, records, messages or logs."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from osgeo import gdal
from servers import PublicFolder, moto_server, on_a_faulty_way, serving

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import located
from ortho_pipeline.stores import objects
from ortho_pipeline.stores.objects import Objects

SECRET = "5ecretValue"
KEYS = {"AWS_ACCESS_KEY_ID": f"AKIA{SECRET}1", "AWS_SECRET_ACCESS_KEY": f"{SECRET}2", "AWS_SESSION_TOKEN": f"{SECRET}3"}


@pytest.fixture
def public(tiny: Any) -> Iterator[PublicFolder]:
    with serving(tiny.folder) as served:
        yield served


@pytest.mark.parametrize(
    "form",
    [
        "http://user:{}@{}", "http://{}@{}", "http://{1}?X-Amz-Signature={0}", "http://{1}?sv=2&sig={0}",
        "http://{1}?Key-Pair-Id=a&Signature={0}", "http://{1}?api_key={0}", "http://{1}?token={0}",
        "/vsicurl/http://{1}?x-goog-signature={0}", "/vsicurl?header.Authorization={0}&url=http://{1}",
        "/vsicurl?url=http%3A%2F%2Fuser%3A{0}%40{1}", "http://{1}?X%2DAmz%2DSignature={0}",
        *(f"http://{{1}}?{name}={{0}}" for name in (
            "jwt", "auth", "pwd", "code", "credential", "Credentials", "hmac", "ticket", "authorization", "passwd",
            "client_secret", "X-Auth", "bearer", "assertion", "otp")),
        "http://{1}#token={0}", "http://{1}#access_token={0}&x=1", "http://{1}?si%2567={0}", "http://{1}?%25%37%33ig={0}",
        "http://{1}?a=1&amp;sig={0}", "http://{1}?a=b%26sig%3D{0}",
    ],
)  # fmt: skip
def test_addresses_with_credentials_are_refused_without_naming_them(form: str, public: PublicFolder) -> None:
    """They would stand in reports, models, VRTs and logs: all that is read is named there."""
    address = form.format(SECRET, public.address.removeprefix("http://") + "/tiny.tif")
    for allowed in (True, False):
        with pytest.raises(InputError, match="credentials") as caught:
            located(address, allow_network=allowed)
        assert SECRET not in str(caught.value)
    assert not public.asked


@pytest.mark.parametrize(
    "address",
    [
        "http://h/a.tif?k=v",
        "http://h/a.tif?monkey=1",
        "http://h/a.tif?zipcode=3",
        "http://h/i.json#image",
        "http://h/a%25.tif",
        "s3://box/a@b.tif",
    ],
)
def test_addresses_without_credentials_are_read(address: str) -> None:
    located(address, allow_network=True)


def test_no_command_tells_what_an_address_was_signed_with(
    public: PublicFolder, tiny: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Wherever it is given: as image, heights, points or reference, on the command line, in a file, in an item."""
    caplog.set_level(logging.DEBUG)

    def signed(name: str) -> str:
        return f"{public.address}/{name}?X-Amz-Signature={SECRET}"

    image, heights = str(tiny.image), ["--dem", str(tiny.dem), "--dem-vertical", "ellipsoid"]
    item = {"type": "Feature", "stac_version": "1.0.0", "id": "one", "links": [], "properties": {}}
    asset = {"href": signed("tiny.tif"), "roles": ["data"], "type": "image/tiff"}
    (tmp_path / "item.json").write_text(json.dumps({**item, "assets": {"image": asset}}))
    pipeline = f"defaults: {{surface: {{height: 500}}}}\nscenes: [{{image: '{signed('tiny.tif')}'}}]\n"
    (tmp_path / "p.yaml").write_text(pipeline)
    out = tmp_path / "out"
    commands = [
        ["rectify", signed("tiny.tif"), *heights, "-o", out], ["rectify", tmp_path / "item.json", *heights, "-o", out],
        ["rectify", image, "--dem", signed("dem.tif"), "-o", out], ["info", signed("tiny.tif")],
        ["rectify", image, *heights, "--gcps", signed("gcps.csv"), "-o", out],
        ["match", image, "--reference", signed("tiny.tif"), *heights, "-o", out / "m.geojson"],
        ["rectify", image, "--dem", "auto", "--dem-source", signed("cells"), "-o", out],
        ["run", tmp_path / "p.yaml"], ["run", signed("p.yaml"), "-o", "s3://bucket/x"],
    ]  # fmt: skip
    for command in commands:
        done = CliRunner().invoke(cli, [str(word) for word in (*command, "--allow-network")])
        assert done.exit_code in (2, 3), (command, done.output)
        assert "credentials" in done.output + done.stderr, command
        assert SECRET not in done.output + done.stderr, command
    written = [path for path in tmp_path.rglob("*") if path.is_file() and path.name not in ("p.yaml", "item.json")]
    assert not [path for path in written if path.suffix != ".txt" and SECRET.encode() in path.read_bytes()]
    assert SECRET not in caplog.text
    assert not public.asked


def test_keys_of_a_store_are_in_no_output_record_message_or_log(
    tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A run from a bucket to a bucket, of image, heights, points and a reference, and one that fails."""
    caplog.set_level(logging.DEBUG)
    monkeypatch.setattr(objects, "RETRIES", {"max_retries": 1})
    said = ""
    with moto_server("bucket") as target, on_a_faulty_way(target, 1, share=0.0) as way:
        settings = {"AWS_ENDPOINT_URL": way.address, "AWS_S3_ENDPOINT": way.address.removeprefix("http://")}
        plain = {"AWS_HTTPS": "NO", "AWS_VIRTUAL_HOSTING": "FALSE", "AWS_REGION": "us-east-1"}
        for name, value in {**settings, **plain, **KEYS}.items():
            monkeypatch.setenv(name, value)
        store = Objects("s3://bucket/in", allow_network=True)
        for path in (tiny.image, tiny.dem, tiny.gcps):
            store.put(path.name, path)
        heights = ["--dem", "s3://bucket/in/dem.tif", "--dem-vertical", "ellipsoid", "--allow-network"]
        points = ["--points-crs", "EPSG:4326", "--points-vertical", "ellipsoid"]
        rectify = [
            "rectify",
            "s3://bucket/in/tiny.tif",
            *heights,
            "--gcps",
            f"s3://bucket/in/{tiny.gcps.name}",
            *points,
        ]
        gdal.VSICurlClearCache()
        before = way.sent
        done = CliRunner().invoke(cli, [*rectify, "-o", str(tmp_path / "out")])
        assert done.exit_code == 0, done.stderr
        report = json.loads((tmp_path / "out" / "tiny_report.json").read_text())
        # Bytes are counted and reported; but for lists of folders, and 16 kB of each file that GDAL reads first.
        counted = report["provenance"]["network_bytes"]
        assert way.sent - before - 2 * 16_384 - 2_000 < counted <= way.sent - before
        assert report["provenance"]["image"]["path"] == "/vsis3/bucket/in/tiny.tif"
        said += done.output + done.stderr
        far = CliRunner().invoke(cli, [*rectify, "-o", "s3://bucket/out"])
        assert far.exit_code == 0, far.stderr
        reference = ["--reference", "s3://bucket/out/tiny_ortho.tif"]
        match = CliRunner().invoke(
            cli, ["match", str(tiny.image), *reference, *heights, "-o", str(tmp_path / "out" / "m.geojson")]
        )
        lost = CliRunner().invoke(cli, ["rectify", "s3://nowhere/a.tif", *heights, "-o", str(tmp_path / "no")])
        denied = CliRunner().invoke(cli, [*rectify, "-o", "s3://nowhere/out"])
        assert (lost.exit_code, denied.exit_code) == (2, 1), lost.stderr + denied.stderr
        said += "".join(one.output + one.stderr for one in (far, match, lost, denied))
        out = Objects("s3://bucket/out", allow_network=True)
        assert SECRET not in json.dumps(sorted(name for name, _ in out.names()))
        there = [out.read(name, 1 << 30)[0] for name, _ in out.names()]
    assert len(there) > 5
    made = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert not [one for one in (*there, *made) if SECRET.encode() in one]
    assert SECRET not in said + caplog.text
