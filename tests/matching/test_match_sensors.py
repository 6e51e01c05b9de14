"""Scenes without RPC are matched, too: a frame, a line scanner from metadata alone, an image rectified to a plane."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
PAN = "po_39001_pan_0000000.tif"
#: By sensor: the image that becomes the reference, points, the files of the scene, the model that these alone make, its
#: correction, and within how many pixels measured points have it.
SCENES = {
    "cartosat": ("BANDA.tif", "points.csv", ("BANDF.tif", "BANDF_MET.TXT"), "pushbroom", "affine", 0.8),
    "ikonos": (PAN, "gcps.csv", (PAN, "po_39001_metadata.txt"), "geo", "affine", 0.15),
    "bilsat": ("bilsat.tif", "gcps.csv", ("bilsat.tif", "bilsat_survey.txt"), "rigorous", "model", 1.1),
}


def ortho(*words: object) -> dict:
    done = CliRunner().invoke(cli, [*map(str, words), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    "sensor", ["bilsat", *(pytest.param(name, marks=pytest.mark.slow) for name in list(SCENES)[:2])]
)
def test_scenes_without_rpc_are_matched(tmp_path: Path, sensor: str) -> None:
    """Adjusted to an ortho of the other image of the pair, else of the image itself, models lie where points have them.

    These took no part; they were measured to 0.5 px per axis in CARTOSAT's images, 0.7 px in BILSAT's, 0.06 in IKONOS'.
    """
    other, points, files, name, correction, within = SCENES[sensor]
    folder, scene = SAMPLE / sensor, tmp_path / "scene"
    scene.mkdir()
    for file in files:
        shutil.copy(folder / file, scene)
    dem, measured = ("--dem", folder / "dem.tif"), ("--gcps", folder / points)
    made = ortho("rectify", folder / other, *measured, *dem, "-o", tmp_path / "other",
                 *(("--correction", "model") if sensor == "bilsat" else ()))  # fmt: skip
    assert list(ortho("info", scene / files[0])["models"]) == [name]
    found = ortho("fit", scene / files[0], "--reference", made["files"]["ortho"], *dem, *measured,
                  "--match-points", 100, "--correction", correction)  # fmt: skip
    assert sum(point["used"] for point in found["points"]) >= 40  # of 62 places with texture at least
    assert found["rmse"]["check"]["n"] >= 20
    assert found["rmse"]["check"]["total"] < within
