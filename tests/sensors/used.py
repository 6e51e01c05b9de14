"""A scene in the hands of a user: `info`, `fit`, `export` and `rectify` of a small image, judged by its geometry."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline.cli.program import cli
from ortho_pipeline.exchange.rpc_files import read_rpc_text
from ortho_pipeline.models.base import Array, SensorModel


def pixels(path: Path, size: tuple[int, int], bands: int = 1) -> Path:
    """Write an image of soft stripes, so that a shift of it shows."""
    column, row = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, bands)
    for k in range(bands):
        dataset.GetRasterBand(k + 1).WriteArray((130 + 60 * np.sin(column / 5 + k) + 50 * np.cos(row / 4)).astype("u1"))
    dataset = None
    return path


def ran(*words: Any) -> dict[str, Any]:
    """Return the JSON document of a command that has to succeed."""
    result = CliRunner().invoke(cli, [*map(str, words), "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def control(path: Path, truth: SensorModel, size: tuple[int, int], height: float, offset: Array) -> Path:
    """Write nine points at three heights, seen where a true camera that is `offset` pixels off the model sees them."""
    image = np.array([[x, y] for x in (0.1, 0.5, 0.9) for y in (0.15, 0.5, 0.85)]) * size
    heights = height + np.tile([0.0, 40.0, 90.0], 3)
    ground = truth.image_to_ground(image, heights)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["id", "col", "row", "x", "y", "h", "role"])
        for k, ((x, y), (lon, lat, h)) in enumerate(zip((image + offset).tolist(), ground.tolist(), strict=True)):
            writer.writerow([k, x, y, lon, lat, h, "check" if k in (2, 4) else "control"])
    return path


def used(given: Path, truth: SensorModel, size: tuple[int, int], *, sensor: str, height: float, correction: str,
         options: tuple[str, ...] = ()) -> dict[str, Any]:  # fmt: skip
    """Use a scene through the commands, and return what `info` says of it.

    Parameters
    ----------
    given : path
        What a user names: image, metadata or folder.
    truth : SensorModel
        Its geometry; points are measured 3 px right and 2 px above of it.
    correction : str
        What they correct; the check points have to be within 0.1 px then.
    """
    folder = given.parent / "used"
    folder.mkdir()
    info = ran("info", given, *options)
    assert info["sensor"] == sensor
    assert info["size"] == list(size)
    points = control(folder / "p.csv", truth, size, height, np.array([3.0, -2.0]))
    measured = ("--gcps", points, "--points-crs", "EPSG:4326", "--points-vertical", "ellipsoid")
    found = ran("fit", given, *measured, "--correction", correction, *options)
    assert found["rmse"]["check"]["total"] < 0.1, found["rmse"]
    ran("export", given, "--height", height, "--format", "rpc-txt", "-o", folder / "out", *options)
    (rpc,) = (read_rpc_text(one) for one in (folder / "out").iterdir())
    inner = np.random.default_rng(0).uniform(0.1, 0.9, (20, 2)) * size
    ground = truth.image_to_ground(inner, height)
    assert np.abs(rpc.ground_to_image(ground) - inner).max() < 0.05
    ran("rectify", given, "--height", height, "-o", folder / "ortho", *options)
    (ortho,) = (folder / "ortho").glob("*_ortho.tif")
    assert (gdal.Open(str(ortho)).ReadAsArray() > 0).mean() > 0.3
    return info
