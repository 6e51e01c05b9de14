"""`ortho adjust --export`: files for CARS, Ames Stereo Pipeline and s2p, against their published formats."""

from __future__ import annotations

import json
import os
import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
from click.testing import CliRunner
from ortho_asp.stereo import asp_text
from ortho_csm.files import read_csm
from osgeo import gdal
from pair import BIAS, LAT, LON, SIZE, Pair

import ortho_pipeline as op
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.errors import CoverageError, InputError, PluginError
from ortho_pipeline.exchange.block_export import BlockExport, ExportedImage, ImagePair, pairs_of
from ortho_pipeline.exchange.rpc import read_rpc
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.hookspecs import BlockFormat, hookimpl
from ortho_pipeline.host import Host
from ortho_pipeline.options import BlockOptions, SurfaceOptions
from ortho_pipeline.surface.writing import write_dem

ALL = ("cars", "asp", "s2p")


@pytest.fixture
def pair(tmp_path: Path) -> Pair:
    return Pair(tmp_path / "pair")


def ground_of(model: op.SensorModel) -> np.ndarray:
    columns, rows = np.meshgrid(np.linspace(0, SIZE, 5), np.linspace(0, SIZE, 5))
    image = np.column_stack([columns.ravel(), rows.ravel()])
    return np.concatenate([model.image_to_ground(image, height) for height in (200.0, 500.0, 800.0)])


def test_every_file_of_a_model_is_read_again_as_the_adjusted_model(pair: Pair, tmp_path: Path) -> None:
    done = adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=ALL)
    for name in pair.rpcs:
        adjusted = op.load_model(done.files[f"{name} model"])
        ground = ground_of(adjusted)
        image = adjusted.ground_to_image(ground)
        assert np.abs(image - pair.rpcs[name].ground_to_image(ground) - BIAS[name]).max() < 0.2
        for kind in ("geom", "rpc-xml", "rpc-txt"):
            again = read_rpc(done.files[f"{name} {kind}"])
            np.testing.assert_allclose(again.ground_to_image(ground), image, rtol=0, atol=1e-6)


def test_cars_gets_sensors_pairs_and_heights_above_the_ellipsoid(pair: Pair, tmp_path: Path) -> None:
    out = tmp_path / "out"
    surface = SurfaceOptions(dem=pair.dem())
    done = adjust(pair.images, out, BlockOptions(points=pair.points()), surface=surface, export=["cars"])
    document = json.loads(done.files["cars"].read_text())
    sensors = document["input"]["sensors"]
    assert list(sensors) == ["aft", "fore"]
    for name, sensor in sensors.items():
        assert (out / sensor["image"]["path"]).resolve() == pair.image(name).resolve()
        assert (out / sensor["geomodel"]["path"]).is_file()
    assert document["input"]["pairing"] == [["aft", "fore"]]
    assert document["output"]["geoid"] is False
    elevation = document["input"]["initial_elevation"]
    assert elevation == {"dem": "elevation.tif", "geoid": None}
    # EGM96 is 500 m in the DEM; what CARS gets is above the ellipsoid, less the error that the adjustment found in it.
    given = gdal.Open(str(out / "elevation.tif"))
    undulation = op.open_dem(pair.dem()).heights([[LON, LAT]], "EPSG:4326")[0] - 500.0
    assert abs(undulation) > 20
    report = json.loads(done.files["report"].read_text())
    assert given.ReadAsArray()[100, 100] == pytest.approx(500.0 + undulation, abs=2.0), report["warnings"]


def test_the_coarse_dem_is_no_wider_where_images_meet_at_the_antimeridian(tmp_path: Path) -> None:
    """One RPC counts longitudes from 180 degrees, the other one from -180."""
    pair = Pair(tmp_path / "pair", turns={"aft": 180.0 - LON, "fore": -180.0 - LON})
    dem = tmp_path / "dem.tif"
    write_dem(dem, np.full((120, 120), 500.0), (180.0 - 0.06, LAT + 0.06), 0.001, "EPSG:4326+5773")
    surface = SurfaceOptions(dem=dem)
    adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), surface=surface, export=["cars"])
    elevation = gdal.Open(str(tmp_path / "out" / "elevation.tif"))
    assert elevation.RasterXSize * elevation.GetGeoTransform()[1] < 0.2


def test_s2p_gets_what_it_requires(pair: Pair, tmp_path: Path) -> None:
    """The keys are those of `s2p.initialization.check_parameters` and of `s2p.config.cfg`."""
    done = adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=["s2p"])
    document = json.loads(done.files["s2p"].read_text())
    known = {"out_dir", "full_img", "dsm_resolution", "out_crs", "disp_range_method", "exogenous_dem", "images"}
    assert set(document) <= known | {"exogenous_dem_geoid_mode"}
    assert document["full_img"] is True
    # The first image is the reference of s2p.
    assert [Path(image["img"]).stem for image in document["images"]] == ["aft", "fore"]
    assert all((tmp_path / "out" / image["rpc"]).is_file() for image in document["images"])


def test_asp_gets_a_script_and_cameras_as_its_own_writer_makes_them(pair: Pair, tmp_path: Path) -> None:
    """The elements are those of `asp::RPCModel::saveXML`, which `asp::RPCXML::parse_rpb` reads."""
    surface = SurfaceOptions(dem=pair.dem())
    done = adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), surface=surface, export=["asp"])
    commands = [shlex.split(line) for line in done.files["asp"].read_text().splitlines() if not line.startswith("#")]
    programs = [words[0] for words in commands]
    assert programs == ["set", "cd", "mapproject", "mapproject", "parallel_stereo", "point2dem"]
    stereo = commands[4]
    assert stereo[1:3] == ["-t", "rpc"]
    assert stereo[-6:-2] == ["asp/aft_map.tif", "asp/fore_map.tif", "aft_rpc.xml", "fore_rpc.xml"]
    assert stereo[-1] == "elevation.tif"
    image = ElementTree.parse(tmp_path / "out" / "aft_rpc.xml").getroot().find("RPB/IMAGE")
    assert image is not None
    for name in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT"):
        assert float(image.findtext(f"{name}OFFSET", "")) is not None
        assert float(image.findtext(f"{name}SCALE", "")) > 0
    for name in ("LINENUM", "LINEDEN", "SAMPNUM", "SAMPDEN"):
        assert len(image.findtext(f"{name}COEFList/{name}COEF", "").split()) == 20


def test_asp_gets_states_of_rigorous_models(sample: Path, tmp_path: Path) -> None:
    folder, out = sample / "cartosat", tmp_path / "out"
    images = [folder / "BANDF.tif", folder / "BANDA.tif"]
    done = adjust(images, out, BlockOptions(points=folder / "points.csv", model="pushbroom"), export=["asp"])
    stereo = next(line for line in done.files["asp"].read_text().splitlines() if line.startswith("parallel_stereo"))
    assert "-t csm" in stereo
    assert "BANDF_csm.json BANDA_csm.json" in stereo
    for name in ("BANDF", "BANDA"):
        model, state = op.load_model(done.files[f"{name} model"]), read_csm(out / f"{name}_csm.json")
        ground = ground_of(model)
        seen = state.ground_to_image(ground_transform(model.crs, state.crs)(ground))
        np.testing.assert_allclose(seen, model.ground_to_image(ground), rtol=0, atol=1e-6)


def test_images_that_look_like_maps_are_given_without_their_georeference(pair: Pair, tmp_path: Path) -> None:
    pair.georeference()
    done = adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=["cars"])
    sensors = json.loads(done.files["cars"].read_text())["input"]["sensors"]
    assert sensors["aft"]["image"]["path"] == "aft_image.vrt"
    bare = gdal.Open(str(tmp_path / "out" / "aft_image.vrt"))
    assert bare.GetGeoTransform(can_return_null=True) is None
    assert (bare.GetSpatialRef(), bare.GetGCPCount(), bare.GetMetadata("RPC")) == (None, 0, {})
    np.testing.assert_array_equal(bare.ReadAsArray(), gdal.Open(str(pair.image("aft"))).ReadAsArray())


def test_the_command_takes_several_programs_and_says_what_to_run(pair: Pair, tmp_path: Path) -> None:
    words = ["adjust", *pair.images, "--points", str(pair.points()), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(cli, [*words, "--export", "cars,asp", "--export", "s2p"])
    assert done.exit_code == 0, done.output
    assert f"CARS 1: `cars {tmp_path / 'out' / 'cars.json'}`" in done.output
    directions = []
    for rpc in pair.rpcs.values():
        low, high = rpc.image_to_ground([[150.0, 150.0], [150.0, 150.0]], np.array([200.0, 800.0]))
        directions.append((high - low) * [111_320 * np.cos(np.radians(LAT)), 110_850, 1])
    cosine = directions[0] @ directions[1] / np.prod([np.linalg.norm(one) for one in directions])
    said = re.search(r"Stereo pair aft and fore: (\S+) degrees apart", done.output)
    assert said is not None
    assert float(said[1]) == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.2)
    assert {"cars.json", "asp.sh", "s2p.json"} <= set(os.listdir(tmp_path / "out"))
    listed = " ".join(CliRunner().invoke(cli, ["adjust", "--help"]).stdout.split())
    assert "asp (Ames Stereo Pipeline 3), cars (CARS 1), s2p (s2p)" in listed


def leaning(tangent: float, first: float = 0.0, size: tuple[int, int] = (400, 300)) -> tuple[op.RPC, tuple[int, int]]:
    """Return an image of 400 x 300 pixels from its column `first` on, whose rays go so many metres east per metre up.

    They meet at 500 m.
    """
    one, column, row = np.eye(20)[0], np.eye(20)[1], -np.eye(20)[2]
    radius = pyproj.Geod(ellps="WGS84").inv(20.0, -30.0, 20.01, -30.0)[2] * (1 + 500 / 6_384_000)
    column[3] = -tangent * 500.0 / radius
    return op.RPC(
        200.0 - first, 150.0, 20.0, -30.0, 500.0, 200.0, 150.0, 0.01, 0.0065, 500.0, column, one, row, one
    ), size


@pytest.mark.parametrize(
    ("first", "second", "overlap", "angle_deg"),
    [
        (leaning(0.2), leaning(-0.2), 1.0, 2 * np.degrees(np.arctan(0.2))),
        (leaning(0.0), leaning(0.5, first=200.0), 0.5, np.degrees(np.arctan(0.5))),
        # All of a small image counts, whichever is named first.
        (leaning(0.1), leaning(0.3, first=100.0, size=(200, 300)), 1.0, np.degrees(np.arctan(0.3) - np.arctan(0.1))),
        (leaning(0.3, first=100.0, size=(200, 300)), leaning(0.1), 1.0, np.degrees(np.arctan(0.3) - np.arctan(0.1))),
        (leaning(0.0), leaning(np.tan(np.radians(1.05))), 1.0, 1.05),
    ],
)
def test_overlap_and_angle_of_a_pair_are_those_of_its_rays(first, second, overlap, angle_deg) -> None:
    (pair,) = pairs_of({"a": first, "b": second}, 500.0)
    assert (pair.first, pair.second) == ("a", "b")
    assert pair.overlap == pytest.approx(overlap, abs=1 / 32)
    assert pair.angle_deg == pytest.approx(angle_deg, rel=0.01)


@pytest.mark.parametrize(
    ("second", "message"),
    [(leaning(np.tan(np.radians(0.95))), "less than 1 degree"), (leaning(0.5, first=388.0), "no images overlap")],
)
def test_views_that_make_no_pair_are_refused(second, message) -> None:
    with pytest.raises(CoverageError, match=message):
        pairs_of({"a": leaning(0.0), "b": second}, 500.0)


# -- refusals --------------------------------------------------------------------------------------------------------


def test_images_without_overlap_are_one_error(tmp_path: Path) -> None:
    pair = Pair(tmp_path / "pair", away=0.2)
    with pytest.raises(CoverageError, match="no images overlap") as caught:
        adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=["cars"])
    assert (caught.value.field, bool(caught.value.remedy)) == ("export", True)
    assert not (tmp_path / "out").exists()


def test_a_dem_of_another_place_is_one_error(pair: Pair, tmp_path: Path) -> None:
    far = tmp_path / "far.tif"
    gdal.Translate(str(far), str(pair.dem()), outputBounds=[30.0, 10.0, 30.1, 9.9])
    surface = SurfaceOptions(dem=far)
    with pytest.raises(CoverageError) as caught:
        adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), surface=surface, export=["cars"])
    assert "surface.dem" in str(caught.value.field)


def test_an_unknown_program_is_refused_before_any_work(pair: Pair, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown program micmac") as caught:
        adjust(pair.images, tmp_path / "out", BlockOptions(points="no such file"), export=["micmac"])
    assert "asp, cars, s2p" in str(caught.value.remedy)


def test_an_export_into_a_store_of_objects_is_refused() -> None:
    words = ["adjust", "a.tif", "b.tif", "--points", "p.csv", "--export", "cars", "-o", "s3://bucket/block"]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 2
    assert "read images and models from disk" in done.output


def test_names_that_begin_with_a_dash_are_no_options_of_asp() -> None:
    images = {name: ExportedImage(f"{name}.tif", f"{name}_rpc.xml", (9, 9)) for name in ("-a", "b")}
    block = BlockExport(images, "rpc-xml", [ImagePair("-a", "b", 0.9, 20.0)], 2.5, "EPSG:32636")
    words = shlex.split(asp_text(block), comments=True)
    assert {"./-a.tif", "./-a_rpc.xml", "b.tif"} <= set(words)


def test_asp_refuses_images_of_several_bands(tmp_path: Path) -> None:
    pair = Pair(tmp_path / "pair", bands=3)
    with pytest.raises(InputError, match="one band, but aft has 3"):
        adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=["asp"])


def fails(export: object) -> str:
    raise KeyError("sensors")


@pytest.mark.parametrize(
    ("offered", "message"),
    [
        ({"file": "../a.json"}, "the file must be like 'name.json'"),
        ({"file": "cars.json"}, "the format 'cars' has the same ending|the format 'mine' has the same ending"),
        ({"models": ()}, "models must name formats"),
        ({"text": "text"}, "text must be callable"),
        ({"text": fails}, r"format 'mine' of plugin other failed \(KeyError: 'sensors'"),
        ({"text": lambda export: ""}, "text returned ''"),
        ({"models": ("none",)}, "unknown format none"),
    ],
)
def test_a_format_that_is_none_names_its_plugin(pair, tmp_path, monkeypatch, offered, message) -> None:
    import types

    format_of = {"name": "mine", "title": "mine", "file": "mine.txt", "models": ("geom",), "command": "mine"}
    module = types.ModuleType("other")
    module.ortho_formats = hookimpl(  # type: ignore[attr-defined]
        lambda: [BlockFormat(**{**format_of, "text": lambda export: "x", **offered})]
    )
    host = Host([module], installed=True)
    monkeypatch.setattr(Host, "discover", lambda: host)
    with pytest.raises((PluginError, InputError), match=message):
        adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=["mine"])
    assert not (tmp_path / "out").exists()
