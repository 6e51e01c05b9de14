"""The chips on the page of a stack: dates over another date, before and after their correction."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from rasters import CORNER, Rasters

from ortho_pipeline.batch.stack import document as documents
from ortho_pipeline.batch.stack.command import stack
from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import MatchOptions, OutputOptions
from ortho_pipeline.report.stack import chips

gdal.UseExceptions()
RASTERS = Rasters(side=200, dates=3, error=6.0)


def run(folder: Path) -> Any:
    output = OutputOptions(resampling="cubic", threads=1, format="GTiff")
    return stack([folder / "in"], folder / "out", match=MatchOptions(points=80), output=output)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("chips")
    RASTERS.write(folder / "in")
    run(folder)
    return folder


def pictures(page: str) -> list[Any]:
    found = []
    for text in re.findall(r'<img src="data:image/png;base64,([^"]+)"', page):
        gdal.FileFromMemBuffer("/vsimem/chip.png", base64.b64decode(text))
        found.append(gdal.Open("/vsimem/chip.png").ReadAsArray())
        gdal.Unlink("/vsimem/chip.png")
    return found


def stretched(values: Any) -> Any:
    low, high = np.percentile(values, (2, 98))
    return (np.clip((values - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def test_a_chip_is_the_date_as_delivered_and_as_aligned_over_another_date(made: Path) -> None:
    page, document = (made / "out" / "stack.html").read_text(), json.loads((made / "out" / "stack.json").read_text())
    column, row = (int(text) - 64 for text in re.findall(r"One place \(column (\d+), row (\d+) of the grid\)", page)[0])
    size = {one["name"]: float(np.hypot(*one["shift_px"])) for one in document["dates"]}
    *shown, lower = sorted(size, key=lambda name: -size[name])
    assert re.findall(r'alt="(\S+) as aligned, over (\S+)"', page) == [(name, lower) for name in shown]
    left, _, _, top, _, _ = document["grid"]["geotransform"]

    def window(path: str, west: float, north: float) -> Any:
        image = gdal.Open(str(made / path))
        return stretched(
            image.ReadAsArray(round(left + column - west), round(north - top + row), 128, 128).astype(float)
        )

    red = window(f"out/aligned/{lower}_aligned.tif", left, top)
    for number, name in enumerate(shown):
        before, after = pictures(page)[2 * number : 2 * number + 2]
        for picture, cyan in (
            (before, window(f"in/{name}.tif", *CORNER)),
            (after, window(f"out/aligned/{name}_aligned.tif", left, top)),
        ):
            np.testing.assert_array_equal(picture, [red, cyan, cyan, np.full_like(red, 255)])
        assert np.corrcoef(after[0].ravel(), after[1].ravel())[0, 1] > 0.97
        assert np.corrcoef(before[0].ravel(), before[1].ravel())[0, 1] < 0.9


def test_chips_that_cannot_be_read_cost_no_page(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    page, regridded = (made / "out" / "stack.html").read_text(), chips.Regridded

    def failing(path: Any, *given: Any, **more: Any) -> Any:
        if Path(path).stem in names:
            raise InputError("it cannot be read")
        return regridded(path, *given, **more)

    monkeypatch.setattr(chips, "Regridded", failing)
    first, second = re.findall(r'alt="(\S+) as aligned', page)
    names: list[str] = []
    for lost, left in (([first], [second]), ([f"{first}_aligned", f"{second}_aligned"], [])):
        names[:] = lost
        run(tmp_path)
        page = (tmp_path / "out" / "stack.html").read_text()
        assert re.findall(r'alt="(\S+) as aligned', page) == left
        assert ("<h2>Before and after</h2>" in page) == bool(left)


def test_the_place_of_chips_is_a_still_one_that_most_pairs_see() -> None:
    cells = Cells(np.zeros(2), 10.0, (5, 5))
    measured, touched = np.ones((3, 25), dtype=bool), np.zeros(25, dtype=bool)
    measured[2] = False

    def place() -> list[float]:
        motion = SimpleNamespace(touched=lambda cells: touched)
        accepted = SimpleNamespace(accepted=np.array([True, True, False]))
        solved: Any = SimpleNamespace(
            cells=cells, edges=SimpleNamespace(measured=measured), closures=accepted, motion=motion
        )
        found = documents._chip_place(solved)
        return [] if found is None else found.tolist()

    assert place() == [25.0, 25.0]
    touched[[12, 7, 11]] = True
    assert place() == [35.0, 25.0]
    measured[0, 13] = False
    assert place() == [25.0, 35.0]
    touched[:] = True
    assert place() == []
    touched[:], measured[:2] = False, False
    assert place() == []
