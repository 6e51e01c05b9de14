"""Orthos of which a part is displaced, as a wrong tile of a mosaic is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from pairs import Pair

from ortho_pipeline.commands.orthos.aligning import align
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.imaging.matching import SceneView, open_references
from ortho_pipeline.imaging.matching.agreement import said_of_parts
from ortho_pipeline.imaging.matching.sight import displaced_parts
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.flat import FlatSurface

SIDE, FROM = 240, 180


def written(folder: Path, moved: int, first: int = FROM) -> tuple[Path, Path]:
    """Write an ortho whose columns from the `first` on show things `moved` pixels too far down, and its reference."""
    ortho, reference = Pair(side=SIDE, seed=11).write(folder)
    opened = gdal.Open(str(ortho), gdal.GA_Update)
    pixels = opened.ReadAsArray()
    pixels[:, first:] = np.roll(pixels[:, first:], moved, axis=0)
    opened.GetRasterBand(1).WriteArray(pixels)
    return ortho, reference


@pytest.mark.parametrize("moved", [0, 1, 4, 15])
def test_rejected_chips_that_agree_elsewhere_are_a_displaced_part(tmp_path, moved):
    ortho, reference = written(tmp_path, moved)
    view = SceneView(Intensity(RasterSource(ortho)), open_ortho(ortho, SceneOptions()).model, FlatSurface(0.0))
    columns, rows = np.meshgrid(np.arange(24.0, SIDE - 20, 16), np.arange(24.0, SIDE - 20, 16))
    centres = np.column_stack([columns.ravel(), rows.ravel()])
    reason = np.where(columns.ravel() < FROM - 20, "", "weak")
    references = open_references([str(reference)])
    index, offset, covariance = displaced_parts(view, references, centres, reason, 1, 40.0, 1)
    assert len(index) == len(offset) == len(covariance)
    if moved:
        # Chips that are mostly left of the edge agree with the rest.
        assert set(np.flatnonzero(columns.ravel() > FROM + 10)) <= set(index.tolist())
        # The part shows things too low: the map grid puts them higher up.
        assert np.abs(np.median(offset, axis=0) - [0.0, -moved]).max() < 0.02
    else:
        assert not len(index)


def test_places_that_change_alike_all_over_are_no_part(tmp_path):
    # Hedges and shadows of another season do, and 51 of 2,171 chips were a part that is displaced by 0.5 px.
    ortho, reference = Pair(side=SIDE, seed=11).write(tmp_path)
    opened = gdal.Open(str(ortho), gdal.GA_Update)
    pixels = opened.ReadAsArray()
    columns, rows = np.meshgrid(np.arange(24.0, SIDE - 20, 16), np.arange(24.0, SIDE - 20, 16))
    centres = np.column_stack([columns.ravel(), rows.ravel()])
    changed = (centres % 64 == 24).all(axis=1)
    moved = np.roll(pixels, 4, axis=0)
    for column, row in centres[changed].astype(int):
        place = slice(row - 24, row + 24), slice(column - 24, column + 24)
        pixels[place] = moved[place]
    opened.GetRasterBand(1).WriteArray(pixels)
    opened = None
    view = SceneView(Intensity(RasterSource(ortho)), open_ortho(ortho, SceneOptions()).model, FlatSurface(0.0))
    references = open_references([str(reference)])
    index, _, _ = displaced_parts(view, references, centres, np.where(changed, "weak", ""), 1, 40.0, 1)
    assert changed.sum() == 16
    assert not len(index)


@pytest.mark.parametrize("moved", [3, 12])
def test_a_displaced_part_is_in_the_accuracy(tmp_path, moved):
    # Matches there were left out as contradicting or ambiguous, and CE90 was 0.004 m.
    ortho, reference = written(tmp_path, moved)
    match, output = MatchOptions(reference=[str(reference)]), OutputOptions(threads=1)
    document = verify(ortho, match=match, output=output).document
    relative, matches = document["relative"], document["matches"]
    # The edge is between matches, which lie 10 m apart: the displaced area is known to 2 x 10 m of 240 m.
    share = (SIDE - FROM) / SIDE
    low, high = (moved * np.sqrt(share + side * 20 / SIDE) for side in (-1, 1))
    assert low < relative["rmse_m"]["value"] < high
    assert relative["ce90_m"]["value"] == pytest.approx(moved, rel=0.15)
    assert matches["kept"] + sum(matches["reasons"].values()) == matches["tried"]
    notice = next(one for one in document["notices"] if one["code"] == "ortho-part-displaced")
    assert notice["displaced_m"] == pytest.approx(moved, abs=0.5)
    assert "mostly in the right part of the image" in notice["text"]
    # A model that was not adjusted was named as well.
    assert {cause["code"] for cause in document["causes"]} <= {"step"}


@pytest.mark.parametrize(
    ("far", "said"),
    [([0.31, 0.33], "0.32 m from"), ([12.2] * 9, "12 m from"), ([2.0, 2.1, 9.0, 9.1], "2 to 9.1 m from")],
)
def test_displacements_have_their_own_digits(far, said):
    # Those of a drone's ortho were "0 m", and parts that had moved differently had one length.
    assert said in said_of_parts(np.zeros((3, 2)), np.ones((len(far), 2)), np.array(far))


@pytest.mark.parametrize("side", [SIDE, 400])
def test_a_small_part_is_in_the_rmse_and_not_in_the_ce90(tmp_path, side):
    # With a side of 60 px it was smaller than a chip of the coarsest search, and was not found.
    # A smooth field rounded its edges: RMSE was 0.93 m (0.89 to 0.97), and CE90 0.8 m.
    ortho, reference = Pair(side=side, seed=11, patch=(5.0, 0.0)).write(tmp_path)
    found = verify(ortho, match=MatchOptions(reference=[str(reference)], points=300)).document["relative"]
    true = 5.0 / 4
    assert found["rmse_m"]["value"] == pytest.approx(true, rel=0.15)
    assert found["rmse_m"]["low"] < true < found["rmse_m"]["high"]
    assert found["bias_east_m"]["low"] < 5.0 / 16 < found["bias_east_m"]["high"]
    assert found["ce90_m"]["value"] < 0.02


@pytest.mark.parametrize(("moved", "first", "search"), [(10, SIDE - 70, 11.0), (45, FROM, 60.0)])
def test_align_says_what_it_cannot_correct(tmp_path, moved, first, search):
    ortho, reference = written(tmp_path, moved, first)
    match = MatchOptions(reference=[str(reference)], search=search, points=80)
    done = align(ortho, tmp_path / "out", match=match, output=OutputOptions(threads=1, resampling="cubic")).document
    # A field bends too little for the edge, and a shift between both parts is right in none.
    assert done["correction"]["kind"] == "shift"
    assert np.abs(done["correction"]["shift_px"]).max() < 0.02
    # The result was searched within 30 px only, and had a CE90 of 0.003 m.
    for accuracy in (done["before"], done["relative"]):
        assert accuracy["ce90_m"]["value"] == pytest.approx(moved, rel=0.15)
