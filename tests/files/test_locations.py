"""Files in archives, behind URLs and in other folders: what is opened, and what is not."""

from __future__ import annotations

import functools
import http.server
import json
import re
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from osgeo import gdal
from servers import serving

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import Location, VsiPath, located
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster import source
from ortho_pipeline.raster.source import open_dataset

POINTS = ["--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


class _Quiet(http.server.SimpleHTTPRequestHandler):
    asked: list[str]

    def log_message(self, *_: Any) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        """Send a part of the file: GDAL asks for ranges, which the server of the library does not know."""
        self.asked.append(self.path)
        file = Path(self.translate_path(self.path))
        if not file.is_file():
            return self.send_error(404)
        data = file.read_bytes()
        wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        first, last = (
            (int(wanted[1]), min(int(wanted[2] or len(data)), len(data) - 1)) if wanted else (0, len(data) - 1)
        )
        self.send_response(206 if wanted else 200)
        self.send_header("Content-Length", str(last + 1 - first))
        if wanted:
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
        self.end_headers()
        self.wfile.write(data[first : last + 1])
        return None

    def do_HEAD(self) -> None:
        self.asked.append(self.path)
        super().do_HEAD()


@pytest.fixture
def served(tiny) -> Iterator[tuple[str, list[str]]]:
    """Serve the folder of the tiny scene; yield its URL and the list of what was asked for."""
    asked: list[str] = []
    handler = type("Handler", (_Quiet,), {"asked": asked})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(handler, directory=str(tiny.folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", asked
    server.shutdown()
    server.server_close()
    thread.join()
    gdal.VSICurlClearCache()


# -- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("http://h/a.tif", "/vsicurl/http://h/a.tif"), ("HTTPS://h/a.tif?k=v", "/vsicurl/https://h/a.tif?k=v"),
        ("s3://bucket/key/a.tif", "/vsis3/bucket/key/a.tif"), ("gs://bucket/a.tif", "/vsigs/bucket/a.tif"),
        ("az://box/a.tif", "/vsiaz/box/a.tif"),
    ],
)  # fmt: skip
def test_urls_are_names_of_gdal(url, name):
    place = located(url, allow_network=True)
    assert isinstance(place, VsiPath)
    assert str(place) == name
    assert (place.stem, place.suffix) == ("a", ".tif")
    with pytest.raises(InputError, match=r"scene\.allow_network"):
        located(url)


def test_other_urls_are_refused_and_files_stay_files():
    with pytest.raises(InputError, match="ftp"):
        located("ftp://h/a.tif", allow_network=True)
    assert located("file:///tmp/a.tif") == "/tmp/a.tif"
    assert located("a.tif") == "a.tif"
    assert located(Path("b.tif")) == Path("b.tif")


@pytest.mark.parametrize(
    ("name", "local"),
    [
        ("/vsizip/a.zip/b.tif", True), ("/vsizip//tmp/a.zip/b.tif", True), ("/vsizip/{/tmp/a.zip}/b.tif", True),
        ("/vsigzip//vsizip/a.zip/b.gz", True), ("/vsitar/a.tgz/b.tif", True),
        ("/vsizip//vsicurl/http://h/a.zip", False),
        ("/vsizip/vsicurl/http://h/a.zip/b", False), ("/vsizip/{/vsis3/box/a.zip}/b", False),
        ("/vsicurl/http://h", False),
        ("/vsimem/a.tif", False), ("/vsistdin/", False), ("/vsisubfile/0_10,/etc/passwd", False), ("/vsizipx/a", False),
    ],
)  # fmt: skip
def test_archives_on_disk_are_not_the_network(name, local):
    assert Location(name).in_archive == local
    if not local:
        with pytest.raises(InputError, match=r"scene\.allow_network"):
            open_dataset(name)


def test_a_path_of_strangers_does_not_lead_elsewhere():
    place = VsiPath("/vsizip/a.zip/folder/b.xml")
    assert str(place.with_name("c.txt")) == "/vsizip/a.zip/folder/c.txt"
    for name in ("../c", "/vsicurl/http://h/x", ".."):
        with pytest.raises(InputError, match="not the name of a file"):
            place.with_name(name)


# -- the network -----------------------------------------------------------------------------------------------------


def test_everything_may_lie_behind_urls(tiny, served, tmp_path):
    url, _ = served
    here = [tiny.image, "--gcps", tiny.gcps, *POINTS, "--dem", tiny.dem, "--dem-vertical", "ellipsoid"]
    there = [f"{url}/tiny.tif", "--gcps", f"{url}/gcps.csv", *POINTS, "--dem", f"{url}/dem.tif", "--dem-vertical",
             "ellipsoid", "--allow-network"]  # fmt: skip
    ours, theirs = (run("rectify", *words, "-tr", 20, "-o", tmp_path / name) for words, name in
                    ((here, "here"), (there, "there")))  # fmt: skip
    assert ours.exit_code == 0, ours.stderr
    assert theirs.exit_code == 0, theirs.stderr
    a, b = (gdal.Open(str(tmp_path / name / "tiny_ortho.tif")) for name in ("here", "there"))
    assert (a.ReadAsArray() == b.ReadAsArray()).all()
    model = tmp_path / "here" / "tiny_model.json"
    model.rename(tiny.folder / "model.json")
    (tmp_path / "here" / "tiny_RPC.TXT").rename(tiny.folder / "other.txt")
    for words in (["--model", f"{url}/model.json"], ["--rpc", f"{url}/other.txt"]):
        done = run("info", f"{url}/tiny.tif", *words, "--allow-network", "--json")
        assert done.exit_code == 0, done.stderr
        assert words[1].rpartition("/")[2] in json.loads(done.stdout)["model_source"]


@pytest.mark.parametrize("option", ["image", "--gcps", "--dem", "--rpc", "--model"])
def test_nothing_is_fetched_unasked(tiny, served, tmp_path, option):
    url, asked = served
    words = [
        "rectify",
        f"{url}/tiny.tif" if option == "image" else tiny.image,
        "--height",
        "500",
        "-o",
        tmp_path / "out",
    ]
    if option != "image":
        words = [word for word in words if option != "--dem" or word not in ("--height", "500")]
        words += [option, f"{url}/tiny.tif", *(POINTS if option == "--gcps" else ())]
    done = run(*words)
    assert done.exit_code == 2, done.stderr
    assert "--allow-network" in done.stderr
    assert not asked


def test_what_is_not_there_is_said(tiny, served):
    url, _ = served
    done = run("fit", tiny.image, "--gcps", f"{url}/none.csv", *POINTS, "--allow-network")
    assert done.exit_code == 2
    assert "none.csv" in done.stderr


@pytest.mark.parametrize(("status", "said"), [(404, "file not found"), (403, "the store denies access")])
def test_why_an_image_behind_a_url_cannot_be_opened_is_said(tiny, status, said):
    with serving(tiny.folder) as public:
        public.faults["tiny.tif"] = lambda data, number: status
        done = run("info", f"{public.address}/tiny.tif", "--allow-network")
    assert done.exit_code == 2
    assert said in done.stderr


def test_a_server_that_sends_no_parts_of_files_has_a_remedy(tiny, monkeypatch):
    def refused(*_: Any) -> Any:
        raise RuntimeError("Range downloading not supported by this server!")

    monkeypatch.setattr(source, "open_seen", refused)
    with serving(tiny.folder) as public:
        done = run("info", f"{public.address}/tiny.tif", "--allow-network")
    assert "download the file and give its path" in done.stderr


# -- archives --------------------------------------------------------------------------------------------------------


@pytest.fixture
def archive(tiny) -> Path:
    """Put the scene with a side-car, DEM and points into an archive."""
    path = tiny.folder / "scene.zip"
    with zipfile.ZipFile(path, "w") as made:
        for file in (tiny.image, tiny.dem, tiny.gcps):
            made.write(file, f"product/{file.name}")
    return path


def test_a_scene_in_an_archive_needs_no_network(tiny, archive, tmp_path):
    inside = f"/vsizip/{archive}/product"
    done = run("rectify", f"{inside}/tiny.tif", "--gcps", f"{inside}/gcps.csv", *POINTS, "--dem", f"{inside}/dem.tif",
               "--dem-vertical", "ellipsoid", "-tr", "20", "-o", tmp_path / "out", "--json")  # fmt: skip
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)["report"]
    assert report["scene"]["sensor"] == "rpc"
    assert report["adjustment"]["rmse"]["control"]["n"] == 12
    assert str(archive) in {one["path"] for one in report["provenance"]["inputs"]}


def test_archive_and_member_are_named_where_they_are_wrong(archive):
    for name in (archive, f"/vsizip/{archive}/product/none.tif"):
        done = run("info", name)
        assert done.exit_code == 2
        assert f"/vsizip/{archive}/product/tiny.tif" in done.stderr
    assert Location(f"/vsizip/{archive}/product/tiny.tif").archive == archive
    assert Location(f"/vsizip/{{{archive}}}/product/tiny.tif").archive == archive


# -- other folders ---------------------------------------------------------------------------------------------------


def adjusted(tiny: Any, tmp_path: Path) -> Path:
    out = tmp_path / "out"
    done = run("export", tiny.image, "--gcps", tiny.gcps, *POINTS, "--format", "vrt", "-o", out)
    assert done.exit_code == 0, done.stderr
    return out / "tiny.vrt"


def test_our_own_vrt_opens_where_a_root_holds_both(tiny, tmp_path):
    vrt = adjusted(tiny, tmp_path)
    refused = run("info", vrt)
    assert refused.exit_code == 2
    assert f"--root {tmp_path}" in refused.stderr
    opened = json.loads(run("info", vrt, "--root", tmp_path, "--json").stdout)
    assert opened["size"] == [tiny.width, tiny.height]
    assert opened["models"] == {"rpc": "rpc"}
    made = run("rectify", vrt, "--root", tmp_path, "--height", "500", "-tr", "20", "-o", tmp_path / "ortho")
    assert made.exit_code == 0, made.stderr


def test_the_root_of_a_run_is_a_root_of_its_images(tiny, tmp_path):
    from ortho_pipeline.batch import plan as batch_plan

    vrt = adjusted(tiny, tmp_path)
    file = tmp_path / "run.yaml"
    file.write_text(f"output: made\nscenes:\n  - {{image: out/{vrt.name}, surface: {{height: 500}}}}\n")
    job = batch_plan.plan(file).jobs[0]
    assert commands.info(job.image, job.request.scene)["sensor"] == "rpc"


@pytest.mark.parametrize("source", ["../../secret.tif", "/etc/hostname", "link.tif"])
def test_a_root_does_not_open_what_lies_outside_of_it(tiny, tmp_path, source):
    root = tmp_path / "project"
    (root / "deep").mkdir(parents=True)
    secret = tmp_path / "secret.tif"
    secret.write_bytes(tiny.image.read_bytes())
    (root / "deep" / "link.tif").symlink_to(secret)
    vrt = root / "deep" / "a.vrt"
    relative = int(not source.startswith("/"))
    vrt.write_text(
        f'<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="UInt16" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="{relative}">{source}</SourceFilename><SourceBand>1</SourceBand>'
        f"</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with pytest.raises(InputError, match="outside"):
        open_dataset(vrt, **SceneOptions(roots=(root,)).access)


@pytest.mark.parametrize("root", ["/vsicurl/https://store.test", "/vsis3/bucket", "/vsizip/delivery.zip"])
def test_nothing_is_above_a_server_a_bucket_or_an_archive(root):
    assert str(VsiPath(f"{root}/a.tif").parent.parent.parent) == root
