"""STAC items in place of files: which asset is meant, where it lies, and what a stranger's item may name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal
from servers import PublicFolder, running, serving

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import fit, info, rectify
from ortho_pipeline.commands.stac.given import resolved
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_files import write_rpc_txt
from ortho_pipeline.files.locations import Location
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.stores.stac.item import item_of, read_item

gdal.UseExceptions()
TIFF, TEXT = "image/tiff; application=geotiff; profile=cloud-optimized", "text/plain"


def asset(href: str, *roles: str, type: str | None = TIFF) -> dict[str, Any]:
    return {"href": href, "roles": list(roles)} | ({} if type is None else {"type": type})


def document(**assets: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "stac_version": "1.0.0", "id": "one", "assets": assets, "links": [], "properties": {}}


def item(path: Path, **assets: dict[str, Any]) -> Path:
    path.write_text(json.dumps(document(**assets)))
    return path


@pytest.fixture
def delivery(tiny: Any) -> Path:
    """An image without a model, its RPC in another folder, heights and points, and an item of all."""
    plain = gdal.Translate(str(tiny.folder / "plain.tif"), str(tiny.image))
    plain.SetMetadata({}, "RPC")
    plain = None
    (tiny.folder / "meta").mkdir()
    write_rpc_txt(tiny.model, tiny.folder / "meta" / "delivered_RPC.TXT")
    item(
        tiny.folder / "item.json", image=asset("./plain.tif", "data"), browse=asset("./browse.png", "thumbnail"),
        rpc=asset("meta/delivered_RPC.TXT", "metadata", type=TEXT), points=asset(tiny.gcps.name, type="text/csv"),
    )  # fmt: skip
    item(tiny.folder / "heights.json", data=asset("dem.tif", "data"))
    return tiny.folder


def pixels(result: Any) -> Any:
    return gdal.Open(str(result.files["ortho"])).ReadAsArray()


def test_an_item_on_disk_and_behind_a_url_is_its_image_with_its_rpc(delivery: Path, tiny: Any, tmp_path: Path) -> None:
    output = OutputOptions(format="GTiff")
    heights = SurfaceOptions(dem=str(delivery / "heights.json"), vertical="ellipsoid")
    truth = pixels(
        rectify(tiny.image, tmp_path / "a", surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), output=output)
    )
    made = rectify(delivery / "item.json", tmp_path / "b", surface=heights, output=output)
    np.testing.assert_array_equal(pixels(made), truth)
    assert made.files["ortho"].name == "plain_ortho.tif"
    used = {Path(one["path"]).name: one["role"] for one in made.document["report"]["provenance"]["inputs"]}
    assert used["delivered_RPC.TXT"] == "RPC"
    with serving(delivery) as public:
        far = SurfaceOptions(dem=f"{public.address}/heights.json", vertical="ellipsoid")
        with pytest.raises(InputError, match="off by default"):
            rectify(f"{public.address}/item.json", tmp_path / "c", surface=far, output=output)
        scene = SceneOptions(allow_network=True)
        made = rectify(f"{public.address}/item.json", tmp_path / "c", scene=scene, surface=far, output=output)
        np.testing.assert_array_equal(pixels(made), truth)


def test_points_and_other_commands_take_items_as_well(delivery: Path, tiny: Any) -> None:
    path = str(delivery / "item.json")
    by_item = fit(path, points=PointOptions(gcps=path, crs="EPSG:4326", vertical="ellipsoid"))
    by_file = fit(tiny.image, points=PointOptions(gcps=tiny.gcps, crs="EPSG:4326", vertical="ellipsoid"))
    assert by_item.to_json() == by_file.to_json() | {"model_source": by_item.to_json()["model_source"]}
    assert info(path)["sensor"] == "rpc"
    done = CliRunner().invoke(cli, ["info", path, "--json"])
    assert json.loads(done.stdout)["sensor"] == "rpc", done.stderr
    # A table of points in GeoJSON is no item.
    table = delivery / "table.geojson"
    table.write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(InputError, match=r"table\.geojson"):
        fit(path, points=PointOptions(gcps=table))


def test_our_own_items_are_references(tiny: Any, tmp_path: Path) -> None:
    """The item that `rectify` writes names the ortho by a role that is understood."""
    heights = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    made = rectify(
        tiny.image, tmp_path, surface=heights, output=OutputOptions(stac=True, acquired="2024-05-01T08:00:00Z")
    )
    found = read_item(made.files["stac"]).image()
    assert Path(found.href) == Path(made.files["ortho"])
    with pytest.raises(InputError) as caught:
        fit(tiny.image, points=PointOptions(), match=MatchOptions(reference=(str(made.files["stac"]),)))
    assert not str(caught.value.file).endswith(".json"), "what is matched is the ortho"


# -- which asset ------------------------------------------------------------------------------------------------------


def test_the_asset_is_that_of_its_role_or_the_one_that_is_named() -> None:
    one = item_of(
        document(
            visual=asset("v.tif", "visual"), analytic=asset("a.tif", "data"), udm=asset("u.tif", "metadata"),
            shown=asset("o.tif", "overview"), text=asset("a.json", "data", type="application/json"),
        ),
        "item.json",
    )  # fmt: skip
    assert one.image().key == "analytic"
    assert one.image("visual").key == "visual"
    assert item_of(document(x=asset("a.tif", type=None)), "i.json").image().key == "x"
    bands = {f"B0{k}": asset(f"{k}.jp2", "data", type="image/jp2") for k in range(3)}
    assert item_of(document(**bands, visual=asset("v.tif", "visual")), "i.json").image().key == "visual"
    with pytest.raises(InputError, match=r"several assets.*B00, B01, B02") as caught:
        item_of(document(**bands), "i.json").image()
    assert "i.json#B00" in caught.value.remedy
    with pytest.raises(InputError, match="no asset of the item 'one' is a raster"):
        item_of(document(t=asset("a.txt", type=TEXT)), "i.json").image()
    with pytest.raises(InputError, match="no asset 'nir'"):
        one.image("nir")


def test_an_rpc_that_gdal_finds_is_left_to_it(tiny: Any) -> None:
    beside = document(image=asset("a.tif", "data"), rpc=asset("a_RPC.TXT", type=TEXT))
    elsewhere = document(image=asset("a.tif", "data"), rpc=asset("b_RPC.TXT", type=TEXT))
    for given, found in ((beside, None), (elsewhere, "b_RPC.TXT")):
        one = item_of(given, tiny.folder / "i.json")
        rpc = one.rpc_of(one.image())
        assert (rpc and rpc.name) == found
    item(tiny.folder / "i.json", **elsewhere["assets"])
    several = document(
        image=asset("a.tif", "data"), one=asset("b_RPC.TXT", type=TEXT), two=asset("c_RPC.TXT", type=TEXT)
    )
    ambiguous = item_of(several, str(tiny.folder / "i.json"))
    with pytest.raises(InputError, match="several assets could be the RPC of 'image': one, two"):
        ambiguous.rpc_of(ambiguous.image())
    assert resolved(tiny.folder / "i.json", SceneOptions())[1].rpc == str(tiny.folder / "b_RPC.TXT")
    assert resolved(tiny.folder / "i.json", SceneOptions(rpc="tag"))[1].rpc == "tag", "what the user says comes first"


@pytest.mark.parametrize(
    ("address", "href", "place"),
    [
        ("https://h/c/one.json", "./a.tif", "https://h/c/a.tif"),
        ("https://h/c/one.json", "/b/a.tif", "https://h/b/a.tif"),
        ("https://h/c/one.json", "s3://box/a.tif", "s3://box/a.tif"),
        ("s3://box/c/one.json", "../d/a.tif", "s3://box/d/a.tif"),
        ("/data/one.json", "https://h/a.tif?sig=1", "https://h/a.tif?sig=1"),
    ],
)
def test_assets_lie_where_the_item_says(address: str, href: str, place: str) -> None:
    assert item_of(document(x=asset(href, "data")), address).image().href == place


@pytest.mark.parametrize(
    "href", ["/etc/passwd", "../x.tif", "file:///etc/passwd", "/vsicurl/http://h/a.tif", "a\0", ""]
)
def test_an_item_leads_to_no_files_elsewhere_on_this_machine(href: str, tmp_path: Path) -> None:
    given = document(x=asset(href, "data"))
    with pytest.raises(InputError) as caught:
        item_of(given, tmp_path / "one.json")
    assert caught.value.remedy
    if "file:" in href or "/vsi" in href:
        with pytest.raises(InputError):
            item_of(given, "https://h/one.json")


def test_what_may_be_an_item_is_told_by_its_name() -> None:
    assert Location("a/b.json").is_item
    assert Location(Path("b.geojson")).is_item
    assert Location("https://h/stac/v1/collections/c/items/S_1").is_item
    assert Location("https://h/one.json?key=1").is_item
    assert not Location("s3://h/one.tif").is_item
    assert not Location("auto").is_item


def test_an_answer_that_ends_too_early_is_asked_for_again(tmp_path: Path) -> None:
    item(tmp_path / "one.json", x=asset("a.tif", "data"))

    class Cut(PublicFolder):
        def answer(self, handler: Any) -> None:
            if self.asked["one.json"]:
                return super().answer(handler)
            self.asked["one.json"] += 1
            handler.send_response(200)
            handler.send_header("Content-Length", "5000")
            handler.end_headers()
            handler.wfile.write(b'{"type": "Feature",')
            handler.close_connection = True
            return None

    with running(Cut(tmp_path)) as public:
        assert read_item(f"{public.address}/one.json", allow_network=True).image().href == f"{public.address}/a.tif"


def test_an_item_without_a_raster_is_named_in_a_page_of_items() -> None:
    with pytest.raises(InputError, match="no asset of the item 'one' is a") as caught:
        item_of(document(), "https://host/items").image()
    assert caught.value.remedy == "give another item"


def test_answers_that_fail_in_passing_are_asked_for_again(tmp_path: Path) -> None:
    item(tmp_path / "one.json", x=asset("a.tif", "data"))
    with serving(tmp_path) as public:
        public.faults["one.json"] = lambda _, number: 503 if number == 1 else None
        found = read_item(f"{public.address}/one.json", allow_network=True)
        assert found.image().href == f"{public.address}/a.tif"
        with pytest.raises(InputError, match="404"):
            read_item(f"{public.address}/two.json", allow_network=True)
