"""Matching over grounds of known truth: how exact, how often, how honest, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trials
from osgeo import gdal
from scenes import Case, Setting, View, lonlat, write_raster
from scipy import ndimage
from trials import Outcome, good_texture, grounds, matches, refusals, run, tried

from ortho_pipeline.errors import CrsError, OrthoError
from ortho_pipeline.imaging import matching
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.dem import open_dem

#: What the default run has: grounds that are there without real images.
PLAIN = Setting(side=500, seed=3, error=12.0)


def told(rows):
    """Return the rows as text, for a test that fails."""
    return "\n".join(trials.line(row) for row in rows)


def outcome(tmp_path, points=500, **changes) -> Outcome:
    return tried(Case(replace(PLAIN, **changes), tmp_path).write(), points=points)


def rms(rows) -> float:
    return math.sqrt(float(np.mean([row["rms"] ** 2 for row in rows])))


# -- exact -------------------------------------------------------------------------------------------------------------


def test_matches_over_good_texture_are_within_015_px_of_the_truth():
    rows = run(good_texture(1, ("country",)), points=150)
    assert all(row["succeeded"] for row in rows), told(rows)
    assert rms(rows) < 0.15, told(rows)


@pytest.mark.slow
def test_matches_over_all_good_textures_are_within_015_px_of_the_truth():
    rows = run(good_texture(20))
    assert all(row["succeeded"] for row in rows), told(rows)
    assert rms(rows) < 0.15, told(rows)


@pytest.mark.parametrize("change", [
    pytest.param({"pushbroom": False, "heading_deg": 100.0}, marks=pytest.mark.slow),
    pytest.param({"scene": View(dtype="uint8"), "reference": View(bands="aba")}, marks=pytest.mark.slow),
    {"scene": View(holes=0.15), "reference": View(holes=0.1), "reference_crs": "EPSG:3857"},
    pytest.param({"reference": View(season=1)}, marks=pytest.mark.slow),
    {"error": 90.0, "kind": "affine", "margin": 110.0},
], ids="+".join)  # fmt: skip
def test_what_scene_and_reference_are_like_does_not_matter(tmp_path, change):
    found = outcome(tmp_path, points=150, **change)
    assert found.succeeded, found
    assert found.off < 0.3, found


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "changes"), [(6.0, {"side": 900, "fine": 1.2}), (1 / 6, {"side": 360, "fine": 1.0})])
def test_a_reference_may_be_six_times_coarser_or_finer(tmp_path, ratio, changes):
    found = outcome(tmp_path, ratio=ratio, **changes)
    assert found.succeeded, found
    assert found.off < 0.05, found


@pytest.mark.slow
def test_a_reference_may_be_in_parts(tmp_path):
    """As a VRT of two files, and as two files, one of which lies in another zone."""
    case = Case(replace(PLAIN, side=400), tmp_path).write()
    whole, parts = gdal.Open(str(case.reference_file)), [tmp_path / "west.tif", tmp_path / "east.tif"]
    half = whole.RasterXSize // 2
    for path, left in zip(parts, (0, half), strict=True):
        width = half if left == 0 else whole.RasterXSize - half
        gdal.Translate(str(path), whole, srcWin=[left, 0, width, whole.RasterYSize]).FlushCache()
    gdal.BuildVRT(str(tmp_path / "both.vrt"), [str(path) for path in parts]).FlushCache()
    zone = tmp_path / "zone.tif"
    gdal.Warp(str(zone), str(parts[1]), dstSRS="EPSG:32734", resampleAlg="cubic", dstNodata=0).FlushCache()
    for references in ([tmp_path / "both.vrt"], [parts[0], zone]):
        found = tried(case, references)
        assert found.succeeded, found
        assert found.found > 250, found
        assert found.off < 0.05, found


@pytest.mark.slow
def test_stripes_of_a_detector_do_not_attract_matches(tmp_path):
    found = outcome(tmp_path, scene=View(stripes=0.1), heading_deg=180.0)
    assert found.refused or found.off < 0.3, found


def test_matches_do_not_depend_on_threads(tmp_path):
    case = Case(PLAIN, tmp_path).write()
    surface = open_dem(case.dem_file, "ellipsoid")
    one, two = (
        matches(case.scene_file, case.model, surface, [case.reference_file], search=30.0, points=40, threads=count)
        for count in (1, 2)
    )
    assert one.ids == two.ids
    np.testing.assert_array_equal(one.image, two.image)
    np.testing.assert_array_equal(one.ground, two.ground)
    np.testing.assert_array_equal(one.sigma_image, two.sigma_image)


def test_chips_show_the_same_where_it_was_found(tmp_path):
    # A reference that errs from place to place, or all chips would lie within a hundredth of a pixel of each other.
    case = Case(replace(PLAIN, reference_sigma=0.5, reference_length=80.0), tmp_path).write()
    seen = matching.SceneView(
        Intensity(RasterSource(case.scene_file)), case.model, open_dem(case.dem_file, "ellipsoid")
    )  # fmt: skip
    settings = matching.MatchSettings(search=30.0, points=60, threads=1)
    found = matching.match(seen, matching.open_references([case.reference_file]), settings)
    kept = found.reason == ""
    assert np.isfinite(found.found[kept]).all()
    assert np.isnan(found.found[np.isnan(found.target).all(axis=(1, 2))]).all()

    def alike(times: float) -> float:
        """Return the mean correlation of the chips once those of the target are moved by so many times `found`."""
        pairs = zip(found.scene[kept], found.target[kept], times * found.found[kept], strict=True)
        moved = [(one, ndimage.shift(other, (-row, -column), order=3, mode="nearest"))
                 for one, other, (column, row) in pairs]  # fmt: skip
        inner = slice(4, -4)
        return float(np.mean([
            np.corrcoef(one[inner, inner].ravel(), other[inner, inner].ravel())[0, 1] for one, other in moved
        ]))  # fmt: skip

    # As far from it on one side as on the other, so that interpolation smooths both alike.
    assert alike(1.0) > max(alike(-1.0), alike(3.0)) + 0.01


#: Wrong heights displace chips by 8 px along the line of sight, and by another length 60 px farther on.
COARSE = Setting(side=360, seed=3, error=12, dem_sigma=20, dem_length=60, off_nadir_deg=25)


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)])
def test_a_scene_that_looks_sideways_is_matched_over_a_coarse_dem(tmp_path, seed):
    case = Case(replace(COARSE, seed=seed), tmp_path).write()
    surface = open_dem(case.dem_file, "ellipsoid")
    found = matches(
        case.scene_file, case.model, surface, [case.reference_file], search=case.search, dem_sigma=20.0, points=100
    )
    assert len(found) > 30
    errors = trials.errors_of(case, found)
    ground, metre = lonlat(case.ground_of(found.image)), np.array([0.0, 0.0, 1.0])
    sight = case.model.ground_to_image(ground + metre) - case.model.ground_to_image(ground)
    across = (errors[:, 0] * sight[:, 1] - errors[:, 1] * sight[:, 0]) / np.hypot(*sight.T)
    assert np.sqrt(np.mean(across**2)) < 0.35
    # Half of them have a place of the map within a pixel: chips are sheared by the slopes of wrong heights.
    assert np.median(np.hypot(*errors.T)) < 1.0


@pytest.mark.slow
def test_another_place_is_refused_over_a_coarse_dem_with_heights_as_a_cause(tmp_path):
    for seed in (3, 4, 5):
        found = tried(Case(replace(COARSE, seed=seed, elsewhere=True), tmp_path / str(seed)).write())
        assert "line of sight" in found.refused


# -- often, and honest -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("numbers", [(80,), pytest.param(tuple(range(0, 200, 40)), marks=pytest.mark.slow)])
def test_scenes_of_all_kinds_are_matched_or_refused_never_wrong(numbers):
    """Some of what `benchmarks/match.py --truth` runs, smaller and without real grounds: of five one may fail."""
    drawn = [trials.drawn(number, ("country",)) for number in numbers]
    rows = run(
        replace(one, side=one.side * 3 // 5, error=min(one.error, 60.0), margin=min(one.margin, 90.0)) for one in drawn
    )
    assert not any(row["wrong"] for row in rows), told(rows)
    assert sum(row["succeeded"] for row in rows) >= 0.8 * len(rows), told(rows)


@pytest.mark.slow
def test_200_scenes_of_all_kinds():
    """One may be beyond four sigmas, none beyond six.

    Where the errors of a reference are as alike as over a fifth of the scene, its matches count as five independent
    points, so the sigma is itself uncertain. It is right on average, but an affine correction is beyond four sigmas in
    0.2 to 1 % of such scenes (`test_far_errors_are_rare_with_few_effective_points`); they are half of the 200.
    """
    rows = run(trials.scenes(200))
    assert sum(row["wrong"] for row in rows) <= 1, told(rows)
    assert not any(row["off"] > 6.0 * row["sigma"] for row in rows if row["wrong"]), told(rows)
    assert np.mean([row["succeeded"] for row in rows]) >= 0.95, told(rows)


@pytest.mark.slow
def test_sigmas_of_the_parameters_are_not_far_from_true():
    rows = run(trials.coverage(6)[:6:2])
    assert not any(row["refused"] for row in rows), told(rows)
    # The root mean square of six numbers of sigma 1 is within this in 999 of 1000 cases.
    assert trials.spread(rows) < 1.95, told(rows)


@pytest.mark.slow
def test_sigmas_of_the_parameters_are_true():
    rows = run(trials.coverage(200))
    assert 0.85 <= trials.spread(rows) <= 1.15, told(rows)


# -- refused -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sigmas_cover_where_the_reference_lies_anywhere_within_its_own():
    """Of 60 scenes; two axes of each know a spread to 6.5 %."""
    rows = run(trials.displaced(60), reference_sigma=2.0, points=120)
    assert all(not row["refused"] for row in rows), told(rows)
    assert 0.85 < trials.spread(rows) < 1.15, told(rows)


@pytest.mark.parametrize("what", ["place", pytest.param("roofs", marks=pytest.mark.slow)])
def test_what_cannot_be_matched_is_refused(what):
    rows = refusals(what, 1)
    assert all(row["refused"] for row in rows), told(rows)


def test_a_pattern_of_which_one_position_is_at_whole_pixels_is_refused():
    setting, search = trials.to_refuse("chessboard", 20)[11]
    (row,) = run([setting], search=search)
    assert "no clear best position" in row["refused"], told([row])


@pytest.mark.slow
@pytest.mark.parametrize("what", ["place", "chessboard", "water", "beyond", "roofs"])
def test_what_cannot_be_matched_is_refused_20_times_of_20(what):
    rows = refusals(what, 20)
    assert all(row["refused"] for row in rows), told(rows)


def test_a_reference_without_a_crs_is_refused(tmp_path):
    case = Case(PLAIN, tmp_path).write()
    dataset = gdal.Open(str(case.reference_file))
    bare = tmp_path / "bare.tif"
    write_raster(bare, [dataset.ReadAsArray() / 3000.0], "uint16", place=dataset.GetGeoTransform())
    found = tried(case, [bare])
    assert "coordinate system" in found.refused
    assert "bare.tif" in found.refused


@pytest.mark.parametrize("crs", ["EPSG:4978", 'LOCAL_CS["of a site",UNIT["metre",1]]'], ids=["geocentric", "local"])
def test_a_reference_whose_crs_leads_nowhere_is_refused_by_its_name(tmp_path, crs):
    path = tmp_path / "bad.tif"
    write_raster(path, [np.ones((9, 9))], "uint16", place=(0.0, 1.0, 0.0, 0.0, 0.0, -1.0), crs=crs)
    with pytest.raises(CrsError) as caught:
        matching.open_references([path])
    assert (caught.value.file, caught.value.field, bool(caught.value.remedy)) == (str(path), "CRS", True)


def test_a_reference_of_far_away_is_refused(tmp_path):
    case = Case(PLAIN, tmp_path).write()
    dataset = gdal.Open(str(case.reference_file), gdal.GA_Update)
    left, step, *rest = dataset.GetGeoTransform()
    dataset.SetGeoTransform((left + 5000.0, step, *rest))
    dataset = None
    assert "does not overlap the image" in tried(case).refused


def test_the_scene_itself_is_no_reference(tmp_path):
    case = Case(PLAIN, tmp_path).write()
    assert tried(case, [case.scene_file]).refused
    # With the georeference that a viewer may have given it.
    dataset = gdal.Open(str(case.scene_file))
    place, _, _ = case.reference_grid()
    copy = tmp_path / "copy.tif"
    write_raster(copy, [dataset.ReadAsArray() / 3000.0], "uint16", place=place, crs="EPSG:32735")
    found = tried(case, [copy])
    assert found.refused, found


def test_a_scene_of_one_ground_says_so_in_words(tmp_path):
    case = Case(replace(PLAIN, ground="water"), tmp_path).write()
    surface = open_dem(case.dem_file, "ellipsoid")
    with pytest.raises(OrthoError) as caught:
        matches(case.scene_file, case.model, surface, [case.reference_file], search=30.0, points=100)
    assert str(caught.value.remedy)


def test_grounds_are_there():
    assert set(grounds()) >= {"country", "woods", "town"}
