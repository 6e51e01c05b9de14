"""Orthos of which a part is displaced farther than single matches are searched, as a wrong tile of a mosaic is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from pairs import Pair

from ortho_pipeline.commands.orthos.aligning import align
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging.matching import SceneView, open_references
from ortho_pipeline.imaging.matching.sight import displaced_part
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.flat import FlatSurface

SIDE, FROM, MOVED = 240, 180, 15


def written(folder: Path, moved: int) -> tuple[Path, Path]:
    """Write an ortho whose right quarter shows things `moved` pixels too far down, and its reference."""
    ortho, reference = Pair(side=SIDE, seed=11).write(folder)
    opened = gdal.Open(str(ortho), gdal.GA_Update)
    pixels = opened.ReadAsArray()
    pixels[:, FROM:] = np.roll(pixels[:, FROM:], moved, axis=0)
    opened.GetRasterBand(1).WriteArray(pixels)
    return ortho, reference


@pytest.mark.parametrize("moved", [0, MOVED])
def test_chips_that_agree_elsewhere_are_a_displaced_part(tmp_path, moved):
    ortho, reference = written(tmp_path, moved)
    view = SceneView(Intensity(RasterSource(ortho)), open_ortho(ortho, SceneOptions()).model, FlatSurface(0.0))
    columns, rows = np.meshgrid(np.arange(24.0, SIDE - 20, 16), np.arange(24.0, SIDE - 20, 16))
    centres = np.column_stack([columns.ravel(), rows.ravel()])
    reason = np.where(columns.ravel() < FROM - 20, "", "weak")
    said = displaced_part(view, open_references([str(reference)]), centres, reason, 1, 40.0, 1)
    assert (f"{MOVED} m from there, mostly in the right part" in said) if moved else not said


@pytest.mark.slow
def test_such_an_ortho_has_no_accuracy(tmp_path):
    ortho, reference = written(tmp_path, MOVED)
    match, output = MatchOptions(reference=[str(reference)]), OutputOptions(threads=1)
    with pytest.raises(InputError, match=r"displaced: .* 15 m from there"):
        verify(ortho, match=match, output=output)
    with pytest.raises(InputError, match="displaced: "):
        align(ortho, tmp_path / "out", match=match, output=output)
