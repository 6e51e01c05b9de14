"""Inputs that are cut off, misnamed, linked in circles or at the edges of the Earth: right, or an error that helps."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline import commands
from ortho_pipeline.batch import plan as batch_plan
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.files import read_json
from ortho_pipeline.imaging.matching import open_references
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.stores.stac.item import read_item

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
SMALL = OutputOptions(extent=(530600.0, 4122000.0, 530800.0, 4122200.0))


def copied(folder: Path, stem: str = "scene") -> Path:
    """Copy the sample scene and DEM under a name of their own."""
    folder.mkdir(parents=True, exist_ok=True)
    for ending in (".tif", "_RPC.TXT"):
        shutil.copyfile(SAMPLE / f"scene{ending}", folder / f"{stem}{ending}")
    shutil.copyfile(SAMPLE / "dem.tif", folder / "dem.tif")
    return folder / f"{stem}.tif"


def helps(error: OrthoError, out: Path, word: str = "") -> None:
    """Hold that an error names what it is about and what to do, and that there is no ortho."""
    assert word in str(error)
    assert error.remedy
    assert not list(out.rglob("*.tif"))


def rectify(image: Path, out: Path) -> Path:
    surface = SurfaceOptions(dem=str(image.parent / "dem.tif"))
    commands.rectify(image, out, surface=surface, output=SMALL)
    return out / f"{image.stem}_ortho.tif"


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_source_that_is_cut_off_is_named_and_leaves_no_ortho(tmp_path, share):
    image = copied(tmp_path / "in")
    data = image.read_bytes()
    # The directory of this file lies in front of its tiles: it opens, and its pixels are not there.
    image.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError) as caught:
        commands.rectify(image, tmp_path / "out", surface=SurfaceOptions(dem=str(image.parent / "dem.tif")))
    helps(caught.value, tmp_path / "out", "scene.tif")
    assert str(caught.value).count("scene.tif") == 1
    assert ".)" not in str(caught.value)


@pytest.mark.parametrize("kind", ["folder", "no XML", "loop"])
def test_an_aux_xml_that_cannot_be_read_is_an_error_or_does_no_harm(tmp_path, kind):
    image = copied(tmp_path / "in")
    aux = Path(f"{image}.aux.xml")
    if kind == "folder":
        aux.mkdir()
    elif kind == "loop":
        aux.symlink_to(aux.name)
    else:
        aux.write_bytes(b"\xff\xfe<PAMDataset><Metadata domain=")
    try:
        assert rectify(image, tmp_path / "out").is_file()
    except InputError as error:
        helps(error, tmp_path / "out", "aux.xml")


ODD = [
    "a\nb",
    'a"b',
    "a'b",
    "a%41b",
    "a%sb",
    "-a",
    "a;b",
    "a&b<c>",
    "a" * 120,
    "ä" * 50,
    "a b ",
    os.fsdecode(b"a\xff\xfe"),
]


@pytest.mark.parametrize("stem", ODD, ids=[ascii(stem[:8]) for stem in ODD])
def test_odd_names_give_an_ortho_of_that_name_or_an_error_about_it(tmp_path, stem):
    image = copied(tmp_path / "in", stem)
    try:
        assert rectify(image, tmp_path / "out").is_file()
    except InputError as error:
        helps(error, tmp_path / "out")


def test_links_in_circles_end_below_two_stars(tmp_path):
    folder = tmp_path / "in"
    copied(folder / "a")
    (folder / "a" / "up").symlink_to(folder)
    # Two that lead up: followed to the system's limit of 40 links they would be 2 to the power of 40 paths.
    (folder / "a" / "again").symlink_to(folder)
    (folder / "a" / "self").symlink_to("self")
    (folder / "run.yaml").write_text(
        "scenes:\n  - images: '**/scene.tif'\noutput: out\ndefaults:\n  surface: {dem: a/dem.tif}\n"
        "  output: {crs: 'EPSG:32636', resolution: 10}\n"
    )
    planned = batch_plan.plan(folder / "run.yaml")
    assert len(planned.jobs) == 1


#: Longitude, latitude, degrees off nadir, heights: each at an edge of what there is.
EDGES = {
    "north pole": (40.0, 89.7, 10.0, (0.0, 500.0)),
    "south pole": (-120.0, -89.7, 10.0, (2500.0, 3300.0)),
    "antimeridian": (179.999, 10.0, 20.0, (0.0, 500.0)),
    "60 degrees off nadir": (33.35, 37.25, 60.0, (650.0, 1350.0)),
    "below the sea": (35.5, 31.5, 20.0, (-450.0, -380.0)),
}


@pytest.mark.parametrize("place", EDGES)
def test_an_rpc_at_an_edge_is_the_model_or_says_that_it_is_none(tmp_path, place):
    lon, lat, angle, heights = EDGES[place]
    camera = LineScanner.over(
        lon, lat, float(np.mean(heights)), image_width=500, image_height=500, gsd=5.0, off_nadir_deg=angle,
        heights=heights,
    )  # fmt: skip
    image = np.random.default_rng(2).uniform(0, 500, (200, 2))
    height = np.random.default_rng(3).uniform(*heights, 200)
    ground = camera.image_to_ground(image, height)
    # The model itself: there and back.
    assert np.abs(camera.ground_to_image(ground) - image).max() < 1e-3
    try:
        low, high = ground.min(axis=0), ground.max(axis=0)
        found = fit_rpc(camera, (low[0], low[1], high[0], high[1]), heights)
    except OrthoError as error:
        helps(error, tmp_path)
        return
    # What it says of itself is what is measured at points of its own; 0.05 px is beside what any control resolves.
    assert np.abs(found.rpc.ground_to_image(ground) - image).max() <= max(0.05, 1.5 * found.max_error_px)


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="a file whose every read fails (EIO) is Linux's")
@pytest.mark.parametrize(
    "words",
    [
        ("info", "BAD"),
        ("info", "IMAGE", "--rpc", "BAD"),
        ("info", "IMAGE", "--model", "BAD"),
        ("fit", "IMAGE", "--gcps", "BAD"),
        ("rectify", "IMAGE", "--dem", "BAD", "-o", "OUT"),
        ("run", "BAD"),
        ("report", "BAD", "--plots", "OUT"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, words):
    places = {"BAD": "/proc/self/mem", "IMAGE": str(SAMPLE / "scene.tif"), "OUT": str(tmp_path / "out")}
    ended = CliRunner().invoke(cli, [places.get(word, word) for word in words])
    assert ended.exit_code == 2, ended.output
    assert "/proc/self/mem" in ended.output
    assert "Remedy" in ended.output
    assert not (tmp_path / "out").exists()


def test_a_format_that_this_gdal_was_built_without_is_named(tmp_path):
    """As with wheels of GDAL: what cannot be read is refused by the name of the driver, not as if it were no raster."""
    files = {
        "scene.TIL": ("TIL", b"numTiles = 1;"), "DIM_A.XML": ("DIMAP", b"<?xml version='1.0'?><Dimap_Document/>"),
        "a.ntf": ("NITF", b"NITF02.10" + bytes(400)), "N45E007.hgt": ("SRTMHGT", bytes(800)),
        "folder": ("DIMAP", None),
    }  # fmt: skip
    for name, (_, content) in files.items():
        if content is None:
            (tmp_path / name).mkdir()
            (tmp_path / name / "DIM_A.XML").touch()
        else:
            (tmp_path / name).write_bytes(content)
    program = (
        "import sys\nfrom ortho_pipeline.errors import InputError\n"
        "from ortho_pipeline.raster.source import open_dataset\n"
        "for path in sys.argv[1:]:\n    try:\n        open_dataset(path)\n    except InputError as error:\n"
        "        print(str(error).replace(chr(10), ' '))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *(tmp_path / name for name in files)], capture_output=True, text=True,
        env=os.environ | {"GDAL_SKIP": ",".join({driver for driver, _ in files.values()})}, check=True,
    )  # fmt: skip
    said = done.stdout.splitlines()
    assert len(said) == len(files), done.stderr
    for line, (name, (driver, _)) in zip(said, files.items(), strict=True):
        assert name in line
        assert f"GDAL's driver {driver}, but this GDAL" in line
        assert "Remedy: use a GDAL that has it" in line


# -- texts that are no text, places that are no place ------------------------------------------------------------------


@pytest.mark.parametrize("where", ["href", "id", "key", "far"])
def test_a_lone_surrogate_in_a_document_is_refused(where: str, tmp_path: Path) -> None:
    href = {"href": "a\ud800.tif", "far": "http://host/\ud800.tif"}.get(where, "a.tif")
    document = {"type": "Feature", "stac_version": "1.0.0", "id": "one\udfff" if where == "id" else "one", "links": []}
    key = "image\ud800" if where == "key" else "image"
    assets = {key: {"href": href, "roles": ["data"], "type": "image/tiff"}}
    (tmp_path / "item.json").write_text(json.dumps({**document, "properties": {}, "assets": assets}))
    with pytest.raises(InputError, match=r"item\.json"):
        read_item(tmp_path / "item.json")


def test_a_pair_of_surrogates_is_a_character(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"name": "scene \U0001f6f0"}))
    assert "\\ud83d" in (tmp_path / "a.json").read_text()
    assert read_json(tmp_path / "a.json", 1000, "")["name"] == "scene \U0001f6f0"


@pytest.mark.parametrize(
    "place", ["inf,1,0,50,0,-1", "0,1,0,nan,0,-1", "0,1,0,-inf,0,-1", "0,1e999,0,0,0,-1", "0,1,0,0,0,-1e-320",
              "1e308,1e-5,0,0,0,-1e-5"]
)  # fmt: skip
def test_a_reference_that_lies_nowhere_is_refused(place: str, tmp_path: Path) -> None:
    path = tmp_path / "r.vrt"
    path.write_text(
        f'<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>EPSG:32636</SRS><GeoTransform>{place}</GeoTransform>'
        '<VRTRasterBand dataType="Float32" band="1"/></VRTDataset>'
    )
    with pytest.raises(InputError, match=r"r\.vrt"):
        open_references([path])
    if "n" in place or "999" in place:
        # Whatever it is opened for: an image, a DEM, a template of a grid, a source of heights.
        with pytest.raises(InputError, match=r"r\.vrt"):
            open_dataset(path)
