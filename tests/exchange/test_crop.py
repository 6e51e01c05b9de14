"""Crops: a model belongs to the pixels of the image that it came with."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ortho_studies.simulation.scanner import LineScanner
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.family_fit import fit_own
from ortho_pipeline.exchange.crop import fits, moved, nearer, noted_offset, placed
from ortho_pipeline.exchange.rpc import read_rpc, rpc_metadata, write_rpb, write_rpc_txt
from ortho_pipeline.exchange.rpc_files import write_geom
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.hookspecs import Piece
from ortho_pipeline.host import open_scene as open_product
from ortho_pipeline.models import ImageCorrection, model_from_dict
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.options import PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points.table import Points
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.testing import check_sensor_model

gdal.UseExceptions()
CORNER = (100.0, 50.0)


@pytest.fixture
def whole(tiny, tmp_path) -> Path:
    """Return the RPC of the whole image."""
    write_rpc_txt(tiny.model, tmp_path / "whole_RPC.TXT")
    return tmp_path / "whole_RPC.TXT"


def cut(tiny: Any, path: Path, note: tuple[float, ...] | None = (*CORNER[:1], 1, 0, CORNER[1], 0, 1)) -> Path:
    """Cut 200 x 150 pixels out as programs do that know no RPC."""
    pixels = gdal.Open(str(tiny.image)).ReadAsArray(int(CORNER[0]), int(CORNER[1]), 200, 150)
    made = gdal.GetDriverByName("GTiff").Create(
        str(path), 200, 150, 1, gdal.GDT_Byte if pixels.dtype == np.uint8 else gdal.GDT_UInt16
    )
    if note is not None:
        made.SetGeoTransform(note)
    made.GetRasterBand(1).WriteArray(pixels)
    return path


def ground_of(scene: Any) -> np.ndarray:
    """Return the ground of a pixel of the crop, at the corner of its quarter."""
    return scene.model.image_to_ground([[50.0, 30.0]], 500.0)


def truth(tiny: Any) -> np.ndarray:
    return tiny.model.image_to_ground([[150.0, 80.0]], 500.0)


def test_a_noted_crop_with_the_rpc_of_the_whole_lies_where_it_belongs(tiny, whole, tmp_path):
    scene = open_scene(cut(tiny, tmp_path / "crop.tif"), SceneOptions(rpc=whole))
    np.testing.assert_allclose(ground_of(scene), truth(tiny), atol=1e-9)
    assert scene.facts["crop_offset"] == [100.0, 50.0]
    (said,) = [text for text in scene.warnings if "crop" in text]
    assert "column 100, row 50" in said


def test_a_crop_by_gdal_is_not_moved_twice(tiny, tmp_path):
    noted = tmp_path / "noted.tif"
    gdal.Translate(str(noted), str(tiny.image))
    dataset = gdal.Open(str(noted), gdal.GA_Update)
    # GDAL keeps no geotransform that is the identity.
    dataset.SetGeoTransform((0.0, 1.0, 0.0, 0.0, 0.0, 1.000000001))
    dataset.SetMetadata(rpc_metadata(tiny.model), "RPC")
    dataset = None
    crop = tmp_path / "crop.tif"
    gdal.Translate(str(crop), str(noted), srcWin=[100, 50, 200, 150])
    dataset = gdal.Open(str(crop), gdal.GA_Update)
    assert dataset.GetGeoTransform()[0] == 100.0
    dataset.SetGeoTransform((100.0, 1.0, 0.0, 50.0, 0.0, 1.0))
    dataset = None
    scene = open_scene(crop)
    np.testing.assert_allclose(ground_of(scene), truth(tiny), atol=1e-9)
    assert not [text for text in scene.warnings if "crop" in text]


@pytest.mark.parametrize("corner", [(0.0, 140.0), (190.0, 0.0)])
def test_a_crop_along_an_edge_is_decided_in_the_other_direction(tiny, tmp_path, corner):
    """In one direction the range of the RPC is possible for the crop and for the whole; in the other it is not."""
    path = cut(tiny, tmp_path / "crop.tif", (corner[0], 1, 0, corner[1], 0, 1))
    for model, belongs in ((tiny.model, True), (tiny.model.shifted(*corner), False)):
        write_rpc_txt(model, tmp_path / "elsewhere_RPC.TXT")
        scene = open_scene(path, SceneOptions(rpc=tmp_path / "elsewhere_RPC.TXT"))
        expected = tiny.model.image_to_ground([[50.0 + corner[0], 30.0 + corner[1]]], 500.0)
        np.testing.assert_allclose(ground_of(scene), expected, atol=1e-9)
        shifted = [text for text in scene.warnings if "shifted to the crop (its range is too small" in text]
        assert len(shifted) == belongs


@pytest.mark.parametrize(
    ("kept", "shifted", "expected"),
    [(0.0, 500.0, False), (500.0, 0.0, True), (124.0, 126.0, False), (126.0, 124.0, True), (126.0, 374.0, None)],
)
def test_evidence_within_a_quarter_of_the_offset_decides(kept, shifted, expected):
    assert nearer(kept, shifted, (300.0, 400.0)) is expected


def test_the_place_by_hand_counts_more(tiny, whole, tmp_path):
    bare = cut(tiny, tmp_path / "bare.tif", None)
    scene = open_scene(bare, SceneOptions(rpc=whole, crop_offset=CORNER))
    np.testing.assert_allclose(ground_of(scene), truth(tiny), atol=1e-9)
    wrong = cut(tiny, tmp_path / "wrong.tif", (7.0, 1.0, 0.0, 9.0, 0.0, 1.0))
    scene = open_scene(wrong, SceneOptions(rpc=whole, crop_offset=CORNER))
    np.testing.assert_allclose(ground_of(scene), truth(tiny), atol=1e-9)
    scene = open_scene(wrong, SceneOptions(rpc=whole, crop_offset=(0.0, 0.0)))
    np.testing.assert_allclose(ground_of(scene), tiny.model.image_to_ground([[50.0, 30.0]], 500.0), atol=1e-9)


def test_an_image_much_smaller_than_its_rpc_is_remarkable(tiny, whole, tmp_path):
    small = tmp_path / "small.tif"
    gdal.GetDriverByName("GTiff").Create(str(small), 90, 60, 1)
    (said,) = open_scene(small, SceneOptions(rpc=whole)).warnings
    assert "90 x 60" in said
    assert "scene.crop_offset" in said
    # Crops by GDAL are small too, but their RPC says where they lie; the whole image is not.
    part = tmp_path / "part.tif"
    gdal.Translate(str(part), str(tiny.image), srcWin=[300, 200, 60, 60])
    assert open_scene(part).warnings == ()
    assert open_scene(tiny.image).warnings == ()


def opened(tiny: Any, tmp_path: Path, size: tuple[int, int], first: tuple[float, float]) -> Any:
    """Open an image of a size with an RPC for 400 x 300 pixels, of which this is the first in the image's own count."""
    write_rpc_txt(tiny.model.shifted(-first[0], -first[1]), tmp_path / "any_RPC.TXT")
    gdal.GetDriverByName("GTiff").Create(str(tmp_path / "any.tif"), *size, 1)
    return open_scene(tmp_path / "any.tif", SceneOptions(rpc=tmp_path / "any_RPC.TXT"))


@pytest.mark.parametrize("name", ["IMG_A_R2C1.TIF", "21FEB01-P1BS_R1C2-01_P001.TIF"])
def test_a_tile_with_the_rpc_of_all_tiles_needs_its_place(tiny, tmp_path, name):
    """GDAL applies the RPC of all tiles to each, if the metadata that list them are missing."""
    image = cut(tiny, tmp_path / name, None)
    write_rpb(tiny.model, tmp_path / "A.RPB")
    choice = {"rpc": str(tmp_path / "A.RPB")}
    with pytest.raises(InputError, match=r"the tile R[12]C[12], but A\.RPB has the RPC of all tiles") as error:
        open_product(image, options=choice)
    assert "crop_offset=COL,ROW" in str(error.value.remedy)
    placed_there = open_product(image, options=choice, crop_offset=CORNER)
    np.testing.assert_allclose(tiny.model.ground_to_image(ground_of(placed_there)), [[150.0, 80.0]], atol=1e-6)
    # The first tile begins where all do, and a file of this name is that of the tile.
    open_product(image.rename(tmp_path / "IMG_A_R1C1.TIF"), options=choice)
    own = (tmp_path / "A.RPB").rename(tmp_path / "IMG_A_R1C2.RPB")
    open_product((tmp_path / "IMG_A_R1C1.TIF").rename(tmp_path / "IMG_A_R1C2.TIF"), options={"rpc": str(own)})


@pytest.mark.parametrize(
    ("size", "first", "codes"),
    [
        ((400, 300), (0, 0), ()), ((300, 225), (0, 0), ()), ((299, 300), (0, 0), ("maybe-a-crop",)),
        ((400, 224), (0, 0), ("maybe-a-crop",)), ((199, 149), (-39, 10), ("maybe-a-crop",)), ((199, 149), (-41, 0), ()),
        ((199, 149), (0, -31), ()), ((400, 300), (-390, 0), ()), ((400, 300), (390, 290), ()),
        ((400, 300), (-410, 0), ("rpc-elsewhere",)), ((400, 300), (410, 0), ("rpc-elsewhere",)),
        ((400, 300), (0, -310), ("rpc-elsewhere",)), ((400, 300), (0, 310), ("rpc-elsewhere",)),
    ],
)  # fmt: skip
def test_an_rpc_for_other_pixels_is_remarkable(tiny, tmp_path, size, first, codes):
    """Less than 3/4 of the range on one side, or no common pixel at all; a range that begins elsewhere is a crop's."""
    scene = opened(tiny, tmp_path, size, first)
    assert tuple(notice.code for notice in scene.notices) == codes
    if codes == ("rpc-elsewhere",):
        ends = (first[0], first[0] + 400, first[1], first[1] + 300)
        assert "columns {} to {} and rows {} to {}".format(*ends) in scene.warnings[0]


@pytest.mark.parametrize(
    ("tags", "domain"),
    [
        # Airbus counts rows first, from 1.
        ({"gml.root-instance": "<gml:low>1 1</gml:low> <gml:high>300 400</gml:high>"}, ""),
        ({"numColumns": "400", "numRows": " 300 "}, "IMD"),
    ],
)
def test_vendors_state_the_size_of_the_larger_image(tiny, whole, tmp_path, tags, domain):
    scene = open_product(cut(tiny, tmp_path / "bare.tif", None), options={"rpc": str(whole)})
    dataset = gdal.GetDriverByName("MEM").Create("", 200, 150)
    dataset.SetGeoTransform((100.0, 1.0, 0.0, 50.0, 0.0, 1.0))
    dataset.SetMetadata(tags, domain)
    found = placed(scene, dataset)
    np.testing.assert_allclose(ground_of(found), truth(tiny), atol=1e-9)
    assert "shifted to the crop (the larger image has 400 x 300 pixels)" in found.warnings[-1]


def test_pieces_move_with_their_scene(tiny):
    """A piece that begins at column 250 and row 30 of the larger image begins 100 and 50 earlier in the crop."""
    scene = replace(open_product(tiny.image), pieces=(Piece("b.tif", offset=(250.0, 30.0)),))
    (piece,) = placed(scene, open_dataset(tiny.image), CORNER).pieces
    assert piece.offset == (150.0, -20.0)


@pytest.mark.parametrize(
    ("size", "offset", "expected"),
    [
        ((400, 300), None, True), ((400, 299), None, False), ((200, 150), None, False), ((200, 150), (0, 0), True),
        ((200, 150), (200, 150), True), ((200, 150), (201, 150), False), ((200, 150), (200, 151), False),
        ((200, 150), (-1, 0), False), ((200, 150), (0, -1), False),
    ],
)  # fmt: skip
def test_a_crop_lies_within_the_larger_image(size, offset, expected):
    assert fits(size, (400, 300), offset) is expected


def test_the_size_in_a_geom_file_says_whose_rpc_it_is(tiny, tmp_path):
    path = cut(tiny, tmp_path / "crop.tif")
    for model, size, said in ((tiny.model, (400, 300), 1), (tiny.model.shifted(*CORNER), (200, 150), 0)):
        write_geom(model, size, tmp_path / "any.geom")
        # Other programs read these names.
        assert {f"number_samples:  {size[0]}", f"number_lines:  {size[1]}"} <= set(
            (tmp_path / "any.geom").read_text().splitlines()
        )
        scene = open_scene(path, SceneOptions(rpc=tmp_path / "any.geom"))
        np.testing.assert_allclose(ground_of(scene), truth(tiny), atol=1e-9)
        text = "shifted to the crop (the RPC file is for an image of 400 x 300 pixels)"
        assert sum(text in warning for warning in scene.warnings) == said


@pytest.mark.parametrize(
    ("transform", "crs", "expected"),
    [
        ((5000, 1, 0, 5000, 0, 1), None, (5000.0, 5000.0)),
        ((0, 1, 0, 12, 0, 1), None, (0.0, 12.0)),
        ((0, 1, 0, 0, 0, 1), None, None),
        ((5000, 1, 0, 5000, 0, -1), None, None),
        ((5000, 2, 0, 5000, 0, 2), None, None),
        ((5000, 1, 0.1, 5000, 0, 1), None, None),
        ((5000, 1, 0, 5000, 0, 1), "EPSG:32636", None),
    ],
)
def test_which_geotransforms_count_pixels(transform, crs, expected):
    dataset = gdal.GetDriverByName("MEM").Create("", 3, 3)
    dataset.SetGeoTransform(transform)
    if crs:
        dataset.SetProjection(crs)
    assert noted_offset(dataset) == expected


def test_every_command_knows_the_place(tiny, whole, tmp_path):
    crop = cut(tiny, tmp_path / "crop.tif")
    rows = [(name, col - 100, row - 50, *ground) for name, col, row, *ground in tiny.points(12)]
    points = PointOptions(gcps=tiny.write(tmp_path / "p.csv", rows), crs="EPSG:4979", vertical="ellipsoid")
    options, surface = SceneOptions(rpc=whole), SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    values = commands.fit(crop, points, options).fit.model.params
    np.testing.assert_allclose(values, tiny.bias, atol=0.15)
    assert commands.info(crop, options)["facts"]["crop_offset"] == [100.0, 50.0]
    result = commands.rectify(crop, tmp_path / "out", scene=options, points=points, surface=surface)
    assert any("column 100, row 50" in text for text in result.document["report"]["warnings"])
    exported = read_rpc(result.files["rpc"])
    found = exported.image_to_ground([[50.0, 30.0]], 500.0)
    expected = tiny.model.image_to_ground(np.array([[150.0, 80.0]]) - values, 500.0)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    # The model file is one of the crop now.
    again = open_scene(crop, SceneOptions(model=result.files["model"]))
    np.testing.assert_allclose(ground_of(again), expected, atol=1e-9)
    compared = commands.compare(crop, points, models="rpc,rpc+shift", scene=options)
    assert compared.comparison.best.model == "rpc+shift"


def test_a_saved_model_of_the_whole_serves_its_crops(tiny, tmp_path):
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    model = commands.rectify(tiny.image, tmp_path / "out", surface=surface).files["model"]
    crop = cut(tiny, tmp_path / "crop.tif")
    np.testing.assert_allclose(ground_of(open_scene(crop, SceneOptions(model=model))), truth(tiny), atol=1e-9)
    bare = cut(tiny, tmp_path / "bare.tif", None)
    with pytest.raises(InputError, match="400 x 300"):
        open_scene(bare, SceneOptions(model=model))
    scene = open_scene(bare, SceneOptions(model=model, crop_offset=CORNER))
    np.testing.assert_allclose(ground_of(scene), truth(tiny), atol=1e-9)
    with pytest.raises(InputError, match="400 x 300"):
        open_scene(bare, SceneOptions(model=model, crop_offset=(250.0, 50.0)))


def test_any_model_can_be_moved(tiny):
    affine = ImageCorrection.identity(tiny.model, "affine", (200.0, 150.0)).with_params([1.0, 1e-3, 0, -2.0, 0, 1e-3])
    ground = tiny.model.image_to_ground([[120.0, 90.0], [310.0, 20.0]], 500.0)
    for model in (tiny.model, affine):
        crop = moved(model, CORNER)
        np.testing.assert_allclose(crop.ground_to_image(ground), model.ground_to_image(ground) - CORNER, atol=1e-9)
        back = crop.image_to_ground(crop.ground_to_image(ground), 500.0)
        np.testing.assert_allclose(back, ground, atol=1e-9)
        assert moved(model, (0.0, 0.0)) is model


@pytest.mark.parametrize("offset", [(1.0,), (1.0, float("nan")), (1.0, 2.0, 3.0)])
def test_places_that_are_none(tiny, offset):
    with pytest.raises(InputError, match=r"not the offset of a crop|not a list of two numbers") as error:
        open_scene(tiny.image, SceneOptions(crop_offset=offset))
    assert error.value.field == "scene.crop_offset"


@pytest.mark.realdata
def test_pleiades_crops_meet_each_other(real):
    folder = real / "shareloc"
    images = {side: folder / "image" / "phr_ventoux" / f"{side}_image.tif" for side in ("left", "right")}
    rpcs = {side: folder / "rpc" / "phr_ventoux" / f"{side}_image.geom" for side in images}
    scenes = {side: open_product(images[side], options={"rpc": str(rpcs[side])}) for side in images}
    assert scenes["left"].facts["crop_offset"] == [5000.0, 5000.0]
    # The notes of the data: the left crop's first pixel in the right image, in pixels of the whole, by height.
    for height, column, row in ((0.0, 4906.5, 5195.7), (700.0, 5034.3, 4727.7), (1500.0, 5180.4, 4192.9)):
        seen = scenes["right"].model.ground_to_image(scenes["left"].model.image_to_ground([[0.0, 0.0]], height))
        corner = noted_offset(open_dataset(images["right"]))
        np.testing.assert_allclose(seen[0] + corner, (column, row), atol=0.1)


def test_a_crop_is_adjusted_by_the_parameters_of_the_whole():
    """A line scanner, its points measured in the crop: the same parameters, sigmas and residuals as in the whole."""
    corners = LineScanner.over(
        33.35, 37.25, 850.0, image_width=900, image_height=700, off_nadir_deg=5.0, altitude=618e3, heights=(0.0, 1700.0)
    ).image_to_ground([(0, 0), (900, 0), (900, 700), (0, 700)], 850.0)
    whole = pushbroom_of_metadata(corners, 900, 700, altitude=618e3, along_deg=0.0, heights=(0.0, 1700.0))
    random = np.random.default_rng(0)
    image = random.uniform((200, 100), (900, 700), (25, 2))
    ground = whole.image_to_ground(image, random.uniform(200, 1500, 25))
    measured = image + (3.0, -2.0) + 1e-3 * image + random.normal(0, 0.2, image.shape)
    crop = moved(whole, (200.0, 100.0))
    check_sensor_model(crop, ground)
    fits = [
        fit_own(
            model,
            Points(
                tuple(map(str, range(25))), at, ground, np.full(25, "control"), np.full(25, 0.2), np.zeros((25, 3)),
                parse_crs(whole.crs), "",
            ),
        )
        for model, at in ((whole, measured), (crop, measured - (200.0, 100.0)))
    ]  # fmt: skip
    np.testing.assert_allclose(fits[1].model.params, fits[0].model.params, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(fits[1].residuals, fits[0].residuals, atol=1e-6)
    assert abs(fits[1].sigma0 / fits[0].sigma0 - 1) < 1e-6
    again = model_from_dict(json.loads(json.dumps(fits[1].model.to_dict())))
    np.testing.assert_array_equal(again.ground_to_image(ground), fits[1].model.ground_to_image(ground))
