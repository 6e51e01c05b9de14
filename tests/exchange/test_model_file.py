"""Model files: what they hold is read again, and what is none is refused by its field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import SavedModel, read_model_file, write_model_file
from ortho_pipeline.models import FrameCamera
from ortho_pipeline.models.frame.camera import MAP
from ortho_pipeline.models.lens import Interior

GAUGE, POINTS, PARAMETERS = {"gauge": "free"}, {"points": [{"id": "a"}]}, {"parameters": {"col": {"value": 1.0}}}


def test_what_was_saved_is_read_again_to_the_last_bit(tiny: Any, tmp_path: Path) -> None:
    saved = SavedModel(tiny.model, "any", "a_RPC.TXT", (400, 300), {"adjustment": {**POINTS, **PARAMETERS}})
    write_model_file(saved, tmp_path / "a_model.json")
    again = read_model_file(tmp_path / "a_model.json")
    assert (again.sensor, again.model_source, again.size) == ("any", "a_RPC.TXT", (400, 300))
    assert again.provenance == saved.provenance
    ground = np.array([[20.003, -30.002, 512.0]])
    np.testing.assert_array_equal(again.model.ground_to_image(ground), tiny.model.ground_to_image(ground))


@pytest.mark.parametrize(
    ("adjustment", "counts"),
    [
        ({}, False), (POINTS, False), (GAUGE, False), (PARAMETERS, False), (POINTS | PARAMETERS, True),
        (GAUGE | PARAMETERS, True), (POINTS | GAUGE | PARAMETERS, True), ({"points": []} | PARAMETERS, False),
        (POINTS | {"parameters": {}}, False),
    ],
)  # fmt: skip
def test_a_model_is_adjusted_by_points_or_in_a_block(tiny: Any, adjustment: dict[str, Any], counts: bool) -> None:
    """Check points alone adjust no parameters."""
    assert SavedModel(tiny.model, provenance={"adjustment": adjustment}).adjusted == (adjustment if counts else None)
    assert SavedModel(tiny.model).adjusted is None


@pytest.mark.parametrize(
    ("change", "field", "said"),
    [
        *(({"size": size}, "size", "is not an image size")
          for size in ([0, 300], [400, -1], [400], [400, 300, 1], [400.0, 300], "400 x 300")),
        *(({"schema_version": version}, "schema_version", "unknown schema version") for version in (0, 2, None)),
        ({"document": "another"}, None, "not a model file"), ({"model": []}, None, "not a model file"),
    ],
)  # fmt: skip
def test_what_is_no_model_file_is_refused(tiny: Any, tmp_path: Path, change: Any, field: str | None, said: str) -> None:
    path = tmp_path / "a_model.json"
    write_model_file(SavedModel(tiny.model, size=(400, 300)), path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=said) as caught:
        read_model_file(path)
    assert (caught.value.file, caught.value.field) == (str(path), field)
    assert caught.value.remedy


@pytest.mark.parametrize(("omega", "sees"), [(0.0, True), (np.pi, False)])
def test_a_camera_that_looks_at_the_sky_is_refused(tmp_path: Path, omega: float, sees: bool) -> None:
    interior, exterior = Interior(1000, 668, 0.01, 1e-5, 1e-5), [300_000.0, 2_700_000.0, 2000.0, omega, 0.0, 0.0]
    model = FrameCamera.from_map(interior, "EPSG:32651", exterior, frame=MAP, heights=(0.0, 100.0))
    path = tmp_path / "a_model.json"
    write_model_file(SavedModel(model), path)
    if sees:
        assert read_model_file(path).model.height_range == pytest.approx((0.0, 100.0))
        return
    with pytest.raises(InputError, match=r"maps no ground|not finite") as caught:
        read_model_file(path)
    assert (caught.value.file, caught.value.field) == (str(path), "model")
