"""Texts of strangers that state a coordinate system or a height datum lead PROJ to no file.

Each names a pipe: whoever opens it is noted. That PROJ would come for it is tested too.
"""

from __future__ import annotations

import contextlib
import html
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import seeds
from pyproj.database import get_codes
from pyproj.enums import PJType

from ortho_pipeline.batch.runner import run
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import CrsError, DatumError, InputError, OrthoError
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.geodesy.crs_gate import refuse_files
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.raster.verified_writing import checked_options
from ortho_pipeline.stores.stac.item import read_item
from ortho_pipeline.surface.dem import open_dem

_GEOGCS = (
    'GEOGCS["u",DATUM["u",SPHEROID["b",6377397.155,299.1528128]{}],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)
_PROJCS = (
    f'PROJCS["x",{_GEOGCS.format("")},PROJECTION["Mercator_1SP"],PARAMETER["central_meridian",0],'
    'PARAMETER["scale_factor",1],UNIT["metre",1],EXTENSION["PROJ4","{}"]]'
)
_CS = 'CS[ellipsoidal,2],AXIS["lat",north],AXIS["lon",east],UNIT["degree",0.0174532925199433]'
_BOUND = (
    f'BOUNDCRS[SOURCECRS[GEOGCRS["u",DATUM["u",ELLIPSOID["b",6377397.155,299.1528128]],{_CS}]],TARGETCRS['
    f'GEOGCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]],{_CS}]],'
    'ABRIDGEDTRANSFORMATION["x",METHOD["NTv2",ID["EPSG",9615]],'
    'PARAMETERFILE["Latitude and longitude difference file","PIPE",ID["EPSG",8656]]]]'
)


def _json(path: str) -> str:
    """Return the system as PROJJSON in which the path is written with escapes."""
    document = pyproj.CRS.from_wkt(_BOUND.replace("PIPE", "somewhere")).to_json()
    return document.replace("somewhere", "".join(f"\\u{ord(one):04x}" for one in path))


#: Texts that name the file at a path.
TEXTS: dict[str, Callable[[str], str]] = {
    "init": lambda path: f"+init={path}:1",
    "init-plain": lambda path: f"init={path}:1",
    "nadgrids": lambda path: f"+proj=longlat +ellps=bessel +nadgrids={path} +no_defs +type=crs",
    "nadgrids-optional": lambda path: f"+proj=longlat +ellps=bessel +nadgrids=@null,@{path} +no_defs +type=crs",
    "nadgrids-quoted": lambda path: f'+proj=longlat +ellps=bessel +nadgrids="{path}" +no_defs +type=crs',
    "nadgrids-dots": lambda path: f"+proj=longlat +ellps=bessel +nadgrids=./{os.path.relpath(path)} +no_defs +type=crs",
    "geoidgrids": lambda path: f"+proj=longlat +datum=WGS84 +geoidgrids={path} +vunits=m +no_defs +type=crs",
    "wkt-grids": lambda path: _GEOGCS.format(f',EXTENSION["PROJ4_GRIDS","{path}"]'),
    "wkt-nadgrids": lambda path: _PROJCS.format(f"+proj=merc +nadgrids={path}"),
    "wkt-init": lambda path: _PROJCS.format(f"+init={path}:1"),
    "wkt-bound": lambda path: _BOUND.replace("PIPE", path),
    "wkt-printed-quotes": lambda path: _BOUND.replace('"PIPE"', f"“{path}”"),
    "json": _json,
}  # fmt: skip


#: Lets go whoever opens the pipe, and notes them; a process, for PROJ opens files without releasing the interpreter.
_WATCHER = """
import os, sys, time
while True:
    try:
        pipe = os.open(sys.argv[1], os.O_WRONLY | os.O_NONBLOCK)
    except OSError:
        time.sleep(0.002)
        continue
    with open(sys.argv[2], "a") as log:
        log.write("x")
    os.close(pipe)
    time.sleep(0.002)
"""


@dataclass
class Pipe:
    """A pipe, and the file that notes who opened it."""

    path: str
    log: Path

    @property
    def readers(self) -> int:
        """How often it was opened since the last look."""
        found = self.log.stat().st_size
        self.log.write_text("")
        return found


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pipe]:
    path = tmp_path_factory.mktemp("elsewhere") / "pipe.gtx"
    os.mkfifo(path)
    pipe = Pipe(str(path), path.with_name("log"))
    pipe.log.write_text("")
    watcher = subprocess.Popen([sys.executable, "-c", _WATCHER, str(path), str(pipe.log)])
    yield pipe
    watcher.kill()
    watcher.wait()


@pytest.fixture
def pipe(watched: Pipe) -> Pipe:
    watched.log.write_text("")
    return watched


# -- where such texts stand ------------------------------------------------------------------------------------------


def _direct(folder: Path, text: str) -> None:
    ground_transform(parse_crs(text), "EPSG:4979")(np.array([[10.0, 50.0, 0.0]]))


def _table(folder: Path, text: str) -> None:
    (folder / "p.csv").write_text(f"#CRS: {text}\nid,col,row,x,y,h\n" + "".join(f"{k},1,2,10,50,0\n" for k in range(4)))
    read_points(folder / "p.csv", vertical="ellipsoid")


def _qgis(folder: Path, text: str) -> None:
    (folder / "p.points").write_text(f"#CRS: {text}\nmapX,mapY,sourceX,sourceY,enable\n" + "10,50,1,-2,1\n" * 4)
    read_points(folder / "p.points", vertical="ellipsoid")


def _vrt_text(text: str) -> str:
    return (
        f'<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>{html.escape(text)}</SRS><GeoTransform>10,1e-4,0,50,0,-1e-4'
        '</GeoTransform><VRTRasterBand dataType="Float32" band="1"/></VRTDataset>'
    )


def _vrt(folder: Path, text: str) -> None:
    (folder / "dem.vrt").write_text(_vrt_text(text))
    open_dem(folder / "dem.vrt", "ellipsoid").heights(np.array([[10.0, 50.0]]), "EPSG:4326")


def _entities(folder: Path, text: str) -> None:
    (folder / "dem.vrt").write_text(_vrt_text(text).replace("/pipe", "&#47;pipe").replace("/tmp", "&#47;tmp"))
    open_dataset(folder / "dem.vrt")


def _control_points(folder: Path, text: str) -> None:
    raster = _vrt_text("EPSG:4326").partition("<GeoTransform>")[0]
    places = "".join(f'<GCP Id="{k}" Pixel="{k}" Line="2" X="10" Y="50"/>' for k in range(4))
    listed = f'<GCPList Projection="{html.escape(text)}">{places}</GCPList>'
    (folder / "p.vrt").write_text(f'{raster}{listed}<VRTRasterBand dataType="Byte" band="1"/></VRTDataset>')
    open_dataset(folder / "p.vrt")


def _grid(folder: Path) -> Path:
    (folder / "a.asc").write_text("ncols 2\nnrows 2\nxllcorner 10\nyllcorner 50\ncellsize 1\n1 2\n3 4\n")
    return folder / "a.asc"


def _aux(folder: Path, text: str) -> None:
    path = _grid(folder)
    path.with_name("a.asc.aux.xml").write_text(f"<PAMDataset><SRS>{html.escape(text)}</SRS></PAMDataset>")
    open_dem(path, "ellipsoid")


def _prj(folder: Path, text: str) -> None:
    path = _grid(folder)
    path.with_suffix(".prj").write_text(text)
    open_dem(path, "ellipsoid")


def _envi(folder: Path, text: str) -> None:
    (folder / "a.dat").write_bytes(b"\1" * 81)
    (folder / "a.hdr").write_text(
        "ENVI\nsamples = 9\nlines = 9\nbands = 1\nheader offset = 0\ndata type = 1\ninterleave = bsq\nbyte order = 0\n"
        "map info = {Arbitrary, 1, 1, 10, 50, 1e-4, 1e-4, 0}\ncoordinate system string = {" + text + "}\n"
    )
    open_dem(folder / "a.dat", "ellipsoid")


def _geolocation(folder: Path, text: str) -> None:
    seeds.image(folder / "lon.tif", tag=False)
    keys = {"X_DATASET": "lon.tif", "Y_DATASET": "lon.tif", "X_BAND": "1", "Y_BAND": "1", "PIXEL_OFFSET": "0",
            "LINE_OFFSET": "0", "PIXEL_STEP": "1", "LINE_STEP": "1", "SRS": text}  # fmt: skip
    listed = "".join(f'<MDI key="{key}">{html.escape(value)}</MDI>' for key, value in keys.items())
    (folder / "a.vrt").write_text(
        '<VRTDataset rasterXSize="9" rasterYSize="9"><Metadata domain="GEOLOCATION">' + listed
        + '</Metadata><VRTRasterBand dataType="Byte" band="1"/></VRTDataset>'
    )  # fmt: skip
    open_scene(folder / "a.vrt", SceneOptions(sensor="geolocation"))


def _item(folder: Path, text: str) -> None:
    asset = {"href": "a.tif", "roles": ["data"], "type": "image/tiff", "proj:wkt2": text}
    document = {"type": "Feature", "stac_version": "1.0.0", "id": "one", "links": [], "properties": {"proj:wkt2": text}}
    (folder / "item.json").write_text(json.dumps({**document, "assets": {"image": asset}}))
    for system in read_item(folder / "item.json").heights().systems:
        _direct(folder, system)


ROUTES = {
    "direct": _direct, "table": _table, "qgis": _qgis, "vrt": _vrt, "entities": _entities, "gcps": _control_points,
    "aux": _aux, "prj": _prj, "envi": _envi, "geolocation": _geolocation, "item": _item,
}  # fmt: skip


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.filterwarnings("ignore")
def test_no_text_of_a_stranger_leads_to_a_file(route: str, name: str, tmp_path: Path, pipe: Pipe) -> None:
    with pytest.raises(OrthoError):
        ROUTES[route](tmp_path, TEXTS[name](pipe.path))
    assert not pipe.readers


@pytest.mark.filterwarnings("ignore")
def test_proj_would_come_for_each(tmp_path: Path, pipe: Pipe) -> None:
    for name, text in TEXTS.items():
        try:
            crs = pyproj.CRS.from_user_input(text(pipe.path))
            pyproj.Transformer.from_crs(crs, "EPSG:4979", always_xy=True).transform(10.0, 50.0, 0.0)
        except pyproj.exceptions.ProjError:
            pass
        assert pipe.readers, name


# -- height datums ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["{}", "./{}", "  {}  "])
def test_a_point_file_names_no_grid_by_its_path(form: str, tmp_path: Path, pipe: Pipe, monkeypatch: Any) -> None:
    monkeypatch.chdir(Path(pipe.path).parent)
    stated = form.format(pipe.path if form == "{}" else Path(pipe.path).name)
    table = tmp_path / "p.csv"
    table.write_text(
        f"#CRS: EPSG:4326\n#vertical: {stated}\nid,col,row,x,y,h\n" + "".join(f"{k},1,2,10,50,0\n" for k in range(4))
    )
    with pytest.raises(DatumError):
        read_points(table)
    assert not pipe.readers


def test_a_bare_name_is_not_looked_for_in_the_working_folder(tmp_path: Path, pipe: Pipe, monkeypatch: Any) -> None:
    monkeypatch.chdir(Path(pipe.path).parent)
    name = Path(pipe.path).name
    for text in (f"+proj=longlat +datum=WGS84 +geoidgrids={name} +vunits=m +type=crs", _BOUND.replace("PIPE", name)):
        (tmp_path / "dem.vrt").write_text(_vrt_text(text))
        with pytest.raises(InputError):
            open_dem(tmp_path / "dem.vrt").heights(np.array([[10.0, 50.0]]), "EPSG:4326")
    with pytest.raises(DatumError):
        Vertical.stated(name)
    assert not pipe.readers


def test_a_grid_of_the_working_folder_is_not_what_a_file_means(tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "mine.gtx").write_bytes(seeds.geoid_gtx())
    monkeypatch.chdir(tmp_path)
    assert Vertical.parse("mine.gtx").name == str(tmp_path / "mine.gtx")
    for text in ("mine.gtx", "./mine.gtx", str(tmp_path / "mine.gtx")):
        with pytest.raises(DatumError):
            Vertical.stated(text)


# -- what has to go on working ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:32636", "urn:ogc:def:crs:EPSG::4326", "http://www.opengis.net/def/crs/EPSG/0/4326", "+init=epsg:4326",
        "+proj=utm +zone=36 +datum=WGS84 +units=m +no_defs", "+proj=lcc +lat_1=49 +lat_2=46 +lat_0=47.5 +lon_0=13 "
        "+x_0=400000 +y_0=400000 +ellps=bessel +to_meter=0.3048", "+proj=merc +nadgrids=@null +a=6378137 +b=6378137",
        "WGS 84 / UTM zone 36N", "OGC:CRS84",
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore")
def test_codes_names_and_strings_without_files_are_taken(text: str) -> None:
    assert parse_crs(text).is_projected or parse_crs(text).is_geographic


@pytest.mark.filterwarnings("ignore")
def test_systems_of_the_database_are_taken_in_every_form() -> None:
    for authority in ("EPSG", "ESRI"):
        for code in sorted(get_codes(authority, PJType.CRS))[::700]:
            crs = pyproj.CRS.from_authority(authority, code)
            for form in ("WKT2_2019", "WKT1_GDAL", "WKT1_ESRI"):
                with contextlib.suppress(pyproj.exceptions.CRSError):
                    refuse_files(crs.to_wkt(form))
            refuse_files(crs.to_json())
            refuse_files(crs.name)


@pytest.mark.parametrize(
    "text",
    [
        "+proj=longlat +ellps=bessel +nadgrids=@missing.gsb,%s%n +type=crs",
        'GEOGCS["x",DATUM["y",SPHEROID["z",6377397,299],EXTENSION["PROJ4_GRIDS","%s%n%s%s"]],PRIMEM["Greenwich",0],'
        'UNIT["degree",0.0174532925199433]]',
        '{"type": "GeographicCRS", "name": "\\u0025n"}',
    ],
    ids=["PROJ", "WKT", "PROJJSON"],
)
def test_formats_in_place_of_names_never_reach_proj(text: str) -> None:
    """PROJ 9.5 prints the name of a missing grid as a format, and the process ends."""
    with pytest.raises(CrsError, match="percent sign"):
        parse_crs(text)


def test_a_refusal_says_what_to_do() -> None:
    with pytest.raises(CrsError, match="refers to a file by its path") as caught:
        parse_crs("+proj=longlat +ellps=bessel +nadgrids=/data/grid.gsb")
    assert "EPSG:n" in str(caught.value)


# -- pipeline files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("group", "key", "text"),
    [
        ("output", "creation_options", "{}"), ("output", "crs", "+init={}:1"), ("points", "crs", "+init={}:1"),
        ("points", "crs", "+proj=longlat +ellps=bessel +nadgrids={} +type=crs"), ("points", "vertical", "{}"),
        ("surface", "vertical", "{}"), ("surface", "vertical", "+/../{}"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore")
def test_a_pipeline_file_reads_nothing_outside(
    group: str, key: str, text: str, pipe: Pipe, tiny: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tiny.folder / "+").mkdir()
    monkeypatch.chdir(tiny.folder)
    path = os.path.relpath(pipe.path) if text.startswith("+/") else pipe.path
    values: list[Any] = [text.replace("{}", path)]
    if key == "creation_options":
        values = [{name: path} for name in ("TILING_SCHEME", "TARGET_SRS", "RESAMPLING", "NUM_THREADS")]
    for value in values:
        defaults = {
            "points": {"gcps": "gcps.csv"}, "surface": {"dem": "dem.tif", "vertical": "ellipsoid"}, "output": {},
        }  # fmt: skip
        defaults[group] = {**defaults[group], key: value}
        document = {"scenes": [{"image": tiny.image.name}], "defaults": defaults}
        (tiny.folder / "p.yaml").write_text(json.dumps(document))
        with contextlib.suppress(InputError):
            assert {one.status for one in run(tiny.folder / "p.yaml", executor="sequential").scenes} == {"failed"}
        assert not pipe.readers, value


def test_creation_options_name_no_files_and_no_addresses() -> None:
    for name in ("TILING_SCHEME", "TARGET_SRS", "EXTENT", "WARP_RESAMPLING", "NUM_THREADS", "OVERVIEW_RESAMPLING"):
        for value in ("http://127.0.0.1:1/a.json", "/vsicurl/http://127.0.0.1:1/a", "../a"):
            with pytest.raises(InputError, match=name):
                checked_options("COG", {name: value}, 1)
