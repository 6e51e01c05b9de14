"""Four real photos of a DJI Phantom 4 RTK: adjusted by their tags alone, next to OpenDroneMap's reconstruction."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from ortho_pipeline import load_model
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.options import BlockOptions, MatchOptions, OutputOptions, SceneOptions, SurfaceOptions

pytestmark = [pytest.mark.realdata, pytest.mark.slow]
SIDE, STEP, MAP = 64, 48, "EPSG:32651"


def read(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    dataset = gdal.Open(str(path))
    shown = dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    return dataset.ReadAsArray()[:3].astype(float).mean(axis=0), shown, dataset.GetGeoTransform()


def shift(first: Path, second: Path) -> tuple[float, int]:
    """Return the length (px) of the median shift of windows of two orthos on one grid, and their number."""
    (one, shown, place), (other, shown_too, there) = read(first), read(second)
    right, down = round((there[0] - place[0]) / place[1]), round((there[3] - place[3]) / place[5])
    found, taper = [], np.outer(np.hanning(SIDE), np.hanning(SIDE))
    rows = range(max(0, down), min(one.shape[0], other.shape[0] + down) - SIDE, STEP)
    columns = range(max(0, right), min(one.shape[1], other.shape[1] + right) - SIDE, STEP)
    for row, column in itertools.product(rows, columns):
        here = np.s_[row : row + SIDE, column : column + SIDE]
        far = np.s_[row - down : row - down + SIDE, column - right : column - right + SIDE]
        if shown[here].all() and shown_too[far].all() and one[here].std() > 8:
            windows = [(part - part.mean()) * taper for part in (one[here], other[far])]
            moved, *_ = phase_cross_correlation(*windows, upsample_factor=50, normalization=None)
            found.append(moved[::-1])
    return (float(np.hypot(*np.median(found, axis=0))), len(found)) if len(found) >= 10 else (np.nan, len(found))


def of_odm(project: Path) -> dict[str, np.ndarray]:
    """Return OpenDroneMap's positions, along the axes of UTM as it uses them."""
    part = json.loads((project / "opensfm" / "reconstruction.json").read_text())[0]
    place = part["reference_lla"]
    corner = ground_transform("EPSG:4979", MAP)([[place[key] for key in ("longitude", "latitude", "altitude")]])[0]
    return {
        name: corner - Rotation.from_rotvec(shot["rotation"]).as_matrix().T @ shot["translation"]
        for name, shot in part["shots"].items()
    }


def test_photos_by_their_tags_alone_fit_and_are_where_opendronemap_has_them(real, tmp_path):
    project = real / "orthority" / "odm"
    images = sorted((project / "images").glob("*.tif"))
    surface = SurfaceOptions(dem=project / "odm_dem" / "dsm.tif", vertical="ellipsoid", fill="mask")
    output = OutputOptions(crs=MAP, resolution=0.15)
    adjust(
        images,
        tmp_path / "tags",
        BlockOptions(ties="auto"),
        SceneOptions(sensor="photo", sensor_options={"vertical": "ellipsoid"}),
        match=MatchOptions(search=10.0, points=150),
        surface=surface,
        orthos=output,
    )
    report = json.loads((tmp_path / "tags" / "block_report.json").read_text())
    to_map = ground_transform("EPSG:4979", MAP)
    sigma_odm = 0.045  # the accuracy of GPS in the reconstruction, gps_dop
    for name, wanted in of_odm(project).items():
        found = to_map([load_model(tmp_path / "tags" / f"{name}_model.json").perspective_centre])[0]
        parameters = report["adjustment"]["images"][name]["parameters"]
        sigmas = np.array([parameters[key]["sigma"] for key in ("X_L", "Y_L", "Z_L")])
        assert (np.abs(found - wanted) < 3 * np.hypot(sigmas, sigma_odm)).all(), name
    orthos = {name: tmp_path / "tags" / f"{name}_ortho.tif" for name in of_odm(project)}
    pairs = [shift(orthos[one], orthos[other])[0] for one, other in itertools.combinations(orthos, 2)]
    known = [value for value in pairs if np.isfinite(value)]
    assert len(known) >= 4
    assert max(known) < 1.0
