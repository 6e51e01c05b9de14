"""STAC collections as DEMs: documents that pystac writes, against a mosaic that GDAL makes of the same cells."""

from __future__ import annotations

import json
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pystac
import pytest
from click.testing import CliRunner
from osgeo import gdal, osr
from servers import PublicFolder, running

from ortho_pipeline import ortho_array
from ortho_pipeline.batch.plan import plan
from ortho_pipeline.batch.runner import list_scenes, run
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import check, rectify
from ortho_pipeline.errors import CoverageError, DatumError, InputError
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.stores.stac import collection as collections
from ortho_pipeline.stores.stac import item as stac_item
from ortho_pipeline.stores.stac.boxes import boxes_of, meet, questions
from ortho_pipeline.stores.stac.collection import Collection
from ortho_pipeline.stores.stac.item import item_of
from ortho_pipeline.surface.cells.collected import open_collected
from ortho_pipeline.surface.cells.copernicus import Extent

gdal.UseExceptions()
TIFF = pystac.MediaType.COG
OUTPUT = OutputOptions(format="GTiff")
HERE = Extent(19.99, -30.01, 20.01, -29.99)


def system(code: str) -> osr.SpatialReference:
    found = osr.SpatialReference()
    found.SetFromUserInput(code)
    found.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    return found


def cell(path: Path, source: Path, window: list[int], crs: str | None = None, add: float = 0.0) -> Path:
    """Write a window of a DEM as a file of its own, of heights that may be others and another system."""
    path.parent.mkdir(parents=True, exist_ok=True)
    made = gdal.Translate(str(path), str(source), srcWin=window, creationOptions=["COMPRESS=DEFLATE"])
    if crs is not None:
        made.SetSpatialRef(system(crs))
    if add:
        made.WriteArray(made.ReadAsArray() + np.float32(add))
    made = None
    return path


def degrees(path: Path) -> list[float]:
    """Return the box of a file in degrees, by GDAL."""
    extent = gdal.Info(str(path), format="json")["wgs84Extent"]["coordinates"][0]
    lon, lat = zip(*extent, strict=True)
    return [min(lon), min(lat), max(lon), max(lat)]


def item(path: Path, href: str, day: int = 1, **properties: Any) -> pystac.Item:
    west, south, east, north = box = degrees(path)
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    made = pystac.Item(
        path.stem, {"type": "Polygon", "coordinates": [ring]}, box, datetime(2020, 1, day, tzinfo=UTC), properties
    )
    made.add_asset("dem", pystac.Asset(href, media_type=TIFF, roles=["data"]))
    made.add_asset("metadata", pystac.Asset(href + ".xml", media_type="application/xml", roles=["metadata"]))
    return made


def whole(items: list[pystac.Item]) -> pystac.Collection:
    span = pystac.TemporalExtent([[datetime(2020, 1, 1, tzinfo=UTC), None]])
    made = pystac.Collection("heights", "cells", pystac.Extent(pystac.SpatialExtent([[-180, -90, 180, 90]]), span))
    made.add_items(items)
    return made


WINDOWS = {"a": [0, 0, 70, 70], "b": [70, 0, 60, 70], "c": [0, 70, 70, 60], "d": [70, 70, 60, 60]}


@pytest.fixture
def cells(tiny: Any) -> Path:
    """Cut the DEM of the tiny scene into four cells, next to one that lies elsewhere, and make a VRT of the four."""
    folder: Path = tiny.folder / "cells"
    paths = [cell(folder / f"{name}.tif", tiny.dem, window) for name, window in WINDOWS.items()]
    gdal.BuildVRT(str(folder / "all.vrt"), list(map(str, paths))).FlushCache()
    moved = gdal.Open(str(cell(folder / "far.tif", tiny.dem, [0, 0, 60, 60])), gdal.GA_Update)
    place = moved.GetGeoTransform()
    moved.SetGeoTransform((place[0] + 50_000, *place[1:]))
    moved = None
    return folder


def static(folder: Path, names: str = "abcd", **changes: dict[str, Any]) -> Path:
    """Write a self-contained catalog: the collection, and each item in a folder of its own with its file."""
    items = []
    for name in [*names, "far"]:
        made = item(folder / f"{name}.tif", f"./{name}.tif", **changes.get(name, {}))
        (folder / made.id).mkdir(exist_ok=True)
        (folder / made.id / f"{name}.tif").write_bytes((folder / f"{name}.tif").read_bytes())
        items.append(made)
    made = whole(items)
    made.normalize_and_save(str(folder), pystac.CatalogType.SELF_CONTAINED)
    assert pystac.Collection.from_file(str(folder / "collection.json")).id == "heights"
    return folder / "collection.json"


def listed(folder: Path, names: list[str] | str = "abcd", **changes: dict[str, Any]) -> Path:
    """Write a list of items: what a search of an API answers."""
    items = [item(folder / f"{name}.tif", f"./{name}.tif", **changes.get(name, {})) for name in [*names, "far"]]
    pystac.ItemCollection(items).save_object(str(folder / "items.json"))
    return folder / "items.json"


class Api(PublicFolder):
    """An API of one collection: its items by place, two on a page, as OGC API Features and STAC have it."""

    def answer(self, handler: Any) -> None:
        path, _, query = handler.path.partition("?")
        if not path.startswith("/stac/"):
            return super().answer(handler)
        self.asked[path] += 1
        asked = {key: values[0] for key, values in urllib.parse.parse_qs(query).items()}
        root = f"{self.address}/stac/collections/heights"
        if path == "/stac/collections/heights":
            links = [{"rel": "items", "href": f"{root}/items", "type": "application/geo+json"}]
            document = {**whole([]).to_dict(), "links": links}
        else:
            document = self._page(root, asked)
        return self._say(handler, 200, json.dumps(document).encode())

    def _page(self, root: str, asked: dict[str, str]) -> dict[str, Any]:
        box = tuple(map(float, asked["bbox"].split(",")))
        assert len(box) == 4
        assert -180 <= box[0] <= box[2] <= 180, box
        found = [one for one in self.items if meet(tuple(one["bbox"]), box)]  # type: ignore[arg-type]
        first = int(asked.get("token", 0))
        links = []
        if first + 2 < len(found):
            following = urllib.parse.urlencode({"bbox": asked["bbox"], "token": first + 2})
            links = [{"rel": "next", "href": f"{root}/items?{following}", "method": self.method}]
        return {"type": "FeatureCollection", "features": found[first : first + 2], "links": links}

    items: Sequence[dict[str, Any]] = ()
    method = "GET"


@pytest.fixture
def api(cells: Path) -> Iterator[Api]:
    served = Api(cells)
    with running(served) as public:
        names = [*"abcd", "far"]
        made = [item(cells / f"{name}.tif", f"{public.address}/{name}.tif") for name in names]
        # An API leaves out what is the same everywhere, and every item has an address of its own.
        public.items = [{**one.to_dict(), "links": [], "collection": "heights"} for one in made]
        yield public


def collection_of(kind: str, cells: Path, api: Api) -> str:
    if kind == "api":
        return f"{api.address}/stac/collections/heights"
    path = static(cells) if kind.endswith("static") else listed(cells)
    return f"{api.address}/{path.name}" if kind.startswith("far ") else str(path)


def pixels(result: Any) -> Any:
    return gdal.Open(str(result.files["ortho"])).ReadAsArray()


# -- the same heights, however they are found --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["static", "list", "far static", "far list", "api"])
def test_an_ortho_on_a_collection_is_that_on_a_mosaic_of_its_cells(
    kind: str, cells: Path, api: Api, tiny: Any, tmp_path: Path
) -> None:
    local = SurfaceOptions(dem=str(cells / "all.vrt"), vertical="ellipsoid")
    truth = pixels(rectify(tiny.image, tmp_path / "a", surface=local, output=OUTPUT))
    address = collection_of(kind, cells, api)
    surface = SurfaceOptions(dem=address, vertical="ellipsoid")
    far = address.startswith("http")
    if far:
        with pytest.raises(InputError, match="off by default"):
            rectify(tiny.image, tmp_path / "b", surface=surface, output=OUTPUT)
    scene = SceneOptions(allow_network=far)
    made = rectify(tiny.image, tmp_path / "b", scene=scene, surface=surface, output=OUTPUT)
    np.testing.assert_array_equal(pixels(made), truth)
    report = made.document["report"]
    assert sorted(report["surface"]["items"]) == ["a", "b", "c", "d"]
    assert report["surface"]["path"] == address
    assert report["surface"]["declared_in"] is None
    used = {Path(one["path"]).name for one in report["provenance"]["inputs"] if one["role"] == "DEM"}
    wanted = {"static": {"collection.json", *(f"{name}.{end}" for name in "abcd" for end in ("json", "tif"))},
              "list": {"items.json", *(f"{name}.tif" for name in "abcd")}}  # fmt: skip
    assert used == wanted.get(kind, set())
    if far:
        assert 4000 < report["provenance"]["network_bytes"] <= api.sent
        assert not api.asked["far.tif"]


def test_an_api_is_asked_for_the_place_and_followed_from_page_to_page(cells: Path, api: Api) -> None:
    address = f"{api.address}/stac/collections/heights"
    dem = open_collected(address, [HERE], "ellipsoid", access={"allow_network": True})
    assert dem.provenance["items"] == ["a", "b", "c", "d"]
    assert api.asked["/stac/collections/heights/items"] == 2
    # Three places that overlap are one question; one beyond is another, which has no items.
    three = [
        HERE,
        Extent(20.0, -30.01, 20.02, -29.99),
        Extent(19.98, -30.0, 20.0, -29.98),
        Extent(10.0, 0.0, 10.1, 0.1),
    ]
    again = open_collected(address, three, "ellipsoid", access={"allow_network": True})
    assert again.provenance["items"] == dem.provenance["items"]
    assert api.asked["/stac/collections/heights/items"] == 5
    api.method = "POST"
    with pytest.raises(InputError, match="cannot be read with GET"):
        open_collected(address, [HERE], "ellipsoid", access={"allow_network": True})


def test_commands_python_and_the_command_line_take_collections(cells: Path, tiny: Any, tmp_path: Path) -> None:
    local = SurfaceOptions(dem=str(cells / "all.vrt"), vertical="ellipsoid")
    path = static(cells)
    surface = SurfaceOptions(dem=path, vertical="ellipsoid")
    truth = ortho_array(tiny.image, local).compute()
    np.testing.assert_array_equal(ortho_array(tiny.image, surface).compute(), truth)
    assert check(tiny.image, surface=surface)["coverage"] == 1.0
    heights = ["--dem", str(path), "--dem-vertical", "ellipsoid"]
    ground = ["--points-crs", "EPSG:4326", "--points-vertical", "ellipsoid"]
    fitted = CliRunner().invoke(cli, ["fit", str(tiny.image), "--gcps", str(tiny.gcps), *ground, *heights, "--json"])
    assert fitted.exit_code == 0, fitted.output
    (tmp_path / "checks.csv").write_text("id,x,y,h\n1,20.0,-30.0,500\n2,20.005,-30.003,510\n")
    points = ["--points", str(tmp_path / "checks.csv"), *ground]
    told = [
        json.loads(CliRunner().invoke(cli, ["dem-check", str(dem), *points, *heights[2:], "--json"]).stdout)["overall"]
        for dem in (path, cells / "all.vrt")
    ]
    assert told[0] == told[1]


def test_a_run_knows_the_documents_and_files_of_a_collection(cells: Path, tiny: Any, tmp_path: Path) -> None:
    path = static(cells)
    config = tiny.folder / "run.yaml"
    config.write_text(
        f"scenes: [{{image: {tiny.image.name}}}]\noutput: out\n"
        "defaults: {surface: {dem: cells/collection.json, vertical: ellipsoid}, output: {format: GTiff}}\n"
    )

    def states() -> list[str]:
        answer = CliRunner().invoke(cli, ["run", str(config), "--list", "--json"])
        assert answer.exit_code == 0, answer.output
        return [one["state"] for one in json.loads(answer.stdout)["scenes"]]

    def made() -> Any:
        answer = CliRunner().invoke(cli, ["run", str(config), "--executor", "sequential"])
        assert answer.exit_code == 0, answer.output
        return states()

    assert states() == ["new"]
    assert made() == ["done"]
    # A name next to the collection changes nothing; an item, its file and the list of items do.
    (cells / "notes.txt").write_text("x")
    assert states() == ["done"]
    for changed in (cells / "a" / "a.json", cells / "b" / "b.tif", path):
        changed.write_bytes(changed.read_bytes() + b"\n")
        assert states() == ["changed"]
        assert made() == ["done"]


def test_a_run_with_an_item_as_dem_is_made_again_when_the_item_names_another_file(cells: Path, tiny: Any) -> None:
    config = tiny.folder / "run.yaml"
    config.write_text(
        f"scenes: [{{image: {tiny.image.name}}}]\noutput: out\n"
        "defaults: {surface: {dem: one.json, vertical: ellipsoid}, output: {format: GTiff}}\n"
    )
    for href, state in (("./dem.tif", "new"), ("./dem.tif", "done"), ("./cells/all.vrt", "changed")):
        (tiny.folder / "one.json").write_text(json.dumps(item(tiny.dem, href).to_dict()))
        assert [one["state"] for one in list_scenes(config)] == [state]
        assert run(config, executor="sequential").failed == 0


def test_a_plan_reads_the_document_of_a_dem_once_for_all_scenes(
    cells: Path, tiny: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(20):
        (tiny.folder / f"s{number}.tif").write_bytes(tiny.image.read_bytes())
    listed(cells)
    config = tiny.folder / "run.yaml"
    config.write_text("scenes: [{images: s*.tif}]\noutput: out\ndefaults: {surface: {dem: cells/items.json}}\n")
    read: list[Any] = []
    true = stac_item.read_document
    monkeypatch.setattr(stac_item, "read_document", lambda path, **more: read.append(path) or true(path, **more))
    planned = plan(config)
    assert [job.request.surface.dem for job in planned.jobs] == [str(cells / "items.json")] * 20
    assert len(read) == 1


# -- which items, and which of their files -----------------------------------------------------------------------------


def stripped(features: list[dict[str, Any]], path: Path) -> Path:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def test_an_item_that_lies_nowhere_and_a_place_without_items_are_refused(cells: Path, tiny: Any) -> None:
    path = listed(cells, ["far"])
    with pytest.raises(CoverageError, match="0 items of this collection cover the scene") as caught:
        check(tiny.image, surface=SurfaceOptions(dem=path, vertical="ellipsoid"))
    assert (caught.value.file, caught.value.field) == (str(path), "surface.dem")
    lost = item(cells / "a.tif", "./a.tif").to_dict() | {"geometry": None}
    del lost["bbox"]
    with pytest.raises(InputError, match="'a' does not state its position"):
        open_collected(stripped([lost], cells / "lost.json"), [HERE], "ellipsoid")


def test_a_scene_that_is_covered_in_part_is_said_as_of_any_dem(cells: Path, tiny: Any, tmp_path: Path) -> None:
    path = listed(cells, "ac")
    with pytest.raises(CoverageError, match=r"the DEM covers \d+"):
        rectify(tiny.image, tmp_path / "a", surface=SurfaceOptions(dem=path, vertical="ellipsoid"), output=OUTPUT)
    part = SurfaceOptions(dem=path, vertical="ellipsoid", fill="mask")
    made = rectify(tiny.image, tmp_path / "a", surface=part, output=OUTPUT)
    assert "dem-covers-part" in [one["code"] for one in made.document["report"]["notices"]]


def test_catalogs_within_a_collection_are_followed_but_not_where_they_lie_elsewhere(cells: Path) -> None:
    """As the collections of 3DEP and ArcticDEM are built: items, and catalogs of tiles, as children."""
    path = static(cells)
    document = json.loads(path.read_text())
    links = {Path(link["href"]).stem: link for link in document["links"] if link["rel"] == "item"}
    away = {"spatial": {"bbox": [[100.0, 10.0, 101.0, 11.0]]}}
    below = {
        "north.json": {"type": "Catalog", "links": [links["a"], links["b"], {"rel": "parent", "href": path.name}]},
        "south.json": {"type": "Collection", "links": [{**links["c"], "rel": "child"}]},
        "away.json": {"type": "Collection", "extent": away, "links": [{"rel": "item", "href": "./nothing.json"}]},
    }
    for name, one in below.items():
        (cells / name).write_text(json.dumps({"stac_version": "1.0.0", "id": name, **one}))
    document["links"] = [links["d"], *({"rel": "child", "href": f"./{name}"} for name in below)]
    path.write_text(json.dumps(document))
    dem = open_collected(path, [HERE], "ellipsoid", access={})
    assert dem.provenance["items"] == ["a", "b", "c", "d"]
    assert {"north.json", "south.json"} <= {Path(one).name for one in dem.provenance["documents"]}
    document["type"] = "Catalog"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="catalog of collections") as caught:
        open_collected(path, [HERE], "ellipsoid")
    assert "south.json" in caught.value.remedy


@pytest.mark.parametrize(
    ("assets", "chosen"),
    [
        # 3DEP: data, beside metadata and a picture.
        ({"data": ["data"], "metadata": ["metadata"], "thumbnail": ["thumbnail"]}, "data"),
        # Copernicus: masks and quicklooks have no roles, for theirs are misspelt.
        ({"data": ["data"], "edm": [], "hem": [], "dem_ql": []}, "data"),
        # NASADEM.
        ({"elevation": []}, "elevation"),
        # ArcticDEM and REMA: the DEM next to its counts, and a hillshade.
        ({"hillshade": ["overview", "visual"], "dem": ["data"], "count": ["metadata"], "mad": ["metadata"]}, "dem"),
        # LINZ calls its only raster so.
        ({"visual": []}, "visual"),
        # HRDEM: surface and terrain, and hillshades of both; swissALTI3D: two resolutions.
        ({"dsm": ["data"], "dtm": ["data"], "hillshade-dtm": ["visual"]}, "dtm"),
        ({"x_0.5_2056_5728.tif": [], "x_2_2056_5728.tif": []}, "x_2_2056_5728.tif"),
    ],
)
def test_the_asset_of_published_collections_is_told_by_its_role_or_by_a_pattern(
    assets: dict[str, list[str]], chosen: str
) -> None:
    types = {"metadata": "application/xml", "thumbnail": "image/jpeg"}
    document = {
        "type": "Feature", "stac_version": "1.0.0", "id": "x",
        "assets": {key: {"href": f"https://h/{key}", "type": types.get(key, TIFF), "roles": roles}
                   for key, roles in assets.items()},
    }  # fmt: skip
    found = item_of(document, "https://h/x.json")
    if chosen in ("dtm", "x_2_2056_5728.tif"):
        with pytest.raises(InputError, match="several assets could be the image"):
            found.heights()
        assert found.heights(chosen).key == chosen
        assert found.heights({"dtm": "dt?"}.get(chosen, "*_2_2056_*")).key == chosen
        with pytest.raises(InputError, match="several assets are"):
            found.heights("*")
    else:
        assert found.heights().key == chosen


def test_a_pattern_after_the_collection_chooses_the_asset_of_every_item(cells: Path, tiny: Any) -> None:
    """The keys of swissALTI3D hold the name of their tile."""
    features = []
    for name in "abcd":
        one = item(cells / f"{name}.tif", f"./{name}.tif").to_dict()
        fine, coarse = dict(one["assets"]["dem"]), dict(one["assets"]["dem"], href="./far.tif")
        one["assets"] = {f"{name}_0.5.tif": coarse, f"{name}_2.tif": fine}
        features.append(one)
    path = stripped(features, cells / "collection.json")
    with pytest.raises(InputError, match="several assets could be the image") as caught:
        check(tiny.image, surface=SurfaceOptions(dem=path, vertical="ellipsoid"))
    assert "#a_0.5.tif" in caught.value.remedy
    found = check(tiny.image, surface=SurfaceOptions(dem=f"{path}#*_2.tif", vertical="ellipsoid"))
    assert found["coverage"] == 1.0


# -- the datum ---------------------------------------------------------------------------------------------------------


def test_the_datum_is_stated_by_the_user_the_files_or_the_items_and_else_asked_for(cells: Path, tiny: Any) -> None:
    path = listed(cells)
    with pytest.raises(DatumError, match="does not state its height datum"):
        open_collected(path, [HERE])
    # What the files are in is what items mostly say, and it says nothing of heights.
    plain = {name: {"proj:code": "EPSG:32734"} for name in "abcd"}
    with pytest.raises(DatumError, match="does not state its height datum"):
        open_collected(listed(cells, "abcd", **plain), [HERE])
    ways = [
        {"proj:code": "EPSG:32734+5773"},
        {"proj:wkt2": system("EPSG:32734+5773").ExportToWkt(["FORMAT=WKT2_2019"])},
        {"proj:projjson": json.loads(system("EPSG:32734+5773").ExportToPROJJSON([]))},
    ]
    for one in ways:
        dem = open_collected(listed(cells, "abcd", **dict.fromkeys("abcd", one)), [HERE])
        assert (dem.provenance["vertical"], dem.provenance["declared_in"]) == ("EPSG:5773", "items")
    # Of an item that is in another system than its file nothing is believed.
    other = {name: {"proj:code": "EPSG:32735+5773"} for name in "abcd"}
    with pytest.raises(DatumError, match="does not state its height datum"):
        open_collected(listed(cells, "abcd", **other), [HERE])
    for name, window in WINDOWS.items():
        cell(cells / f"{name}.tif", tiny.dem, window, "EPSG:32734+5773")
    dem = open_collected(listed(cells), [HERE])
    assert (dem.provenance["vertical"], dem.provenance["declared_in"]) == ("EPSG:5773", "files")
    contrary = {name: {"proj:code": "EPSG:32734+3855"} for name in "abcd"}
    with pytest.raises(DatumError, match=r"EGM96.* in this file, but .*EGM2008.* in its STAC item"):
        open_collected(listed(cells, "abcd", **contrary), [HERE])
    told = open_collected(listed(cells, "abcd", **contrary), [HERE], "ellipsoid", override=True)
    assert told.provenance["vertical"] == "ellipsoid"


@pytest.mark.parametrize("by", ["files", "items"])
def test_a_change_of_datum_between_cells_is_refused(by: str, cells: Path, tiny: Any) -> None:
    changes: dict[str, dict[str, Any]] = {}
    for name, code in zip("abcd", ("5773", "5773", "5773", "3855"), strict=True):
        crs = f"EPSG:32734+{code}"
        if by == "files":
            cell(cells / f"{name}.tif", tiny.dem, WINDOWS[name], crs)
        else:
            changes[name] = {"proj:code": crs}
    with pytest.raises(DatumError, match=r"EGM2008.*EGM96.*not one DEM") as caught:
        open_collected(listed(cells, "abcd", **changes), [HERE])
    assert caught.value.file.endswith("d.tif")
    assert "FeatureCollection" in caught.value.remedy


# -- several at one place ----------------------------------------------------------------------------------------------


def test_of_two_editions_the_later_counts_where_it_has_a_height_and_a_notice_says_so(
    cells: Path, tiny: Any, tmp_path: Path
) -> None:
    """Whatever the order of the list is, and whatever their names are."""
    later = gdal.Open(str(cell(cells / "0.tif", tiny.dem, WINDOWS["a"], add=100.0)), gdal.GA_Update)
    later.GetRasterBand(1).SetNoDataValue(-9999)
    heights = later.ReadAsArray()
    heights[:, :10] = -9999
    later.WriteArray(heights)
    later = None
    path = listed(cells, ["0", *"abcd"], **{"0": {"day": 3}, "a": {"day": 2}})
    old = open_collected(listed(cells), [HERE], "ellipsoid").window(0, 0, 130, 130)
    dem = open_collected(listed(cells, ["0", *"abcd"], **{"0": {"day": 3}, "a": {"day": 2}}), [HERE], "ellipsoid")
    wanted = old.copy()
    wanted[:70, 10:70] += 100.0
    np.testing.assert_allclose(dem.window(0, 0, 130, 130), wanted, rtol=1e-6)
    [notice] = dem.provenance["warnings"]
    assert (notice.code, notice.fields["items"]) == ("dem-items-overlap", ["a"])
    made = rectify(tiny.image, tmp_path / "o", surface=SurfaceOptions(dem=path, vertical="ellipsoid"), output=OUTPUT)
    assert "dem-items-overlap" in [one["code"] for one in made.document["report"]["notices"]]
    # Rims that neighbours share are no editions.
    rims = {name: [x, y, w + 5, h + 5] for name, (x, y, w, h) in zip("abcd", WINDOWS.values(), strict=True)}
    for name, window in rims.items():
        cell(
            cells / f"{name}.tif",
            tiny.dem,
            [*window[:2], min(window[2], 130 - window[0]), min(window[3], 130 - window[1])],
        )
    assert open_collected(listed(cells), [HERE], "ellipsoid").provenance["warnings"] == []


def test_two_resolutions_that_are_no_one_grid_are_refused_with_a_way_out(cells: Path, tiny: Any) -> None:
    """As a collection of 1 and of 1/3 arc seconds is."""
    gdal.Translate(str(cells / "e.tif"), str(tiny.dem), xRes=60, yRes=60)
    with pytest.raises(InputError, match="differ in direction or spacing") as caught:
        open_collected(listed(cells, "abcde"), [HERE], "ellipsoid")
    assert "FeatureCollection" in caught.value.remedy


# -- the antimeridian --------------------------------------------------------------------------------------------------


def globe(path: Path, west: float, south: float) -> Path:
    """Write a cell of a degree whose heights are a function of place alone."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lon, lat = np.meshgrid(west + (np.arange(50) + 0.5) / 50, south + 1 - (np.arange(50) + 0.5) / 50)
    made = gdal.GetDriverByName("GTiff").Create(str(path), 50, 50, 1, gdal.GDT_Float32)
    made.SetGeoTransform((west, 0.02, 0, south + 1, 0, -0.02))
    made.SetSpatialRef(system("EPSG:4979"))
    made.WriteArray((500 + 50 * np.sin(np.deg2rad(lon * 30)) + lat).astype(np.float32))
    made = None
    return path


def test_a_scene_over_the_antimeridian_gets_the_items_on_both_sides(tmp_path: Path) -> None:
    cells = tmp_path / "cells"
    places = {"east": (179.0, 10.0), "west": (-180.0, 10.0), "far": (178.0, 10.0), "south": (179.0, 8.0)}
    features = [item(globe(cells / f"{name}.tif", *place), f"./{name}.tif").to_dict() for name, place in places.items()]
    served = Api(cells)
    with running(served) as public:
        public.items = [
            {**one, "assets": {"dem": {**one["assets"]["dem"], "href": f"{public.address}/{one['id']}.tif"}}}
            for one in features
        ]
        address = f"{public.address}/stac/collections/heights"
        ways = [(stripped(features, cells / "items.json"), {}), (address, {"allow_network": True})]
        for path, access in ways:
            dem = open_collected(path, [Extent(179.8, 10.4, 180.2, 10.6)], access=access).around(180.0)
            assert dem.provenance["items"] == ["east", "west"]
            lon = np.array([179.6, 179.99, 180.0, 180.01, -179.6, 180.4])
            heights = dem.heights(np.column_stack([lon, np.full(6, 10.5)]))
            np.testing.assert_allclose(heights, 510.5 + 50 * np.sin(np.deg2rad(lon * 30)), atol=0.5)
        assert public.asked["/stac/collections/heights/items"] == 2


def test_where_items_lie_is_read_as_geojson_has_it() -> None:
    square = [[[170, 0], [180, 0], [180, 1], [170, 1], [170, 0]]], [[[-180, 0], [-170, 0], [-170, 1], [-180, 0]]]
    over = {"geometry": {"type": "MultiPolygon", "coordinates": list(square)}, "bbox": [-180, 0, 180, 1]}
    assert boxes_of(over) == ((170, 0, 180, 1), (-180, 0, -170, 1))
    assert boxes_of({"geometry": None, "bbox": [170, 0, 5, -170, 1, 900]}) == ((170, 0, 190, 1),)
    assert boxes_of({"geometry": {"type": "Polygon", "coordinates": "x"}, "bbox": [0, 0, 1, 1]}) == ((0, 0, 1, 1),)
    for broken in ({}, {"bbox": [0, 0, "1", 1]}, {"bbox": [0, 0, True, 1]}, {"geometry": {"type": "Point"}}):
        assert boxes_of(broken) == ()
    assert meet((179.5, 0, 180.5, 1), (-180, 0, -179, 1))
    assert meet((359, 0, 361, 1), (-0.5, 0, 0.5, 1))
    assert not meet((179.5, 0, 180.5, 1), (-179, 0, -178, 1))
    assert questions([(179.0, 0.0, 181.0, 1.0)]) == [(179.0, 0.0, 180.0, 1.0), (-180.0, 0.0, -179.0, 1.0)]
    assert questions([(-190.0, 0.0, -181.0, 1.0)]) == [(170.0, 0.0, 179.0, 1.0)]
    assert questions([(-180.0, 80.0, 180.0, 90.0)]) == [(-180.0, 80.0, 180.0, 90.0)]


# -- documents of strangers --------------------------------------------------------------------------------------------


def test_a_collection_leads_to_no_files_elsewhere_and_has_an_end(cells: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cells.parent / "secret.json").write_text("{}")
    for href in ("../secret.json", "/etc/passwd", "file:///etc/passwd", "/vsizip/x.zip/a.json"):
        path = cells / "collection.json"
        path.write_text(json.dumps({"type": "Collection", "links": [{"rel": "item", "href": href}]}))
        with pytest.raises(InputError, match=r"outside its own folder|not the address of a file"):
            Collection(path).under([HERE])
    # Catalogs that lead to each other, and one more at every step.
    for number in range(12):
        links = [{"rel": "child", "href": f"./{other}.json"} for other in (number, 0, number + 1)]
        (cells / f"{number}.json").write_text(json.dumps({"type": "Catalog", "links": links}))
    with pytest.raises(InputError, match="nested catalogs"):
        Collection(cells / "0.json").under([HERE])
    monkeypatch.setattr(collections, "_MOST_DOCUMENTS", 3)
    with pytest.raises(InputError, match="more than 3 documents"):
        Collection(static(cells)).under([HERE])


def test_pages_without_an_end_and_addresses_with_credentials_are_refused(
    cells: Path, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = f"{api.address}/stac/collections/heights"
    monkeypatch.setattr(collections, "_PAGES", 1)
    with pytest.raises(InputError, match="more than 1 pages"):
        open_collected(address, [HERE], "ellipsoid", access={"allow_network": True})
    monkeypatch.undo()
    for one in api.items:
        one["assets"]["dem"]["href"] += "?sig=secret"
    with pytest.raises(InputError, match="credentials") as caught:
        open_collected(address, [HERE], "ellipsoid", access={"allow_network": True})
    assert "secret" not in str(caught.value)


def test_a_store_that_fails_in_passing_is_asked_again(cells: Path, api: Api) -> None:
    fails: Callable[[bytes, int], int | None] = lambda _, number: 503 if number == 1 else None  # noqa: E731
    api.faults = {"items.json": fails, "a.tif": fails}
    listed(cells)
    dem = open_collected(f"{api.address}/items.json", [HERE], "ellipsoid", access={"allow_network": True})
    assert np.isfinite(dem.window(0, 0, 130, 130)).all()
    assert api.asked["items.json"] == 2
