"""Products in archives and behind links: they are the same products as on disk."""

from __future__ import annotations

import importlib.util
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import read_bounded, sha256
from ortho_pipeline.files.locations import MAX_READ, VsiPath
from ortho_pipeline.host import Host
from ortho_pipeline.models import model_from_dict
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions

ORBVIEW = "3v050620p0000443940a5200000000200m_001443940.tif"
PRODUCTS = {
    "ikonos": "po_39001_pan_0000000.tif", "orbview3": ORBVIEW, "cartosat": "BANDA.tif", "bilsat": "bilsat.tif",
}  # fmt: skip


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def zipped(folder: Path, archive: Path, **more: bytes) -> str:
    """Put a folder into an archive; return its place in there as GDAL names it."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as made:
        for file in sorted(folder.iterdir()):
            made.write(file, f"delivery/{file.name}")
        for name, data in more.items():
            made.writestr(name, data)
    return f"/vsizip/{archive}/delivery"


def facts(*words: Any, folder: str) -> dict[str, Any]:
    """Return what `ortho info` says, with the folder of the product left out of all paths."""
    done = run("info", *words, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout.replace(json.dumps(folder)[1:-1], "FOLDER"))


@pytest.mark.parametrize("sensor", PRODUCTS)
def test_a_product_in_an_archive_keeps_its_sensor(sample, tmp_path, sensor):
    folder, image = sample / sensor, PRODUCTS[sensor]
    inside = zipped(folder, tmp_path / "order.zip")
    on_disk = facts(folder / image, folder=str(folder))
    assert on_disk["sensor"] == sensor
    assert facts(f"{inside}/{image}", folder=inside) == on_disk
    models = [
        {name: model.to_dict() for name, model in open_scene(f"{place}/{image}").models.items()}
        for place in (folder, inside)
    ]
    assert models[0] == models[1]
    assert all(model_from_dict(model).to_dict() == model for model in models[0].values())


@pytest.mark.parametrize("name", ["/vsitar/{}", "/vsizip/{{{}}}"])
def test_other_archives_and_other_names_of_them(sample, tmp_path, name):
    kind = "gztar" if "tar" in name else "zip"
    archive = shutil.make_archive(str(tmp_path / "order"), kind, sample / "ikonos")
    scene = open_scene(f"{name.format(archive)}/{PRODUCTS['ikonos']}")
    assert (scene.sensor, list(scene.models)) == ("ikonos", ["rpc", "geo"])


def test_bands_and_points_of_other_bands_in_an_archive(sample, tmp_path):
    folder = sample / "ikonos"
    inside = zipped(folder, tmp_path / "order.zip")
    (here, there) = (open_scene(f"{place}/po_39001_red_0000000.tif", SceneOptions(sensor_options={"bands": "all"}))
                     for place in (folder, inside))  # fmt: skip
    assert [Path(piece.path).name for piece in there.pieces] == [Path(piece.path).name for piece in here.pieces]
    assert [(piece.offset, piece.scale, piece.size) for piece in there.pieces] == [
        (piece.offset, piece.scale, piece.size) for piece in here.pieces
    ]
    assert list(map(str, there.rasters)) == [f"{inside}/po_39001_{band}_0000000.tif"
                                             for band in ("blu", "grn", "red", "nir")]  # fmt: skip
    # Points that were measured in the panchromatic image count for the red one.
    lines = (folder / "gcps.csv").read_text().splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("id,"))
    rows = [f"{line},{'image' if number == 0 else PRODUCTS['ikonos']}" for number, line in enumerate(lines[start:])]
    points = tmp_path / "points.csv"
    points.write_text("\n".join([*lines[:start], *rows]) + "\n")
    control = PointOptions(gcps=points)
    on_disk, inside_too = (
        commands.fit(f"{place}/po_39001_red_0000000.tif", points=control).to_json() for place in (folder, inside)
    )
    assert inside_too["rmse"] == on_disk["rmse"]
    assert inside_too["rmse"]["control"]["n"] == 20


def test_the_ortho_from_an_archive_is_that_from_disk(sample, tmp_path):
    folder = sample / "ikonos"
    inside = zipped(folder, tmp_path / "order.zip")
    made = {
        place: commands.rectify(
            f"{place}/po_39001_red_0000000.tif", tmp_path / str(number),
            scene=SceneOptions(sensor_options={"bands": "red,nir"}),
            surface=SurfaceOptions(dem=f"{place}/dem.tif"),
            output=OutputOptions(resolution=(50.0, 50.0)),
        )
        for number, place in enumerate((folder, inside))
    }  # fmt: skip
    here, there = (gdal.Open(str(result.files["ortho"])) for result in made.values())
    assert here.RasterCount == 2
    assert here.GetGeoTransform() == there.GetGeoTransform()
    assert (here.ReadAsArray() == there.ReadAsArray()).all()
    documents = [result.document["report"] for result in made.values()]
    (read,) = documents[1]["provenance"]["inputs"]
    archive = tmp_path / "order.zip"
    assert (read["path"], read["sha256"]) == (str(archive), sha256(archive))
    assert documents[1]["scene"]["model_source"] == f"{inside}/po_39001_red_0000000_rpc.txt"


@pytest.mark.parametrize(
    ("sensor", "beside"),
    [
        ("bilsat", {"bilsat_survey.txt"}), ("cartosat", {"BANDA_MET.TXT", "BANDA_RPC.TXT"}),
        ("orbview3", {ORBVIEW.replace(".tif", ".pvl"), ORBVIEW.replace(".tif", "_rpc.txt")}),
    ],
)  # fmt: skip
def test_the_record_names_all_metadata_that_were_read(sample, sensor, beside):
    from ortho_pipeline.commands.resolved.ledger import Ledger
    from ortho_pipeline.commands.resolved.request import Request

    image = sample / sensor / PRODUCTS[sensor]
    read = {path.name for path in Ledger.of(Request(image), open_scene(image)).roles}
    assert read == beside | {image.name}


def test_metadata_in_an_archive_beside_an_image_on_disk(sample, tmp_path):
    inside = zipped(sample / "bilsat", tmp_path / "order.zip")
    shutil.copyfile(sample / "bilsat" / "bilsat.tif", tmp_path / "alone.tif")
    words = ["--sensor", "bilsat", "--sensor-option", f"survey={inside}/bilsat_survey.txt"]
    done = run("rectify", tmp_path / "alone.tif", *words, "--height", 500, "-tr", 200, "-o", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)["report"]["provenance"]
    assert {Path(one["path"]).name for one in record["inputs"]} == {"alone.tif", "order.zip"}


def test_frame_tables_in_an_archive(tmp_path):
    folder = tmp_path / "flight"
    folder.mkdir()
    gdal.GetDriverByName("GTiff").Create(str(folder / "one.tif"), 60, 40, 1)
    camera = {"width": 60, "height": 40, "focal_length_mm": 50, "pixel_pitch_um": [5, 5]}
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "poses.csv").write_text("filename,x,y,z,omega,phi,kappa\none.tif,500000,4600000,2000,1,2,3\n")
    inside = zipped(folder, tmp_path / "flight.zip")
    found = []
    for place in (str(folder), inside):
        given = {"camera": f"{place}/camera.json", "exterior": f"{place}/poses.csv", "crs": "EPSG:32636",
                 "vertical": "ellipsoid"}  # fmt: skip
        words = [word for key, value in given.items() for word in ("--sensor-option", f"{key}={value}")]
        found.append(facts(f"{place}/one.tif", *words, folder=place))
    assert found[0]["sensor"] == "frame"
    assert found[0] == found[1]


def test_a_sensor_of_somebody_else_in_an_archive(tmp_path):
    """The example of docs/plugins.md does nothing for archives but to begin at `place`."""
    root, folder = Path(__file__).parent.parent.parent, tmp_path / "delivery"
    folder.mkdir()
    gdal.GetDriverByName("GTiff").Create(str(folder / "scene.tif"), 120, 90)
    flight = (root / "docs" / "plugins.md").read_text().partition("```json\n")[2].partition("```")[0]
    (folder / "scene.tinysat.json").write_text(flight)
    code = root / "examples" / "ortho_tinysat" / "ortho_tinysat.py"
    spec = importlib.util.spec_from_file_location("ortho_tinysat_here", code)
    tinysat = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tinysat)
    inside = zipped(folder, tmp_path / "order.zip")
    found = [Host([tinysat]).open_scene(f"{place}/scene.tif") for place in (folder, inside)]
    assert found[0].model.to_dict() == found[1].model.to_dict()
    assert found[1].model_source == f"{inside}/scene.tinysat.json"


# -- archives of strangers -------------------------------------------------------------------------------------------

#: What a sensor reads next to its image, and by what beginning it takes the file for its own.
READ = {
    "ikonos": ("po_39001_metadata.txt", b"IKONOS"),
    "orbview3": (ORBVIEW.replace(".tif", ".pvl"), b"OV-3"),
    "cartosat": ("BANDA_MET.TXT", b"SatID = CARTOSAT-1\n"),
    "bilsat": ("bilsat_survey.txt", b"BILSAT-1 IMAGING SURVEY 1\n"),
}


@pytest.mark.parametrize("sensor", READ)
def test_a_bomb_is_not_unpacked(sample, tmp_path, monkeypatch, sensor):
    name, beginning = READ[sensor]
    archive = tmp_path / "bomb.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as made:
        made.write(sample / sensor / PRODUCTS[sensor], PRODUCTS[sensor])
        made.writestr(name, beginning + b" " * 20_000_000)
    asked: list[int] = []
    read = VsiPath.read
    monkeypatch.setattr(VsiPath, "read", lambda self, limit: asked.append(limit) or read(self, limit))
    done = run("info", f"/vsizip/{archive}/{PRODUCTS[sensor]}", "--sensor", sensor)
    assert done.exit_code == 2, done.output
    assert name in done.stderr or "no metadata" in done.stderr
    assert 0 < max(asked) <= MAX_READ + 1


def test_no_more_is_read_whole_than_may_be(tmp_path):
    archive = tmp_path / "bomb.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("large.txt", b"1" * (MAX_READ + 1))
        made.writestr("small.txt", "é 1\n")
    large, small = (VsiPath(f"/vsizip/{archive}/{name}.txt") for name in ("large", "small"))
    for whole in (large.read_bytes, large.read_text, large.open):
        with pytest.raises(OSError, match="5 MB"):
            whole()
    assert len(read_bounded(large, 1000)) == 1001
    assert small.open().read() == small.read_text() == "é 1\n"
    assert small.open("rb").read() == "é 1\n".encode()


def test_names_that_lead_out_of_an_archive_are_not_followed(sample, tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    shutil.copyfile(sample / "bilsat" / "bilsat_survey.txt", tmp_path / "bilsat_survey.txt")
    archive = inner / "order.zip"
    survey = (sample / "bilsat" / "bilsat_survey.txt").read_bytes()
    with zipfile.ZipFile(archive, "w") as made:
        made.write(sample / "bilsat" / "bilsat.tif", "deep/bilsat.tif")
        for name in ("../bilsat_survey.txt", "deep/../../bilsat_survey.txt", "/bilsat_survey.txt", "bilsat_survey.txt"):
            made.writestr(name, survey)
        link = zipfile.ZipInfo("deep/bilsat_survey.txt")
        link.external_attr = 0o120777 << 16
        made.writestr(link, str(tmp_path / "bilsat_survey.txt"))
    # A link in an archive is a file that holds a path, and here no survey.
    with pytest.raises(InputError, match="no sensor recognises"):
        open_scene(f"/vsizip/{archive}/deep/bilsat.tif")
    top = {path.name for path in VsiPath(f"/vsizip/{archive}").iterdir()}
    assert not top & {"..", ".", ""}
    with pytest.raises(OSError, match="no such folder"):
        list(VsiPath(f"/vsizip/{archive}").parent.iterdir())


def test_a_path_in_an_archive_has_the_methods_of_one_on_disk(sample, tmp_path):
    inside = VsiPath(zipped(sample / "ikonos", tmp_path / "order.zip"))
    on_disk = sample / "ikonos"
    for pattern in ("*_rpc.txt", "po_*", "*.tif"):
        assert {path.name for path in inside.glob(pattern)} == {path.name for path in on_disk.glob(pattern)}
    for name in ("po_39001_metadata.txt", "none.txt"):
        here, there = on_disk / name, inside / name
        for asked in ("exists", "is_file", "is_dir"):
            assert getattr(here, asked)() == getattr(there, asked)()
        assert (there.name, there.stem, there.suffix) == (here.name, here.stem, here.suffix)
        assert there.with_suffix(".x").name == here.with_suffix(".x").name
    assert inside.is_dir()
    assert (inside / "gcps.csv").read_text() == (on_disk / "gcps.csv").read_text()
    assert (inside / "gcps.csv").stat().st_size == (on_disk / "gcps.csv").stat().st_size


# -- links -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", PRODUCTS)
def test_a_link_to_an_image_is_its_product(sample, tmp_path, sensor):
    link = tmp_path / PRODUCTS[sensor]
    link.symlink_to(sample / sensor / PRODUCTS[sensor])
    for words in ((), ("--sensor", sensor)):
        found = json.loads(run("info", link, *words, "--json").stdout)
        assert found["sensor"] == sensor
        assert found["model_source"].startswith(str(sample / sensor))


def test_what_lies_beside_a_link_goes_first(sample, tmp_path):
    for name in ("bilsat.tif", "bilsat_survey.txt"):
        (tmp_path / name).symlink_to(sample / "bilsat" / name)
    scene = open_scene(tmp_path / "bilsat.tif")
    assert (str(scene.path), scene.model_source) == (str(tmp_path / "bilsat.tif"), str(tmp_path / "bilsat_survey.txt"))


def test_an_rpc_beside_the_target_of_a_link(sample, tmp_path):
    link = tmp_path / "elsewhere.tif"
    shutil.copyfile(sample / "cartosat" / "BANDA.tif", tmp_path / "image.tif")
    shutil.copyfile(sample / "cartosat" / "BANDA_RPC.TXT", tmp_path / "image_RPC.TXT")
    (tmp_path / "links").mkdir()
    link = tmp_path / "links" / "image.tif"
    link.symlink_to(tmp_path / "image.tif")
    result = commands.rectify(link, tmp_path / "out", surface=SurfaceOptions(height=0.0),
                              output=OutputOptions(resolution=(20.0, 20.0)))  # fmt: skip
    inputs = result.document["report"]["provenance"]["inputs"]
    assert {Path(one["path"]).name for one in inputs} == {"image.tif", "image_RPC.TXT"}


# -- real files ------------------------------------------------------------------------------------------------------


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("sensor", "image", "beside"),
    [
        ("orbview3", "md_ov.tif", ("md_ov.pvl", "md_ov_rpc.txt")),
        ("ikonos", "md_ge_rgb_0010000.tif", ("md_ge_metadata.txt", "md_ge_rgb_0010000_rpc.txt")),
    ],
)
def test_real_metadata_in_an_archive(real, tmp_path, sensor, image, beside):
    data, folder = real / "gdal" / "gcore" / "data", tmp_path / "delivery"
    folder.mkdir()
    for name in (image, *beside):
        # The vendor's names begin with po_ and the number of the order.
        shutil.copyfile(data / name, folder / name.replace("md_ge", "po_0000000"))
    inside = zipped(folder, tmp_path / "order.zip")
    name = image.replace("md_ge", "po_0000000")
    here, there = (run("info", f"{place}/{name}", "--json") for place in (folder, inside))
    assert here.exit_code == there.exit_code
    if here.exit_code:
        assert there.stderr.replace(inside, "F") == here.stderr.replace(str(folder), "F")
        assert sensor in ("ikonos", "orbview3")
    else:
        assert json.loads(here.stdout)["sensor"] == sensor
        assert facts(f"{inside}/{name}", folder=inside) == facts(folder / name, folder=str(folder))
