"""Pairs of images for a stereo program, and odd lines of RPC texts: cases by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.errors import CoverageError, InputError
from ortho_pipeline.exchange.block_export import pairs_of
from ortho_pipeline.exchange.rpc_files import (
    read_rpc_text,
    rpc_metadata,
    rpc_of_fields,
    size_of_image,
    write_geom,
    write_rpc_txt,
)
from ortho_pipeline.models.base import SensorModel, as_ground

#: On the equator a degree of longitude is so many metres; one of latitude is a little less.
METRES = 6378137.0 * math.pi / 180
SIZE = (1000, 1000)


class Parallel(SensorModel):
    """Parallel rays, pixels of a metre, from so many metres east of a place; `slope` metres aside a metre of height."""

    kind = "parallel"

    def __init__(self, east: float, slope: float) -> None:
        self.east, self.slope = east, slope

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([(self.east + 500) / METRES, 0.0, 100.0]), np.array([0.006, 0.006, 100.0])

    def ground_to_image(self, ground: Any) -> np.ndarray:
        lon, lat, h = as_ground(ground).T
        return np.stack([lon * METRES - self.east + self.slope * h, 500 - lat * METRES], axis=1)


def pairs(*images: tuple[float, float]) -> list[Any]:
    models = {f"i{k}": (Parallel(*image), SIZE) for k, image in enumerate(images)}
    return pairs_of(models, 0.0)


def test_pairs_share_five_per_cent_of_an_image_and_differ_by_a_degree() -> None:
    (pair,) = pairs((0.0, 0.0), (500.0, math.tan(math.radians(20.0))))
    assert (pair.first, pair.second) == ("i0", "i1")
    assert pair.overlap == pytest.approx(0.5)
    assert pair.angle_deg == pytest.approx(20.0, abs=0.01)
    # Two of 32 columns of cells are 6 %, one is 3 %.
    slope = math.tan(math.radians(1.1))
    assert pairs((0.0, 0.0), (935.0, slope))[0].overlap == pytest.approx(2 / 32)
    with pytest.raises(CoverageError, match="no images overlap"):
        pairs((0.0, 0.0), (965.0, slope))
    with pytest.raises(CoverageError, match="differ by less than 1 degree"):
        pairs((0.0, 0.0), (0.0, math.tan(math.radians(0.9))))
    assert [(one.first, one.second) for one in pairs((0.0, 0.0), (0.0, slope), (5000.0, 0.0), (500.0, -slope))] == [
        ("i0", "i1"), ("i0", "i3"), ("i1", "i3")
    ]  # fmt: skip


def test_the_overlap_is_of_the_image_that_shares_more() -> None:
    small = (Parallel(0.0, 0.3), (250, 1000))
    for images in ({"a": (Parallel(0.0, 0.0), SIZE), "b": small}, {"a": small, "b": (Parallel(0.0, 0.0), SIZE)}):
        assert pairs_of(images, 0.0)[0].overlap == pytest.approx(1.0)


# -- RPC texts ---------------------------------------------------------------------------------------------------------


def test_lines_of_a_text_that_are_none_of_the_rpc_may_repeat(tiny: Any, tmp_path: Path) -> None:
    write_rpc_txt(tiny.model, tmp_path / "a_RPC.TXT")
    text = (tmp_path / "a_RPC.TXT").read_text()
    for more in ("remark: one\nremark: two\n", "remark\nremark\n", "LINE_OFF\n", text):
        (tmp_path / "b_RPC.TXT").write_text(more + text)
        found = read_rpc_text(tmp_path / "b_RPC.TXT")
        assert found.row_off == tiny.model.row_off
        np.testing.assert_array_equal(found.row_num, tiny.model.row_num)
    (tmp_path / "b_RPC.TXT").write_text(text.replace(": ", " = "))
    assert read_rpc_text(tmp_path / "b_RPC.TXT").h_off == tiny.model.h_off


@pytest.mark.parametrize(
    ("error", "known"), [("-1", None), ("0", 0.0), ("0.5", 0.5), ("nan", None), ("-nan", None), ("", None)]
)
def test_an_unknown_accuracy_is_no_number(tiny: Any, tmp_path: Path, error: str, known: float | None) -> None:
    write_rpc_txt(tiny.model, tmp_path / "a_RPC.TXT")
    lines = [line for line in (tmp_path / "a_RPC.TXT").read_text().splitlines() if not line.startswith("ERR")]
    (tmp_path / "a_RPC.TXT").write_text("\n".join([*lines, f"ERR_BIAS: {error} meters" if error else "ERR_BIAS:"]))
    assert read_rpc_text(tmp_path / "a_RPC.TXT").err_bias == known


@pytest.mark.parametrize(
    ("field", "value", "ok"),
    [("LAT_OFF", 90.0, True), ("LONG_OFF", -540.0, True), ("LAT_OFF", -90.1, False), ("LONG_OFF", 540.1, False)],
)
def test_an_rpc_is_on_earth(tiny: Any, field: str, value: float, ok: bool) -> None:
    fields = {**rpc_metadata(tiny.model), field: repr(value)}
    if ok:
        rpc_of_fields(fields)
    else:
        with pytest.raises(InputError, match="on Earth") as caught:
            rpc_of_fields(fields)
        assert caught.value.field == field


def test_a_geom_file_states_the_size_of_its_image(tiny: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.geom"
    write_geom(tiny.model, (400, 300), path)
    assert size_of_image(path) == (400, 300)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("number_lines")))
    assert size_of_image(path) is None
    path.write_text("\n".join([*lines, "adjustment_0.adj_param_0.parameter:  0.0"]))
    assert read_rpc_text(path).h_off == tiny.model.h_off
    path.write_text("\n".join([*lines, "adjustment_0.adj_param_0.parameter:  0.25"]))
    with pytest.raises(InputError, match="adjustment"):
        read_rpc_text(path)
