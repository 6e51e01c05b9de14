"""Four real photos of a DJI Phantom 4 RTK: adjusted by their tags, compared with OpenDroneMap's reconstruction."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ortho_windows import tapered, windows
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from ortho_pipeline import load_model, rectify
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.options import BlockOptions, MatchOptions, OutputOptions, SceneOptions, SurfaceOptions

pytestmark = [pytest.mark.realdata, pytest.mark.slow]
MAP = "EPSG:32651"
OUTPUT = OutputOptions(crs=MAP, resolution=0.15)


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


def adjusted(project: Path, folder: Path, **block: Any) -> tuple[dict[str, Any], dict[str, Path]]:
    """Adjust the photos by their tags alone; return the report and the orthos by image."""
    images = sorted((project / "images").glob("*.tif"))
    adjust(
        images,
        folder,
        BlockOptions(ties="auto", **block),
        SceneOptions(sensor="photo", sensor_options={"vertical": "ellipsoid"}),
        match=MatchOptions(search=10.0),
        surface=surface_of(project),
        orthos=OUTPUT,
    )
    report = json.loads((folder / "block_report.json").read_text())
    return report, {image.stem: folder / f"{image.stem}_ortho.tif" for image in images}


def surface_of(project: Path) -> SurfaceOptions:
    """Return OpenDroneMap's DSM."""
    return SurfaceOptions(dem=project / "odm_dem" / "dsm.tif", vertical="ellipsoid", fill="mask")


def check_places(project: Path, folder: Path, report: dict[str, Any]) -> None:
    """Compare the positions of the photos with those of OpenDroneMap."""
    to_map = ground_transform("EPSG:4979", MAP)
    sigma_odm = 0.045  # the accuracy of GPS in the reconstruction, gps_dop
    for name, wanted in of_odm(project).items():
        found = to_map([load_model(folder / f"{name}_model.json").perspective_centre])[0]
        parameters = report["adjustment"]["images"][name]["parameters"]
        sigmas = np.array([parameters[key]["sigma"] for key in ("X_L", "Y_L", "Z_L")])
        assert (np.abs(found - wanted) < 3 * np.hypot(sigmas, sigma_odm)).all(), name


def check_neighbours(orthos: dict[str, Path]) -> None:
    """Compare the orthos with each other."""
    pairs = [shift(one, other)[0] for one, other in itertools.combinations(orthos.values(), 2)]
    known = [value for value in pairs if np.isfinite(value)]
    assert len(known) >= 4
    assert max(known) < 1.0


def check_orthos(project: Path, folder: Path, orthos: dict[str, Path]) -> None:
    """Compare the orthos with those by OpenDroneMap's reconstruction."""
    for image in sorted((project / "images").glob("*.tif")):
        theirs = rectify(
            image,
            folder,
            scene=SceneOptions(sensor_options={"vertical": "ellipsoid"}),
            surface=surface_of(project),
            output=OUTPUT,
        )
        assert theirs.document["report"]["scene"]["sensor"] == "odm"
        assert shift(orthos[image.stem], theirs.files["ortho"])[0] < 2.0


def test_photos_by_their_tags_alone_fit_and_are_where_opendronemap_has_them(real, tmp_path):
    project = real / "orthority" / "odm"
    report, orthos = adjusted(project, tmp_path / "tags")
    check_places(project, tmp_path / "tags", report)
    check_neighbours(orthos)
    check_orthos(project, tmp_path / "odm", orthos)


def test_the_camera_is_that_of_opendronemap_within_its_sigmas(real, tmp_path):
    """OpenDroneMap had the whole flight, and square pixels. DJI states pixels that are 0.18 % higher than wide."""
    project = real / "orthority" / "odm"
    report, _ = adjusted(project, tmp_path, dem_heights="off")
    (theirs,) = json.loads((project / "opensfm" / "reconstruction.json").read_text())[0]["cameras"].values()
    longer = 5472e-6  # m: the longer side of the sensor; a photo does not state it, so 1 px counts as 1 µm
    wanted = {
        "focal_length": theirs["focal_x"] * longer,
        "x0": theirs["c_x"] * longer,
        "y0": -theirs["c_y"] * longer,
        "pitch_y": longer / theirs["width"],
        **{name: theirs[name] for name in ("k1", "k2", "k3", "p1", "p2")},
    }
    found = {one["name"]: one for one in report["adjustment"]["shared_parameters"]}
    assert set(found) == set(wanted)
    for name, value in wanted.items():
        assert abs(found[name]["value"] - value) < 3 * found[name]["sigma"], name
    assert found["pitch_y"]["chance"] < 0.001


def test_orthos_are_those_of_opendronemap_if_its_dsm_is_the_datum(real, tmp_path):
    """The DSM is from the reconstruction, so it has no bias and no shift. By default both are estimated."""
    project = real / "orthority" / "odm"
    report, orthos = adjusted(project, tmp_path / "tags", dem_bias=0.0, dem_shift_sigma=0.0)
    check_places(project, tmp_path / "tags", report)
    check_neighbours(orthos)
    check_orthos(project, tmp_path / "odm", orthos)
