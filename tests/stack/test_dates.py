"""Dates of a stack: lists, file names, documents next to an ortho, metadata."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal, osr
from servers import serving

from ortho_pipeline.batch.stack.acquisition.times import by_pattern, time_of
from ortho_pipeline.batch.stack.dates import dated_orthos, read_list
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import SceneOptions

gdal.UseExceptions()


def ortho(path: Path, **metadata: str) -> Path:
    made = gdal.GetDriverByName("GTiff").Create(str(path), 8, 8, 1)
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(32735)
    made.SetProjection(reference.ExportToWkt())
    made.SetGeoTransform((500_000.0, 1.0, 0.0, 7_000_000.0, 0.0, -1.0))
    made.GetRasterBand(1).WriteArray(np.ones((8, 8), dtype=np.uint8))
    made.SetMetadata(metadata)
    return path


def test_dates_come_from_metadata_and_documents_in_order_of_time(tmp_path):
    ortho(tmp_path / "late.tif", ACQUISITIONDATETIME="2022:05:03 10:12:00", TIFFTAG_DATETIME="1999:01:01 00:00:00")
    ortho(tmp_path / "early_ortho.tif")
    (tmp_path / "early_stac.json").write_text(json.dumps({"properties": {"datetime": "2020-01-02T00:00:00Z"}}))
    ortho(tmp_path / "middle.tif")
    (tmp_path / "middle_report.json").write_text(json.dumps({"scene": {"facts": {"acquired": "2021-01-01"}}}))
    found = dated_orthos([tmp_path])
    assert [one.name for one in found] == ["early_ortho", "middle", "late"]
    assert [one.source for one in found] == ["early_stac.json", "middle_report.json", "ACQUISITIONDATETIME"]
    assert found[2].time.isoformat() == "2022-05-03T10:12:00+00:00"


def test_a_list_and_a_pattern_count_more_than_metadata(tmp_path):
    for day in ("20200105", "20200301"):
        ortho(tmp_path / f"a_{day}.tif", TIFFTAG_DATETIME="1999:01:01 00:00:00")
    found = dated_orthos([tmp_path / "a_*.tif"], "_%Y%m%d")
    assert [one.time.date().isoformat() for one in found] == ["2020-01-05", "2020-03-01"]
    (tmp_path / "list.csv").write_text("file,date\na_20200105.tif,2001-02-03\na_20200301.tif,2000-01-01\n")
    found = dated_orthos([tmp_path / "list.csv"])
    assert [one.name for one in found] == ["a_20200301", "a_20200105"]
    assert {one.source for one in found} == {"list"}


def test_a_pattern_takes_images_and_no_sidecars(tmp_path):
    for name in ("a_20200105", "a_20200301"):
        ortho(tmp_path / f"{name}.tif")
        (tmp_path / f"{name}.tfw").write_text("1\n0\n0\n-1\n500000.5\n6999999.5\n")
        (tmp_path / f"{name}_RPC.TXT").write_text("LINE_OFF: 1\n")
    with pytest.raises(InputError) as caught:
        read_list(tmp_path / "a_20200105_RPC.TXT")
    assert "give the folder of the images" in str(caught.value.remedy)
    for name in ("a_20200105", "a_20200301"):
        (tmp_path / f"{name}_RPC.TXT").rename(tmp_path / f"{name}.txt")
    found = dated_orthos([tmp_path / "a_*"], "_%Y%m%d")
    assert [one.path.name for one in found] == ["a_20200105.tif", "a_20200301.tif"]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_the_delimiter_of_a_list_is_that_of_its_header(tmp_path, delimiter):
    rows = [["Date", "File"], ["2020-01-05", '"a, b; c.tif"'], ["", "d.tif"]]
    (tmp_path / "list.csv").write_text("\ufeff\n" + "\n".join(delimiter.join(row) for row in rows))
    names = [str(tmp_path / name) for name in ("a, b; c.tif", "d.tif")]
    assert read_list(tmp_path / "list.csv") == list(zip(names, ["2020-01-05", None], strict=True))


def test_the_date_of_a_list_counts_wherever_else_the_image_was_given(tmp_path):
    for name in "ab":
        ortho(tmp_path / f"{name}.tif", ACQUISITIONDATETIME="2020-01-05")
    (tmp_path / "list.csv").write_text("file,date\na.tif,2021-02-03\n")
    for given in (["list.csv", "."], [".", "list.csv"], [".", "list.csv", "list.csv"]):
        found = dated_orthos([tmp_path / name for name in given])
        assert [(one.name, str(one.time.date()), one.source) for one in found] == [
            ("b", "2020-01-05", "ACQUISITIONDATETIME"),
            ("a", "2021-02-03", "list"),
        ]


def test_assets_of_one_name_have_the_ids_of_their_items(tmp_path):
    for number, name in enumerate(("x/S2_1", "x:S2 2", "B04_3", "x/S2_1_4")):
        folder = tmp_path / str(number)
        folder.mkdir()
        ortho(folder / ("B04_3.tif" if number == 2 else "B04.tif"))
        properties = {"datetime": f"2020-01-0{number + 1}T00:00:00Z"}
        asset = {"href": "B04_3.tif" if number == 2 else "B04.tif"}
        item = {
            "type": "Feature",
            "stac_version": "1.0.0",
            "id": name,
            "properties": properties,
            "assets": {"b": asset},
        }
        (folder / "item.json").write_text(json.dumps(item))
    (tmp_path / "list.csv").write_text(
        "file,date\n0/item.json#b,2020-01-05\n1/item.json,\n2/item.json,\n3/item.json,\n"
    )
    names = ["x_S2_1_B04", "x_S2_2_B04", "B04_3", "x_S2_1_4_B04"]
    (tmp_path / "items").mkdir()
    for number in range(4):
        text = (tmp_path / str(number) / "item.json").read_text().replace('"href": "', f'"href": "../{number}/')
        (tmp_path / "items" / f"{number}.json").write_text(text)
    (tmp_path / "items" / "collection.json").write_text('{"type": "Collection", "stac_version": "1.0.0"}')
    (tmp_path / "items" / "gcps.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    within = SceneOptions(roots=[tmp_path])
    assert [one.name for one in dated_orthos([tmp_path / "items"], options=within)] == names
    for given in (["*/item.json#b"], ["[0-9]/item.json", "0/B04.tif"], [f"{number}/item.json" for number in range(4)]):
        assert [one.name for one in dated_orthos([tmp_path / one for one in given])] == names
    found = dated_orthos([tmp_path / "list.csv", tmp_path / "0" / "B04.tif"])
    assert [one.name for one in found] == [*names[1:], names[0]]
    with pytest.raises(InputError, match="two images are called B04") as caught:
        dated_orthos([tmp_path / "*" / "B04.tif"])
    assert "STAC item of each, with an id of its own" in str(caught.value.remedy)


def test_two_items_of_one_image_are_refused(tmp_path):
    ortho(tmp_path / "a.tif")
    for name, day in (("x", "05"), ("y", "06")):
        item = {"type": "Feature", "stac_version": "1.0.0", "id": name, "assets": {"b": {"href": "a.tif"}}}
        item["properties"] = {"datetime": f"2020-01-{day}T00:00:00Z"}
        (tmp_path / f"{name}.json").write_text(json.dumps(item))
    with pytest.raises(InputError, match=r"another STAC item names this image, too: x\.json") as error:
        dated_orthos([tmp_path / "x.json", tmp_path / "y.json", tmp_path / "x.json"])
    assert Path(str(error.value.file)) == tmp_path / "y.json"


def test_a_list_in_utf_16_is_read(tmp_path):
    """PowerShell and spreadsheets write such lists."""
    for name in ("utf-16", "utf-8-sig"):
        (tmp_path / "list.csv").write_text("file,date\nİ.tif,2020-01-05\n", encoding=name)
        assert read_list(tmp_path / "list.csv") == [(str(tmp_path / "İ.tif"), "2020-01-05")]


def test_an_image_with_two_dates_in_lists_is_refused(tmp_path):
    for name in "ab":
        ortho(tmp_path / f"{name}.tif")
    (tmp_path / "list.csv").write_text("file,date\na.tif,2020-01-05\nb.tif,2020-02-01\na.tif,2020-03-01\n")
    with pytest.raises(InputError, match="lists give this image two dates: 2020-01-05 and 2020-03-01") as error:
        dated_orthos([tmp_path / "list.csv"])
    assert Path(str(error.value.file)) == tmp_path / "a.tif"


def test_clouds_and_sun_come_from_documents_and_metadata(tmp_path):
    ortho(tmp_path / "a_20200101.tif", CLOUD_COVERAGE_ASSESSMENT="12.5")
    ortho(tmp_path / "b_20200102.tif", CLOUD_COVER="999")
    ortho(tmp_path / "c_20200103.tif")
    properties = {"eo:cloud_cover": 80, "view:sun_elevation": 31.5}
    (tmp_path / "c_20200103.json").write_text(json.dumps({"properties": properties}))
    ortho(tmp_path / "d_20200104.tif")
    facts = {"cloud_cover": 0.25, "sun_elevation_deg": "40"}
    (tmp_path / "d_20200104_report.json").write_text(json.dumps({"scene": {"facts": facts}}))
    found = [one.conditions.stated() for one in dated_orthos([tmp_path], "_%Y%m%d")]
    assert found == [{"eo:cloud_cover": 12.5}, {}, properties, {"eo:cloud_cover": 25.0, "view:sun_elevation": 40.0}]


def test_an_ortho_without_a_date_is_an_error(tmp_path):
    ortho(tmp_path / "a.tif")
    ortho(tmp_path / "b.tif", TIFFTAG_DATETIME="2022:05:03 10:12:00")
    with pytest.raises(InputError, match="has no date") as error:
        dated_orthos([tmp_path])
    assert "stack.date_pattern=%Y%m%d" in str(error.value.remedy)
    (tmp_path / "a.tif").unlink()
    ortho(tmp_path / "c.tif", ACQUISITIONDATETIME="2022-05-03")
    with pytest.raises(InputError, match=r"TIFFTAG_DATETIME may be when the file was written"):
        dated_orthos([tmp_path])


def test_the_remedy_for_an_unknown_time_in_metadata_is_a_list_or_a_pattern(tmp_path):
    """Nobody writes dates into the metadata of an archive."""
    ortho(tmp_path / "a.tif", ACQUISITIONDATETIME="0001-01-01T00:00:00Z")
    ortho(tmp_path / "b.tif", ACQUISITIONDATETIME="2022-05-03")
    with pytest.raises(InputError, match="not a date from 1900") as error:
        dated_orthos([tmp_path])
    assert "CSV file" in str(error.value.remedy)
    assert "stack.date_pattern=%Y%m%d" in str(error.value.remedy)


@pytest.mark.parametrize(
    ("name", "pattern", "day"),
    [
        ("x_2020-061.tif", "%Y-%j", "2020-03-01"),
        ("S2A_20240503T101201_B04.jp2", "_%Y%m%dT%H%M%S", "2024-05-03"),
        ("LC81750322024123LGN00.tif", "%Y%j", "2024-05-02"),
        # A pattern may keep off the date of processing.
        ("LC81750322024123LGN00_20240201.tif", "%Y%jLGN", "2024-05-02"),
        # A number with another valid date within it: the whole number is meant.
        ("x9201201011_20240503.tif", "%Y%m%d", "2024-05-03"),
        ("20240503_to_20240503.tif", "%Y%m%d", "2024-05-03"),
        # The day of acquisition is before that of processing.
        ("LC08_L2SP_175032_20240123_20240201_02_T1.tif", "%Y%m%d", "2024-01-23"),
        ("LC08_L2SP_175032_20240123_20240201_02_T1.tif", "_%Y%m%d_", "2024-01-23"),
    ],
)
def test_patterns(name, pattern, day):
    assert by_pattern(name, pattern).date().isoformat() == day


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("a.tif", "%Y"), ("a_2020.tif", "%q"), ("a_20201399.tif", "%Y%m%d"), ("a_81750322.tif", "%Y%m%d"),
        ("a_920200101920210101.tif", "%Y%m%d"), ("a_2023366.tif", "%Y%j"), ("a_20240503.tif", "%Y%M%d"),
        # A day of the year within a date, or without the day of it.
        ("a_20240503.tif", "%Y%j"), ("a_20240503.tif", "%Y%m"),
    ],
)  # fmt: skip
def test_patterns_that_do_not_fit_are_refused(name, pattern):
    with pytest.raises(InputError):
        by_pattern(name, pattern)


def test_what_is_no_date_or_list_is_refused(tmp_path):
    with pytest.raises(InputError, match="not a date"):
        time_of("yesterday")
    # Programs write this for an unknown time.
    with pytest.raises(InputError, match="not a date from 1900 to 2100"):
        time_of("0001-01-01T00:00:00Z")
    (tmp_path / "list.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="no column of files"):
        read_list(tmp_path / "list.csv")


@pytest.mark.parametrize("wrong", ["03/05/2024", "2024"])
def test_the_error_of_a_date_in_a_list_names_the_list_and_the_line(tmp_path, wrong):
    """Otherwise people look into the image."""
    for name in "ab":
        ortho(tmp_path / f"{name}.tif")
    (tmp_path / "list.csv").write_text(f"file,date\na.tif,2020-01-05\nb.tif,{wrong}\n")
    with pytest.raises(InputError, match=f"'{wrong}' is not a date") as error:
        dated_orthos([tmp_path / "list.csv"])
    assert (Path(str(error.value.file)), error.value.field) == (tmp_path / "list.csv", "date")
    assert str(error.value.remedy) == "write the date of line 3 as 2024-05-03"


def test_the_error_of_a_date_in_an_item_names_the_item(tmp_path):
    ortho(tmp_path / "a.tif")
    (tmp_path / "a.json").write_text(json.dumps({"properties": {"datetime": "yesterday"}}))
    with pytest.raises(InputError, match="'yesterday' is not a date") as error:
        dated_orthos([tmp_path])
    assert Path(str(error.value.file)) == tmp_path / "a.json"


def test_the_state_of_an_ortho_behind_a_url_has_its_side_cars(tmp_path):
    path = ortho(tmp_path / "a.tif")
    path.with_name("a.tif.msk").write_bytes(ortho(tmp_path / "mask.tif").read_bytes())
    with serving(tmp_path) as server:
        images = [f"{server.address}/{name}.tif" for name in ("a", "mask")]
        (tmp_path / "list.csv").write_text("file,date\n" + "".join(f"{image},2020-01-01\n" for image in images))
        access = SceneOptions(allow_network=True)
        first = dated_orthos([tmp_path / "list.csv"], options=access)[0]
        assert [Path(state.path).name for state in first.states(access)] == ["a.tif", "a.tif.msk"]


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"seris: there is no such file"):
        dated_orthos([tmp_path / "seris"])
    with pytest.raises(InputError, match="at least two images, not 0"):
        dated_orthos([tmp_path])
