"""RPC in and out, with GDAL's transformer and real products as the authorities."""

import errno
import math
import os
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyproj
import pytest
from osgeo import gdal
from products import til_text
from real_data import data_folder

from ortho_pipeline.errors import InputError, ModelError, OrthoError
from ortho_pipeline.exchange import rpc as rpc_module
from ortho_pipeline.exchange.rpc import (
    export_rpc,
    files_of,
    has_rpc,
    read_rpc,
    rpc_metadata,
    rpc_of_dataset,
    write_rpb,
    write_rpc_txt,
    write_tagged_copy,
    write_vrt,
)
from ortho_pipeline.exchange.rpc_files import write_geom, write_rpc_xml
from ortho_pipeline.exchange.rpc_fit import domain_box, fit_rpc
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.base import SensorModel, as_ground

gdal.UseExceptions()

REAL = data_folder()
QUICKBIRD = "orthority/rpc/qb2_basic1b.tif"
CORRECTIONS = {
    "shift": (3.0, 0.0, 0.0, -2.1, 0.0, 0.0),
    "scale": (3.0, 2e-4, 0.0, -2.1, 0.0, -3e-4),
    "cross": (3.0, 2e-4, 1e-4, -2.1, -2e-4, -3e-4),
}


def real(path: str) -> Path:
    if not (REAL / path).exists():
        pytest.skip(f"the real data are not there: {path}")
    if path.endswith(".NTF") and gdal.GetDriverByName("NITF") is None:
        pytest.skip("this GDAL reads no NITF")
    return REAL / path


def make_rpc(seed=5, **changes) -> RPC:
    rng = np.random.default_rng(seed)
    num, den = rng.normal(0, 1e-3, (2, 20)), rng.normal(0, 1e-4, (2, 20))
    num[0, 1], num[1, 2], num[0, 3], num[1, 3] = 1.0, -1.05, 0.1, 0.02
    den[:, 0] = 1.0
    fields = {
        "col_off": 425.25, "row_off": 725.5 + 1 / 3, "lon_off": 24.4057, "lat_off": -33.6726, "h_off": 703.0,
        "col_scale": 1377.6, "row_scale": 1210.0, "lon_scale": 0.0995, "lat_scale": 0.0737, "h_scale": 501.0,
        "col_num": num[0], "col_den": den[0], "row_num": num[1], "row_den": den[1], "err_bias": 12.15,
    }  # fmt: skip
    return RPC(**(fields | changes))


def in_box(rpc: RPC, n=10_000, seed=1) -> np.ndarray:
    centre, half = rpc.domain
    return centre + np.random.default_rng(seed).uniform(-1, 1, (n, 3)) * half


def gdal_project(dataset, ground) -> np.ndarray:
    transformer = gdal.Transformer(dataset, None, ["METHOD=RPC", "RPC_HEIGHT=0"])
    points, good = transformer.TransformPoints(1, ground.tolist())
    assert all(good)
    return np.array(points)[:, :2]


def make_image(path: Path, rpc: RPC | None = None, **creation) -> Path:
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 40, 30, 2, gdal.GDT_UInt16, **creation)
    data = np.random.default_rng(0).integers(1, 2000, (2, 30, 40))
    for band in (1, 2):
        dataset.GetRasterBand(band).WriteArray(data[band - 1])
        dataset.GetRasterBand(band).SetNoDataValue(0)
    if rpc is not None:
        dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    return path


def same(a: RPC, b: RPC) -> bool:
    first, second = a.to_dict(), b.to_dict()
    return all(first[key] == second[key] for key in first)


# -- conventions -----------------------------------------------------------------------------------------------------


def test_own_offsets_give_half_a_pixel_more():
    num, den = np.eye(20)[1], np.eye(20)[0]
    rpc = make_rpc(col_num=num, col_den=den, row_num=np.eye(20)[2], row_den=den)
    fields = rpc_metadata(rpc)
    image = rpc.ground_to_image([[rpc.lon_off, rpc.lat_off, rpc.h_off]])[0]
    assert image.tolist() == [float(fields["SAMP_OFF"]) + 0.5, float(fields["LINE_OFF"]) + 0.5]


def test_raw_rpc_agrees_with_gdal(tmp_path):
    rpc = make_rpc()
    dataset = gdal.Open(str(make_image(tmp_path / "a.tif")))
    dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    ground = in_box(rpc)
    image = rpc.ground_to_image(ground)
    assert np.abs(image - gdal_project(dataset, ground)).max() < 1e-7
    closed = rpc.ground_to_image(rpc.image_to_ground(image, ground[:, 2])) - image
    assert np.isfinite(closed).all()
    assert np.abs(closed).max() < 1e-5


def unclosed(rpc: RPC, ground: np.ndarray) -> np.ndarray:
    """Return by how much ground -> image -> ground -> image misses (px), beyond the rounding of degrees to doubles."""
    image = rpc.ground_to_image(ground)
    back = rpc.image_to_ground(image, ground[:, 2])
    rounding = np.einsum("nij,nj->ni", np.abs(rpc.ground_partials(back)[:, :, :2]), np.spacing(np.abs(back[:, :2])))
    return (np.abs(rpc.ground_to_image(back) - image) - rounding).max(axis=1)


@pytest.mark.parametrize("strength", [1.0, 20.0, 60.0])
def test_the_inverse_closes_far_outside_of_the_image_too(strength):
    """Strong terms far from the middle need many steps, and the last one must not be left out."""
    plain = make_rpc()
    bent = {name: getattr(plain, name).copy() for name in ("col_num", "col_den", "row_num", "row_den")}
    for values in bent.values():
        values[4:] *= strength
    rpc = plain._replace(**bent)
    centre, half = rpc.domain
    ground = centre + np.random.default_rng(3).uniform(-1.45, 1.45, (100_000, 3)) * half
    missed = unclosed(rpc, ground)
    assert np.isfinite(missed).mean() > 0.95
    assert np.nanmax(missed) < 1e-10


def test_crop_and_scale_move_the_model_as_the_pixels():
    rpc = make_rpc()
    ground = in_box(rpc, 100)
    image = rpc.ground_to_image(ground)
    assert np.allclose(rpc.shifted(100, 250).ground_to_image(ground), image - [100, 250], rtol=0, atol=1e-9)
    assert np.allclose(rpc.scaled(4.0).ground_to_image(ground), image / 4, rtol=0, atol=1e-9)
    samp_off = float(rpc_metadata(rpc)["SAMP_OFF"])
    assert float(rpc_metadata(rpc.scaled(4.0))["SAMP_OFF"]) == pytest.approx((samp_off + 0.5) / 4 - 0.5, abs=1e-12)


# -- files -----------------------------------------------------------------------------------------------------------


def write_sized_geom(rpc: RPC, path: Path) -> None:
    write_geom(rpc, (1200, 900), path)


@pytest.mark.parametrize(
    ("writer", "name"),
    [
        (write_rpc_txt, "a_RPC.TXT"),
        (write_rpb, "a.RPB"),
        (write_sized_geom, "a.geom"),
        (write_rpc_xml, "a_rpc.xml"),
    ],
)
def test_text_is_read_again_to_the_last_bit(tmp_path, writer, name):
    for seed in range(20):
        rpc = make_rpc(seed, err_rand=None if seed % 2 else 1 / 3, col_off=seed * 7001.1 + 1.1)
        writer(rpc, tmp_path / name)
        assert same(read_rpc(tmp_path / name), rpc)


@pytest.mark.parametrize("writer", [write_rpc_txt, write_rpb, write_sized_geom, write_rpc_xml])
def test_text_is_known_by_its_content_whatever_its_suffix(tmp_path, writer):
    rpc = make_rpc()
    writer(rpc, tmp_path / "scene.metadata")
    assert same(read_rpc(tmp_path / "scene.metadata"), rpc)


@pytest.mark.parametrize(("writer", "name"), [(write_vrt, "b.vrt"), (write_tagged_copy, "b.tif")])
def test_the_rpc_of_a_raster_is_read_from_it(tmp_path, writer, name):
    """A VRT is text, too, with the names of an RPC's fields."""
    rpc = make_rpc()
    writer(gdal.Open(str(make_image(tmp_path / "a.tif"))), rpc, tmp_path / name)
    found = read_rpc(tmp_path / name).ground_to_image(in_box(rpc, 50))
    np.testing.assert_allclose(found, rpc.ground_to_image(in_box(rpc, 50)), atol=1e-6)


@pytest.mark.parametrize("correction", ["shift", "scale"])
@pytest.mark.parametrize("how", ["txt", "rpb", "tag", "vrt"])
def test_gdal_reads_what_was_exported(tmp_path, how, correction):
    rpc = make_rpc()
    adjusted = ImageCorrection(rpc, "affine", (400.0, 700.0), np.array(CORRECTIONS[correction]))
    exported = export_rpc(adjusted)
    assert exported.exact
    image = make_image(tmp_path / "a.tif", rpc if how in ("tag", "vrt") else None)
    if how == "txt":
        write_rpc_txt(exported.rpc, tmp_path / "a_RPC.TXT")
    elif how == "rpb":
        write_rpb(exported.rpc, tmp_path / "a.RPB")
    else:
        (tmp_path / "out").mkdir()
        image = tmp_path / "out" / f"b.{'tif' if how == 'tag' else 'vrt'}"
        write = write_tagged_copy if how == "tag" else write_vrt
        write(gdal.Open(str(tmp_path / "a.tif")), exported.rpc, image)
    ground = in_box(rpc, 2000)
    dataset = gdal.Open(str(image))
    assert np.abs(gdal_project(dataset, ground) - adjusted.ground_to_image(ground)).max() < 1e-6
    source = {"txt": "a_RPC.TXT", "rpb": "a.RPB", "tag": "b.tif (TIFF tag)", "vrt": "b.vrt (VRT metadata)"}[how]
    assert rpc_of_dataset(dataset)[1].endswith(source)


def with_gcps(path: Path, rpc: RPC) -> gdal.Dataset:
    dataset = gdal.Open(str(make_image(path, rpc)))
    wkt = pyproj.CRS("EPSG:4326").to_wkt("WKT1_GDAL")
    view = gdal.GetDriverByName("MEM").CreateCopy("", dataset)
    view.SetGCPs([gdal.GCP(24.0 + c, -33.0 - r, 0, c, r) for c, r in ((0, 0), (40, 0), (0, 30))], wkt)
    final = path.with_name("gcps.tif")
    gdal.GetDriverByName("GTiff").CreateCopy(str(final), view)
    return gdal.Open(str(final))


def test_gcps_that_would_beat_the_rpc_are_left_out(tmp_path):
    rpc = make_rpc()
    dataset = with_gcps(tmp_path / "a.tif", rpc)
    assert dataset.GetGCPCount() == 3
    write_vrt(dataset, rpc, tmp_path / "b.vrt")
    write_tagged_copy(dataset, rpc, tmp_path / "c.tif")
    ground = in_box(rpc, 50)
    for name in ("b.vrt", "c.tif"):
        written = gdal.Open(str(tmp_path / name))
        assert written.GetGCPCount() == 0
        points, _ = gdal.Transformer(written, None, []).TransformPoints(1, ground[:, :2].tolist())
        flat = np.column_stack([ground[:, :2], np.zeros(50)])
        assert np.abs(np.array(points)[:, :2] - rpc.ground_to_image(flat)).max() < 1e-6


def test_vrt_finds_its_source_when_the_folder_moves(tmp_path):
    (tmp_path / "one" / "out").mkdir(parents=True)
    rpc = make_rpc()
    write_vrt(gdal.Open(str(make_image(tmp_path / "one" / "ä b.tif"))), rpc, tmp_path / "one" / "out" / "b.vrt")
    (tmp_path / "one").rename(tmp_path / "two")
    dataset = gdal.Open(str(tmp_path / "two" / "out" / "b.vrt"))
    assert dataset.ReadAsArray().max() > 0
    assert same(rpc_of_dataset(dataset)[0], rpc)


@pytest.mark.parametrize("name", ["/vsizip/order.zip/a.tif", "/vsizip/{order.zip}/a.tif", "/vsizip/./order.zip/a.tif"])
def test_vrt_finds_an_archive_from_any_folder(tmp_path, monkeypatch, name):
    make_image(tmp_path / "a.tif")
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("order.zip", "w") as archive:
        archive.write("a.tif")
    write_vrt(gdal.Open(name), make_rpc(), tmp_path / "b.vrt")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert np.array_equal(
        gdal.Open(str(tmp_path / "b.vrt")).ReadAsArray(), gdal.Open(str(tmp_path / "a.tif")).ReadAsArray()
    )


def test_tagged_copy_keeps_pixels_nodata_mask_and_colours(tmp_path):
    source = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 40, 30, 3, gdal.GDT_Byte)
    data = np.random.default_rng(0).integers(0, 255, (3, 30, 40), dtype=np.uint8)
    colours = (gdal.GCI_BlueBand, gdal.GCI_GreenBand, gdal.GCI_RedBand)
    for band, colour in enumerate(colours, 1):
        source.GetRasterBand(band).WriteArray(data[band - 1])
        source.GetRasterBand(band).SetColorInterpretation(colour)
    source.CreateMaskBand(gdal.GMF_PER_DATASET)
    mask = np.zeros((30, 40), np.uint8)
    mask[5:20] = 255
    source.GetRasterBand(1).GetMaskBand().WriteArray(mask)
    source = None
    write_tagged_copy(gdal.Open(str(tmp_path / "a.tif")), make_rpc(), tmp_path / "b.tif")
    copy = gdal.Open(str(tmp_path / "b.tif"))
    assert np.array_equal(copy.ReadAsArray(), data)
    assert np.array_equal(copy.GetRasterBand(1).GetMaskBand().ReadAsArray(), mask)
    assert tuple(copy.GetRasterBand(band).GetColorInterpretation() for band in (1, 2, 3)) == colours
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith("b")) == ["b.tif"]
    write_tagged_copy(gdal.Open(str(make_image(tmp_path / "c.tif"))), make_rpc(), tmp_path / "d.tif")
    dataset = gdal.Open(str(tmp_path / "d.tif"))  # a band does not keep its dataset alive
    assert dataset.GetRasterBand(2).GetNoDataValue() == 0


def test_tagged_copy_refuses_a_side_car_that_would_win(tmp_path):
    write_rpc_txt(make_rpc(), tmp_path / "b_RPC.TXT")
    with pytest.raises(InputError, match=r"b_RPC\.TXT"):
        write_tagged_copy(gdal.Open(str(make_image(tmp_path / "a.tif"))), make_rpc(), tmp_path / "b.tif")
    assert not (tmp_path / "b.tif").exists()


@pytest.mark.parametrize(("change", "same"), [(0.0, True), (6e-10, True), (1.1e-9, False), (-1.1e-9, False)])
@pytest.mark.parametrize(("writer", "name"), [(write_vrt, "out.vrt"), (write_tagged_copy, "out.tif")])
def test_an_rpc_that_is_stored_as_another_is_not_left(tmp_path, monkeypatch, writer, name, change, same):
    """As if GDAL stored another coefficient: at the sides, 1377.6 px from the middle, 8e-7 or 1.5e-6 px off."""
    rpc, original, path = make_rpc(), rpc_module.rpc_metadata, tmp_path / name
    other = rpc._replace(col_num=rpc.col_num + change * np.eye(20)[1])
    image = gdal.Open(str(make_image(tmp_path / "a.tif")))
    monkeypatch.setattr(rpc_module, "rpc_metadata", lambda _: original(other))
    if same:
        writer(image, rpc, path)
    else:
        with pytest.raises(ModelError, match=r"the written RPC is off by 1\.5\d*e-06 px"):
            writer(image, rpc, path)
    assert path.exists() is same


# -- which RPC it is -------------------------------------------------------------------------------------------------


def test_side_car_that_agrees_with_the_tag_wins_and_is_named(tmp_path):
    rpc = make_rpc()
    image = make_image(tmp_path / "a.tif", rpc)
    write_rpc_txt(rpc.shifted(0.5, 0.5), tmp_path / "a_RPC.TXT")
    found, source = rpc_of_dataset(gdal.Open(str(image)))
    assert same(found, rpc.shifted(0.5, 0.5))
    assert source == str(tmp_path / "a_RPC.TXT")


def test_stale_side_car_is_an_error_with_a_choice(tmp_path):
    rpc = make_rpc()
    image = make_image(tmp_path / "a.tif", rpc)
    write_rpb(rpc.shifted(3.0, 0.0), tmp_path / "a.RPB")
    dataset = gdal.Open(str(image))
    with pytest.raises(
        InputError, match=r"a\.RPB differ by 3\.0 px(.|\n)*`scene.rpc=tag`, `scene.rpc=sidecar`, or `scene.rpc=FILE`"
    ):
        rpc_of_dataset(dataset)
    assert rpc_of_dataset(dataset, "tag")[0].col_off == pytest.approx(rpc.col_off, abs=1e-9)
    assert rpc_of_dataset(dataset, "tag")[1] == f"{image} (TIFF tag)"
    assert same(rpc_of_dataset(dataset, "sidecar")[0], rpc.shifted(3.0, 0.0))
    write_rpc_txt(rpc.shifted(9.0, 9.0), tmp_path / "other.txt")
    found, source = rpc_of_dataset(dataset, tmp_path / "other.txt")
    assert same(found, rpc.shifted(9.0, 9.0))
    assert source == str(tmp_path / "other.txt")


@pytest.mark.parametrize("shift", [(0.9, 0.0), (0.0, -0.9), (1.1, 0.0), (0.0, -1.1)])
def test_a_side_car_and_a_tag_agree_within_a_pixel(tmp_path, shift):
    rpc = make_rpc()
    image = make_image(tmp_path / "a.tif", rpc)
    write_rpb(rpc.shifted(*shift), tmp_path / "a.RPB")
    if np.abs(shift).max() < 1:
        assert same(rpc_of_dataset(gdal.Open(str(image)))[0], rpc.shifted(*shift))
    else:
        with pytest.raises(InputError, match=r"differ by 1\.1 px"):
            rpc_of_dataset(gdal.Open(str(image)))


def test_a_side_car_that_cannot_be_read_is_an_error_and_not_passed_over(tmp_path, monkeypatch):
    dataset = gdal.Open(str(make_image(tmp_path / "a.tif", make_rpc())))
    (tmp_path / "a_RPC.TXT").write_text("of another user")
    opened = os.open

    def refusing(path, *words):
        if Path(path).name == "a_RPC.TXT":
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *words)

    monkeypatch.setattr(os, "open", refusing)
    with pytest.raises(InputError, match=r"a_RPC\.TXT: scene\.rpc"):
        rpc_of_dataset(dataset)
    assert rpc_of_dataset(dataset, "tag")[1] == f"{tmp_path / 'a.tif'} (TIFF tag)"


def test_choice_that_is_not_there_is_an_error(tmp_path):
    dataset = gdal.Open(str(make_image(tmp_path / "a.tif", make_rpc())))
    with pytest.raises(InputError, match="no RPC sidecar"):
        rpc_of_dataset(dataset, "sidecar")
    with pytest.raises(InputError, match="cannot be read"):
        rpc_of_dataset(dataset, "nowhere.txt")
    bare = gdal.Open(str(make_image(tmp_path / "bare.tif")))
    with pytest.raises(InputError, match="there is no RPC tag"):
        rpc_of_dataset(bare, "tag")
    with pytest.raises(InputError, match="there is no RPC\n"):
        rpc_of_dataset(bare)


def test_damaged_metadata_name_file_and_field(tmp_path):
    dataset = gdal.Open(str(make_image(tmp_path / "a.tif")))
    dataset.SetMetadata(rpc_metadata(make_rpc()) | {"LAT_SCALE": "0"}, "RPC")
    with pytest.raises(InputError, match=r"LAT_SCALE: an RPC scale cannot be zero"):
        rpc_of_dataset(dataset)


# -- damaged and odd files -------------------------------------------------------------------------------------------


def text_of(rpc: RPC, tmp_path: Path, writer=write_rpc_txt) -> str:
    writer(rpc, tmp_path / "written.txt")
    return (tmp_path / "written.txt").read_text()


def test_spellings_of_rpc_text(tmp_path):
    rpc = make_rpc()
    text = text_of(rpc, tmp_path)
    variants = {
        "crcrlf": text.replace("\n", "\r\r\n"),
        "lower": text.lower(),
        "tabs": text.replace(": ", ":\t  "),
        "no units": text.replace(" pixels", "").replace(" degrees", ""),
        "bom": "\ufeff" + text,
        "plus": text.replace(": 1377.6", ": +001377.60"),
        "comment": "# Orbital, März 2005\n" + text,
        "fortran": text.replace("e-0", "D-0"),
        "three digits": text.replace("e-0", "e-00"),
    }
    for name, variant in variants.items():
        path = tmp_path / f"{name}.txt"
        path.write_bytes(variant.encode("latin-1" if name == "comment" else "utf-8"))
        assert same(read_rpc(path), rpc), name


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("LINE_SCALE: 1210.0", "LINE_SCALE: 0", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE: nan", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE: 1e400", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE: inf", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE: 1210,0", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE: 1_210", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE:", "LINE_SCALE"),
        ("LINE_SCALE: 1210.0", "LINE_SCALE: 1210\nLINE_SCALE: 1211", "LINE_SCALE"),
        ("LAT_OFF: -33.6726", "LAT_OFF: -133.6726", "LAT_OFF"),
        ("LINE_DEN_COEFF_1: 1.0", "LINE_DEN_COEFF_1: 0.0", "LINE_DEN_COEFF"),
        ("LINE_DEN_COEFF_1: 1.0", "LINE_DEN_COEFF_21: 1.0", "LINE_DEN_COEFF_1"),
    ],
)
def test_wrong_field_is_named(tmp_path, old, new, field):
    text = text_of(make_rpc(), tmp_path)
    assert old in text
    (tmp_path / "bad_RPC.TXT").write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_rpc(tmp_path / "bad_RPC.TXT")
    assert field in caught.value.field
    assert caught.value.file.endswith("bad_RPC.TXT")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"FAKE\n",
        b"\0" * 100,
        "LINE_OFF: 1".encode("utf-16"),
        b"LINE_OFF: 1\nSAMP_OFF: 2\0",
        b"<" * 1000,
        b"<a>" * 100_000,
        b"lineNumCoef = (" * 100_000,
        b"lineNumCoef = " + b"1 " * 2_000_000,
        b"LINE_OFF: " + b"9" * 4_000_000,
        b"x" * 10_000_000,
        b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>',
    ],
)
def test_hostile_file_is_a_typed_error(tmp_path, data):
    for suffix in ("_RPC.TXT", ".RPB", ".XML", ".geom"):
        path = tmp_path / f"bad{suffix}"
        path.write_bytes(data)
        with pytest.raises(InputError):
            read_rpc(path)
    with pytest.raises(InputError):
        read_rpc(tmp_path)
    with pytest.raises(InputError):
        read_rpc(tmp_path / "missing.txt")


def test_rpc00a_is_refused(tmp_path):
    text = text_of(make_rpc(), tmp_path, write_rpb)
    (tmp_path / "a.RPB").write_text(text.replace("RPC00B", "RPC00A"))
    with pytest.raises(InputError, match="only RPC00B"):
        read_rpc(tmp_path / "a.RPB")


def dimap_of(rpc: RPC, profile: str, origin: int) -> str:
    fields = rpc_metadata(rpc)
    inverse, validity = [], []
    for key, value in fields.items():
        if "COEFF" in key:
            inverse += [f"<{key}_{n}>{v}</{key}_{n}>" for n, v in enumerate(value.split(), 1)]
        elif not key.startswith("ERR"):
            moved = repr(float(value) + origin) if key in ("LINE_OFF", "SAMP_OFF") else value
            validity.append(f"<{key}>{moved}</{key}>")
    return (
        '<?xml version="1.0" encoding="ISO-8859-1"?>\n<Dimap_Document><Metadata_Identification>'
        f"<METADATA_PROFILE>{profile}</METADATA_PROFILE></Metadata_Identification><Rational_Function_Model><Global_RFM>"
        f"<Direct_Model><SAMP_NUM_COEFF_1>7</SAMP_NUM_COEFF_1></Direct_Model><Inverse_Model>{''.join(inverse)}"
        f"</Inverse_Model><RFM_Validity>{''.join(validity)}</RFM_Validity></Global_RFM></Rational_Function_Model>"
        "</Dimap_Document>"
    )


@pytest.mark.parametrize(("profile", "origin"), [("PHR_SENSOR", 1), ("S6_SENSOR", 1), ("PNEO_SENSOR", 0)])
def test_origin_of_dimap_goes_by_the_satellite(tmp_path, profile, origin):
    rpc = make_rpc(err_bias=None, row_off=725.5)
    (tmp_path / "RPC_a.XML").write_text(dimap_of(rpc, profile, origin))
    found = read_rpc(tmp_path / "RPC_a.XML")
    assert np.allclose(found.ground_to_image(in_box(rpc, 20)), rpc.ground_to_image(in_box(rpc, 20)), atol=1e-9)


def test_mutated_files_give_typed_errors_or_finite_models(tmp_path):
    rng = np.random.default_rng(45)
    rpc = make_rpc()
    seeds = {
        "_RPC.TXT": text_of(rpc, tmp_path).encode(),
        ".RPB": text_of(rpc, tmp_path, write_rpb).encode(),
        ".XML": dimap_of(rpc, "PHR_SENSOR", 1).encode(),
    }
    splices = [
        b"nan",
        b"1e400",
        b"-inf",
        b"0",
        b"\0",
        b":",
        b"=",
        b"(",
        b")",
        b";",
        b"<",
        b">",
        b"\xff",
        b",",
        b"\n",
        b"e",
    ]
    corners = np.array([rpc.domain[0] + np.array(s) * rpc.domain[1] for s in ((-1, -1, -1), (0, 0, 0), (1, 1, 1))])
    accepted = 0
    for number in range(1000):
        suffix = list(seeds)[number % 3]
        path = tmp_path / f"m{suffix}"
        path.write_bytes(mutate(seeds[suffix], rng, splices))
        try:
            with np.errstate(all="ignore"):
                model = read_rpc(path)
                image = model.ground_to_image(corners)
        except OrthoError:
            continue
        accepted += 1
        numbers = [v for value in model.to_dict().values() for v in np.atleast_1d(value) if not isinstance(v, str)]
        assert all(v is None or math.isfinite(v) for v in numbers)
        assert image.shape == (3, 2)
    assert 25 < accepted < 750


def mutate(data: bytes, rng: np.random.Generator, splices: list[bytes]) -> bytes:
    at = int(rng.integers(len(data)))
    length = int(rng.integers(1, 40))
    kind = rng.integers(5)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes(rng.integers(0, 256, length, dtype=np.uint8)) + data[at + length :]
    if kind == 2:
        return data[:at] + data[at + length :]
    if kind == 3:
        return data[:at] + data[at : at + length] * 3 + data[at + length :]
    return data[:at] + splices[rng.integers(len(splices))] + data[at + int(rng.integers(4)) :]


# -- RPC of other models ---------------------------------------------------------------------------------------------


def corrected(rpc: RPC, name: str) -> ImageCorrection:
    return ImageCorrection(rpc, "affine", (400.0, 700.0), np.array(CORRECTIONS[name]))


@pytest.mark.parametrize("name", ["shift", "scale", "cross"])
def test_correction_is_folded_exactly_where_it_can_be(name):
    rpc = make_rpc()
    if name == "cross":
        rpc = make_rpc(row_den=rpc.col_den)
    exported = export_rpc(corrected(rpc, name))
    assert exported.exact
    assert exported.max_error_px == 0.0
    ground = in_box(rpc, 1000)
    expected = corrected(rpc, name).ground_to_image(ground)
    assert np.abs(exported.rpc.ground_to_image(ground) - expected).max() < 1e-8


def test_cross_term_with_two_denominators_is_fitted_and_says_how_well():
    rpc = make_rpc()
    model = corrected(rpc, "cross")
    exported = export_rpc(model)
    assert not exported.exact
    ground = in_box(rpc, 1000)
    seen = np.abs(exported.rpc.ground_to_image(ground) - model.ground_to_image(ground)).max()
    assert seen <= 1.2 * exported.max_error_px
    assert exported.max_error_px < 1e-4


def test_correction_of_a_correction_is_folded():
    rpc = make_rpc()
    model = ImageCorrection(corrected(rpc, "scale"), "shift", (0.0, 0.0), np.array(CORRECTIONS["shift"]))
    exported = export_rpc(model)
    ground = in_box(rpc, 100)
    assert exported.exact
    assert np.abs(exported.rpc.ground_to_image(ground) - model.ground_to_image(ground)).max() < 1e-8
    assert export_rpc(rpc).rpc is rpc


@dataclass(frozen=True, eq=False)
class Frame(SensorModel):
    """A frame camera over a UTM zone, looking down with a tilt, with radial distortion."""

    kind: ClassVar[str] = "test-frame"
    height: float = 680_000.0
    focal: float = 68_000.0
    distortion: float = 0.0

    @property
    def crs(self):
        return "EPSG:32735"

    @property
    def domain(self):
        return np.array([260_000.0, 6_270_000.0, 800.0]), np.array([10_000.0, 10_000.0, 800.0])

    def ground_to_image(self, ground):
        ground = as_ground(ground)
        # Onto the tangent plane of the ellipsoid, as a camera sees the curved Earth.
        (x, y, h), (x0, y0, _) = ground.T, self.domain[0]
        x, y = x - x0, y - y0
        depth = self.height - h + (x**2 + y**2) / (2 * 6_371_000.0)
        tilted = np.array([x + 0.2 * depth, y, depth - 0.2 * x])
        plane = self.focal * tilted[:2] / tilted[2]
        radial = 1 + self.distortion * (((plane - [[self.focal * 0.2], [0]]) / 1000.0) ** 2).sum(axis=0)
        return (plane * radial * [[1], [-1]]).T


@pytest.mark.parametrize("distortion", [0.0, 1e-4])
def test_rpc_stands_for_a_frame_camera_in_another_crs(distortion):
    model = Frame(distortion=distortion)
    exported = export_rpc(model)
    assert exported.max_error_px < 0.005
    assert not exported.exact
    centre, half = model.domain
    ground = centre + np.random.default_rng(2).uniform(-1, 1, (500, 3)) * half
    to_geographic = pyproj.Transformer.from_crs("EPSG:32735", "EPSG:4326", always_xy=True)
    lon, lat = to_geographic.transform(ground[:, 0], ground[:, 1])
    image = exported.rpc.ground_to_image(np.column_stack([lon, lat, ground[:, 2]]))
    assert np.abs(image - model.ground_to_image(ground)).max() < 0.005


class Wavy(Frame):
    """A frame camera with an attitude jitter that no rational function follows."""

    kind: ClassVar[str] = "test-wavy"
    amplitude: ClassVar[float] = 0.05

    def ground_to_image(self, ground):
        image = super().ground_to_image(ground)
        image[:, 0] += self.amplitude * np.sin(image[:, 1] / 40)
        return image


def test_a_poor_fit_has_a_notice_or_is_refused(monkeypatch, caplog):
    """Each command shows the notice with the image that it is of; a line of the log named none."""
    poor = export_rpc(Wavy())
    assert 0.02 < poor.max_error_px < 0.1
    assert "only to" in poor.warnings[0]
    assert caplog.text == ""
    monkeypatch.setattr(Wavy, "amplitude", 1.0)
    with pytest.raises(InputError, match="represents this model only to"):
        export_rpc(Wavy())
    assert export_rpc(Wavy(), force=True).max_error_px > 0.5


@pytest.mark.parametrize(("amplitude", "told", "refused"), [(0.012, 0, False), (0.028, 1, False), (0.14, 1, True)])
def test_a_poor_fit_is_told_above_two_hundredths_and_refused_above_a_tenth_of_a_pixel(
    monkeypatch, amplitude, told, refused
):
    monkeypatch.setattr(Wavy, "amplitude", amplitude)
    exported = export_rpc(Wavy(), force=True)
    assert exported.max_error_px == pytest.approx(amplitude, rel=0.35)
    assert len(exported.warnings) == told
    if refused:
        with pytest.raises(InputError, match="represents this model only to"):
            export_rpc(Wavy())


@pytest.mark.parametrize(
    ("box", "heights"),
    [
        ((24, -34, 24, -33), (0, 100)),
        ((25, -34, 24, -33), (0, 100)),
        ((24, -34, 25, -33), (100, 0)),
        ((24, math.nan, 25, -33), (0, 100)),
        ((44, -34, 45, -33), (0, 100)),
    ],
)
def test_empty_or_outlying_box_is_refused(box, heights):
    with pytest.raises(InputError, match="box"):
        fit_rpc(make_rpc(), box, heights)


def test_flat_height_range_and_antimeridian_are_fitted():
    rpc = make_rpc(lon_off=179.99)
    lo_box = (179.93, -33.70, 180.05, -33.62)
    exported = fit_rpc(rpc, lo_box, (700.0, 700.0))
    assert exported.max_error_px < 1e-4
    ground = np.array([[-179.97, -33.66, 700.5], [179.95, -33.66, 700.5]])
    assert np.abs(exported.rpc.ground_to_image(ground) - rpc.ground_to_image(ground)).max() < 1e-4
    assert export_rpc(corrected(rpc, "cross")).max_error_px < 1e-4


# -- real products ---------------------------------------------------------------------------------------------------

RPC_FILES = [
    "gdal/gcore/data/md_ov_rpc.txt", "gdal/gcore/data/md_ge_rgb_0010000_rpc.txt", "gdal/gcore/data/md_dg.RPB",
    "gdal/gcore/data/md_dg_2.XML", "gdal/gcore/data/md_eros.rpc", "gdal/gcore/data/md_kompsat.rpc",
]  # fmt: skip
ALL_RPC = [
    *RPC_FILES, QUICKBIRD, "gdal/gcore/data/test_rpc.txt", "gdal/gcore/data/rpc.vrt", "rpcm/rpc_IKONOS.txt",
    "rpcm/rpc_PLANET_L1A.txt", "rpcm/rpc_PLEIADES.xml", "rpcm/rpc_SPOT6.xml", "shareloc/rpc/wv3_20.NTF",
    "shareloc/rpc/phr_oise/RPC_PHR1A_P_202503191043438_SEN_7342362101-1.XML", "otb/ikonos/ikonos-1.geom",
    "otb/QB/qb-1.geom", "otb/geoeye1/geoeye1-1.geom", "otb/pleiades/pleiades-1.geom",
]  # fmt: skip


@pytest.mark.realdata
@pytest.mark.parametrize("path", RPC_FILES)
def test_readers_agree_with_gdals(path):
    found = read_rpc(real(path))
    images = {"md_ov_rpc.txt": "md_ov.tif", "md_ge_rgb_0010000_rpc.txt": "md_ge_rgb_0010000.tif"}
    image = images.get(Path(path).name, Path(path).with_suffix(".tif").name)
    by_gdal, source = rpc_of_dataset(gdal.Open(str(real(path).with_name(image))))
    assert same(found, by_gdal)
    assert source == str(real(path))


@pytest.mark.realdata
def test_dimap_reader_agrees_with_gdals(tmp_path):
    for number, path in enumerate(("shareloc/rpc", "rpcm", "gdal/gdrivers/data/jpeg2000")):
        names = ["RPC_PHR1B_P_201709281038393_SEN_PRG_FC_178609-001.XML", "rpc_PLEIADES.xml", "RPC_md_ple.XML"]
        folder = tmp_path / str(number)
        folder.mkdir()
        shutil.copy(real(f"{path}/{names[number]}"), folder / "RPC_abcdef.XML")
        # The reader of GDAL wants the file of metadata as well.
        shutil.copy(real("gdal/gdrivers/data/jpeg2000/DIM_md_ple.XML"), folder / "DIM_abcdef.XML")
        make_image(folder / "IMG_abcdef_R1C1.tif")
        dataset = gdal.Open(str(folder / "IMG_abcdef_R1C1.tif"))
        found, source = rpc_of_dataset(dataset)
        assert source == str(folder / "RPC_abcdef.XML")
        mine = read_rpc(folder / "RPC_abcdef.XML")
        ground = in_box(mine, 100)
        assert np.abs(found.ground_to_image(ground) - mine.ground_to_image(ground)).max() < 1e-7


@pytest.mark.realdata
@pytest.mark.parametrize("path", ALL_RPC)
def test_real_rpcs_agree_with_gdal_close_and_are_refitted(path, tmp_path):
    rpc = read_rpc(real(path))
    dataset = gdal.Open(str(make_image(tmp_path / "a.tif")))
    dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    ground = in_box(rpc)
    image = rpc.ground_to_image(ground)
    assert np.abs(image - gdal_project(dataset, ground)).max() < 1e-7
    back = rpc.image_to_ground(image, ground[:, 2])
    closed = rpc.ground_to_image(back) - image
    # This one, altered by its publisher, folds over in a part of its box, so that two grounds have one image.
    assert np.isfinite(closed).all() or path.endswith("md_eros.rpc")
    assert np.nanmax(np.abs(closed)) < 1e-5
    centre, half = rpc.domain
    wide = centre + np.random.default_rng(3).uniform(-1.45, 1.45, (20_000, 3)) * half
    assert np.nanmax(unclosed(rpc, wide)) < 1e-10
    box, heights = domain_box(rpc)
    assert fit_rpc(rpc, box, heights).max_error_px < 1e-4


@pytest.mark.realdata
def test_orbview3_corners():
    rpc = read_rpc(real("gdal/gcore/data/md_ov_rpc.txt"))
    corners, fields = [], {}
    for line in real("gdal/gcore/data/md_ov.pvl").read_text().splitlines():
        key, _, value = line.strip().rstrip(";").partition("=")
        fields[key.strip()] = value.strip()
        if key.strip() == "height":
            corners.append([float(fields[name]) for name in ("longitude", "latitude", "height")])
    expected = [(0.5, 0.5), (8015.5, 0.5), (8015.5, 27481.5), (0.5, 27481.5)]
    image = rpc.ground_to_image(corners[:4])
    distance = np.abs(image[:, None] - np.array(expected)).max(axis=2).min(axis=1)
    assert len(corners) >= 4
    assert distance.max() < 0.003


@pytest.mark.realdata
def test_ikonos_geo_corner():
    rpc = read_rpc(real("gdal/gcore/data/md_ge_rgb_0010000_rpc.txt"))
    to_geographic = pyproj.Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True)
    lon, lat = to_geographic.transform([445950.21, 446950.21], [5417803.74, 5416803.74])
    image = rpc.ground_to_image(np.column_stack([lon, lat, [85.9509811401441] * 2]))
    assert np.abs(image[0] - 0.5).max() < 0.005
    assert np.abs(image[1] - image[0] - 1000).max() < 0.02


@pytest.mark.parametrize(
    ("bias", "random", "metres"), [(0.3, 0.4, 0.5), (0.6, -1.0, 0.6), (0.0, 0.8, 0.8), (-1.0, 0.0, None)]
)
def test_the_stated_accuracy_is_that_of_both_errors(bias, random, metres):
    """RPC00B: ERR_BIAS and ERR_RAND are standard deviations of independent errors; -1 is unknown, and so is 0."""
    assert make_rpc(err_bias=bias, err_rand=random).stated_accuracy == pytest.approx(metres)


def test_a_geom_file_counts_from_the_centre_of_the_first_pixel(tmp_path):
    """As RPC00B does: GDAL, given the same numbers, finds the same pixels, which it measures from the corner."""
    rpc, path = make_rpc(), tmp_path / "a.geom"
    fields = rpc_metadata(rpc)
    lines = [f"{key.lower().replace('long_', 'lon_')}:  {value}" for key, value in fields.items() if "COEFF" not in key]
    for key, value in fields.items():
        if "COEFF" in key:
            lines += [f"{key.lower()}_{k:02d}:  {number}" for k, number in enumerate(value.split())]
    path.write_text("\n".join(["polynomial_format:  B", "type:  ossimRpcModel", *lines, "number_lines:  1600", ""]))
    dataset = gdal.GetDriverByName("MEM").Create("", 2000, 1600)
    dataset.SetMetadata(fields, "RPC")
    transformer = gdal.Transformer(dataset, None, ["METHOD=RPC", "RPC_PIXEL_ERROR_THRESHOLD=1e-9"])
    centre, half = rpc.domain
    ground = centre + half * np.array([[-0.5, 0.4, 0.2], [0.6, -0.7, -0.9], [0.1, 0.2, 0.8]])
    theirs = np.array([transformer.TransformPoint(1, *point)[1][:2] for point in ground.tolist()])
    np.testing.assert_allclose(read_rpc(path).ground_to_image(ground), theirs, atol=1e-6)


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "half"), [("ikonos/ikonos-1", 0.0), ("QB/qb-1", 0.0), ("pleiades/pleiades-1", -0.5)])
def test_otb_localisations_are_reproduced(name, half):
    # That program counts from the corner too, except for Pleiades, where it takes over the vendor's count from 1.
    rpc = read_rpc(real(f"otb/{name}.geom"))
    table = np.loadtxt(real(f"otb/{name}.gcp2"), comments="#")
    offset = rpc.ground_to_image(table[:, 2:5]) - table[:, :2]
    assert np.abs(offset - half).max() < 1e-6


@pytest.mark.realdata
def test_pleiades_parallax():
    left = read_rpc(real("shareloc/rpc/phr_ventoux/left_image.geom"))
    right = read_rpc(real("shareloc/rpc/phr_ventoux/right_image.geom"))
    for height, row, col in ((0, 5195.7, 4906.5), (700, 4727.7, 5034.3), (1500, 4192.9, 5180.4)):
        image = right.ground_to_image(left.image_to_ground([[5000.0, 5000.0]], height))[0]
        assert np.abs(image - [col, row]).max() < 0.1


@pytest.mark.realdata
def test_quickbird_bias_is_what_was_measured():
    import json

    rpc, source = rpc_of_dataset(gdal.Open(str(real(QUICKBIRD))))
    assert source.endswith("qb2_basic1b.tif (TIFF tag)")
    features = json.loads(real("orthority/rpc/gcps.geojson").read_text())["features"]
    ground = np.array([feature["geometry"]["coordinates"] for feature in features])
    measured = np.array([feature["properties"]["ji"] for feature in features]) + 0.5
    bias = measured - rpc.ground_to_image(ground)
    assert np.abs(bias - np.array([-3.0, -2.11])).max() < 0.12


def test_a_side_car_that_gdal_cannot_read_is_named(tmp_path):
    image = tmp_path / "scene.tif"
    gdal.GetDriverByName("GTiff").Create(str(image), 20, 16)
    # GDAL takes this for damaged RPC text and raises at the first look, and only then.
    (tmp_path / "scene_RPC.TXT").write_bytes(bytes(range(128, 256)) * 30)
    for _ in range(2):
        dataset = gdal.Open(str(image))
        assert files_of(dataset)[0] == str(image)
        with pytest.raises(InputError, match=r"there is no RPC that can be read: scene_RPC\.TXT is damaged"):
            rpc_of_dataset(dataset)
    dataset = gdal.Open(str(image))
    assert has_rpc(dataset)
    with pytest.raises(InputError, match="damaged or encrypted"):
        rpc_of_dataset(dataset)


@pytest.mark.parametrize(
    ("driver", "ending"),
    [
        pytest.param("ENVI", "img", marks=pytest.mark.driver("ENVI")),
        pytest.param("EHdr", "bil", marks=pytest.mark.driver("EHdr")),
    ],
)
def test_the_rpc_of_an_image_with_its_header_in_another_file(tmp_path, driver, ending):
    made = gdal.Open(str(make_image(tmp_path / "made.tif", make_rpc())))
    path = str(tmp_path / f"scene.{ending}")
    gdal.GetDriverByName(driver).CreateCopy(path, made)
    ground = in_box(make_rpc(), 100)
    found, source = rpc_of_dataset(gdal.Open(path))
    np.testing.assert_allclose(found.ground_to_image(ground), make_rpc().ground_to_image(ground), atol=1e-6)
    assert source == f"{path} ({driver} metadata)"


@pytest.mark.driver("TIL")
def test_the_rpc_of_all_tiles_of_a_delivery_without_xml(tmp_path):
    tiles = [("scene_R1C1.tif", 0, 0, 40, 30), ("scene_R1C2.tif", 40, 0, 40, 30)]
    for name, *_ in tiles:
        make_image(tmp_path / name)
    (tmp_path / "scene.TIL").write_text(til_text(tuple(tiles)))
    (tmp_path / "scene.IMD").write_text("numRows = 30;\nnumColumns = 80;\nbitsPerPixel = 16;\nEND;\n")
    write_rpb(make_rpc(), tmp_path / "scene.RPB")
    found, source = rpc_of_dataset(gdal.Open(str(tmp_path / "scene.TIL")))
    np.testing.assert_allclose(
        found.ground_to_image([[24.4, -33.7, 600.0]]), make_rpc().ground_to_image([[24.4, -33.7, 600.0]]), atol=1e-6
    )
    assert source == str(tmp_path / "scene.RPB")


@pytest.mark.driver("NITF")
@pytest.mark.parametrize("factor", [1, 2])
def test_a_chip_of_a_nitf_image_has_the_rpc_of_the_whole_image(tmp_path, factor):
    """GDAL uses the RPC as if the chip were the whole image: hundreds of pixels off, without a word."""
    rpc, size, first = make_rpc(), 100, (60.0, 40.0)
    corners = [(0.5, 0.5), (0.5, size - 0.5), (size - 0.5, 0.5), (size - 0.5, size - 0.5)]  # row, column

    def chip(*full: tuple[float, float]) -> gdal.Dataset:
        numbers = "".join(f"{value:012.3f}" for pair in (*corners, *full) for value in pair)
        text = f"00{factor:010.5f}0000{numbers}{800:08d}{1000:08d}"
        made = gdal.GetDriverByName("MEM").Create("", size, size, 1)
        made.SetMetadata(rpc_metadata(rpc), "RPC")
        path = str(tmp_path / "chip.ntf")
        gdal.GetDriverByName("NITF").CreateCopy(path, made, options=[f"TRE=ICHIPB={text}", "RPC00B=YES"])
        (tmp_path / "chip.ntf.aux.xml").unlink(missing_ok=True)
        return gdal.Open(path)

    found, _ = rpc_of_dataset(chip(*((row * factor + first[1], column * factor + first[0]) for row, column in corners)))
    ground = rpc.image_to_ground([[first[0] + 30 * factor, first[1] + 70 * factor]], 300.0)
    # Offsets in the file are whole pixels.
    np.testing.assert_allclose(found.ground_to_image(ground), [[30.0, 70.0]], atol=1.0)
    with pytest.raises(InputError, match="ICHIPB"):
        rpc_of_dataset(chip(*((column, row) for row, column in corners)))


@pytest.mark.realdata
def test_a_tile_has_its_place_in_the_mosaic_also_where_its_rpc_file_is_given(tmp_path, real):
    """Pléiades: one RPC for all tiles. With `--rpc` the second tile was a whole tile off."""
    (source,) = real.glob("**/RPC_PHR1A_P_*.XML")
    name = source.stem.removeprefix("RPC_")
    shutil.copy(source, tmp_path / source.name)
    for column in (1, 2):
        gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"IMG_{name}_R1C{column}.TIF"), 400, 300, 1)
    tiles = "".join(
        f'<Data_File tile_R="1" tile_C="{column}"><DATA_FILE_PATH href="IMG_{name}_R1C{column}.TIF"/></Data_File>'
        for column in (1, 2)
    )
    (tmp_path / f"DIM_{name}.XML").write_text(
        '<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT>'
        "<METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification><Raster_Data><Data_Access>"
        f"<Data_Files>{tiles}</Data_Files></Data_Access><Raster_Dimensions><NROWS>300</NROWS><NCOLS>800</NCOLS>"
        '<NBANDS>1</NBANDS><Tile_Set><NTILES>2</NTILES><Regular_Tiling><NTILES_SIZE nrows="300" ncols="400"/>'
        '<NTILES_COUNT ntiles_R="1" ntiles_C="2"/><OVERLAP_ROW>0</OVERLAP_ROW><OVERLAP_COL>0</OVERLAP_COL>'
        "</Regular_Tiling></Tile_Set></Raster_Dimensions></Raster_Data></Dimap_Document>"
    )
    whole = read_rpc(source)
    for column, off in ((1, 0.0), (2, 400.0)):
        dataset = gdal.Open(str(tmp_path / f"IMG_{name}_R1C{column}.TIF"))
        for choice in (None, tmp_path / source.name):
            found, path = rpc_of_dataset(dataset, choice)
            assert path == str(tmp_path / source.name)
            assert (found.col_off, found.row_off) == pytest.approx((whole.col_off - off, whole.row_off), abs=1e-6)
        # A file elsewhere is that of this image.
        assert same(rpc_of_dataset(dataset, source)[0], whole)
