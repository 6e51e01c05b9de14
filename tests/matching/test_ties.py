"""Ties between simulated scenes against their truth, with a DEM that is wrong and models that err."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from osgeo import gdal
from scenes import Case, Setting, write_raster

from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control.ties import Tied, _crowded, _points, names_of, tie_scenes
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import load_model
from ortho_pipeline.imaging import matching
from ortho_pipeline.imaging.matching.agreement import refuse_accident
from ortho_pipeline.imaging.matching.targets import OtherScene
from ortho_pipeline.imaging.matching.weights import Components, components
from ortho_pipeline.imaging.ties import Pair, Ties, TieSettings, pairs, tie
from ortho_pipeline.imaging.ties.pairs import PairSummary, shared
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.options import MatchOptions
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Look(Case):
    """One of several scenes of the same ground, with an attitude, noise and a model's error of its own."""

    number: int = 0

    def random(self, what: int) -> np.random.Generator:
        own = [self.number] if what in (2, 3, 10) else []
        return np.random.default_rng([self.setting.seed, what, *own])

    @property
    def scene_file(self) -> Path:
        return self.folder / f"scene{self.number}.tif"

    def view(self, surface: Surface) -> matching.SceneView:
        return matching.SceneView(Intensity(RasterSource(self.scene_file)), self.model, surface)


def looks(folder: Path, angles: list[float], **changes: object) -> tuple[list[Look], list[matching.SceneView]]:
    """Return scenes off nadir by so many degrees, and how a matcher sees them."""
    settings = {"side": 420, "relief": 6.0, "error": 6.0, "margin": 250.0, **changes}
    found = [Look(Setting(off_nadir_deg=angle, **settings), folder, k) for k, angle in enumerate(angles)]
    for look in found:
        write_raster(look.scene_file, look.rendered(), "uint16", rpc=look.model)
    found[0].write_dem()
    surface = open_dem(found[0].dem_file, "ellipsoid")
    return found, [look.view(surface) for look in found]


def apart(first: Look, second: Look, ties: Ties, pair: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Return measured minus true positions in the second scene, across and along the epipolar direction, and z."""
    tracks = ties.of_pair(*pair)
    one, other = (np.flatnonzero((ties.image == image) & np.isin(ties.track, tracks)) for image in pair)
    # Rows of a scene are in the order of the tracks.
    ground = first.ground_of(ties.measured[one])
    off = ties.measured[other] - second.image_of(ground)
    steps = []
    for step in (-5.0, 5.0):
        height = ground[:, 2] + step
        steps.append(
            second.camera.image_of(np.column_stack([first.camera.ground_at(ties.measured[one], height), height]))
        )
    along = steps[1] - steps[0]
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    sigma = np.sqrt(2 * np.einsum("ni,nij,nj->n", across, ties.covariance[other], across))
    return (off * across).sum(axis=1), (off * along).sum(axis=1), sigma


def _each_scene_once(ties: Ties) -> None:
    both = np.stack([ties.track, ties.image], axis=1)
    assert len(np.unique(both, axis=0)) == len(both)


def rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.mark.parametrize(
    ("angles", "dem_sigma"),
    [
        pytest.param([-12.0, 12.0], 3.0, marks=pytest.mark.slow),
        ([-30.0, 30.0], 5.0),
        pytest.param([-30.0, 0.0, 30.0], 5.0, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_ties_lie_where_the_truth_is_whatever_the_heights_of_the_dem(tmp_path, angles, dem_sigma):
    scenes, views = looks(tmp_path, angles, dem_sigma=dem_sigma)
    ties = tie(views, TieSettings(search=25.0, points=60, dem_sigma=dem_sigma))
    _each_scene_once(ties)
    for pair in ties.pairs:
        across, along, sigma = apart(scenes[pair.images[0]], scenes[pair.images[1]], ties, pair.images)
        assert len(across) >= 40
        assert rms(across) < 0.15
        # Along it slopes of the DEM's error displace a chip as a whole; heights are found to that.
        assert rms(along) < 0.35
        assert 0.7 < rms(across / sigma) < 1.4


@pytest.mark.slow
def test_a_track_has_each_scene_once_and_covers_the_overlap(tmp_path):
    _, views = looks(tmp_path, [-15.0, 0.0, 15.0], dem_sigma=2.0)
    ties = tie(views, TieSettings(search=25.0, points=100, dem_sigma=3.0))
    _each_scene_once(ties)
    counts = np.bincount(ties.track)
    assert set(counts) <= {2, 3}
    assert (counts == 3).mean() > 0.6
    # All but the rim of the scenes, where chips do not fit, and corners that one of them does not show.
    place = ties.measured[ties.image == 0] / views[0].size
    cells = np.histogram2d(*place.T, bins=5, range=[[0, 1], [0, 1]])[0]
    assert (cells > 0).mean() > 0.85
    values = np.linalg.eigvalsh(ties.covariance)
    assert (values > 0).all()
    assert np.sqrt(values.max()) < 0.6


@pytest.mark.parametrize(("points", "crowded"), [(20, False), (400, True)])
def test_crowded_ties_are_told_with_the_number_that_would_not_be(tmp_path, points, crowded):
    """Chips of 40 px share pixels where cells are smaller."""
    _, views = looks(tmp_path, [-10.0, 10.0], side=200, dem_sigma=2.0)
    ties = tie(views, TieSettings(search=25.0, points=points, dem_sigma=3.0))
    notices = _crowded(ties, points)
    assert [one.code for one in notices] == ["crowded-ties"] * crowded
    if crowded:
        # A scene shows 70 to 100 % of the other one, and as many cells more are needed.
        assert 0.7 <= points * 40**2 / 200**2 / notices[0].fields["crowding"] <= 1.0
        assert 0.7 <= notices[0].fields["points"] / (200**2 / 40**2) <= 1.0


def tied_by_default(folder: Path, side: int, **match: float) -> tuple[Tied, Array]:
    """Tie two scenes as the command does; return also how far (px) each pair of ties is apart in the first one."""
    folder.mkdir()
    scenes, _ = looks(folder, [-10.0, 10.0], side=side, dem_sigma=2.0)
    opened = {name: open_scene(scene.scene_file) for name, scene in zip("ab", scenes, strict=True)}
    found = tie_scenes(opened, MatchOptions(search=25.0, **match), open_dem(scenes[0].dem_file, "ellipsoid"))
    place = found.points.measured[found.points.image == 0]
    return found, np.abs(place[:, None] - place).max(axis=2)[~np.eye(len(place), dtype=bool)]


def test_chips_of_a_small_image_share_no_pixels_unless_a_number_is_asked_for(tmp_path):
    found, gaps = tied_by_default(tmp_path / "default", 300)
    assert 16 <= len(found.points) <= (300 / 40) ** 2
    assert gaps.min() >= 40
    assert "crowded-ties" not in [one.code for one in found.notices]
    asked, _ = tied_by_default(tmp_path / "asked", 300, points=400)
    assert len(asked.points) > 2 * len(found.points)
    (notice,) = (one for one in asked.notices if one.code == "crowded-ties")
    assert "Ask for fewer: `match.points=" in str(notice)


def test_a_very_small_image_has_enough_ties_all_the_same(tmp_path):
    """Only 16 chips fit side by side, and a pair needs a dozen matches."""
    found, _ = tied_by_default(tmp_path / "small", 200)
    assert len(found.points) >= 18
    smaller, _ = tied_by_default(tmp_path / "smaller", 150)
    (notice,) = (one for one in smaller.notices if one.code == "crowded-ties")
    assert "too small for more ties" in str(notice)


def test_scenes_that_share_a_strip_without_width_are_refused(tmp_path):
    _, views = looks(tmp_path, [-10.0, 10.0], side=200, dem_sigma=2.0)
    strip = np.column_stack([np.full(20, 199.0), np.linspace(0, 199, 20)])
    with pytest.raises(InputError, match="only a strip of less than 1 px") as caught:
        Pair.place(views[0], OtherScene(views[1].intensity, views[1].model), strip, 25.0, TieSettings(search=25.0))
    assert "overlap more" in str(caught.value.remedy)


def test_a_track_goes_on_where_its_home_cannot_be_matched(tmp_path, monkeypatch):
    """The first and the last scene have nothing that is alike; the one between them has ties with both."""
    scenes, views = looks(tmp_path, [-10.0, 0.0, 10.0], side=300, dem_sigma=2.0)
    place = Pair.place.__func__

    def refused(cls, view, target, *more):
        if view is views[0] and target.path == str(scenes[2].scene_file):
            raise InputError("no place stands out")
        return place(cls, view, target, *more)

    monkeypatch.setattr(Pair, "place", classmethod(refused))
    ties = tie(views, TieSettings(search=25.0, points=40, dem_sigma=3.0))
    _each_scene_once(ties)
    assert [one.images for one in ties.pairs if one.reason] == [(0, 2)]
    # What both pairs show of a place is one track, and the far ends of it are the same place.
    assert len(ties.of_pair(0, 2)) > 0.5 * len(ties.of_pair(0, 1))
    across, _, _ = apart(scenes[0], scenes[2], ties, (0, 2))
    assert rms(across) < 0.2


@pytest.mark.slow
def test_ties_of_scenes_of_different_resolution(tmp_path):
    fine = looks(tmp_path, [-14.0], side=420, dem_sigma=2.0)
    (coarse,) = [Look(Setting(off_nadir_deg=10.0, side=210, gsd=2.0, fine=4.0, relief=3.0, error=3.0), tmp_path, 1)]
    write_raster(coarse.scene_file, coarse.rendered(), "uint16", rpc=coarse.model)
    views = [*fine[1], coarse.view(fine[1][0].surface)]
    for order in ([0, 1], [1, 0]):
        scenes = [[*fine[0], coarse][k] for k in order]
        ties = tie([views[k] for k in order], TieSettings(search=25.0, points=60, dem_sigma=3.0))
        across, _, _ = apart(*scenes, ties, (0, 1))
        assert len(across) >= 25
        # Pixels of the coarser scene.
        assert rms(across) / (1 if order[1] == 1 else 2) < 0.15


@pytest.mark.slow
def test_ties_are_found_where_heights_are_wrong_by_more_than_a_chip(tmp_path):
    """A plane at the wrong height under hills of 15 m: matches lie up to 80 px along the line of sight."""
    scenes, views = looks(tmp_path, [-20.0, 20.0], relief=15.0, margin=60.0)
    views = [replace(view, surface=FlatSurface(340.0)) for view in views]
    ties = tie(views, TieSettings(search=25.0, points=120, dem_sigma=25.0))
    across, _, _ = apart(*scenes, ties, (0, 1))
    # Slopes without a DEM shear chips; on the steep ones nothing is found.
    assert len(across) >= 30
    assert rms(across) < 0.3


def test_scenes_without_common_ground_are_refused(tmp_path):
    _, views = looks(tmp_path, [-5.0, 5.0], side=280)
    away = ImageCorrection(views[1].model, "shift", (0.0, 0.0), np.array([5000.0, 0, 0, 0, 0, 0]))
    with pytest.raises(InputError, match="no two of these images overlap"):
        tie([views[0], replace(views[1], model=away)], TieSettings(search=25.0))


def test_scenes_of_different_places_have_no_ties(tmp_path):
    scenes, views = looks(tmp_path, [-5.0], side=280)
    other = Look(replace(scenes[0].setting, seed=1), tmp_path, 1)
    write_raster(other.scene_file, other.rendered(), "uint16", rpc=other.model)
    with pytest.raises(InputError, match=r"no tie points found: scene0.tif and scene1.tif: ") as refused:
        tie([*views, other.view(views[0].surface)], TieSettings(search=25.0))
    assert "reference" not in str(refused.value)
    assert "if the DEM covers only a part, fill the rest (`surface.fill`)" in str(refused.value.remedy)
    with pytest.raises(InputError, match=r"cannot match the scene with scene0.tif") as refused:
        refuse_accident(2, 20, 1.5, 1.0, [matching.OtherScene(views[0].intensity, views[0].model)], 25.0)
    assert "reference" not in str(refused.value)
    assert refused.value.field == "images"


def test_images_without_heights_where_they_overlap_lead_to_filling_the_dem(tmp_path):
    scenes, views = looks(tmp_path, [-5.0, 5.0], side=140)
    dem = gdal.Open(str(scenes[0].dem_file), gdal.GA_Update)
    heights = dem.ReadAsArray()
    heights[:, : int(heights.shape[1] * 0.7)] = np.nan
    dem.GetRasterBand(1).WriteArray(heights)
    dem = None
    partial = open_dem(scenes[0].dem_file, "ellipsoid")
    with pytest.raises(InputError, match="no two of these images overlap") as refused:
        tie([replace(view, surface=partial) for view in views], TieSettings(search=25.0))
    assert "if the DEM covers only a part, fill the rest (`surface.fill`)" in str(refused.value.remedy)


def test_resolutions_that_are_too_different_are_said_of_both_images(tmp_path):
    _, views = looks(tmp_path, [-14.0], side=280)
    coarse = ImageCorrection(views[0].model, "affine", (0.0, 0.0), np.array([0.0, -0.93, 0, 0, 0, -0.93]))
    with pytest.raises(InputError, match=r"a pixel of scene0.tif is 0.07 pixels of scene0.tif"):
        tie([views[0], replace(views[0], model=coarse)], TieSettings(search=25.0))


def run(*args: object, code: int = 0) -> str:
    """Run a command; return what it prints."""
    done = CliRunner().invoke(cli, [str(arg) for arg in args])
    assert done.exit_code == code, done.output + str(done.exception)
    return done.output


def test_the_command_writes_ties_that_an_adjustment_reads(tmp_path):
    scenes, _ = looks(tmp_path, [-12.0, 12.0], side=300, dem_sigma=2.0)
    images = [scene.scene_file for scene in scenes]
    heights = "--dem", scenes[0].dem_file, "--dem-vertical", "ellipsoid", "--dem-sigma", 3
    said = run("ties", *images, *heights, "--search", 25, "--match-points", 40, "-o", tmp_path / "ties.csv")
    assert "scene0.tif - scene1.tif: " in said
    points = read_block_points(tmp_path / "ties.csv")
    assert len(points) > 25
    assert points.tie.all()
    assert points.shape_image is not None
    assert 0.01 < np.median(points.sigma_image) < 0.3
    run("adjust", *images, "--points", tmp_path / "ties.csv", "--correction", "shift", "-o", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "block_report.json").read_text())["adjustment"]
    assert found["sigma0"] == pytest.approx(1.0, abs=0.35)
    apart = [np.hypot(*ray["residual"]) for ray in found["rays"] if ray["used"]]
    assert np.median(apart) < 0.1
    refused = run("ties", images[0], *heights, "-o", tmp_path / "one.csv", code=2)
    assert "two images" in refused
    assert not (tmp_path / "one.csv").exists()


def test_images_of_one_name_are_told_apart():
    assert names_of(["/a/fore/BAND.tif", "/a/aft/BAND.tif", "/a/other.tif"]) == [
        "fore/BAND.tif",
        "aft/BAND.tif",
        "other.tif",
    ]


def test_an_adjustment_finds_ties_and_control_by_itself(tmp_path):
    """Two scenes that are some ten pixels off, a reference and a DEM in a STAC collection: all in one command."""
    scenes, _ = looks(tmp_path, [-12.0, 12.0], side=300, dem_sigma=1.0, margin=100.0)
    scenes[0].write_reference()
    images = [scene.scene_file for scene in scenes]
    dem = scenes[0].dem_file
    place = gdal.Info(str(dem), format="json")["wgs84Extent"]
    cell = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": "cell",
        "geometry": place,
        "assets": {"dem": {"href": dem.name}},
    }
    (dem.parent / "dem.json").write_text(json.dumps({"type": "FeatureCollection", "features": [cell]}))
    heights = "--dem", dem.parent / "dem.json", "--dem-vertical", "ellipsoid", "--dem-sigma", 1
    run("adjust", *images, "--ties", "auto", "--reference", scenes[0].reference_file, *heights, "--search", 25,
        "--reference-sigma", 2, "--match-points", 60, "--correction", "affine", "-o", tmp_path / "out")  # fmt: skip
    before, after = [], []
    for scene in scenes:
        model = load_model(tmp_path / "out" / f"{scene.scene_file.stem}_model.json")
        before.append(scene.misfit(scene.model)[0])
        after.append(scene.misfit(model)[0])
    assert rms(np.array(before)) > 4.0
    # Nine places to the corners, by a plan with the DEM's errors.
    assert rms(np.array(after)) < 0.5
    report = json.loads((tmp_path / "out" / "block_report.json").read_text())
    assert {"relative-to-reference", "dem-sigma-by-default"} & {one["code"] for one in report["notices"]} == {
        "relative-to-reference"
    }
    assert "takes-no-part" not in {one["code"] for one in report["notices"]}
    assert (
        "in the images, relative to the reference, whose ground coordinates were not used" in report["headline"]["what"]
    )
    read = {(one["role"], Path(one["path"]).name) for one in report["provenance"]["inputs"]}
    assert {("DEM", dem.name), ("DEM", "dem.json"), ("reference", scenes[0].reference_file.name)} <= read
    # Pixels are 1 m: however many matches, the images lie as well as the reference does.
    adjustment = report["adjustment"]
    for image in adjustment["images"].values():
        shifts = [image["parameters"][name]["sigma"] for name in ("col_shift", "row_shift")]
        assert np.hypot(*shifts) == pytest.approx(np.hypot(2, 2), rel=0.2)
    ties = [point["sigma"] for point in adjustment["points"] if point["role"] == "tie" and point["sigma"][0]]
    assert np.min(ties, axis=0)[:2] == pytest.approx([2, 2], rel=0.1)
    assert adjustment["common_error"]["estimate_sigma_m"] == [2, 2]
    assert 0.4 < adjustment["sigma0"] < 2.5


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "--points"),
        (["--ties", "auto"], "--dem"),
        (["--ties", "auto", "--height", 0, "--check", "fraction:0.2"], "--check"),
        (["--ties", "auto", "--height", 0, "--reference-sigma", 1], "--reference-sigma"),
        (["--points", "rays.csv", "--height", 0], "--height"),
        (["--points", "rays.csv", "--search", 5], "--search"),
    ],
)
def test_options_of_a_block_that_contradict_each_other_are_refused(tmp_path, words, named):
    said = run("adjust", "a.tif", "b.tif", "-o", tmp_path / "out", *words, code=2)
    assert named in said


def test_residuals_of_one_direction_leave_a_covariance_that_can_be_inverted():
    random = np.random.default_rng(1)
    along = np.tile([0.4, 0.3], (40, 1))
    parts = components(along * random.normal(0, 2, (40, 1)), np.tile(1e-4 * np.eye(2), (40, 1, 1)), along)
    assert parts.height == pytest.approx(2.0, rel=0.4)
    assert np.linalg.eigvalsh(parts.covariance(np.tile(1e-4 * np.eye(2), (40, 1, 1)), along)).min() > 0


def test_what_succeeded_between_two_images_is_never_more_than_was_tried() -> None:
    """Ties that two images share through a third one are counted, and not as matches of these two."""
    track, image = np.repeat(np.arange(4), 3), np.tile(np.arange(3), 4)
    parts = Components(0.1, 1.0, 0.1)
    pairs = tuple(
        PairSummary(both, found, tried, (0.5, 0.5), parts)
        for both, found, tried in (((0, 1), 4, 5), ((0, 2), 4, 4), ((1, 2), 1, 2))
    )
    ties = Ties(track, image, np.ones((12, 2)), np.tile(np.eye(2), (12, 1, 1)), pairs)
    tied = Tied(_points(ties, ("a", "b", "c")), ties, 100.0, 10.0)
    last = tied.to_json()["pairs"][-1]
    assert (last["ties"], last["matched"], last["tried"]) == (4, 1, 2)
    assert "b - c: 4 tie points (1 of 2 matches between them succeeded)" in tied.summary()


def test_two_images_without_matches_between_them_can_share_ties() -> None:
    """Most places of the two were found from a third image, and too few were left for a test against each other."""
    track, image = np.repeat(np.arange(4), 3), np.tile(np.arange(3), 4)
    parts, why = Components(0.1, 1.0, 0.1), "none of 11 places matched"
    pairs = (
        *(PairSummary(both, 4, 4, (0.5, 0.5), parts) for both in ((0, 1), (0, 2))),
        PairSummary((1, 2), 0, 11, reason=why),
    )
    ties = Ties(track, image, np.ones((12, 2)), np.tile(np.eye(2), (12, 1, 1)), pairs)
    told = Tied(_points(ties, ("a", "b", "c")), ties, 100.0, 10.0).summary()
    assert told.splitlines()[-1] == f"b - c: 4 tie points through other images ({why})"


@pytest.mark.slow
def test_a_pair_is_placed_if_one_of_its_poses_is_rotated(tmp_path: Path) -> None:
    """Headings of drones are wrong by some degrees: no shift fits, and chips of one shift do not match."""
    _, views = looks(tmp_path, [-5.0, 5.0], dem_sigma=1.0, side=300)
    angle, middle = np.deg2rad(4.5), (150.0, 150.0)
    slopes = [np.cos(angle) - 1, -np.sin(angle), np.sin(angle), np.cos(angle) - 1]
    wrong = ImageCorrection(views[0].model, "affine", middle, np.array([0.0, *slopes[:2], 0.0, *slopes[2:]]))
    view, target = replace(views[0], model=wrong), OtherScene(views[1].intensity, views[1].model)
    settings = TieSettings(search=25.0, dem_sigma=1.0, rotation_deg=5.0)
    found = Pair.place(view, target, shared(view, target), 25.0, settings).correction
    np.testing.assert_allclose(found.matrix @ wrong.matrix, np.eye(2), atol=0.01)


def test_ties_of_photos_are_searched_over_rotations_of_their_poses(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = {name: open_scene(sample / "photos" / f"{name}.jpg") for name in ("photo1", "photo2")}
    asked = []

    def placed(view: object, targets: object, reach: float, base: int, region: object, rotation_deg: float) -> None:
        asked.append(rotation_deg)
        raise InputError("no clear best position")

    monkeypatch.setattr(pairs, "place", placed)
    monkeypatch.setattr(pairs, "along_sight", lambda *given: None)
    with pytest.raises(InputError, match="no tie points found"):
        tie_scenes(scenes, MatchOptions(), FlatSurface(900.0))
    # Only at the finest level: at coarser ones a shift alone may fit.
    assert asked[-1] == 5.0
    assert not any(asked[:-1])
