"""Images that were cut out of others (ICHIPB): their pixels are where the corners of both images say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata, rpc_of_dataset
from ortho_pipeline.models import RPC

gdal.UseExceptions()
#: Row and column of the middles of the corner pixels of a chip of 100 x 80 pixels, by their numbers in STDI-0002.
CORNERS = {"11": (0.5, 0.5), "12": (0.5, 99.5), "21": (79.5, 0.5), "22": (79.5, 99.5)}
Place = tuple[float, float]


def full_image() -> RPC:
    one, column, row = np.eye(20)[0], np.zeros(20), np.zeros(20)
    column[[1, 3, 7]], row[[2, 3, 8]] = (1.0, 0.2, 1e-3), (-1.0, 0.1, -2e-3)
    return RPC(500.0, 400.0, 20.0, -30.0, 500.0, 500.0, 400.0, 0.05, 0.04, 300.0, column, one, row, one)


def chip(full: Callable[[float, float], Place], **changes: str | None) -> gdal.Dataset:
    """Return a chip of which each (row, column) is `full` of it in the full image; changes are to the metadata."""
    stated: dict[str, str | None] = {"NITF_ABPP": "08"}
    for name, (row, column) in CORNERS.items():
        for of, place in (("OP", (row, column)), ("FI", full(row, column))):
            stated |= {f"ICHIP_{of}_{axis}_{name}": f"{at:.3f}" for axis, at in zip(("ROW", "COL"), place, strict=True)}
    dataset = gdal.GetDriverByName("MEM").Create("", 100, 80)
    dataset.SetMetadata(rpc_metadata(full_image()), "RPC")
    dataset.SetMetadata({name: text for name, text in (stated | changes).items() if text is not None})
    return dataset


@pytest.mark.parametrize(("factor", "row", "column"), [(1.0, 40.0, 60.0), (2.0, 110.5, 7.25), (0.5, -3.0, 0.0)])
def test_a_chip_is_shifted_and_scaled(factor: float, row: float, column: float) -> None:
    found, _ = rpc_of_dataset(chip(lambda r, c: (row + factor * r, column + factor * c)))
    ground = np.array([[20.01, -30.02, 600.0], [19.97, -29.99, 350.0], [20.0, -30.0, 500.0]])
    expected = (full_image().ground_to_image(ground) - (column, row)) / factor
    np.testing.assert_allclose(found.ground_to_image(ground), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("full", "changes"),
    [
        (lambda r, c: (r, 500.0 - c), {}), (lambda r, c: (500.0 - r, 500.0 - c), {}), (lambda r, c: (c, r), {}),
        (lambda r, c: (r, 2 * c), {}), (lambda r, c: (2 * r, c), {}), (lambda r, c: (r, c + 0.01 * r), {}),
        (lambda r, c: (r, c), {"ICHIP_FI_COL_21": "0.800"}), (lambda r, c: (r, c), {"ICHIP_FI_ROW_12": "0.200"}),
        (lambda r, c: (r, c), {"ICHIP_FI_ROW_22": None}), (lambda r, c: (r, c), {"ICHIP_OP_COL_11": None}),
        (lambda r, c: (r, c), {"ICHIP_FI_COL_11": "unknown"}),
    ],
)  # fmt: skip
def test_a_chip_that_is_turned_stretched_or_not_described_is_refused(
    full: Callable[[float, float], Place], changes: dict[str, str | None]
) -> None:
    with pytest.raises(InputError, match="cut out of another") as caught:
        rpc_of_dataset(chip(full, **changes))
    assert caught.value.field == "ICHIPB"


@pytest.mark.parametrize(("off", "sound"), [(0.009, True), (-0.009, True), (0.011, False), (-0.011, False)])
def test_corners_may_be_off_by_a_hundredth_of_a_pixel(off: float, sound: bool) -> None:
    """The columns of the left corners, in opposite directions: a shear that leaves shift and scale as they are."""
    changes = {"ICHIP_FI_COL_11": f"{60.5 + off:.3f}", "ICHIP_FI_COL_21": f"{60.5 - off:.3f}"}
    dataset = chip(lambda r, c: (40 + r, 60 + c), **changes)
    if sound:
        ground = np.array([[20.01, -30.02, 600.0]])
        expected = full_image().ground_to_image(ground) - (60, 40)
        np.testing.assert_allclose(rpc_of_dataset(dataset)[0].ground_to_image(ground), expected, atol=1e-6)
    else:
        with pytest.raises(InputError, match="cut out of another"):
            rpc_of_dataset(dataset)
