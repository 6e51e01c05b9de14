"""`ortho rectify` as a step of GDAL's own pipelines."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.commands import rectify
from ortho_pipeline.options import OutputOptions, SurfaceOptions

gdal.UseExceptions()
needs_external = pytest.mark.skipif(
    int(gdal.VersionInfo("VERSION_NUM")) < 3130000, reason="GDAL has the step 'external' from 3.13 on"
)


def pipeline(tiny: Any, folder: Path, heights: str) -> Any:
    """Read a scene, let ortho make its ortho and write what comes of it."""
    out, result = folder / "out", folder / "result.tif"
    command = (
        f"{sys.executable} -m ortho_pipeline rectify <INPUT> {heights} --format GTiff -o {out} >&2 "
        f"&& cp {out}/*_ortho.tif <OUTPUT>"
    )
    steps = f'read {tiny.image} ! external "{command}" ! write {result}'
    with gdal.config_options({"GDAL_ENABLE_EXTERNAL": "YES", "CPL_TMPDIR": str(folder)}):
        gdal.Run("raster", "pipeline", pipeline=steps)
    return gdal.Open(str(result))


@needs_external
def test_the_ortho_goes_on_to_the_next_step(tiny: Any, tmp_path: Path) -> None:
    """The RPC of the scene is in the file that GDAL hands over; the report stays in the folder of the step."""
    made = pipeline(tiny, tmp_path, f"--dem {tiny.dem} --dem-vertical ellipsoid")
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    direct = rectify(tiny.image, tmp_path / "direct", surface=surface, output=OutputOptions(format="GTiff"))
    there = gdal.Open(str(direct.files["ortho"]))
    assert made.GetGeoTransform() == there.GetGeoTransform()
    np.testing.assert_array_equal(made.ReadAsArray(), there.ReadAsArray())
    assert len(list((tmp_path / "out").glob("*_report.json"))) == 1


@needs_external
def test_a_refusal_ends_the_pipeline(tiny: Any, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="error code 2"):
        pipeline(tiny, tmp_path, "")
    assert not (tmp_path / "result.tif").exists()
