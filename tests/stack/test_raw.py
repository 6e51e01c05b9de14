"""Raw scenes in a stack: the correction of a date becomes one of the model, and slopes do not change it."""

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
from ortho_pipeline.batch.stack.raw import Levelled, corrected_model
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

    def seen(place: Any) -> Any:
        """Return the pixels that show the ground at places."""
        return true.ground_to_image(ground_transform(crs, scene.model.crs)(placed.on(surface, place)))

    def at(place: Any) -> tuple[Any, None]:
        """Return where the delivered model shows the ground of a place at its height, minus the place."""
        shown = scene.model.image_to_ground(seen(place), placed.on(surface, place)[:, 2])
        return (placed.at(ground_transform(scene.model.crs, crs)(shown)[:, :2]) - place)[None], None

    placement: Any = SimpleNamespace(model=scene.model, surface=surface, scene=scene)
    solved: Any = SimpleNamespace(at=at, sloped=[kind == "affine"])
    found = corrected_model(placement, placed, solved, 0)
    np.testing.assert_allclose(found.coefficients, made, atol=1e-3, rtol=0)
    # In the ortho of the delivered model, the displacement differs on slopes; at the heights of the places it does not.
    inner = placed.at(plan[np.isfinite(plan).all(axis=1)][:, :2])
    inner = inner[np.isfinite(at(inner)[0]).all(axis=2)[0]]
    shown = placed.at(ground_transform(scene.model.crs, crs)(meet_surface(scene.model, seen(inner), surface))[:, :2])
    right: Any = SimpleNamespace(at=lambda place: (np.zeros((1, len(place), 2)), None))
    levelled = Levelled({1: placement}, placed, right)
    _, there = levelled.pair(1, 0, inner, shown)
    near = np.isfinite(there).all(axis=1)
    apart = [np.abs(one - inner - at(inner)[0][0])[near] for one in (shown, there)]
    assert np.quantile(apart[0], 0.95) > 0.1
    assert np.quantile(apart[1], 0.95) < 0.01


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


@pytest.mark.parametrize(
    "options", [{"bands": (1,)}, {"dem_interpolation": "cubic"}, {"tolerance": 0.1}, {"engine": "gdal"}]
)
def test_a_changed_option_of_the_warp_makes_orthos_again(options: dict[str, Any]) -> None:
    assert raw.written_with(OutputOptions(**options)) != raw.written_with(OutputOptions())


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
    with pytest.raises(InputError, match="all of these are finished orthos"):
        stack(
            list(result.orthos.values()),
            tmp_path / "b",
            StackOptions(date_pattern="%Y%m%d"),
            surface=SurfaceOptions(height=0.0),
        )
    monkeypatch.setattr(raw, "write_in", lambda *given: pytest.fail("it is made again"))
    before = json.loads((tmp_path / "out" / "stack.json").read_text())
    again = run(tmp_path / "in", tmp_path / "out", options=StackOptions(corrections_only=True))
    assert [one["shift_px"] for one in again.document["dates"]] == [one["shift_px"] for one in before["dates"]]
    moved = gdal.Open(str(again.orthos[paths[0].stem]))
    assert moved.GetMetadata("RPC")
