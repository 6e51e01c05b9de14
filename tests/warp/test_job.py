"""What a job of the warp asks for."""

from __future__ import annotations

from typing import Any

import pytest

from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.warp import job


@pytest.mark.parametrize(("wanted", "startable", "threads"), [(3, 99, 3), (3, 5, 2), (3, 1, 1), (1, 99, 1), (1, 1, 1)])
def test_tiles_have_the_threads_that_are_asked_for_if_gdal_can_have_as_many(
    monkeypatch: pytest.MonkeyPatch, wanted: int, startable: int, threads: int
) -> None:
    monkeypatch.setattr(job, "startable_threads", lambda asked: min(asked, startable))
    new: Any = job.WarpJob
    assert new(None, None, None, None, resources=Resources(threads=wanted)).threads() == threads
