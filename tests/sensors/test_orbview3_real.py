"""The metadata of a real OrbView-3 scene: opened through the plugin, and mutated."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import numpy as np
import ortho_orbview3
import pytest
from ortho_orbview3.product import read_product, rpc_text_of
from osgeo import gdal

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.exchange.rpc import read_rpc
from ortho_pipeline.exchange.rpc_files import rpc_metadata
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import RPC
from ortho_pipeline.testing import check_sensor

pytestmark = pytest.mark.realdata
NAME = "3v050905p0000880351a520001100172m_001659557"
MUTATIONS = 600


@pytest.fixture
def label(real) -> Path:
    return real / "gdal" / "gcore" / "data" / "md_ov.pvl"


@pytest.fixture
def scene(label, tmp_path) -> Path:
    """A sparse image of the right size and name next to the real label and RPC text."""
    shutil.copy(label, tmp_path / f"{NAME}.pvl")
    shutil.copy(label.with_name("md_ov_rpc.txt"), tmp_path / f"{NAME}_rpc.txt")
    image = tmp_path / f"{NAME}.tif"
    options = ["SPARSE_OK=TRUE", "TILED=YES"]
    gdal.GetDriverByName("GTiff").Create(str(image), 8016, 27482, 1, gdal.GDT_UInt16, options).FlushCache()
    return image


def test_the_real_metadata_opens(scene):
    opened = check_sensor(next(iter(ortho_orbview3.ortho_sensors())), scene)
    assert open_scene(scene).sensor == "orbview3"
    facts = opened.facts
    assert (facts["satellite"], facts["camera"], facts["kind"]) == ("OV-3", "PAN", "panchromatic")
    assert facts["acquired"] == "2013-07-01T15:00:00Z"
    assert facts["pixel_spacing_m"] == 1.107625
    assert facts["line_spacing_m"] == 1.137198
    assert facts["slow_down_factor_at_full_line_rate"] == 1.249
    assert "cloud_cover_percent" not in facts
    assert facts["circular_error_m"] == 3.30387
    assert facts["orbit"] == "0000"
    assert not opened.warnings


def without_errors(rpc: RPC) -> dict[str, str]:
    """Return the fields without the error estimates, which the text rounds."""
    return {key: value for key, value in rpc_metadata(rpc).items() if not key.startswith("ERR")}


def test_label_and_text_agree_and_corners_are_pixel_centres(scene):
    product = read_product(scene.with_suffix(".pvl"))
    assert without_errors(product.rpc) == without_errors(read_rpc(rpc_text_of(scene)))
    assert np.abs(product.corner_misses).max() < 0.00231
    # Half a pixel further it would not be the centres.
    assert np.abs(product.corner_misses + 0.5).min() > 0.49


def mutated(text: str, random_: random.Random) -> str:
    letters = list(text)
    for _ in range(random_.randint(1, 3)):
        at, how = random_.randrange(len(letters)), random_.randrange(4)
        if how == 0:
            letters[at] = chr(random_.randrange(32, 127))
        elif how == 1:
            del letters[at : at + random_.randint(1, 50)]
        elif how == 2:
            letters.insert(at, random_.choice(["\0", "\n", "=", ";", "(", '"', "9" * 400, "1e400", "nan", "END", "ü"]))
        else:
            other = random_.randrange(len(letters))
            letters[at : at + 40] = letters[other : other + 40]
    whole = "".join(letters)
    return whole[: random_.randrange(len(whole))] if random_.random() < 0.2 else whole


def test_mutations_give_typed_errors_or_sound_models(label, tmp_path):
    text, random_, path = label.read_text(), random.Random(8), tmp_path / "mutated.pvl"
    true, sound, silent = without_errors(read_product(label).rpc), 0, 0
    refused: list[OrthoError] = []
    for _ in range(MUTATIONS):
        path.write_text(mutated(text, random_), encoding="utf-8")
        try:
            product = read_product(path)
        except OrthoError as error:
            refused.append(error)
            continue
        sound += 1
        centre, half = product.rpc.domain
        steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 3)
        assert np.isfinite(product.rpc.ground_to_image(centre + steps * half)).all()
        changed = without_errors(product.rpc) != true
        silent += changed and not any("contradicts" in one for one in ortho_orbview3._contradictions(product))
    assert len(refused) + sound == MUTATIONS
    assert len(refused) > 0.85 * MUTATIONS
    assert all(error.file == str(path) for error in refused)
    # A digit that changes in a coefficient cannot be seen in the label alone, unless it moves the corners.
    assert silent < 0.02 * MUTATIONS
