"""The gate before GDAL: which references of a raster are followed, which refused, and what is decoded at once."""

from __future__ import annotations

import gzip
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.opening.drivers import DRIVERS
from ortho_pipeline.raster.opening.gate import DecodedUnit, VsiPath, _beside, open_seen

#: Blocks larger than those of a VRT.
LARGE = ("TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256")


def tiff(
    path: Path, *options: str, size: tuple[int, int] = (300, 200), bands: int = 1, kind: int = gdal.GDT_UInt16
) -> Path:
    path.parent.mkdir(exist_ok=True)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, bands, kind, list(options))
    dataset.GetRasterBand(1).WriteArray(np.arange(size[0] * size[1]).reshape(size[::-1]) % 1000)
    dataset.FlushCache()
    return path


def vrt(path: Path, source: str, relative: int = 1) -> Path:
    path.write_text(
        f"""<VRTDataset rasterXSize="300" rasterYSize="200"><VRTRasterBand dataType="UInt16" band="1"><SimpleSource>
        <SourceFilename relativeToVRT="{relative}">{source}</SourceFilename><SourceBand>1</SourceBand>
        </SimpleSource></VRTRasterBand></VRTDataset>"""
    )
    return path


def opened(path: Path, *roots: Path, siblings: bool = True) -> tuple[gdal.Dataset, DecodedUnit]:
    return open_seen(path, roots, DRIVERS, siblings)


def overviews(path: Path, *roots: Path, siblings: bool = True) -> int:
    dataset = opened(path, *roots, siblings=siblings)[0]
    return int(dataset.GetRasterBand(1).GetOverviewCount())


def test_sources_in_the_own_folder_and_in_allowed_ones_are_read(tmp_path: Path) -> None:
    inside, outside = (tiff(tmp_path / name, *LARGE) for name in ("a/in.tif", "b/out.tif"))
    dataset, block = opened(vrt(tmp_path / "a" / "one.vrt", "in.tif"))
    assert dataset.ReadAsArray(0, 0, 3, 1).tolist() == [[0, 1, 2]]
    assert block.path == str(inside)
    for name, relative in (("../b/out.tif", 1), (str(outside), 0)):
        with pytest.raises(InputError, match="outside its own folder"):
            opened(vrt(tmp_path / "a" / "two.vrt", name, relative))
        dataset, block = opened(vrt(tmp_path / "a" / "two.vrt", name, relative), tmp_path / "b")
        assert dataset.ReadAsArray(0, 0, 3, 1).tolist() == [[0, 1, 2]]
        assert Path(block.path).resolve() == outside


def test_a_link_may_have_its_files_at_either_end(tmp_path: Path) -> None:
    tiff(tmp_path / "a" / "in.tif")
    target = vrt(tmp_path / "a" / "one.vrt", "in.tif")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "link.vrt").symlink_to(target)
    assert opened(tmp_path / "c" / "link.vrt")[0].RasterXSize == 300


@pytest.mark.parametrize(
    "name", ["/vsicurl/http://example.org/a.tif", "http://example.org/a.tif", "<a/>", "", "NETCDF:a.nc:b"]
)
def test_names_that_are_no_files_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError):
        opened(vrt(tmp_path / "one.vrt", name.replace("<", "&lt;").replace(">", "&gt;"), 0))


def test_a_vrt_that_refers_to_itself_is_refused(tmp_path: Path) -> None:
    vrt(tmp_path / "one.vrt", "two.vrt")
    with pytest.raises(InputError, match="refers to itself"):
        opened(vrt(tmp_path / "two.vrt", "one.vrt"))
    # Two names for one file are no circle.
    source = tiff(tmp_path / "in.tif", *LARGE)
    text = vrt(tmp_path / "three.vrt", "in.tif").read_text()
    start, end = text.index("<SimpleSource>"), text.index("</VRTRasterBand>")
    (tmp_path / "three.vrt").write_text(text[:end] + text[start:end] + text[end:])
    assert opened(tmp_path / "three.vrt")[1].path == str(source)


def test_what_a_source_is_counts_and_not_its_name(tmp_path: Path) -> None:
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(InputError, match="not a raster of an allowed format"):
        opened(vrt(tmp_path / "one.vrt", "text.tif"))
    (tmp_path / "folder.tif").mkdir()
    with pytest.raises(InputError, match="not a file"):
        opened(vrt(tmp_path / "one.vrt", "folder.tif"))
    whole = tiff(tmp_path / "cut.tif").read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[:8] + b"\xff" * 40)
    with pytest.raises(InputError, match="cannot be opened"):
        opened(vrt(tmp_path / "one.vrt", "cut.tif"))


def test_sidecars_that_are_rasters_have_to_be_plain_ones_in_the_folder(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a" / "in.tif")
    shutil.copy(tiff(tmp_path / "b" / "half.tif", size=(150, 100)), tmp_path / "a" / "in.tif.ovr")
    assert overviews(path) == 1
    vrt(tmp_path / "a" / "in.tif.ovr", "in.tif")
    with pytest.raises(InputError, match="not a plain raster"):
        opened(path)
    assert overviews(path, siblings=False) == 0
    (tmp_path / "a" / "in.tif.ovr").unlink()
    (tmp_path / "a" / "in.tif.ovr").symlink_to(tmp_path / "b" / "half.tif")
    with pytest.raises(InputError, match="outside its own folder"):
        opened(path)
    assert overviews(path, tmp_path / "b") == 1


@pytest.mark.parametrize("name", ["in.tfw", "in.tif.aux.xml", "in.prj", "in_RPC.TXT"])
def test_sidecars_that_are_texts_may_not_be_links_elsewhere(tmp_path: Path, name: str) -> None:
    path = tiff(tmp_path / "a" / "in.tif")
    text = tmp_path / "secret"
    text.write_text("<PAMDataset></PAMDataset>" if name.endswith("xml") else "1.0\n0.0\n0.0\n-1.0\n0.5\n0.5\n")
    (tmp_path / "a" / name).symlink_to(text)
    with pytest.raises(InputError, match="outside its own folder"):
        opened(path)
    (tmp_path / "a" / name).rename(tmp_path / "a" / f"other{name[2:]}")
    assert opened(path)[0].RasterXSize == 300


@pytest.mark.parametrize("text", ["", "\n", "\0" * 100])
def test_an_empty_sidecar_is_ignored_as_gdal_does(tmp_path: Path, text: str) -> None:
    path = tiff(tmp_path / "in.tif")
    (tmp_path / "in.tif.aux.xml").write_text(text)
    assert opened(path)[0].RasterXSize == 300


def test_overviews_named_in_metadata_are_seen_to(tmp_path: Path) -> None:
    tiff(tmp_path / "b" / "half.tif", size=(150, 100))
    path = tiff(tmp_path / "a" / "in.tif")
    aux = '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{}</MDI></Metadata></PAMDataset>'
    (tmp_path / "a" / "in.tif.aux.xml").write_text(aux.format("../b/half.tif"))
    with pytest.raises(InputError, match="outside its own folder"):
        opened(path)
    (tmp_path / "a" / "in.tif.aux.xml").write_text(aux.format(":::BASE:::half.tif"))
    shutil.copy(tmp_path / "b" / "half.tif", tmp_path / "a")
    assert opened(path)[0].RasterXSize == 300


def test_a_geotransform_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    tiff(tmp_path / "in.tif")
    path = vrt(tmp_path / "one.vrt", "in.tif")
    text = path.read_text()
    for numbers, good in (("0, 1, 0, 0, 0, -1", True), ("nan, 1, 0, 0, 0, -1", False), ("0, 1, 0, 0, 0, inf", False)):
        path.write_text(text.replace('"200">', f'"200"><GeoTransform>{numbers}</GeoTransform>'))
        if good:
            assert opened(path)[0].GetGeoTransform()[5] == -1.0
        else:
            with pytest.raises(InputError, match="not finite"):
                opened(path)


@pytest.mark.parametrize(
    ("options", "bands", "kind", "size"),
    [
        (["BLOCKYSIZE=8"], 1, gdal.GDT_UInt16, 300 * 8 * 2),
        (["TILED=YES", "BLOCKXSIZE=64", "BLOCKYSIZE=32"], 1, gdal.GDT_Float32, 64 * 32 * 4),
        (["TILED=YES", "BLOCKXSIZE=64", "BLOCKYSIZE=32", "INTERLEAVE=PIXEL"], 3, gdal.GDT_Byte, 64 * 32 * 3),
        (["TILED=YES", "BLOCKXSIZE=64", "BLOCKYSIZE=32", "INTERLEAVE=BAND"], 3, gdal.GDT_Byte, 64 * 32),
        # One compressed strip has all rows; without compression, each row is read alone.
        (["BLOCKYSIZE=200", "COMPRESS=DEFLATE"], 1, gdal.GDT_Byte, 300 * 200),
        (["BLOCKYSIZE=1", "COMPRESS=DEFLATE"], 1, gdal.GDT_Byte, 300),
    ],
)  # fmt: skip
def test_a_pixel_costs_the_block_that_it_is_in(tmp_path: Path, options, bands: int, kind: int, size: int) -> None:
    path = tiff(tmp_path / "in.tif", *options, bands=bands, kind=kind)
    assert opened(path)[1] == DecodedUnit(size, str(path))


def test_a_png_is_decoded_as_a_whole(tmp_path: Path) -> None:
    source = gdal.Open(str(tiff(tmp_path / "in.tif", kind=gdal.GDT_Byte)))
    gdal.GetDriverByName("PNG").CreateCopy(str(tmp_path / "a.png"), source).FlushCache()
    assert opened(tmp_path / "a.png")[1].size == 300 * 200


def test_a_folder_without_a_product_is_no_image(tmp_path: Path) -> None:
    tiff(tmp_path / "in.tif")
    with pytest.raises(InputError, match="this is a folder"):
        opened(tmp_path)
    for name in ("DIM_A.XML", "DIM_B.XML"):
        (tmp_path / name).write_text("<Dimap_Document/>")
    with pytest.raises(InputError, match=r"several products: DIM_A\.XML, DIM_B\.XML"):
        opened(tmp_path)
    for names, message in ((("a/DIM_A.XML",), "is missing"), (("DIM_A.XML", "DIM_B.XML"), "several products")):
        parts = "".join(
            f'<Component><COMPONENT_TYPE>DIMAP</COMPONENT_TYPE><COMPONENT_PATH href="{name}"/></Component>'
            for name in names
        )
        (tmp_path / "VOL_A.XML").write_text(
            "<Dimap_Document><Dataset_Content><Dataset_Components>"
            f"{parts}</Dataset_Components></Dataset_Content></Dimap_Document>"
        )
        with pytest.raises(InputError, match=message):
            opened(tmp_path)


def test_sidecars_of_a_compressed_file_are_asked_for_by_name(tmp_path: Path) -> None:
    """GDAL cannot list what is in a .gz: its reader of single files has no folders; an archive has them."""
    for name in ("b.tif.gz", "b.tif.gz.aux.xml"):
        (tmp_path / name).write_bytes(gzip.compress(b"x"))
    assert _beside(VsiPath(f"/vsigzip/{tmp_path}/b.tif.gz")) == ["b.tif.gz.aux.xml"]
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        for name in ("d/b.tif", "d/b.tfw", "d/other.tfw"):
            archive.writestr(name, "x")
    assert sorted(_beside(VsiPath(f"/vsizip/{tmp_path}/c.zip/d/b.tif"))) == ["b.tfw", "b.tif"]


@pytest.mark.parametrize(("driver", "ending"), [("ENVI", "bil"), ("PCIDSK", "pix"), ("PCRaster", "map")])
@pytest.mark.parametrize("cut", [1, 600, 20_000])
def test_a_truncated_file_whose_missing_pixels_gdal_reads_as_zeros_is_refused(
    tmp_path: Path, driver: str, ending: str, cut: int
) -> None:
    if gdal.GetDriverByName(driver) is None:
        pytest.skip(f"this GDAL has no driver {driver}")
    path = tmp_path / f"a.{ending}"
    source = gdal.Open(str(tiff(tmp_path / "a.tif", kind=gdal.GDT_Float32)))
    gdal.GetDriverByName(driver).CreateCopy(str(path), source).FlushCache()
    whole, _ = open_seen(path, (), DRIVERS, siblings=True)
    np.testing.assert_array_equal(whole.ReadAsArray(), source.ReadAsArray())
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(InputError, match="the file is truncated"):
        open_seen(path, (), DRIVERS, siblings=True)


@pytest.mark.parametrize(("bands", "size"), [(3, 64 * 32 * 3), (1, 64 * 32)])
def test_a_mask_does_not_make_a_pixel_cost_less(tmp_path: Path, monkeypatch, bands: int, size: int) -> None:
    monkeypatch.setenv("GDAL_TIFF_INTERNAL_MASK", "YES")
    options = ["TILED=YES", "BLOCKXSIZE=64", "BLOCKYSIZE=32", "INTERLEAVE=PIXEL"]
    path = tiff(tmp_path / "in.tif", *options, bands=bands, kind=gdal.GDT_Byte)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
    dataset.GetRasterBand(1).GetMaskBand().Fill(255)
    del dataset
    dataset, block = opened(path)
    assert dataset.GetRasterBand(1).GetMaskFlags() == gdal.GMF_PER_DATASET
    assert block == DecodedUnit(size, str(path))
