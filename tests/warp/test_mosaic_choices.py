"""Mosaics with a choice: brightness against known gains, seams against a path that is known to be the best."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
from click.testing import CliRunner
from osgeo import gdal
from scipy.ndimage import gaussian_filter

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.mosaic.assembly import mosaic
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import MosaicOptions
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.mosaic import (
    Balance,
    Ortho,
    along_seams,
    balanced,
    lay_out,
    overlaps,
    owners_of,
    seamlines,
    seams,
    write_cog,
    writing,
)

UTM = pyproj.CRS("EPSG:32635")
Box = tuple[int, int, int, int]


def texture(side: tuple[int, int], seed: int, *scales: float) -> np.ndarray:
    """Return a picture with detail of some sizes, standard deviation 1."""
    random = np.random.default_rng(seed)
    found = sum(gaussian_filter(random.normal(size=side), scale) * scale for scale in scales)
    return found / found.std()


GROUND = 900 + 150 * texture((400, 520), 1, 1.5, 4, 30)


def write(folder: Path, name: str, values: np.ndarray, left: int, top: int, valid: np.ndarray | None = None,
          dtype: str = "uint16", nodata: float | None = None) -> Ortho:  # fmt: skip
    """Write an ortho of values ``(bands, h, w)`` whose first pixel lies at a place of the ground."""
    values = np.atleast_3d(values.T).T
    count, height, width = values.shape
    valid = np.ones((height, width), dtype=bool) if valid is None else valid
    grid = Grid(UTM, 500000 + 2.0 * left, 4e6 - 2.0 * top, 2.0, 2.0, width, height)
    path = folder / f"{name}_ortho.tif"
    kind = "mask" if nodata is None else "nodata"
    with RasterWriter(path, grid, Profile(count, np.dtype(dtype), kind, nodata), driver="GTiff") as writer:
        writer.write(0, 0, np.where(valid, np.rint(values), nodata or 0).astype(dtype), valid)
    return Ortho(name, path)


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    dataset = gdal.Open(str(path))
    return dataset.ReadAsArray(), dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0


# -- brightness ------------------------------------------------------------------------------------------------------

#: Where orthos lie, and gain and offset by which each is too bright in two bands.
PLACES = {"a": (0, 0), "b": (180, 20), "c": (90, 150), "d": (300, 160)}
WRONG = {"a": [(1.0, 0.0), (1.2, -40.0)], "b": [(1.3, -90.0), (1.0, 30.0)], "c": [(0.8, 60.0), (0.9, 0.0)],
         "d": [(1.1, 25.0), (1.4, -200.0)]}  # fmt: skip


def quartet(folder: Path, *, clouds: str = "none", far: bool = False) -> list[Ortho]:
    """Write four orthos of two bands; a fifth lies far away.

    Clouds cover up to a third of an overlap, or as much as they like where they are saturated.
    """
    orthos = []
    for name, (left, top) in PLACES.items():
        part = GROUND[top : top + 240, left : left + 220]
        bands = np.stack([gain * part + offset for gain, offset in WRONG[name]])
        if clouds == "saturated" and name in "bc":
            bands[:, 20:70, 10:110] = 2500.0
        if clouds == "bright" and name in "bc":
            bands[:, 20:100, 10:60] = 2500.0 + np.random.default_rng(6).normal(0, 30, (80, 50))
        orthos.append(write(folder, name, bands, left, top))
    if far:
        orthos.append(write(folder, "far", np.full((2, 50, 50), 700.0), 5000, 0))
    return orthos


@pytest.mark.parametrize("clouds", ["none", "bright", "saturated"])
def test_gains_that_are_known_are_found(tmp_path, clouds):
    placed = lay_out(quartet(tmp_path, clouds=clouds, far=True), "first-on-top")
    found = balanced(placed, overlaps(placed))
    gains = np.array([[gain for gain, _ in WRONG[name]] for name in PLACES])
    offsets = np.array([[offset for _, offset in WRONG[name]] for name in PLACES])
    # Up to what is the same for all, the datum: gain times its inverse, and where zero is.
    common = found.gains[:4] * gains
    np.testing.assert_allclose(common / common.mean(axis=0), 1.0, atol=2e-3)
    zero = found.gains[:4] * offsets + found.offsets[:4]
    np.testing.assert_allclose(zero - zero.mean(axis=0), 0.0, atol=2.0)
    np.testing.assert_allclose(found.gains[:4].mean(axis=0), 1.0)
    np.testing.assert_allclose(found.offsets[:4].mean(axis=0), 0.0, atol=1e-6)
    # What nothing overlaps stays as it is.
    np.testing.assert_allclose(found.gains[4], 1.0)
    np.testing.assert_allclose(found.offsets[4], 0.0, atol=1e-6)
    assert (found.after < 0.5).all()
    assert (found.before > 50).all()
    assert (found.outlying > 0.05) == (clouds != "none")


@pytest.mark.parametrize("changed", [lambda seen: seen + 400, lambda seen: 0.6 * seen + 700])
def test_gains_are_found_where_almost_half_of_an_overlap_has_changed(tmp_path, changed):
    """What has changed keeps to a line of its own, which steps from any other start than the truth would take."""
    first, second = GROUND[:240, :320], 1.5 * GROUND[:240, 120:440] - 300
    second[:96, :200] = changed(second[:96, :200])
    placed = lay_out([write(tmp_path, "a", first, 0, 0), write(tmp_path, "b", second, 120, 0)], "first-on-top")
    found = balanced(placed, overlaps(placed))
    gain, offset = found.gains[:, 0], found.offsets[:, 0]
    assert gain[0] == pytest.approx(gain[1] * 1.5, rel=1e-3)
    assert offset[0] == pytest.approx(offset[1] - gain[1] * 300, abs=0.5)
    # Every cell with a changed pixel in it.
    assert found.outlying == pytest.approx(6 / 16, abs=1 / 32)


def test_orthos_without_an_overlap_have_no_difference_of_brightness(tmp_path):
    placed = lay_out([write(tmp_path, "a", GROUND[:50, :50], 0, 0), write(tmp_path, "b", GROUND[:50, :50], 60, 0)])
    found = balanced(placed, overlaps(placed))
    assert (found.before, found.after) == ([0.0], [0.0])
    np.testing.assert_allclose(found.gains, 1.0)


def test_an_offset_that_is_known_is_halved(tmp_path):
    """The second ortho is 50 brighter: 25 more for the first, 25 less for the second, and gains of 1."""
    first, second = GROUND[:240, :220], GROUND[:240, 100:320] + 50
    placed = lay_out([write(tmp_path, "a", first, 0, 0), write(tmp_path, "b", second, 100, 0)], "first-on-top")
    found = balanced(placed, overlaps(placed))
    np.testing.assert_allclose(found.gains, 1.0, atol=1e-3)
    np.testing.assert_allclose(found.offsets, [[25.0], [-25.0]], atol=1.0)
    np.testing.assert_allclose(found.before, 50.0, atol=0.01)
    np.testing.assert_allclose(found.after, 0.0, atol=0.05)
    assert found.outlying < 0.05


@pytest.mark.parametrize("nodata", [None, 0.0])
@pytest.mark.parametrize("offset", [10.7, -10.7, 0.4, -0.4])
def test_the_share_that_is_clamped_is_counted(tmp_path, offset, nodata):
    """A ramp of all bytes from 1 (0 where that is a value) to 255: an offset moves some beyond what rounding allows."""
    least = 0 if nodata is None else 1
    ramp = np.tile(np.arange(least, 256.0), (20, 1))
    placed = lay_out([write(tmp_path, "a", ramp, 0, 0, dtype="uint8", nodata=nodata)])
    balance = Balance(np.ones((1, 1)), np.full((1, 1), offset), np.zeros(1), np.zeros(1), 0, 0.0)
    share = write_cog(placed, tmp_path / "m.tif", balance=balance)
    assert share == pytest.approx((np.abs(ramp + offset - 127.5) > 128).mean())
    values, valid = read(tmp_path / "m.tif")
    assert valid.all()
    np.testing.assert_array_equal(values, np.clip(np.rint(ramp + offset), least, 255))


def test_a_balanced_mosaic_has_no_steps_and_clamps_what_does_not_fit(tmp_path):
    orthos = quartet(tmp_path)
    result = mosaic(
        [one.path for one in orthos],
        tmp_path / "m.tif",
        MosaicOptions(format="COG", balance=True, order="first-on-top"),
    )
    values, valid = read(tmp_path / "m.tif")
    balance = result.document["mosaic"]["balance"]
    for band in range(2):
        made = np.zeros(valid.shape)
        for name in reversed(PLACES):
            (left, top), scene = PLACES[name], balance["scenes"][name]
            own = read(tmp_path / f"{name}_ortho.tif")[0][band]
            place = slice(top, top + 240), slice(left, left + 220)
            made[place] = own * scene["gain"][band] + scene["offset"][band]
        np.testing.assert_array_equal(values[band][valid], np.floor(made + 0.5)[valid])
        # The mosaic is the ground but for one gain and one offset.
        ground = GROUND[: valid.shape[0], : valid.shape[1]][valid]
        fitted = np.polyval(np.polyfit(ground, values[band][valid], 1), ground)
        assert np.std(values[band][valid] - fitted) < 2.0
    assert balance["clamped_share"] == 0.0
    dark = [
        write(tmp_path, f"x{one.name}", read(one.path)[0] - 700.0 * (one.name == "a"), *PLACES[one.name], dtype="int16")
        for one in orthos
    ]
    bytes_of = [
        write(
            tmp_path,
            f"y{one.name}",
            np.clip(read(one.path)[0] / 5.0, 1, 255),
            *PLACES[one.name[1:]],
            dtype="uint8",
            nodata=0.0,
        )
        for one in dark
    ]
    result = mosaic([one.path for one in bytes_of], tmp_path / "n.tif", MosaicOptions(format="COG", balance=True))
    assert result.document["mosaic"]["balance"]["clamped_share"] > 0.0005
    assert (read(tmp_path / "n.tif")[0][:, read(tmp_path / "n.tif")[1]] > 0).all()


def test_orthos_that_do_not_look_alike_are_refused_by_name(tmp_path):
    one = write(tmp_path, "one", GROUND[:200, :200], 0, 0)
    other = write(tmp_path, "other", 900 + 150 * texture((200, 200), 7, 2, 20), 60, 0)
    other = write(tmp_path, "other", 0.02 * GROUND[:200, 60:260] + 500, 60, 0)
    placed = lay_out([one, other])
    with pytest.raises(InputError, match="gain") as caught:
        balanced(placed, overlaps(placed))
    assert caught.value.field == "mosaic.balance"


# -- seams -----------------------------------------------------------------------------------------------------------


def winding(height: int, width: int) -> np.ndarray:
    """Return a corridor, 17 px wide, that winds down through a field."""
    rows = np.arange(height)
    middle = width / 2 + 0.3 * width * np.sin(rows / 31.0) * np.cos(rows / 97.0)
    return np.abs(np.arange(width)[None] - middle[:, None]) <= 8.0


def test_a_seam_runs_where_it_is_known_to_be_best(tmp_path):
    """Two orthos differ everywhere in their overlap, but for a winding corridor."""
    first = GROUND[:300, :300].copy()
    second = GROUND[:300, 160:460].copy()
    random = np.random.default_rng(4)
    way = winding(300, 140)
    second[:, :140] += np.where(way, 0.0, random.choice([-1.0, 1.0], way.shape) * random.uniform(150, 300, way.shape))
    placed = lay_out([write(tmp_path, "a", first, 0, 0), write(tmp_path, "b", second, 160, 0)], "first-on-top")
    owners = owners_of(placed, None, seamlines=True)
    assert owners.cell == 1
    assert (owners.ordered[:, :300] == 0).all()
    labels = owners.owners[:, 160:300]
    edges = labels[:, 1:] != labels[:, :-1]
    assert (edges.sum(axis=1) >= 1).all()
    assert (way[:, 1:] | way[:, :-1])[edges].all()
    write_cog(placed, tmp_path / "m.tif", owners=owners)
    values, valid = read(tmp_path / "m.tif")
    assert valid.all()
    wanted = np.where(owners.owners == 0, np.pad(first, ((0, 0), (0, 160))), np.pad(second, ((0, 0), (160, 0))))
    np.testing.assert_array_equal(values, np.rint(wanted))


def test_a_seam_stays_within_its_reach_and_away_from_small_holes(tmp_path, monkeypatch):
    """The order's seam is the end of the first ortho, at column 300; far from it the first has a hole."""
    monkeypatch.setattr(seamlines, "_REACH", 20)
    random = np.random.default_rng(4)
    first, second = GROUND[:300, :300].copy(), GROUND[:300, 160:460].copy()
    second[:, :140] += random.choice([-1.0, 1.0], (300, 140)) * random.uniform(0, 300, (300, 140))
    valid = np.ones((300, 300), dtype=bool)
    valid[140:150, 190:200] = False
    orthos = [write(tmp_path, "a", first, 0, 0, valid), write(tmp_path, "b", second, 160, 0)]
    owners = owners_of(lay_out(orthos, "first-on-top"), None, seamlines=True)
    hole = np.zeros(owners.owners.shape, dtype=bool)
    hole[140:150, 190:200] = True
    np.testing.assert_array_equal(
        owners.owners == 1, (np.arange(460) >= 300) | hole | (owners.owners != owners.ordered)
    )
    columns = np.nonzero(owners.owners != owners.ordered)[1]
    assert len(columns) > 500
    assert 280 <= columns.min() <= columns.max() < 300


def scenes(folder: Path) -> list[Ortho]:
    """Write three overlapping orthos with ragged edges, holes, and things that only one of them shows."""
    orthos = []
    for number, (left, top) in enumerate([(0, 0), (150, 40), (60, 150)]):
        part = GROUND[top : top + 240, left : left + 250].copy()
        random = np.random.default_rng(number)
        for _ in range(25):
            row, column = random.integers(0, 225, 2)
            part[row : row + 12, column : column + 8] += random.choice([300.0, 500.0])
        valid = np.add.outer(np.arange(240), np.arange(250)) > 60
        valid[100:108, 120:135] = False
        orthos.append(write(folder, f"s{number}", part, left, top, valid))
    return orthos


def test_the_same_for_any_windows_and_no_pixel_is_lost(tmp_path, monkeypatch):
    placed = lay_out(scenes(tmp_path), "first-on-top")
    plain, owners = owners_of(placed, None, seamlines=False), owners_of(placed, None, seamlines=True)
    write_cog(placed, tmp_path / "plain.tif")
    write_cog(placed, tmp_path / "seams.tif", owners=owners)
    assert 0.01 < (owners.owners != plain.owners).mean() < 0.5
    known = read(tmp_path / "plain.tif")[1]
    np.testing.assert_array_equal(read(tmp_path / "seams.tif")[1], known)
    monkeypatch.setattr(seamlines, "_WINDOW", 61)
    monkeypatch.setattr(writing, "_WINDOW", 97)
    again = owners_of(placed, None, seamlines=True)
    np.testing.assert_array_equal(again.owners, owners.owners)
    write_cog(placed, tmp_path / "again.tif", owners=again)
    np.testing.assert_array_equal(read(tmp_path / "again.tif")[0], read(tmp_path / "seams.tif")[0])
    # Cells of several pixels: fewer choices, no pixel lost.
    monkeypatch.setattr(seamlines, "_CELLS", 20_000)
    coarse = owners_of(placed, None, seamlines=True)
    assert coarse.cell > 1
    write_cog(placed, tmp_path / "coarse.tif", owners=coarse)
    np.testing.assert_array_equal(read(tmp_path / "coarse.tif")[1], known)


def test_cells_of_the_most_accurate_ortho_are_the_same_for_any_windows(tmp_path, monkeypatch):
    """Two orthos, each more accurate in one half; without seams moved, each half has its own."""
    placed, half = [], np.arange(32) < 16
    for name, errors, left in (("a", (1.0, 4.0), 40), ("b", (2.0, 2.0), 40), ("c", (9.0, 9.0), 100)):
        ortho = write(tmp_path, name, GROUND[30:190, left : left + 320], left, 30)
        path = tmp_path / f"{name}_accuracy.tif"
        grid = Grid(UTM, 500000 + 2.0 * left, 4e6 - 60.0, 20.0, 20.0, 32, 16)
        with RasterWriter(path, grid, Profile(1, np.dtype("float32"), "nodata", math.nan), driver="GTiff") as writer:
            writer.write(0, 0, np.where(half, *errors)[None, None].repeat(16, axis=1).astype(np.float32), None)
        placed.append(dataclasses.replace(ortho, accuracy=path))
    mosaic_of = lay_out(placed, "most-accurate")
    for window in (1024, 61):
        monkeypatch.setattr(seamlines, "_WINDOW", window)
        owners = owners_of(mosaic_of, None, seamlines=False).owners
        wanted = np.repeat([0, 1, 2], [160, 160, 60])
        np.testing.assert_array_equal(owners, np.broadcast_to(wanted, owners.shape))


def test_along_the_seams_less_differs_than_before(tmp_path):
    placed = lay_out(scenes(tmp_path), "first-on-top")
    owners = owners_of(placed, None, seamlines=True)
    before = along_seams(placed, owners.ordered, owners.cell, None)
    after = along_seams(placed, owners.owners, owners.cell, None)
    assert set(before) == {("s0", "s1"), ("s0", "s2"), ("s1", "s2")}
    for pair in after:
        assert after[pair]["rms"][0] <= 0.5 * before[pair]["rms"][0]
    labels = owners.owners
    crossed = [
        (one != other) & (one >= 0) & (other >= 0)
        for one, other in ((labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1]))
    ]
    assert sum(found["length_px"] for found in after.values()) == sum(int(one.sum()) for one in crossed)
    # The worst place is never better than all together.
    assert all(np.greater_equal(found["largest_rms"], found["rms"]).all() for found in after.values())


def test_a_step_at_one_place_of_a_seam_is_told_beside_the_mean(tmp_path):
    """The right scene is 50 brighter in the upper sixth of the overlap, and the same below."""
    bright = GROUND[:240, 180:400].copy()
    bright[:40] += 50.0
    orthos = [write(tmp_path, "left", GROUND[:240, :220], 0, 0), write(tmp_path, "right", bright, 180, 0)]
    placed = lay_out(orthos, "first-on-top")
    owners = owners_of(placed, None, seamlines=True)
    (seam,) = along_seams(placed, owners.ordered, owners.cell, None).values()
    assert seam["largest_rms"] == [pytest.approx(50.0, abs=0.5)]
    assert seam["rms"][0] < 30.0
    said = mosaic([one.path for one in orthos], tmp_path / "m.tif", MosaicOptions(format="COG", seamlines=True))
    assert "in brightness (RMS; largest 5" in said.summary


@pytest.mark.parametrize("cell", [1, 4])
def test_the_figures_along_a_straight_seam_are_by_their_definitions(tmp_path, monkeypatch, cell):
    """The right scene is 30 brighter along a seam of 240 px, whatever the size of a cell.

    The displacements of its content at three places are given.
    """
    monkeypatch.setattr(seams, "_shifts", lambda *_: np.array([[3.0, 4.0], [0.0, 1.0], [0.0, 0.0]]))
    left, right = GROUND[:240, :220], GROUND[:240, 180:400] + 30.0
    placed = lay_out([write(tmp_path, "left", left, 0, 0), write(tmp_path, "right", right, 180, 0)], "first-on-top")
    labels = owners_of(placed, None, seamlines=False).owners[::cell, ::cell]
    (seam,) = along_seams(placed, labels, cell, None).values()
    assert seam["length_px"] == 240
    assert (seam["difference"], seam["rms"], seam["largest_rms"]) == ([-30.0], [30.0], [30.0])
    assert (seam["matched"], seam["median_px"], seam["largest_px"]) == (3, [0.0, 1.0], 5.0)
    assert seam["rmse_px"] == pytest.approx(math.sqrt(26 / 3))
    monkeypatch.setattr(seams, "_shifts", lambda *_: np.array([[3.0, 4.0]]))
    alike = Balance(np.ones((2, 1)), np.array([[0.0], [-30.0]]), np.zeros(1), np.zeros(1), 0, 0.0)
    (seam,) = along_seams(placed, labels, cell, alike).values()
    assert (seam["matched"], seam["median_px"], seam["rmse_px"], seam["largest_px"]) == (1, [3.0, 4.0], 5.0, 5.0)
    assert (seam["difference"], seam["rms"]) == ([0.0], [0.0])


@pytest.mark.parametrize("shift", [(0, 0), (3, -2)])
def test_content_beside_a_seam_is_measured_by_the_matcher(tmp_path, shift):
    """The second ortho shows the ground some columns and rows elsewhere, darker and with noise."""
    noise = np.random.default_rng(3).normal(0, 8, (280, 280))
    second = 0.7 * GROUND[20 - shift[1] : 300 - shift[1], 180 - shift[0] : 460 - shift[0]] + 200 + noise
    placed = lay_out(
        [write(tmp_path, "a", GROUND[20:300, 40:320], 40, 20), write(tmp_path, "b", second, 180, 20)], "first-on-top"
    )
    owners = owners_of(placed, None, seamlines=False)
    (found,) = along_seams(placed, owners.owners, owners.cell, None).values()
    assert found["matched"] >= 5
    np.testing.assert_allclose(found["median_px"], shift, atol=0.1)
    assert found["rmse_px"] == pytest.approx(np.hypot(*shift), abs=0.2)


# -- the command -----------------------------------------------------------------------------------------------------


def test_the_command_writes_mosaic_record_and_page(tmp_path):
    paths = [str(one.path) for one in quartet(tmp_path, clouds="bright")]
    out = tmp_path / "all" / "m.tif"
    asked = ["mosaic", *paths, "-o", str(out), "--order", "first-on-top", "--seamlines", "--balance"]
    done = CliRunner().invoke(cli, [*asked, "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert json.loads(out.with_suffix(".json").read_text()) == document["mosaic"]
    assert document["mosaic"]["on_top_first"] == list(PLACES)
    for seam in document["mosaic"]["seams"]:
        if seam["after"]:
            assert max(seam["after"]["rms"]) < 0.2 * max(seam["before"]["rms"])
    page = out.with_suffix(".html").read_text()
    assert "along the seams" in page.lower()
    assert '<path class="seam" d="M' in page
    said = CliRunner().invoke(cli, asked)
    assert "balance: overlaps differ by" in said.stdout
    vrt = CliRunner().invoke(cli, ["mosaic", *paths, "-o", str(tmp_path / "m.vrt")])
    assert vrt.exit_code == 0, vrt.output
    assert json.loads((tmp_path / "m.json").read_text())["balance"] is None


@pytest.mark.parametrize("name", ["mosaic", "mosaic.png", "mosaic.json"])
def test_the_name_of_a_mosaic_says_its_format(tmp_path, name):
    """A COG was written to mosaic.png."""
    path = write(tmp_path, "a", GROUND[:80, :80], 0, 0).path
    done = CliRunner().invoke(cli, ["mosaic", str(path), "-o", str(tmp_path / name)])
    assert done.exit_code == 2
    assert "a mosaic of the format COG needs a name that ends in .tif" in done.stderr
    assert not (tmp_path / name).exists()
    assert mosaic([path], tmp_path / "m.vrt").files["mosaic"].read_text().startswith("<VRTDataset")
    with pytest.raises(InputError, match=r"ends in \.vrt"):
        mosaic([path], tmp_path / "m.tif", MosaicOptions(format="VRT"))


def test_what_cannot_be_is_refused(tmp_path):
    one, other = (write(tmp_path, name, GROUND[:80, :80], 40 * k, 0) for k, name in enumerate("ab"))
    paths = [one.path, other.path]
    for field in ("seamlines", "balance"):
        with pytest.raises(InputError, match="VRT") as caught:
            mosaic(paths, tmp_path / "m.vrt", MosaicOptions(format="VRT", **{field: True}))
        assert caught.value.field == f"mosaic.{field}"
        assert not (tmp_path / "m.vrt").exists()
    with pytest.raises(InputError, match="orthos in its folder or below") as caught:
        mosaic(paths, tmp_path / "elsewhere" / "m.vrt", MosaicOptions(format="VRT"))
    assert caught.value.file == str(one.path)
    assert "a folder that contains all orthos" in str(caught.value.remedy)
    assert not (tmp_path / "elsewhere").exists()
    with pytest.raises(InputError, match="listed twice"):
        mosaic([*paths, one.path], tmp_path / "m.tif")
    with pytest.raises(InputError, match="both input and output"):
        mosaic(paths, one.path)
    palette = gdal.ColorTable()
    for name in "pq":
        dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"{name}.tif"), 50, 50, 1, gdal.GDT_Byte)
        dataset.SetGeoTransform((500000.0, 2.0, 0, 4e6, 0, -2.0))
        dataset.SetProjection(UTM.to_wkt())
        palette.SetColorEntry(3, (10, 20, 30, 255))
        dataset.GetRasterBand(1).SetColorTable(palette)
        dataset = None
    for field in ("seamlines", "balance"):
        with pytest.raises(InputError, match="palette"):
            mosaic(
                [tmp_path / "p.tif", tmp_path / "q.tif"],
                tmp_path / "m.tif",
                MosaicOptions(format="COG", **{field: True}),
            )


def test_the_accuracy_of_a_pixel_is_that_at_its_place_in_its_own_ortho(tmp_path, monkeypatch):
    """The second ortho begins 30 px right of the first and 10 px below; it is better in its first 20 columns.

    Where both are equally accurate, the first has the pixel.
    """
    placed = []
    for number, (left, top) in enumerate([(0, 0), (30, 10)]):
        name = "ab"[number]
        ortho = write(tmp_path, name, np.full((40, 60), 100.0 * (1 + number)), left, top)
        path, grid = tmp_path / f"{name}_accuracy.tif", Grid(UTM, 5e5 + 2.0 * left, 4e6 - 2.0 * top, 2.0, 2.0, 60, 40)
        errors = np.full((40, 60), 2.0, dtype=np.float32)
        if number:
            errors[:] = 3.0
            errors[:25, :20] = 1.0
            errors[25:28] = 2.0  # equal ones
        with RasterWriter(path, grid, Profile(1, np.dtype("float32"), "nodata", math.nan), driver="GTiff") as writer:
            writer.write(0, 0, errors[None], None)
        placed.append(dataclasses.replace(ortho, accuracy=path))
    wanted = np.zeros((50, 90))
    wanted[10:, 30:], wanted[:40, :60], wanted[10:35, 30:50] = 200.0, 100.0, 200.0
    for window in (2048, 17):
        monkeypatch.setattr(writing, "_WINDOW", window)
        write_cog(lay_out(placed, "most-accurate"), tmp_path / "m.tif")
        np.testing.assert_array_equal(read(tmp_path / "m.tif")[0], wanted)
