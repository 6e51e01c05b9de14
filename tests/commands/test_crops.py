"""Whether the RPC of a crop belongs to the crop or to the larger image: by evidence, or not at all.

The sample scene's RPC has a range that begins far before its first pixel, as RPCs that are fitted over a padded box do.
"""

from __future__ import annotations

import json
import pickle
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.block import intersect
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.crop import UndecidedCrop
from ortho_pipeline.options import BlockOptions, MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from tests.conftest import SAMPLE

gdal.UseExceptions()
WHOLE = SceneOptions(rpc=str(SAMPLE / "scene_RPC.TXT"))
PLACE, SIZE = (310, 217), (400, 380)


def crop_of(path: Path, place: tuple[int, int] = PLACE, size: tuple[int, int] = SIZE, *, tags: Any = None) -> Path:
    """Cut the sample scene as programs do that know no RPC, and note the place."""
    pixels = gdal.Open(str(SAMPLE / "scene.tif")).ReadAsArray(*place, *size)
    made = gdal.GetDriverByName("GTiff").Create(str(path), *size, 1, gdal.GDT_UInt16)
    made.SetGeoTransform((place[0], 1, 0, place[1], 0, 1))
    made.SetMetadata(tags or {})
    made.GetRasterBand(1).WriteArray(pixels)
    return path


def crop_by_gdal(path: Path, place: tuple[int, int] = PLACE, size: tuple[int, int] = SIZE, *, tags: Any = None) -> Path:
    """Cut it with GDAL, which moves the RPC into the crop, and note the place all the same."""
    gdal.Translate(str(path), str(SAMPLE / "scene.tif"), srcWin=[*place, *size])
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.SetGeoTransform((place[0], 1, 0, place[1], 0, 1))
    dataset.SetMetadata(tags or {})
    return path


def points_of(path: Path, place: tuple[int, int] = PLACE) -> PointOptions:
    """Write the sample scene's points in the pixels of the crop, those that it shows."""
    rows = []
    for line in (SAMPLE / "gcps.csv").read_text().splitlines()[3:]:
        name, col, row, *rest = line.split(",")
        column, line_ = float(col) - place[0], float(row) - place[1]
        if 0 <= column <= SIZE[0] and 0 <= line_ <= SIZE[1]:
            rows.append(",".join([name, str(column), str(line_), *rest]))
    path.write_text("#CRS: EPSG:32636\n#vertical: ellipsoid\nid,col,row,x,y,h,role,sigma_image,sigma_xy,sigma_h\n"
                    + "\n".join(rows) + "\n")  # fmt: skip
    return PointOptions(gcps=path, correction="none")


def error_px(scene: Any, place: tuple[int, int] = PLACE) -> float:
    """Return how far (px) a scene is from where the whole image's own model has its pixels."""
    image = np.array([[20.0, 30.0], [350.0, 360.0]])
    ground = open_scene(SAMPLE / "scene.tif").model.image_to_ground(image + place, 900.0)
    return float(np.abs(scene.model.ground_to_image(ground) - image).max())


@pytest.mark.parametrize("moved", [False, True])
def test_no_crop_lies_elsewhere_without_a_word(tmp_path, moved):
    undecided = right = 0
    for column in (1, 120, 310, 411, 600):
        for row in (0, 90, 260, 500):
            place = column, row
            path = (crop_by_gdal if moved else crop_of)(tmp_path / f"c{column}_{row}.tif", place)
            try:
                scene = open_scene(path, SceneOptions() if moved else WHOLE)
            except UndecidedCrop:
                undecided += 1
                continue
            right += 1
            assert error_px(scene, place) < 1e-6, place
    assert undecided + right == 20
    assert min(undecided, right) >= 1


def test_points_decide(tmp_path):
    points = points_of(tmp_path / "p.csv")
    for path, options in ((crop_of(tmp_path / "a.tif"), WHOLE), (crop_by_gdal(tmp_path / "b.tif"), SceneOptions())):
        found = commands.fit(path, points, options)
        assert error_px(found.scene) < 1e-6
        assert [one.code for one in found.scene.notices if one.code.startswith("crop")]
        compared = commands.compare(path, PointOptions(gcps=points.gcps), models="rpc,rpc+shift", scene=options)
        assert error_px(compared.scene) < 1e-6


def test_points_of_the_larger_image_are_no_evidence(tmp_path):
    with pytest.raises(UndecidedCrop):
        commands.fit(
            crop_of(tmp_path / "a.tif", (500, 200), (120, 100)),
            PointOptions(gcps=SAMPLE / "gcps.csv", correction="none"), SceneOptions(rpc=WHOLE.rpc),
        )  # fmt: skip


def test_the_place_of_the_dem_decides(tmp_path):
    size = (150, 140)
    path, other = crop_of(tmp_path / "a.tif", size=size), crop_by_gdal(tmp_path / "b.tif", size=size)
    ground = open_scene(SAMPLE / "scene.tif").model.image_to_ground(
        np.array([[310, 217], [460, 217], [310, 357], [460, 357]]), 900.0
    )
    dem = gdal.Open(str(SAMPLE / "dem.tif"))
    x, y = np.array(gdal.osr.CoordinateTransformation(*_geographic_to(dem)).TransformPoints(ground[:, :2]))[:, :2].T
    cut = str(tmp_path / "dem.tif")
    gdal.Translate(cut, dem, projWin=[x.min() - 120, y.max() + 120, x.max() + 120, y.min() - 120])
    surface = SurfaceOptions(dem=cut)
    for image, options in ((path, WHOLE), (other, SceneOptions())):
        with pytest.raises(UndecidedCrop):
            open_scene(image, options)
        done = commands.export(image, tmp_path / "out", formats=["rpc-txt"], scene=options, surface=surface)
        assert error_px(open_scene(image, SceneOptions(rpc=str(done.files["rpc-txt"]), crop_offset=(0, 0)))) < 1e-6
        # A DEM of the whole place tells nothing.
        with pytest.raises(UndecidedCrop):
            commands.check(image, scene=options, surface=SurfaceOptions(dem=SAMPLE / "dem.tif"))


def _geographic_to(dataset: Any) -> tuple[Any, Any]:
    geographic = gdal.osr.SpatialReference()
    geographic.ImportFromEPSG(4326)
    geographic.SetAxisMappingStrategy(gdal.osr.OAMS_TRADITIONAL_GIS_ORDER)
    return geographic, dataset.GetSpatialRef()


def test_the_size_of_the_whole_in_the_metadata_decides(tmp_path):
    tags = {"gml.root-instance": "<gml:Grid><gml:low>1 1</gml:low>\n<gml:high>1000 1000</gml:high></gml:Grid>"}
    scene = open_scene(crop_of(tmp_path / "a.tif", tags=tags), WHOLE)
    assert error_px(scene) < 1e-6
    assert "1000 x 1000" in scene.warnings[0]
    assert error_px(open_scene(crop_by_gdal(tmp_path / "b.tif", tags=tags))) < 1e-6
    # One that does not hold the crop is not of the whole.
    tags = {"gml.root-instance": "<gml:high>500 500</gml:high>"}
    with pytest.raises(UndecidedCrop):
        open_scene(crop_of(tmp_path / "c.tif", tags=tags), WHOLE)


@pytest.mark.slow
def test_matches_decide(tmp_path):
    match = MatchOptions(reference=(SAMPLE / "reference.tif",))
    surface = SurfaceOptions(dem=SAMPLE / "dem.tif")
    for path, options in ((crop_of(tmp_path / "a.tif"), WHOLE), (crop_by_gdal(tmp_path / "b.tif"), SceneOptions())):
        found = commands.fit(path, PointOptions(), options, surface, match)
        assert error_px(found.scene) < 1e-6


def test_the_error_offers_both_as_commands(tmp_path):
    path = crop_of(tmp_path / "a crop.tif")
    words = ["info", str(path), "--rpc", str(WHOLE.rpc)]
    done = CliRunner().invoke(cli, words, prog_name="ortho")
    assert done.exit_code == 2
    offered = [line.strip() for line in done.output.splitlines() if line.strip().startswith("ortho ")]
    assert len(offered) == 2
    found = []
    for line in offered:
        first, *words = shlex.split(line, comments=True)
        assert first == "ortho"
        again = CliRunner().invoke(cli, [*words, "--json"])
        assert again.exit_code == 0, again.output
        found.append(json.loads(again.output)["facts"].get("crop_offset"))
    assert found == [list(PLACE), None]
    # Across processes the text stays, the scene need not.
    with pytest.raises(UndecidedCrop) as stopped:
        open_scene(path, WHOLE)
    assert stopped.value.offset == PLACE
    assert str(pickle.loads(pickle.dumps(stopped.value))) == str(stopped.value)


@pytest.fixture
def pair(tmp_path) -> tuple[Path, Path, Path]:
    """Return a stereo pair without models, the second one a crop, and their points."""
    first, second, place = tmp_path / "first.tif", tmp_path / "second.tif", (40, 30)
    for source, path, (column, row) in (("BANDF", first, (0, 0)), ("BANDA", second, place)):
        dataset = gdal.Open(str(SAMPLE / "cartosat" / f"{source}.tif"))
        pixels = dataset.ReadAsArray(column, row, dataset.RasterXSize - column, dataset.RasterYSize - row)
        made = gdal.GetDriverByName("GTiff").Create(str(path), *pixels.shape[::-1], 1, gdal.GDT_UInt16)
        made.GetRasterBand(1).WriteArray(pixels)
    rows = []
    for line in (SAMPLE / "cartosat" / "points.csv").read_text().splitlines():
        parts = line.split(",")
        if parts[1:2] == ["BANDA.tif"]:
            parts[1:4] = ["second.tif", str(float(parts[2]) - place[0]), str(float(parts[3]) - place[1])]
        rows.append(",".join(parts).replace("BANDF.tif", "first.tif"))
    points = tmp_path / "points.csv"
    points.write_text("\n".join(rows) + "\n")
    return first, second, points


def test_images_of_a_block_have_rpcs_and_places_of_their_own(pair, tmp_path):
    first, second, points = pair
    folder = SAMPLE / "cartosat"
    truth = intersect(
        [folder / "BANDF.tif", folder / "BANDA.tif"], BlockOptions(points=folder / "points.csv", model="rpc")
    ).document["points"]
    own = ["--rpc", f"first={folder / 'BANDF_RPC.TXT'}", "--rpc", f"second.tif={folder / 'BANDA_RPC.TXT'}",
           "--crop-offset", "second=40,30"]  # fmt: skip
    words = [str(first), str(second), "--points", str(points), *own]
    done = CliRunner().invoke(cli, ["intersect", *words, "--json"])
    assert done.exit_code == 0, done.output
    found = {row["id"]: row["ground"] for row in json.loads(done.stdout)["points"]}
    for row in truth:
        np.testing.assert_allclose(found[row["id"]], row["ground"], atol=1e-6)
    done = CliRunner().invoke(cli, ["adjust", *words, "-o", str(tmp_path / "block"), "--json"])
    assert done.exit_code == 0, done.output
    again = intersect(
        [first, second], BlockOptions(points=points),
        models=[tmp_path / "block" / f"{name}_model.json" for name in ("first", "second")],
    ).document["points"]  # fmt: skip
    assert len(again) == len(truth)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--rpc", "BANDF_RPC.TXT"], "name the image"),
        (["--rpc", "third=BANDF_RPC.TXT"], "there is no image 'third'"),
        (["--crop-offset", "1,2"], "name the image"),
        (["--crop-offset", "first=1"], "'1' is not COL,ROW"),
    ],
)
def test_what_is_said_of_one_image_names_it(pair, words, said):
    first, second, points = pair
    done = CliRunner().invoke(cli, ["intersect", str(first), str(second), "--points", str(points), *words])
    assert done.exit_code == 2
    assert said in done.output


def test_measuring_takes_them_too(pair, monkeypatch):
    from ortho_measure.block import session
    from ortho_measure.serving import server

    first, second, points = pair
    given: list[Any] = []
    monkeypatch.setattr(server, "serve", lambda *_: None)
    monkeypatch.setattr(session, "open_block_session", lambda *_, scene, **__: given.extend(scene))
    words = ["measure", str(first), str(second), "--gcps", str(points), "--height", "100", "--no-browser",
             "--rpc", "first=a.txt", "--rpc", "second=b.txt", "--crop-offset", "second=40,30"]  # fmt: skip
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 0, done.output
    assert given == [SceneOptions(rpc="a.txt"), SceneOptions(rpc="b.txt", crop_offset=(40.0, 30.0))]


@pytest.mark.slow
def test_a_session_of_images_with_rpcs_and_places_of_their_own(pair, tmp_path):
    from ortho_measure.block.session import open_block_session

    folder = SAMPLE / "cartosat"
    opened = open_block_session(
        pair[:2], tmp_path / "p.geojson", points=BlockOptions(points=pair[2]),
        surface=SurfaceOptions(dem=folder / "dem.tif"),
        scene=[SceneOptions(rpc=str(folder / "BANDF_RPC.TXT")),
               SceneOptions(rpc=str(folder / "BANDA_RPC.TXT"), crop_offset=(40, 30))],
    )  # fmt: skip
    ground = open_scene(folder / "BANDA.tif").models["rpc"].image_to_ground(np.array([[100.0, 90.0]]), 100.0)
    seen = opened.images.scenes[1].model.ground_to_image(ground)
    np.testing.assert_allclose(seen, [[60.0, 60.0]], atol=1e-6)


def test_as_many_options_as_images(pair):
    with pytest.raises(InputError, match="1 scene for 2 images"):
        intersect(list(pair[:2]), BlockOptions(points=pair[2]), [SceneOptions()])


@pytest.mark.realdata
def test_the_rpcs_of_s2p_belong_to_its_crops(real):
    """Their offsets of pixels are of the larger image, their coefficients undo that: the DSM is the evidence."""
    surface = gdal.Open(str(real / "s2p" / "expected_output" / "triplet" / "dsm.tif"))
    rows, columns = np.nonzero(np.isfinite(surface.ReadAsArray()))
    left, dx, _, top, _, dy = surface.GetGeoTransform()
    geographic, map_ = _geographic_to(surface)
    at = slice(None, None, 9973)
    xyz = np.column_stack([left + (columns[at] + 0.5) * dx, top + (rows[at] + 0.5) * dy])
    lonlat = np.array(gdal.osr.CoordinateTransformation(map_, geographic).TransformPoints(xyz))[:, :2]
    for number in (1, 2, 3):
        scene = open_scene(real / "s2p" / "input_triplet" / f"img_0{number}.tif")
        assert scene.warnings == ()
        image = scene.model.ground_to_image(np.column_stack([lonlat, surface.ReadAsArray()[rows[at], columns[at]]]))
        assert ((image > 0) & (image < (scene.width, scene.height))).all()


@pytest.mark.realdata
def test_crops_with_the_file_of_the_whole_are_of_the_size_that_it_names(real, tmp_path):
    folder = real / "shareloc"
    for name, place in (("img1", (20500, 5000)), ("img2", (20501, 5476))):
        image = tmp_path / f"{name}.tif"
        shutil.copy(folder / "image" / "phr_gizeh" / f"{name}.tif", image)
        scene = open_scene(image, SceneOptions(rpc=str(folder / "rpc" / "phr_gizeh" / f"{name}.geom")))
        assert scene.facts["crop_offset"] == list(place)
        assert "the RPC file is for" in scene.warnings[0]
