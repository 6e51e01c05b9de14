"""Raw scenes in a stack: the correction of a date becomes one of the model, and pixels are resampled once."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from rasters import CORNER, UTM, Rasters

import ortho_pipeline as op
from ortho_pipeline.batch.stack import raw
from ortho_pipeline.batch.stack.command import stack
from ortho_pipeline.batch.stack.placing import Placed
from ortho_pipeline.batch.stack.raw import corrected_model
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.models import MapGrid
from ortho_pipeline.options import MatchOptions, OutputOptions, StackOptions, SurfaceOptions
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.footprint import image_grid
from ortho_pipeline.surface.rays import meet_surface

gdal.UseExceptions()
ROOT = Path(__file__).resolve().parent.parent.parent
RASTERS = Rasters(side=240, dates=2, error=4.0)
HEIGHT = 50.0


@pytest.mark.parametrize("kind", ["shift", "affine"])
def test_a_correction_becomes_that_of_the_model(kind: str) -> None:
    """In mountains and with an oblique view: the error of the model is found again from what it does on the map."""
    scene, surface = op.open_scene(ROOT / "sample_data" / "scene.tif"), op.open_dem(ROOT / "sample_data" / "dem.tif")
    size, slopes = (scene.width, scene.height), (1e-3, -5e-4, 2e-4, 8e-4) if kind == "affine" else (0, 0, 0, 0)
    made = np.array([9.0, *slopes[:2], -7.0, *slopes[2:]])
    true = op.ImageCorrection(scene.model, kind, (size[0] / 2, size[1] / 2), made)
    ground = meet_surface(scene.model, image_grid(*size, 30), surface)
    crs = "EPSG:32636"
    plan = ground_transform(scene.model.crs, crs)(ground)
    low, high = np.nanmin(plan, axis=0), np.nanmax(plan, axis=0)
    side = (high - low)[:2] / 5.0
    placed = Placed(Grid(parse_crs(crs), low[0], high[1], 5.0, 5.0, int(side[0]), int(side[1])))

    def at(place: Any) -> tuple[Any, None]:
        """Return where the delivered model shows the ground of a place, minus the place."""
        there = placed.model.image_to_ground(place, 0.0)[:, :2]
        heights = np.column_stack([there, surface.heights(there, crs)])
        seen = true.ground_to_image(ground_transform(crs, scene.model.crs)(heights))
        shown = ground_transform(scene.model.crs, crs)(meet_surface(scene.model, seen, surface))
        return (placed.at(shown[:, :2]) - place)[None], None

    placement: Any = SimpleNamespace(model=scene.model, surface=surface, scene=scene)
    found = corrected_model(placement, placed, SimpleNamespace(at=at, sloped=[kind == "affine"]), 0)  # type: ignore[arg-type]
    corners = image_grid(*size, 3)
    wrong = found.ground_to_image(true.image_to_ground(corners, 900.0)) - corners
    # Where the ground is hidden or out of the DEM, the inversion is not exact.
    assert np.abs(wrong).max() < 0.1


def delivered(folder: Path) -> list[Path]:
    """Write two dates, the first as a raw scene with an RPC that shows the ground 3 columns and -2 rows off."""
    paths = RASTERS.write(folder)
    image = gdal.OpenEx(str(paths[0]), gdal.OF_RASTER)
    pixels, size = image.ReadAsArray(), (RASTERS.side, RASTERS.side)
    image = None
    model = MapGrid(f"EPSG:{UTM}", (CORNER[0], 1.0, 0.0, CORNER[1], 0.0, -1.0), size)
    ground = ground_transform(model.crs, "EPSG:4979")(
        np.vstack([model.image_to_ground(image_grid(*size, 12), height) for height in (0.0, 100.0)])
    )
    seen = np.tile(image_grid(*size, 12), (2, 1)) + np.array([3.0, -2.0])
    low, high = ground.min(axis=0), ground.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    terms = np.column_stack([np.ones(len(ground)), (ground - middle) / half])
    column, row = (np.linalg.lstsq(terms, seen[:, axis] - 0.5, rcond=None)[0] for axis in (0, 1))
    names = ("LONG", "LAT", "HEIGHT")
    lines = {"LINE_OFF": 0.0, "SAMP_OFF": 0.0, "LINE_SCALE": 1.0, "SAMP_SCALE": 1.0}
    for name, offset, scale in zip(names, middle, half, strict=True):
        lines |= {f"{name}_OFF": offset, f"{name}_SCALE": scale}
    for name, values in (("LINE", row), ("SAMP", column)):
        numerator = [*values, *[0.0] * 16]
        lines |= {f"{name}_NUM_COEFF_{k}": value for k, value in enumerate(numerator, start=1)}
        lines |= {f"{name}_DEN_COEFF_{k}": float(k == 1) for k in range(1, 21)}
    paths[0].unlink()
    made = gdal.GetDriverByName("GTiff").Create(str(paths[0]), *size, 1, gdal.GDT_UInt16)
    made.WriteArray(pixels)
    made.SetMetadataItem("ACQUISITIONDATETIME", f"{RASTERS.days()[0].isoformat()}T10:00:00Z")
    made = None
    text = "".join(f"{name}: {value!r}\n" for name, value in ((k, float(v)) for k, v in lines.items()))
    paths[0].with_name(f"{paths[0].stem}_RPC.TXT").write_text(text)
    return paths


def run(folder: Path, out: Path, **more: Any) -> Any:
    settings = {"match": MatchOptions(points=120), "surface": SurfaceOptions(height=HEIGHT), **more}
    return stack([folder], out, output=OutputOptions(resampling="cubic", threads=1, format="GTiff"), **settings)


def test_a_raw_scene_and_an_ortho_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = delivered(tmp_path / "in")
    with pytest.raises(InputError, match="is not a finished ortho") as error:
        run(tmp_path / "in", tmp_path / "out", surface=SurfaceOptions())
    assert "surface.dem" in str(error.value.remedy)
    result = run(tmp_path / "in", tmp_path / "out")
    apart = RASTERS.shifts()[0] - (3.0, -2.0) - RASTERS.shifts()[1]
    np.testing.assert_allclose(np.subtract(*[one.shift_px for one in result.dates]), apart, atol=0.03)
    assert result.dates[0].path == str(paths[0])
    model = read_model_file(tmp_path / "out" / "aligned" / f"{paths[0].stem}_model.json").model
    np.testing.assert_allclose(model.coefficients[[0, 3]], result.dates[0].shift_px, atol=0.02)
    one, other = (gdal.Open(str(path)) for path in result.orthos.values())
    assert one.GetGeoTransform() == other.GetGeoTransform()
    inner = [image.ReadAsArray()[15:-15, 15:-15].astype(float).ravel() for image in (one, other)]
    assert np.corrcoef(*inner)[0, 1] > 0.97
    monkeypatch.setattr(raw, "write_placed", lambda *given: pytest.fail("it is made again"))
    before = json.loads((tmp_path / "out" / "stack.json").read_text())
    again = run(tmp_path / "in", tmp_path / "out", options=StackOptions(corrections_only=True))
    assert [one["shift_px"] for one in again.document["dates"]] == [one["shift_px"] for one in before["dates"]]
    moved = gdal.Open(str(again.orthos[paths[0].stem]))
    assert moved.GetMetadata("RPC")
    with pytest.raises(InputError, match="all of these are finished orthos"):
        stack(
            list(result.orthos.values()),
            tmp_path / "b",
            StackOptions(date_pattern="%Y%m%d"),
            surface=SurfaceOptions(height=0.0),
        )
