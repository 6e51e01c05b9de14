"""What rasters name: the files in headers of VRT, DIMAP, ERS, ISIS3, PCIDSK and TIL, and their coordinate systems."""

from __future__ import annotations

from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.opening.references import NAMES_OF, Named, crs_texts, products_of_volume


def named(path: Path, kind: str, text: str | bytes) -> list[Named]:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return list(NAMES_OF[kind](path))


VRT = """<VRTDataset rasterXSize="10" rasterYSize="10"><SRS>EPSG:4326</SRS>
<VRTRasterBand dataType="Byte" band="1"{kind}>
<SimpleSource><SourceFilename{relative}>one.tif</SourceFilename></SimpleSource>
<ComplexSource><SourceFilename>two.tif</SourceFilename></ComplexSource></VRTRasterBand></VRTDataset>"""


@pytest.mark.parametrize(
    ("given", "relative"), [("", False), (' relativeToVRT="1"', True), (' relativeToVRT="0"', False)]
)
def test_a_vrt_names_its_sources(tmp_path: Path, given: str, relative: bool) -> None:
    found = named(tmp_path / "a.vrt", "VRT", VRT.format(kind="", relative=given))
    one, two = sorted(found, key=lambda one: one.name)
    assert one == Named("one.tif", "SourceFilename", relative=relative)
    assert two == Named("two.tif", "SourceFilename", relative=False)


def test_a_raw_band_of_a_vrt_names_bytes(tmp_path: Path) -> None:
    text = """<VRTDataset rasterXSize="10" rasterYSize="10"><VRTRasterBand subClass="VRTRawRasterBand" dataType="Byte">
    <SourceFilename relativetoVRT="1">a.raw</SourceFilename><ImageOffset>0</ImageOffset></VRTRasterBand></VRTDataset>"""
    assert named(tmp_path / "a.vrt", "VRT", text) == [Named("a.raw", "SourceFilename", relative=True, raw=True)]
    mixed = VRT.format(kind="", relative="").replace("</VRTDataset>", text[text.index("<VRTRaster") :])
    assert {one.name: one.raw for one in named(tmp_path / "a.vrt", "VRT", mixed)} == {
        "one.tif": False, "two.tif": False, "a.raw": True,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (VRT.format(kind=' subClass="VRTDerivedRasterBand"', relative=""), "only plain VRTs"),
        (VRT.format(kind="", relative="").replace("SimpleSource", "ArraySource"), "only plain VRTs"),
        (VRT.format(kind="", relative=' relativeToVRT="2"'), "no plain file name"),
        (VRT.format(kind="", relative="").replace("one.tif", "<a/>"), "no plain file name"),
        (VRT.format(kind="", relative="").replace("one.tif", ""), "no plain file name"),
        ("<VRTDataset", "not well-formed"),
        (VRT.format(kind="", relative=' relativeToVRT="1" relativeTOVRT="1"'), "no plain file name"),
    ],
)  # fmt: skip
def test_any_other_vrt_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        named(tmp_path / "a.vrt", "VRT", text)


def test_what_a_vrt_holds_as_text_is_not_looked_at(tmp_path: Path) -> None:
    text = VRT.format(kind="", relative="").replace("<SRS>EPSG:4326", "<Metadata><Odd/></Metadata><SRS>EPSG:4326")
    assert len(named(tmp_path / "a.vrt", "VRT", text)) == 2


def pcidsk(headers: list[bytes], count: int | None = None, block: int = 3) -> bytes:
    """Return the beginning of a PCIDSK file, whose image headers of 1024 bytes begin at a block of 512 bytes."""
    start = bytearray(b"PCIDSK  ".ljust((block - 1) * 512, b"7"))
    start[336:352] = b"%016d" % block
    start[376:384] = b"%08d" % (len(headers) if count is None else count)
    return bytes(start) + b"".join(headers)


def header(name: bytes) -> bytes:
    return (b"A" * 64 + name.ljust(64)).ljust(1024, b"B")


def test_a_pcidsk_file_with_all_its_channels_inside_names_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.pix"
    assert named(path, "PCIDSK", pcidsk([header(b""), header(b"\0" * 64), header(b"/SIS=12")])) == []
    assert named(path, "PCIDSK", pcidsk([header(b"")], block=5)) == []
    assert named(path, "PCIDSK", pcidsk([])) == []


@pytest.mark.parametrize(
    "text",
    [
        pcidsk([header(b""), header(b"/etc/passwd")]), pcidsk([header(b"other.raw"), header(b"")]),
        pcidsk([header(b"")], count=2), pcidsk([header(b"")])[:-1], pcidsk([header(b"")], count=10_000),
        pcidsk([header(b"")]).replace(b"%016d" % 3, b"three".rjust(16)), pcidsk([header(b"")], count=-1)[:1024] + b"x",
    ],
    ids=["second outside", "first outside", "one missing", "cut", "too many", "no number", "negative"],
)  # fmt: skip
def test_a_pcidsk_file_with_channels_elsewhere_is_refused(tmp_path: Path, text: bytes) -> None:
    if text.endswith(b"x"):
        assert named(tmp_path / "a.pix", "PCIDSK", text) == []  # no channels, and none outside
        return
    with pytest.raises(InputError, match="in other files"):
        named(tmp_path / "a.pix", "PCIDSK", text)


def test_an_ers_header_names_its_data_file_and_the_file_next_to_it(tmp_path: Path) -> None:
    found = named(tmp_path / "a.ers", "ERS", 'DatasetHeader Begin\n\tDataFile = "b c.bin"\n\tdatafile=d.bin\nEnd\n')
    assert found == [Named(name, "DataFile", raw=True) for name in ("b c.bin", "d.bin", "a")]
    found = named(tmp_path / "a.ers", "ERS", 'DataFile = "b.tif"\nDataSetType = Translated\n')
    assert found == [Named("b.tif", "DataFile"), Named("a", "DataFile")]
    with pytest.raises(InputError, match="no plain value"):
        named(tmp_path / "a.ers", "ERS", "DataFile = 'b.bin'\n")


def test_an_isis_label_names_its_core(tmp_path: Path) -> None:
    label = "Object = IsisCube\n  ^Core = {}\n  Format = {}\nEnd\n"
    assert named(tmp_path / "a.lbl", "ISIS3", label.format("a.cub", "Tile")) == [Named("a.cub", "^Core", raw=True)]
    found = named(tmp_path / "a.lbl", "ISIS3", label.format('"b c.tif"', "GeoTIFF"))
    assert found == [Named("b c.tif", "^Core")]
    assert named(tmp_path / "a.lbl", "ISIS3", "Object = IsisCube\nEnd\n") == []
    with pytest.raises(InputError, match="no plain value"):
        named(tmp_path / "a.lbl", "ISIS3", label.format("('a.cub', 5)", "Tile"))
    # A label ends with its pixels following, within 5 MB.
    assert len(named(tmp_path / "a.lbl", "ISIS3", label.format("a.cub", "Tile").encode() + b"\xff" * 5_000_000)) == 1
    with pytest.raises(InputError, match="larger than 5 MB"):
        named(tmp_path / "a.lbl", "ISIS3", b" " * 5_000_000 + label.format("a.cub", "Tile").encode())


def test_tiles_and_images_of_products_are_named(tmp_path: Path) -> None:
    found = named(tmp_path / "a.til", "TIL", 'numTiles = 2;\nfilename = "one.tif";\nFileName=two.tif;\n')
    assert found == [Named("one.tif", "filename"), Named("two.tif", "filename")]
    text = """<Dimap_Document><Raster_Data><Data_File><DATA_FILE_PATH href="i.tif"/></Data_File><Data_File>
    <DATA_FILE_PATH>j.tif</DATA_FILE_PATH></Data_File></Raster_Data></Dimap_Document>"""
    found = named(tmp_path / "dim.xml", "DIMAP", text)
    assert sorted(one.name for one in found) == ["i.tif", "j.tif"]
    assert {one.field for one in found} == {"DATA_FILE_PATH"}


COMPONENT = '<Component><COMPONENT_TYPE>{}</COMPONENT_TYPE><COMPONENT_PATH href="{}"/></Component>'
CONTENT = "<Dataset_Content><Dataset_Components>{}</Dataset_Components></Dataset_Content>"
VOLUME = f"<Dimap_Document>{CONTENT}{{}}</Dimap_Document>"


def test_a_volume_names_its_products_and_an_image_names_none(tmp_path: Path) -> None:
    path, parts = tmp_path / "vol.xml", COMPONENT.format("DIMAP", " p/dim.xml ") + COMPONENT.format("PDF", "a.pdf")
    path.write_text(VOLUME.format(parts, ""))
    assert products_of_volume(path) == ["p/dim.xml"]
    path.write_text(VOLUME.format(parts, "<Raster_Data/>"))
    assert products_of_volume(path) == []
    kinds = "<COMPONENT_TYPE>PDF</COMPONENT_TYPE><COMPONENT_TYPE>DIMAP</COMPONENT_TYPE>"
    path.write_text(VOLUME.format(f'<Component>{kinds}<COMPONENT_PATH href="q.xml"/></Component>', ""))
    assert products_of_volume(path) == ["q.xml"]
    path.write_text("<Other/>")
    assert products_of_volume(path) == []


def test_coordinate_systems_are_found_where_gdal_takes_them_from(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("GEOGCS[1]")
    assert list(crs_texts(path, ".prj")) == ["GEOGCS[1]"]
    assert list(crs_texts(path, ".tfw")) == []
    path.write_text("samples = 3\nCoordinate System String = {PROJCS[2]}\n")
    assert list(crs_texts(path, ".hdr")) == ["PROJCS[2]"]
    more = '<Metadata><MDI key="SRS">EPSG:2</MDI><MDI key="a">b</MDI></Metadata>'
    path.write_text(f"<PAMDataset><SRS>EPSG:1</SRS>{more}</PAMDataset>")
    assert sorted(crs_texts(path, ".aux.xml")) == ["EPSG:1", "EPSG:2"]
    assert sorted(crs_texts(path, "VRT")) == ["EPSG:1", "EPSG:2"]


def test_a_header_ends_at_the_first_zero_and_at_five_megabytes(tmp_path: Path) -> None:
    path = tmp_path / "a.til"
    assert named(path, "TIL", b'filename = "one.tif"\0filename = "two.tif"') == [Named("one.tif", "filename")]
    assert named(path, "TIL", b'filename = "\xe9.tif"') == [Named("é.tif", "filename")]
    path.write_bytes(b" " * 5_000_000)
    assert list(NAMES_OF["TIL"](path)) == []
    path.write_bytes(b" " * 5_000_001)
    with pytest.raises(InputError, match="larger than 5 MB"):
        list(NAMES_OF["TIL"](path))
    with pytest.raises(InputError, match="not a file"):
        list(NAMES_OF["TIL"](tmp_path))
