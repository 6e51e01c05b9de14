"""Four real photos of a DJI Phantom 4 RTK: adjusted by their tags, compared with OpenDroneMap's reconstruction."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from ortho_windows import tapered, windows
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from ortho_pipeline import load_model
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.options import BlockOptions, MatchOptions, OutputOptions, SceneOptions, SurfaceOptions

pytestmark = [pytest.mark.realdata, pytest.mark.slow]
MAP = "EPSG:32651"


def shift(first: Path, second: Path) -> tuple[float, int]:
    """Return the length (px) of the median shift of windows of two orthos on one grid, and their number."""
    found = []
    for pair in windows(first, second, step=48):
        if pair[0].std() > 8:
            moved, *_ = phase_cross_correlation(*map(tapered, pair), upsample_factor=50, normalization=None)
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
