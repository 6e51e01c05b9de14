"""`ortho run` makes a scene again when something changes behind the files that the pipeline file names."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dem_cells import small_cells, write_cell, write_geoid, write_list
from osgeo import gdal

from ortho_pipeline.batch import runner as batch
from ortho_pipeline.batch.records import RunRecord
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.surface.cells.copernicus import Cell

FILE = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {crs: "EPSG:32734", resolution: 5}
scenes:
  - images: raw/*.tif
"""
ALL_DONE = dict.fromkeys(("s0", "s1"), "done")
HERE = [Cell(lon, lat) for lon in (19, 20) for lat in (-31, -30)]
UNCHANGED = dict.fromkeys(("s0", "s1"), "unchanged")


@dataclasses.dataclass
class Block:
    """A folder with a pipeline file, two overlapping scenes and their DEM."""

    folder: Path

    def write(self, text: str) -> None:
        (self.folder / "pipeline.yaml").write_text(text)

    def change_dem(self) -> None:
        """Let all heights be 900 m."""
        dem = gdal.Open(str(self.folder / "dem.tif"), gdal.GA_Update)
        dem.WriteArray(np.full((dem.RasterYSize, dem.RasterXSize), 900.0, np.float32))
        dem = None

    def run(self, **options: Any) -> dict[str, str]:
        """Run in this process and return the state of each scene."""
        result = batch.run(self.folder / "pipeline.yaml", executor="sequential", **options)
        return {scene.name: scene.status for scene in result.scenes}


@pytest.fixture
def block(tiny: Any, tmp_path: Path) -> Block:
    """Make a block of two scenes."""
    (tmp_path / "raw").mkdir()
    for number in range(2):
        shift = 20 * number
        model = dataclasses.replace(tiny.model, col_off=tiny.model.col_off - shift, row_off=tiny.model.row_off - shift)
        scene = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"raw/s{number}.tif"), 96, 80, 1, gdal.GDT_UInt16)
        scene.SetMetadata(rpc_metadata(model), "RPC")
        scene.WriteArray(gdal.Open(str(tiny.image)).ReadAsArray(shift, shift, 96, 80))
        scene = None
    (tmp_path / "dem.tif").write_bytes(tiny.dem.read_bytes())
    made = Block(tmp_path)
    made.write(FILE)
    return made


def test_a_changed_source_of_a_vrt_with_the_accuracy_of_the_dem(block: Block) -> None:
    def write_sigma(value: float) -> None:
        dem = gdal.Open(str(block.folder / "dem.tif"))
        copy = gdal.GetDriverByName("GTiff").CreateCopy(str(block.folder / "sigma.tif"), dem)
        copy.WriteArray(np.full((dem.RasterYSize, dem.RasterXSize), value, np.float32))
        copy = None

    write_sigma(2.0)
    gdal.Translate(str(block.folder / "sigma.vrt"), str(block.folder / "sigma.tif"))
    block.write(FILE.replace("vertical: ellipsoid", "vertical: ellipsoid, sigma: ./sigma.vrt"))
    assert block.run() == ALL_DONE
    assert block.run() == UNCHANGED
    write_sigma(4.0)
    assert block.run() == ALL_DONE


def mosaic_files(block: Block) -> list[str]:
    return sorted(path.name for path in (block.folder / "out").glob("mosaic.*"))


MOSAIC = ["mosaic.html", "mosaic.json", "mosaic.vrt"]


@pytest.mark.parametrize("part", [{"only": ["s1"]}, {"shard": (2, 2)}])
def test_a_part_removes_a_mosaic_that_no_longer_fits_and_a_full_run_makes_it_again(block: Block, part: Any) -> None:
    block.write(FILE + "mosaic: {}\n")
    block.run()
    assert mosaic_files(block) == MOSAIC
    assert block.run(**part) == {"s1": "unchanged"}
    assert mosaic_files(block) == MOSAIC  # it fits
    block.change_dem()
    assert block.run(**part) == {"s1": "done"}
    assert mosaic_files(block) == []
    assert block.run() == {"s0": "done", "s1": "unchanged"}
    assert mosaic_files(block) == MOSAIC


@pytest.mark.parametrize("killed", ["while a scene is made", "before the record of the mosaic is written"])
def test_a_killed_run_leaves_no_mosaic_that_does_not_fit(
    block: Block, monkeypatch: pytest.MonkeyPatch, killed: str
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    def written(record: RunRecord, path: Path) -> None:
        if record.name == "mosaic" and record.status == "done":
            raise KeyboardInterrupt
        write(record, path)

    write = RunRecord.write
    block.write(FILE + "mosaic: {}\n")
    with monkeypatch.context() as patch:
        if killed == "before the record of the mosaic is written":
            patch.setattr(RunRecord, "write", written)
            with pytest.raises(KeyboardInterrupt):
                block.run()
        else:
            block.run()
    assert mosaic_files(block) == MOSAIC
    block.change_dem()
    with monkeypatch.context() as patch:
        patch.setattr(batch, "_rectified", interrupted)
        with pytest.raises(KeyboardInterrupt):
            block.run()
    assert mosaic_files(block) == []
    assert block.run() == ALL_DONE
    assert mosaic_files(block) == MOSAIC


@pytest.mark.parametrize("new", ["dem/a/east.tif", "dem/b/east.tif"])
def test_new_dem_files_of_a_pattern_with_a_wildcard_in_a_folder_name(block: Block, new: str) -> None:
    (block.folder / "dem/a").mkdir(parents=True)
    (block.folder / "dem.tif").rename(block.folder / "dem/a/dem.tif")
    block.write(FILE.replace("dem: dem.tif", 'dem: "dem/*/*.tif"'))
    assert block.run() == ALL_DONE
    assert block.run() == UNCHANGED
    (block.folder / new).parent.mkdir(exist_ok=True)
    (block.folder / new).write_bytes((block.folder / "dem/a/dem.tif").read_bytes())
    assert block.run() == ALL_DONE
    assert block.run() == UNCHANGED


def test_another_source_of_cells_in_the_environment(block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    small_cells(monkeypatch)
    write_geoid(block.folder / "geoid.gtx")
    for source in ("a", "b"):
        for cell in HERE:
            write_cell(block.folder / source, cell)
    block.write(FILE.replace("dem: dem.tif, vertical: ellipsoid", "dem: auto, vertical: ./geoid.gtx"))
    monkeypatch.setenv("ORTHO_DEM_SOURCE", str(block.folder / "a"))
    assert block.run() == ALL_DONE
    assert block.run() == UNCHANGED
    monkeypatch.setenv("ORTHO_DEM_SOURCE", str(block.folder / "b"))
    assert block.run() == ALL_DONE
    assert block.run() == UNCHANGED


def test_a_new_cell_or_another_list_in_the_folder_of_cells(block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell elsewhere changes nothing; one that a scene lacked does, whether it counted as sea or as a gap."""
    small_cells(monkeypatch)
    write_geoid(block.folder / "geoid.gtx")
    cells = block.folder / "cells"
    first, second, third, fourth = HERE[1], HERE[0], HERE[2], HERE[3]  # the scenes are mainly in the first
    write_cell(cells, first)
    write_list(cells, [first, second, third])
    surface = "dem: auto, source: cells, fill: 500, vertical: ./geoid.gtx"
    block.write(FILE.replace("dem: dem.tif, vertical: ellipsoid", surface))
    assert block.run() == ALL_DONE
    write_cell(cells, Cell(25, -30))
    assert block.run() == UNCHANGED
    assert block.run(checksums=True) == UNCHANGED
    for cell in (second, fourth):
        write_cell(cells, cell)
        assert block.run() == ALL_DONE
        assert block.run() == UNCHANGED
    write_list(cells, [first, second])
    assert block.run() == ALL_DONE
    (cells / "tileList.txt").unlink()
    assert block.run() == ALL_DONE
    write_list(cells, [first, second])
    assert block.run(checksums=True) == ALL_DONE
    assert block.run() == UNCHANGED


def test_checksums_see_a_changed_mosaic_whose_size_and_date_are_as_before(block: Block) -> None:
    block.write(FILE + "mosaic: {}\n")
    block.run()
    mosaic = block.folder / "out" / "mosaic.vrt"
    before, stat = mosaic.read_bytes(), mosaic.stat()
    mosaic.write_bytes(before.replace(b"VRTDataset", b"XXXDataset"))
    os.utime(mosaic, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    block.run(checksums=True)
    assert mosaic.read_bytes() == before


def test_a_mosaic_that_is_no_longer_in_the_file_is_removed(block: Block) -> None:
    block.write(FILE + "mosaic: {}\n")
    block.run()
    block.write(FILE)
    own = block.folder / "out" / "mosaic.txt"
    own.write_text("a file of the user")
    assert block.run(only=["s0"]) == {"s0": "unchanged"}
    assert mosaic_files(block) == sorted([*MOSAIC, own.name])
    assert block.run() == UNCHANGED
    assert mosaic_files(block) == [own.name]


def test_a_record_that_names_what_is_no_file_stops_no_run(block: Block) -> None:
    def tamper(path: Path) -> None:
        document = json.loads(path.read_text())
        for name in ("notes", "a\0b", "x" * 300):
            document["outputs"].append({**document["outputs"][0], "role": "more", "path": name})
        path.write_text(json.dumps(document))

    out = block.folder / "out"
    block.write(FILE.replace("- images: raw/*.tif", "- image: raw/s0.tif") + "mosaic: {}\n")
    block.run()
    for folder in (out, out / "s0"):
        (folder / "notes").mkdir()
    tamper(out / ".run" / "s0.json")
    tamper(out / ".run" / "mosaic" / "record.json")
    assert block.run() == {"s0": "done"}
    assert "error" not in json.loads((out / "run.json").read_text())["mosaic"]
    tamper(out / ".run" / "mosaic" / "record.json")
    block.write(FILE.replace("- images: raw/*.tif", "- image: raw/s0.tif"))
    assert block.run() == {"s0": "unchanged"}
    assert not (out / "mosaic.vrt").exists()
    assert (out / "notes").is_dir()


def test_options_of_matching_without_a_reference_are_refused_by_a_second_run_too(block: Block) -> None:
    assert block.run() == ALL_DONE
    block.write(FILE.replace("scenes:", "  match: {points: 50}\nscenes:"))
    assert block.run() == dict.fromkeys(("s0", "s1"), "failed")


def test_a_catalog_goes_with_its_items_and_a_file_of_the_user_stays(block: Block) -> None:
    catalog = block.folder / "out" / "catalog.json"
    block.write(FILE.replace("resolution: 5", "resolution: 5, stac: true, acquired: '2024-05-05'"))
    assert block.run() == ALL_DONE
    assert catalog.exists()
    block.write(FILE)
    assert block.run() == ALL_DONE
    assert not catalog.exists()
    catalog.write_text("{}")
    assert block.run() == UNCHANGED
    assert catalog.read_text() == "{}"
