"""What the record of a warp says of the memory that GDAL's geolocation arrays take."""

from __future__ import annotations

import pytest

from ortho_pipeline.warp.job import WarpRecord


@pytest.mark.parametrize(
    ("transformer", "memory", "told"),
    [("GEOLOC_ARRAY", 1_370_000_000, False), ("GEOLOC_ARRAY", 1_369_999_999, True), ("RPC", 1000, False),
     (None, 1000, False)],
)  # fmt: skip
def test_arrays_of_a_hundred_bytes_per_pixel_are_told_if_they_exceed_the_memory(
    transformer: str | None, memory: int, told: bool
) -> None:
    record = WarpRecord(max_error_px=0.0, tolerance_px=0.01, pixels=13_700_000, valid_pixels=5, transformer=transformer)
    found = record.notes(memory)
    assert [(notice.code, notice.fields["bytes"]) for notice in found] == [("memory-exceeded", 1_370_000_000)] * told
    assert all("1370 MB" in str(notice) and "1370:" in str(notice) for notice in found)
