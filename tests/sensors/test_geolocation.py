"""Geolocation arrays: the model against GDAL's own transformer, arrays in files, and a start that matches correct."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal, osr
from scipy.ndimage import gaussian_filter, map_coordinates
from used import pixels, ran

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.host import open_scene
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions

SIZE = (120, 96)


def arrays(folder: Path, *, step: int = 4, centred: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Write lon.tif and lat.tif of a turned swath that bends, and return them."""
    columns, rows = SIZE[0] // step + 1, SIZE[1] // step + 1
    x, y = np.meshgrid(np.arange(columns) * step + 0.5 * step * centred, np.arange(rows) * step + 0.5 * step * centred)
    u, v = x / SIZE[0] - 0.5, y / SIZE[1] - 0.5
    found = 12.0 + 0.040 * u + 0.006 * v + 0.002 * u * u * u, 42.0 - 0.031 * v + 0.005 * u - 0.001 * u * v
    for name, values in zip(("lon", "lat"), found, strict=True):
        dataset = gdal.GetDriverByName("GTiff").Create(str(folder / f"{name}.tif"), columns, rows, 1, gdal.GDT_Float64)
        dataset.WriteArray(values)
        dataset = None
    return found


def named(image: Path, *, step: int, centred: bool, **fields: str) -> Path:
    """Write into an image which arrays are its own."""
    wgs84 = osr.SpatialReference()
    wgs84.ImportFromEPSG(4326)
    dataset = gdal.Open(str(image), gdal.GA_Update)
    dataset.SetMetadata(
        {
            "X_DATASET": str(image.with_name("lon.tif")), "Y_DATASET": str(image.with_name("lat.tif")), "X_BAND": "1",
            "Y_BAND": "1", "PIXEL_OFFSET": "0", "LINE_OFFSET": "0", "PIXEL_STEP": str(step), "LINE_STEP": str(step),
            "SRS": wgs84.ExportToWkt(),
            "GEOREFERENCING_CONVENTION": "PIXEL_CENTER" if centred else "TOP_LEFT_CORNER", **fields,
        }, "GEOLOCATION",
    )  # fmt: skip
    dataset = None
    return image


@pytest.mark.parametrize(("step", "centred"), [(4, False), (4, True), (1, True)])
def test_the_model_is_gdals_transformer(tmp_path: Path, step: int, centred: bool) -> None:
    arrays(tmp_path, step=step, centred=centred)
    image = named(pixels(tmp_path / "swath.tif", SIZE), step=step, centred=centred)
    scene = open_scene(image)
    assert (scene.sensor, [notice.code for notice in scene.notices]) == ("geolocation", ["only-a-start"])
    transformer = gdal.Transformer(gdal.Open(str(image)), None, ["METHOD=GEOLOC_ARRAY"])
    at = np.random.default_rng(0).uniform(0.1, 0.9, (40, 2)) * SIZE
    ground = [transformer.TransformPoint(0, *place)[1] for place in at.tolist()]
    # GDAL goes straight between the nodes, the polynomial does not.
    assert np.abs(scene.model.ground_to_image(ground) - at).max() < scene.facts["max_error_px"] + 0.05 < 0.15


def test_arrays_in_files(tmp_path: Path) -> None:
    """As those of PRISMA are after gdal_translate: of every pixel, of its centre, with nothing said in the image."""
    lon, lat = arrays(tmp_path, step=1, centred=True)
    for name, values in (("lon", lon), ("lat", lat)):
        kind = gdal.GetDriverByName("GTiff")
        dataset = kind.Create(str(tmp_path / f"{name}.tif"), *SIZE, 1, gdal.GDT_Float64)
        dataset.WriteArray(values[: SIZE[1], : SIZE[0]])
        dataset = None
    image = pixels(tmp_path / "swath.tif", SIZE)
    options = ("--sensor-option", f"lon={tmp_path / 'lon.tif'}", "--sensor-option", f"lat={tmp_path / 'lat.tif'}")
    info = ran("info", image, *options)
    assert (info["sensor"], info["facts"]["arrays"]) == ("geolocation", ["lon.tif", "lat.tif"])
    model = open_scene(image, None, {name: str(tmp_path / f"{name}.tif") for name in ("lon", "lat")}).model
    seen = model.ground_to_image([[lon[50, 30], lat[50, 30], 0.0]])
    assert np.abs(seen - (30.5, 50.5)).max() < 0.1
    ran("export", image, "--height", "0", "--format", "gcp", "-o", tmp_path / "out", *options)
    ran("rectify", image, "--height", "0", "-o", tmp_path / "ortho", *options)
    (ortho,) = (tmp_path / "ortho").glob("*_ortho.tif")
    assert (gdal.Open(str(ortho)).ReadAsArray() > 0).mean() > 0.3


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"X_DATASET": 'HDF5:"PRS_L1.he5"://HDFEOS/Longitude'}, "is not a file next to the image"),
        ({"X_DATASET": "../lon.tif", "Y_DATASET": "elsewhere.tif"}, "is not a file next to the image"),
        ({"PIXEL_STEP": "0"}, "PIXEL_STEP: .* is not a number"),
        ({"LINE_STEP": "nan"}, "LINE_STEP: .* is not a number"),
        ({"X_BAND": "2"}, "has no band 2"),
        ({"X_DATASET": "9" * 300}, "is not a file next to the image"),
        ({"SRS": "nonsense"}, "CRS of the arrays"),
        ({"PIXEL_OFFSET": "100000"}, "nodes have both a longitude"),
    ],
)
def test_what_is_refused(tmp_path: Path, fields: dict[str, str], said: str) -> None:
    arrays(tmp_path)
    image = named(pixels(tmp_path / "swath.tif", SIZE), step=4, centred=False, **fields)
    with pytest.raises(InputError, match=said) as caught:
        open_scene(image)
    assert (caught.value.file, "GeoTIFF" in caught.value.remedy) == (str(image), True)


def test_damaged_arrays_are_refused(tmp_path: Path) -> None:
    arrays(tmp_path)
    image = named(pixels(tmp_path / "swath.tif", SIZE), step=4, centred=False)
    dataset = gdal.Open(str(tmp_path / "lat.tif"), gdal.GA_Update)
    values = dataset.ReadAsArray()
    dataset.WriteArray(np.where(np.arange(values.size).reshape(values.shape) % 3 > 0, np.nan, values))
    dataset = None
    with pytest.raises(InputError, match="nodes have both a longitude and a latitude"):
        open_scene(image)


def test_matches_correct_what_the_arrays_say(tmp_path: Path) -> None:
    """Thirty-metre pixels that the arrays have 240 m off, as those of spectrometers are before control."""
    size, step, onto = (260, 220), 30.0, ground_transform("EPSG:32633", "EPSG:4979")
    random, corner = np.random.default_rng(4), np.array([300000.0, 4650000.0])
    tone = sum(gaussian_filter(random.normal(0, 1, (520, 600)), s) * s for s in (1.5, 4.0, 10.0))

    def grey(values: np.ndarray) -> np.ndarray:
        return np.clip(120 + 45 * values / tone.std() + random.normal(0, 3, values.shape), 1, 255).astype(np.uint8)

    def written(name: str, values: np.ndarray, grid: tuple[float, ...] | None = None) -> Path:
        kind = gdal.GDT_Byte if values.dtype == np.uint8 else gdal.GDT_Float64
        dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / name), *values.shape[::-1], 1, kind)
        if grid:
            dataset.SetGeoTransform(grid)
            dataset.SetProjection(pyproj.CRS("EPSG:32633").to_wkt())
        dataset.WriteArray(values)
        dataset = None
        return tmp_path / name

    reference = written("reference.tif", grey(tone), (corner[0], 15.0, 0.0, corner[1], 0.0, -15.0))
    column, row = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)

    def truth(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        x = corner[0] + 450.0 + step * (column + 0.06 * row)
        y = corner[1] - 200.0 - step * (row - 0.04 * column) - 300.0
        return np.stack([x, y], axis=-1)

    place = truth(column, row)
    written("swath.tif", grey(map_coordinates(
        tone, [(corner[1] - place[..., 1]) / 15.0 - 0.5, (place[..., 0] - corner[0]) / 15.0 - 0.5], order=1
    )))  # fmt: skip
    off = place.reshape(-1, 2) + np.array([200.0, -130.0])
    lon, lat, _ = onto(np.column_stack([off, np.zeros(len(off))])).T
    for name, values in (("lon.tif", lon), ("lat.tif", lat)):
        written(name, values.reshape(size[::-1]))
    files = {name: str(tmp_path / f"{name}.tif") for name in ("lon", "lat")}
    found = commands.fit(
        tmp_path / "swath.tif", PointOptions(correction="affine"), SceneOptions(sensor_options=files),
        SurfaceOptions(height=0.0), MatchOptions(reference=(reference,), points=25, search=400.0),
    )  # fmt: skip
    at = random.uniform(0.1, 0.9, (30, 2)) * size
    ground = onto(np.column_stack([truth(*at.T), np.zeros(30)]))
    left = found.fit.model.ground_to_image(ground) - at
    assert np.sqrt((left**2).sum(axis=1).mean()) < 0.2
    before = open_scene(tmp_path / "swath.tif", None, files).model.ground_to_image(ground) - at
    assert np.linalg.norm(before.mean(axis=0)) == pytest.approx(np.hypot(200.0, 130.0) / step, rel=0.05)
