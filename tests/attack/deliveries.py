"""Deliveries whose data lead elsewhere: texts that name files outside of their folder, servers and programs.

`hostile.py` has those that are rasters or lie next to one; here are points, pipeline files, models, catalogs and links.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

#: Is replaced by the absolute path of the secret, a folder above the delivery, and by an address that nobody may ask.
SECRET, URL = "SECRET", "http://127.0.0.1:9/x.tif"
_FIT = ("fit", "scene.tif", "--gcps")
_HEADER = "id,col,row,x,y,h\n"
_ROWS = "A,100,100,530700,4122600,850\nB,800,150,531900,4122500,860\nC,450,800,531300,4121500,840\n"
_POINT = {"type": "Feature", "properties": {"id": "A", "col": 100, "row": 100},
          "geometry": {"type": "Point", "coordinates": [33.35, 37.25, 850.0]}}  # fmt: skip


@dataclass(frozen=True)
class Delivery:
    """Files of a delivery by their names, links by what they lead to, and the command that meets them."""

    files: dict[str, str]
    words: tuple[str, ...]
    links: dict[str, str] | None = None


def _pipeline(scene: str, more: str = "") -> Delivery:
    text = f"defaults: {{surface: {{height: 800}}, output: {{resolution: 40}}}}\nscenes:\n  - {scene}\n{more}"
    return Delivery({"run.yaml": text}, ("run", "run.yaml", "--executor", "sequential"))


def _points(text: str, name: str = "p.csv") -> Delivery:
    return Delivery({name: text}, (*_FIT, name))


def _collection(crs: object) -> Delivery:
    return _points(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [_POINT] * 4}), "p.geojson")


def _item(href: str, **more: object) -> Delivery:
    item = {"type": "Feature", "stac_version": "1.0.0", "id": "one", "geometry": None, "links": [],
            "properties": {"datetime": "2020-01-01T00:00:00Z", **more},
            "assets": {"image": {"href": href}}}  # fmt: skip
    return Delivery({"item.json": json.dumps(item)}, ("info", "item.json"))


def _linked(name: str, target: str = SECRET) -> Delivery:
    return Delivery({}, ("info", "scene.tif"), {name: target})


def _dem(text: str) -> Delivery:
    words = ("rectify", "scene.tif", "--dem", "dem.vrt", "--dem-vertical", "ellipsoid", "-tr", "40", "-o", "out")
    return Delivery({"dem.vrt": text}, words)


_VRT = """<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>{srs}</SRS><GeoTransform>33,1,0,38,0,-1</GeoTransform>
<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="{relative}">{source}
</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>""".replace("\n", "")
_GRIDS = (
    f'GEOGCS["a",DATUM["b",SPHEROID["c",6378137,298.25],EXTENSION["PROJ4_GRIDS","{SECRET}"]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
)

DELIVERIES: dict[str, Delivery] = {
    "pipeline: image above": _pipeline("image: ../secret.tif"),
    "pipeline: absolute image": _pipeline(f"image: {SECRET}"),
    "pipeline: pattern above": _pipeline("images: ../*.tif"),
    "pipeline: image of a server": _pipeline(f"image: {URL}"),
    "pipeline: file system of GDAL": _pipeline(f"image: /vsicurl/{URL}"),
    "pipeline: archive above": _pipeline("image: /vsizip/../secret.zip/a.tif"),
    "pipeline: RPC above": _pipeline("{image: scene.tif, scene: {rpc: ../secret_RPC.TXT}}"),
    "pipeline: points above": _pipeline("{image: scene.tif, points: {gcps: ../secret.csv}}"),
    "pipeline: DEM of a server": _pipeline(f"{{image: scene.tif, surface: {{dem: '{URL}', vertical: ellipsoid}}}}"),
    "pipeline: output above": _pipeline("image: scene.tif", "output: ../out\n"),
    "pipeline: creation option": _pipeline(
        f"{{image: scene.tif, output: {{creation_options: {{TILING_SCHEME: '{SECRET}'}}}}}}"
    ),
    "pipeline: CRS of a file": _pipeline(f"{{image: scene.tif, output: {{crs: '+init={SECRET}:1'}}}}"),
    "pipeline: CRS with a grid": _pipeline(
        f"{{image: scene.tif, output: {{crs: '+proj=longlat +nadgrids={SECRET} +type=crs'}}}}"
    ),
    "pipeline: code in YAML": _pipeline("image: !!python/object/apply:os.system ['touch EXECUTED']"),
    "points: CRS of a file": _points(f"#CRS: +init={SECRET}:1\n{_HEADER}{_ROWS}"),
    "points: CRS with a grid": _points(f"#CRS: +proj=longlat +geoidgrids={SECRET} +type=crs\n{_HEADER}{_ROWS}"),
    "points: WKT with a grid": _points(f"#CRS: {_GRIDS}\n{_HEADER}{_ROWS}"),
    "points: datum of a file": _points(f"#CRS: EPSG:32636\n#vertical: {SECRET}\n{_HEADER}{_ROWS}"),
    "points: datum of a server": _points(f"#CRS: EPSG:32636\n#vertical: {URL}\n{_HEADER}{_ROWS}"),
    "points: CRS that is linked": _collection({"type": "link", "properties": {"href": URL, "type": "proj4"}}),
    "points: CRS that is a file": _collection({"type": "name", "properties": {"name": SECRET}}),
    "points: CRS with a shift": _collection(
        {"type": "name", "properties": {"name": f"+proj=longlat +nadgrids={SECRET}"}}
    ),
    "points: external entity": _points(f'<!DOCTYPE a [<!ENTITY b SYSTEM "file://{SECRET}">]><a>&b;</a>'),
    "STAC: image above": _item("../secret.tif"),
    "STAC: absolute image": _item(SECRET),
    "STAC: image of a server": _item(URL),
    "STAC: address of a file": _item(f"file://{SECRET}"),
    "STAC: CRS of a file": _item("scene.tif", **{"proj:projjson": {"type": "GeographicCRS", "name": SECRET}}),
    "DEM: source above": _dem(_VRT.format(srs="EPSG:4326", relative=1, source="../secret.tif")),
    "DEM: source of a server": _dem(_VRT.format(srs="EPSG:4326", relative=0, source=f"/vsicurl/{URL}")),
    "DEM: CRS with a grid": _dem(_VRT.format(srs=f"+proj=longlat +nadgrids={SECRET}", relative=1, source="dem.tif")),
    "model: CRS of a file": Delivery(
        {"m_model.json": json.dumps({
            "document": "ortho-pipeline model", "schema_version": 1, "sensor": "", "model_source": "", "size": None,
            "provenance": {},
            "model": {"kind": "geo", "map_crs": f"+init={SECRET}:1", "corner": [530000, 4123000], "pixel": [2.5, 2.5],
                      "size": [1000, 1000], "plane": 800, "relief": [0.1, 0.1], "heights": [0, 1000],
                      "shift": [0, 0]}})},
        ("rectify", "scene.tif", "--model", "m_model.json", "--height", "800", "-tr", "40", "-o", "out"),
    ),
    "report: paths": Delivery(
        {"x_report.json": json.dumps({"scene": {"path": SECRET}, "outputs": {"ortho": SECRET}})},
        ("report", "x_report.json", "--plots", "plots"),
    ),
    "DIMAP: image above": Delivery(
        {"DIM.XML": "<Dimap_Document><Metadata_Identification/><Data_Access><Data_File>"
                    '<DATA_FILE_PATH href="../secret.tif"/></Data_File></Data_Access></Dimap_Document>'},
        ("info", "DIM.XML"),
    ),
    "side-car: entity in PAM": Delivery(
        {"scene.tif.aux.xml": f'<!DOCTYPE a [<!ENTITY b SYSTEM "file://{SECRET}">]><PAMDataset>&b;</PAMDataset>'},
        ("info", "scene.tif"),
    ),
    "side-car: CRS in PAM": Delivery(
        {"scene.tif.aux.xml": f"<PAMDataset><SRS>+proj=longlat +nadgrids={SECRET}</SRS></PAMDataset>"},
        ("info", "scene.tif"),
    ),
    "side-car: projection": Delivery({"scene.prj": _GRIDS, "scene.tfw": "1\n0\n0\n-1\n0\n0\n"}, ("info", "scene.tif")),
    "link: overviews": _linked("scene.tif.ovr"),
    "link: mask": _linked("scene.tif.msk"),
    "link: RPC": _linked("scene.RPB", f"{SECRET}_RPC.TXT"),
    "link: folder": _linked("more", "/"),
}  # fmt: skip


def deliver(folder: Path, name: str, secret: Path, copy: Callable[[Path], None]) -> tuple[str, ...]:
    """Make a delivery in a folder below that of the secret; return the words of its command."""
    one = DELIVERIES[name]
    folder.mkdir()
    copy(folder)
    for file, text in one.files.items():
        (folder / file).write_text(text.replace(SECRET, str(secret)))
    for link, target in (one.links or {}).items():
        (folder / link).symlink_to(target.replace(SECRET, str(secret)))
    return one.words
