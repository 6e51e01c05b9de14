"""Classical models: GDAL and simulated cameras as authorities, honest covariance, gross errors and poor geometry."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import DegeneratePoints, InputError, TooFewPoints
from ortho_pipeline.estimation.family_fit import fit_family, prune
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.regularisation import _corner
from ortho_pipeline.models import (
    ImageCorrection,
    Rational,
    families,
    family_of,
    model_crs,
    model_from_dict,
    start_model,
)
from ortho_pipeline.models.families import complete, exponents
from ortho_pipeline.points import Points
from ortho_pipeline.testing import check_sensor_model

NAMES = [family.name for family in families()]
SIZE = (10_000, 10_000)
LOW, HIGH = np.array([400e3, 5000e3, 200.0]), np.array([430e3, 5030e3, 1500.0])
#: Parameters and minimum points as the design and the papers count them.
COUNTS = {
    "affine2d": (6, 3), "poly1": (6, 3), "poly2": (12, 6), "poly3": (20, 10), "poly4": (30, 15), "poly5": (42, 21),
    "projective": (8, 4), "affine3d": (8, 4), "affine12": (12, 6), "affine14": (14, 7), "poly3d1": (8, 4),
    "poly3d2": (20, 10), "poly3d3": (40, 20), "dlt": (11, 6), "rfm1": (14, 7), "rfm2": (38, 19), "rfm3": (78, 39),
    "rfm2-common": (29, 15), "rfm3-common": (59, 30),
}  # fmt: skip


def frame_camera(ground: np.ndarray) -> np.ndarray:
    """A frame camera 686 km above and 90 km next to the scene, from the collinearity equations."""
    position = np.array([450e3, 5100e3, 686e3])
    axis = np.array([415e3, 5015e3, 800.0]) - position
    axis /= np.linalg.norm(axis)
    right = np.cross([0.0, 1.0, 0.0], axis)
    right /= np.linalg.norm(right)
    ray = ground - position
    depth = ray @ axis
    return 5000 - 150e3 * np.stack([ray @ right / depth, ray @ np.cross(axis, right) / depth], axis=1)


def make_points(count, noise=0.5, seed=0, camera=frame_camera, **changes) -> Points:
    random = np.random.default_rng(seed)
    ground = random.uniform(LOW, HIGH, (count, 3))
    ground = changes.pop("ground", ground)
    fields = {
        "ids": tuple(f"p{i}" for i in range(count)),
        "image": camera(ground) + noise * random.normal(0, 1, (count, 2)), "ground": ground,
        "roles": np.full(count, "control"), "sigma_image": np.full(count, 0.5), "sigma_ground": np.zeros((count, 3)),
        "crs": pyproj.CRS.from_epsg(32633), "source": "simulated",
    }  # fmt: skip
    return Points(**{**fields, **changes})


def truth_of(name: str, seed: int = 5) -> Rational:
    """A model of this family with all coefficients at work: those of higher order a hundredth of the lower ones."""
    start = start_model(name, make_points(200, noise=0.0), size=SIZE)
    sizes = np.array(
        [100.0 ** -max(0, exponents(n.rpartition("_")[2]).sum() - ("den_" not in n)) for n in start.param_names]
    )
    return start.with_params(start.params + sizes * np.random.default_rng(seed).normal(0, 0.01, len(sizes)))


# -- the table -------------------------------------------------------------------------------------------------------


def test_the_table_is_that_of_the_papers():
    assert {family.name: (family.parameters, family.minimum_points) for family in families()} == COUNTS
    rows = [family.to_json() for family in families()]
    assert json.loads(json.dumps(rows)) == rows
    flat = {family.name for family in families() if family.dimensions == 2}
    assert flat == {"affine2d", "poly1", "poly2", "poly3", "poly4", "poly5", "projective"}
    assert all(simpler in COUNTS for family in families() for simpler in family.simpler)


def test_terms():
    assert complete(2, "XY") == ("1", "X", "Y", "X2", "XY", "Y2")
    assert complete(1) == ("1", "X", "Y", "Z")
    assert exponents("X2YZ").tolist() == [2, 1, 1]
    assert family_of("affine14-col").col[-1] == "X2"
    assert family_of("affine14-col").row[-1] == "XY"
    assert family_of("affine14-row").row[-1] == "X2"
    with pytest.raises(InputError, match="unknown model family"):
        family_of("poly9")


@pytest.mark.parametrize("crs", [None, "geocentric", "geographic", "utm"])
@pytest.mark.parametrize("name", NAMES)
def test_contract(name, crs):
    points = make_points(60)
    model = start_model(name, points, crs=crs, size=SIZE)
    check_sensor_model(model, points.to_crs(model.crs).ground)


def test_flat_ground_has_as_many_metres_of_height_in_any_crs():
    """A model of flat ground is meant for heights of a thousandth of the scene's extent, in degrees or in metres."""
    points = make_points(60)
    flat = replace(points, ground=np.column_stack([points.ground[:, :2], np.full(60, 500.0)]))
    metres = start_model("affine3d", flat, crs="utm").domain[1]
    degrees = start_model("affine3d", flat, crs="geographic").domain[1]
    assert metres[2] == pytest.approx(1e-3 * metres[:2].max())
    # A degree of longitude counts as one of latitude.
    longest = metres[2] / np.cos(np.radians(points.to_crs("EPSG:4979").ground[:, 1].mean()))
    assert 0.95 * metres[2] < degrees[2] < 1.05 * longest
    assert metres[2] > 5.0
    feet = start_model("affine3d", flat, crs="+proj=utm +zone=33 +datum=WGS84 +units=us-ft").domain[1]
    assert feet[0] > 3 * metres[0]
    assert feet[2] == pytest.approx(metres[2], rel=1e-6)


def test_crs_of_models():
    points = make_points(10)
    assert model_crs("utm", points) == "EPSG:32633"
    assert model_crs("geographic", points) == "EPSG:4979"
    assert model_crs("geocentric", points) == "geocentric"
    assert model_crs("EPSG:3857", points) == "EPSG:3857"
    assert start_model("dlt", points, crs="geocentric").crs == "EPSG:4979"
    with pytest.raises(InputError):
        model_crs("EPSG:nothing", points)


def test_geocentric_is_an_affine_change_of_earth_fixed_coordinates():
    """A DLT in geocentric coordinates, solved in the test, has the residuals of ours."""
    points = make_points(30)
    geocentric = points.to_crs("EPSG:4978").ground
    scaled = (geocentric - geocentric.mean(axis=0)) / geocentric.std(axis=0)
    design = np.zeros((60, 8))
    design[0::2, :4] = design[1::2, 4:] = np.column_stack([np.ones(30), scaled])
    left = points.image.ravel() - design @ np.linalg.lstsq(design, points.image.ravel())[0]
    found = fit_family("affine3d", points, crs="geocentric", robust=False)
    np.testing.assert_allclose(found.residuals.ravel(), left, atol=1e-6)


def test_across_the_antimeridian():
    points = make_points(40).to_crs("EPSG:4326")
    moved = points.ground.copy()
    moved[:, 0] += 180.0 - moved[:, 0].mean()
    moved[:, 0] = (moved[:, 0] + 180.0) % 360.0 - 180.0
    assert np.ptp(moved[:, 0]) > 300
    here = fit_family("poly3d2", points, robust=False)
    there = fit_family("poly3d2", points.with_ground(moved), robust=False)
    np.testing.assert_allclose(there.residuals, here.residuals, atol=1e-6)


def test_documents_of_models_are_checked():
    data = start_model("dlt", make_points(10)).to_dict()
    assert isinstance(model_from_dict(data), Rational)
    for change in ({"family": "dltt"}, {"coefficients": [1.0]}, {"removed": ["col_X"]}, {"box": [[0, 0, 0], [0, 0, 0]]},
                   {"image_scale": [0.0, 1.0]}, {"family": None}):  # fmt: skip
        with pytest.raises(InputError):
            model_from_dict({**data, **change})


# -- authorities -----------------------------------------------------------------------------------------------------


def gdal_ground_to_image(points: Points, options: list[str]) -> np.ndarray:
    gdal = pytest.importorskip("osgeo.gdal")
    gdal.UseExceptions()
    dataset = gdal.GetDriverByName("MEM").Create("", *SIZE, 1)
    gcps = [gdal.GCP(*map(float, (*g, *i))) for g, i in zip(points.ground, points.image, strict=True)]
    dataset.SetGCPs(gcps, points.crs.to_wkt())
    transformer = gdal.Transformer(dataset, None, options)
    found = [transformer.TransformPoint(1, float(x), float(y))[1][:2] for x, y, _ in points.ground]
    return np.array(found)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_polynomials_are_those_of_gdal(order):
    points = make_points(40, noise=3.0)
    expected = gdal_ground_to_image(points, ["METHOD=GCP_POLYNOMIAL", f"MAX_GCP_ORDER={order}"])
    found = fit_family(f"poly{order}", points, robust=False)
    assert np.abs(found.residuals).max() > 1
    np.testing.assert_allclose(found.predicted, expected, rtol=0, atol=1e-6)


def test_projective_is_the_homography_of_gdal():
    gdal = pytest.importorskip("osgeo.gdal")
    if int(gdal.VersionInfo()) < 3060000:
        pytest.skip("GDAL has its homography transformer from 3.6 on")
    points = make_points(12, noise=0.0, camera=lambda g: frame_camera(g * [1, 1, 0] + [0, 0, 500.0]))
    try:
        expected = gdal_ground_to_image(points, ["METHOD=GCP_HOMOGRAPHY"])
    except RuntimeError as error:
        pytest.skip(f"this GDAL computes no homography ({error})")
    np.testing.assert_allclose(fit_family("projective", points).predicted, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("name", "relief"), [("dlt", 1.0), ("projective", 0.0)])
def test_dlt_is_a_frame_camera_and_projective_its_view_of_a_plane(name, relief):
    low, high = LOW.copy(), HIGH.copy()
    low[2], high[2] = 850 - 650 * relief, 850 + 650 * relief
    points = make_points(12, noise=0.0, ground=np.random.default_rng(0).uniform(low, high, (12, 3)))
    found = fit_family(name, points, size=SIZE)
    assert np.abs(found.residuals).max() < 1e-6
    elsewhere = np.random.default_rng(9).uniform(low, high, (100, 3))
    np.testing.assert_allclose(found.model.ground_to_image(elsewhere), frame_camera(elsewhere), atol=1e-5)


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("rfm")])
def test_truth_lies_within_the_claimed_sigma(name):
    """The estimate of a noisy sample is off by a few of its sigmas, at points that were not measured as well."""
    truth = truth_of("affine14-row" if name == "affine14" else name)
    points = make_points(80, camera=truth.ground_to_image)
    found = fit_family(name, points, size=SIZE, robust=False)
    assert found.model.family == truth.family
    assert 0.7 < found.sigma0 < 1.3
    # Its own points normalise the fit, so values are compared where both are in the same coordinates: in the image.
    ground = np.random.default_rng(3).uniform(LOW, HIGH, (200, 3))
    miss = (found.model.ground_to_image(ground) - truth.ground_to_image(ground)) / found.image_sigma(ground)
    assert np.abs(miss).max() < 6
    assert np.sqrt((miss**2).mean()) < 2


@pytest.mark.parametrize(
    ("name", "repeats"),
    [
        ("affine14-row", 100), ("rfm1", 100),
        *(pytest.param(one, 1000, marks=pytest.mark.slow)
          for one in ("affine14-row", "rfm1", "poly2", "projective", "dlt")),
    ],
)  # fmt: skip
def test_claimed_covariance_is_honest(name, repeats):
    """Over many repeats the spread of (estimate - truth) / sigma is 1, but for Student's t: sqrt(r / (r - 2))."""
    truth = truth_of(name)
    points = make_points(30, noise=0.0, camera=truth.ground_to_image)
    random = np.random.default_rng(1)
    ratios = []
    for _ in range(repeats):
        noisy = make_points(30, ground=points.ground, image=points.image + random.normal(0, 0.5, (30, 2)))
        found = fit(truth, noisy, robust=False)
        ratios.append((found.values - truth.params) / found.sigmas)
    redundancy = 60 - len(truth.params)
    spread = np.std(ratios, axis=0) / np.sqrt(redundancy / (redundancy - 2))
    # Within three standard errors of the spread, four of the mean.
    assert (np.abs(spread - 1) < 3 / np.sqrt(2 * repeats)).all(), spread
    assert (np.abs(np.mean(ratios, axis=0)) < 4 / np.sqrt(repeats)).all()


@pytest.mark.parametrize(("transposed", "expected"), [(False, "affine14-row"), (True, "affine14-col")])
def test_the_better_assignment_of_axes_is_taken(transposed, expected):
    truth = truth_of("affine14-row")
    points = make_points(40, camera=lambda g: truth.ground_to_image(g)[:, :: -1 if transposed else 1])
    assert fit_family("affine14", points).model_name == expected


def test_points_without_heights_suit_models_of_the_plane():
    points = make_points(20)
    ground = points.ground.copy()
    ground[:, 2] = np.nan
    flat = points.with_ground(ground)
    found = fit_family("poly2", flat, size=SIZE)
    np.testing.assert_allclose(found.residuals, fit_family("poly2", points, size=SIZE).residuals, atol=1e-8)
    with pytest.raises(TooFewPoints):
        fit_family("affine3d", flat)
    # Those with a height do not take the others out.
    ground[::3] = points.ground[::3]
    some = fit_family("poly2", points.with_ground(ground), size=SIZE)
    assert some.used.all()
    np.testing.assert_allclose(some.residuals, found.residuals, atol=1e-8)


def test_unit_and_place_of_the_coordinates_do_not_matter():
    points = make_points(40)
    for name in ("poly3", "dlt", "affine12"):
        here = fit_family(name, points, robust=False).residuals
        changes = {"ground": points.ground + np.array([1e5, -3e5, 900.0]), "image": points.image * 3 + 7}
        moved = Points(**{**vars(points), **changes, "sigma_image": points.sigma_image * 3})
        np.testing.assert_allclose(fit_family(name, moved, robust=False).residuals, 3 * here, atol=1e-6)
        order = np.random.default_rng(0).permutation(40)
        shuffled = fit_family(name, points.select(order), robust=False)
        np.testing.assert_allclose(shuffled.residuals, here[order], atol=1e-7)


# -- gross errors ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["affine3d", "projective", "dlt", "affine14", "poly3d2", "rfm1", "rfm2", "rfm3"])
def test_gross_errors_are_found(name):
    truth = truth_of({"affine14": "affine14-row"}.get(name, name))
    bad = [3, 17, 30]
    points = make_points(60, camera=truth.ground_to_image)
    image = points.image.copy()
    image[bad] += [[60.0, -25.0], [-200.0, 100.0], [0.0, 400.0]]
    found = fit_family(name, make_points(60, ground=points.ground, image=image), size=SIZE)
    rejected = [name for name, _ in found.rejected]
    assert {f"p{i}" for i in bad} <= set(rejected)
    assert len(rejected) <= 4
    assert found.sigma0 < 2


@pytest.mark.parametrize("name", ["affine3d", "dlt", "poly2"])
def test_too_many_gross_errors_are_not_cleaned_up(name):
    truth = truth_of(name)
    points = make_points(40, camera=truth.ground_to_image)
    image = points.image.copy()
    image[:15] += np.random.default_rng(2).normal(0, 150, (15, 2))
    with pytest.raises(DegeneratePoints, match="contradict"):
        fit_family(name, make_points(40, ground=points.ground, image=image), size=SIZE)


@pytest.mark.parametrize(("sets", "most"), [(5, 0), pytest.param(40, 2, marks=pytest.mark.slow)])
def test_good_points_are_kept(sets, most):
    lost = 0
    for seed in range(sets):
        for name in ("dlt", "rfm1", "poly3d2", "rfm2"):
            lost += len(
                fit_family(name, make_points(30 + seed % 7, seed=seed, camera=truth_of("dlt").ground_to_image)).rejected
            )
    assert lost <= most


# -- poor geometry ---------------------------------------------------------------------------------------------------


def on_plane(count=30, tilt=0.02) -> np.ndarray:
    ground = np.random.default_rng(4).uniform(LOW, HIGH, (count, 3))
    ground[:, 2] = 500 + tilt * (ground[:, 0] - LOW[0]) - tilt / 3 * (ground[:, 1] - LOW[1])
    return ground


@pytest.mark.parametrize("tilt", [0.0, 0.02])
@pytest.mark.parametrize(
    ("name", "simpler"), [("dlt", "projective"), ("affine3d", "affine2d"), ("poly3d2", "affine2d")]
)
def test_coplanar_points(name, simpler, tilt):
    points = make_points(30, ground=on_plane(tilt=tilt))
    with pytest.raises(DegeneratePoints, match="do not determine") as caught:
        fit_family(name, points, size=SIZE)
    assert caught.value.remedy.endswith(f"these points are enough for {simpler}")


def test_terrain_that_is_flat_but_for_noise():
    ground = on_plane(tilt=0.0) + np.random.default_rng(0).normal(0, [0, 0, 0.05], (30, 3))
    with pytest.raises(DegeneratePoints, match="whole scene"):
        fit_family("affine3d", make_points(30, ground=ground), size=SIZE)


def test_collinear_points():
    """Rounding of UTM coordinates hides from a rank test that these lie on a line."""
    along = np.linspace(0, 1, 12)[:, None]
    ground = LOW + (HIGH - LOW) * along + np.array([0.1, 0.2, 0.3]) * along
    for name in ("affine2d", "projective", "affine3d", "affine14"):
        with pytest.raises(DegeneratePoints, match="condition"):
            fit_family(name, make_points(12, ground=ground))


def test_clustered_points_do_not_determine_the_scene():
    ground = LOW + (HIGH - LOW) * [0.05, 0.05, 1] * np.random.default_rng(0).uniform(0, 1, (20, 3))
    points = make_points(20, ground=ground)
    with pytest.raises(DegeneratePoints, match="whole scene"):
        fit_family("poly2", points, size=SIZE)
    assert "uncertain at the edge" in " ".join(fit_family("affine2d", points, size=SIZE).warnings)


@pytest.mark.parametrize("name", NAMES)
def test_too_few_points(name):
    least = COUNTS[name][1]
    with pytest.raises(TooFewPoints) as caught:
        fit_family(name, make_points(least - 1))
    assert f"at least {least}" in caught.value.remedy
    with pytest.raises(TooFewPoints) as caught:
        fit(start_model(name, make_points(100)), make_points(1))
    assert "a simpler model" in caught.value.remedy


def test_no_redundancy():
    found = fit_family("affine3d", make_points(4))
    assert found.redundancy == 0
    assert found.sigma0 is None
    assert found.rmse("loo") is None
    assert np.isfinite(found.student[1]).all()


def test_collapse_without_normalisation_does_not_happen():
    """Raw UTM coordinates have conditions of 6e9 (3D affine) and 8.8e16 (DLT); normalised 2.7 and 6.8 or less."""
    assert fit_family("affine3d", make_points(20)).condition < 3
    assert fit_family("dlt", make_points(20)).condition < 7


# -- regularisation --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ridge", "sets"), [("gcv", 4), *(pytest.param(one, 12, marks=pytest.mark.slow) for one in ("gcv", "lcurve"))]
)
def test_rfm3_with_40_points_is_no_catastrophe(ridge, sets):
    """Trap 20: 39 parameters an axis from 40 points; unregularised, the check error is hundreds of pixels."""
    for seed in range(sets):
        points = make_points(240, seed=seed)
        points = points.with_roles(np.where(np.arange(240) < 40, "control", "check"))
        dlt = fit_family("dlt", points, size=SIZE)
        rfm = fit_family("rfm3", points, size=SIZE, ridge=ridge)
        assert rfm.rmse("check").total < 2 * dlt.rmse("check").total
        assert any(text.startswith("unstable") for text in rfm.warnings)
        assert rfm.effective_parameters < 40
        assert rfm.degrees_of_freedom == pytest.approx(80 - rfm.effective_parameters)


def test_rfm_without_regularisation_says_that_it_is_unstable_or_is_refused():
    with pytest.raises(DegeneratePoints, match="do not determine"):
        fit_family("rfm3", make_points(40), size=SIZE, ridge=None)
    found = fit_family("rfm2-common", make_points(400), size=SIZE, ridge=1e-4, robust=False)
    assert any(text.startswith("unstable") for text in found.warnings)


def test_strength_of_a_regularisation():
    """Weak is the unregularised fit, strong is the affine one."""
    points = make_points(200)
    weak = fit_family("rfm1", points, ridge=1e-10)
    np.testing.assert_allclose(weak.predicted, fit_family("rfm1", points, ridge=None).predicted, atol=1e-4)
    strong = fit_family("rfm1", points, ridge=1e10, robust=False)
    np.testing.assert_allclose(strong.predicted, fit_family("affine3d", points, robust=False).predicted, atol=1e-3)
    assert strong.effective_parameters == pytest.approx(8, abs=1e-3)
    with pytest.raises(InputError):
        fit_family("affine3d", points, ridge=1.0)
    with pytest.raises(InputError):
        fit_family("rfm1", points, ridge="magic")
    with pytest.raises(InputError):
        fit_family("rfm1", points, ridge=-1.0)


# -- what was left out -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["poly2", "affine12", "dlt"])
def test_leave_one_out_is_what_refits_give(name):
    points = make_points(24)
    found = fit_family(name, points, robust=False)
    for k in (0, 7, 23):
        refit = fit(found.model, points.select(np.arange(24) != k), robust=False)
        expected = points.image[[k]] - refit.model.ground_to_image(points.ground[[k]])
        np.testing.assert_allclose(found.loo_residuals[[k]], expected, atol=1e-7 if name != "dlt" else 1e-3)


def test_prune_takes_out_what_is_not_there():
    """A camera that is exactly affine, but for one term: the others of affine12 and poly3d2 go, that one stays."""
    truth = truth_of("affine3d")
    x = lambda g: (g[:, 0] - 415e3) / 15e3 * (g[:, 2] - 850) / 650  # noqa: E731
    points = make_points(60, camera=lambda g: truth.ground_to_image(g) + np.outer(x(g), [3.0, 0.0]))
    for name in ("affine12", "poly3d2"):
        pruned = prune(fit_family(name, points, size=SIZE), significance=0.01)
        assert "col_XZ" in pruned.fit.param_names
        assert len(pruned.removed) >= len(family_of(name).param_names) - 10
        assert {r.name for r in pruned.removed}.isdisjoint(pruned.fit.param_names)
        assert all(r.p > 0.01 and abs(r.t) < 3 for r in pruned.removed)
        assert pruned.fit.redundancy == 120 - len(pruned.fit.param_names)
        assert pruned.fit.rmse("loo").total < fit_family(name, points, size=SIZE).rmse("loo").total
        check_sensor_model(pruned.fit.model, points.ground)


def test_prune_keeps_what_others_build_on():
    model = start_model("poly3d2", make_points(20))
    assert set(model.removable) == {f"{axis}_{term}" for axis in ("col", "row") for term in
                                    ("X2", "Y2", "Z2", "XY", "XZ", "YZ")}  # fmt: skip
    assert "col_X" not in model.without(["col_X2", "col_XY"]).removable
    assert "col_X" in model.without(["col_X2", "col_XY", "col_XZ"]).removable
    assert "col_1" not in start_model("affine2d", make_points(20)).removable


def test_prune_of_an_image_correction():
    base = start_model("dlt", make_points(50, noise=0.0))
    truth = ImageCorrection(base, "affine", (5000, 5000), [3.0, 2e-3, 0, -2.0, 0, 0])
    points = make_points(40, camera=truth.ground_to_image, seed=2)
    pruned = prune(fit(ImageCorrection.identity(base, "affine", (5000, 5000)), points))
    assert pruned.fit.param_names == ("col_shift", "col_per_col", "row_shift")
    assert pruned.fit.model.coefficients[2] == 0
    again = model_from_dict(json.loads(json.dumps(pruned.fit.model.to_dict())))
    assert again.param_names == pruned.fit.param_names
    old = {key: value for key, value in truth.to_dict().items() if key != "removed"}
    assert model_from_dict(old).param_names == truth.param_names
    with pytest.raises(InputError, match="redundancy"):
        prune(fit(ImageCorrection.identity(base, "affine", (5000, 5000)), points.select(np.arange(3))))


def test_a_rejected_point_stays_out_when_pruned():
    points = make_points(40)
    image = points.image.copy()
    image[5] += 90.0
    pruned = prune(fit_family("dlt", make_points(40, ground=points.ground, image=image)))
    assert "p5" in [name for name, _ in pruned.fit.rejected]


def test_a_thousand_points_are_all_left_out_in_turn():
    assert fit_family("rfm3", make_points(1000)).rmse("loo").n == 1000


# -- domain of the start ---------------------------------------------------------------------------------------------


def test_the_domain_is_that_of_image_points_and_heights():
    """Nine control points from column and row 100 to 900 of an image with 1000 x 1000 pixels of 10 m."""
    image = np.stack(np.meshgrid([100.0, 500.0, 900.0], [100.0, 500.0, 900.0]), axis=-1).reshape(-1, 2)
    # The last two are check points: 14 and 16 km east of the middle of the image.
    image = np.concatenate([image, [[1900.0, 500.0], [2100.0, 500.0]]])
    heights = np.array([100.0, 300.0, 150.0, 250.0, 120.0, 180.0, 290.0, 110.0, 210.0, 200.0, 200.0])
    ground = np.column_stack([400e3 + 10 * image[:, 0], 5010e3 - 10 * image[:, 1], heights])
    points = make_points(11, ground=ground, camera=lambda _: image, noise=0.0)
    points = points.with_roles(["control"] * 9 + ["check"] * 2)
    control = points.select(np.arange(9))
    # Each side is 1 % of the extent farther.
    box = start_model("affine3d", control, size=(1000, 1000)).box
    np.testing.assert_allclose(box, [[399_900, 4_999_900, 98], [410_100, 5_010_100, 302]], atol=1e-6)
    box = start_model("affine3d", control).box
    np.testing.assert_allclose(box, [[400_920, 5_000_920, 98], [409_080, 5_009_080, 302]], atol=1e-6)
    box = start_model("affine3d", control, heights=(0.0, 1000.0)).box
    np.testing.assert_allclose(box[:, 2], [-10.0, 1010.0], atol=1e-9)
    box = start_model("affine3d", points, size=(1000, 1000)).box
    np.testing.assert_allclose(box[:, 0], [400e3 - 190, 419e3 + 190], atol=1e-6)
    # Terrain is never exactly flat: a thousandth of the extent.
    flat = start_model("affine2d", control.with_ground(control.ground * (1, 1, 0) + (0, 0, 200)), size=(1000, 1000))
    np.testing.assert_allclose(flat.box[:, 2], [200 - 5.1, 200 + 5.1], atol=1e-6)


def test_the_corner_of_an_l_is_found_and_not_a_turn_away_from_the_origin():
    # Down from 5 to 0, to the right by 4, with the sharp corner at index 5; before it a turn outwards.
    x = np.array([0.0, 0, 0, 0, 0, 0, 1, 2, 3, 4])
    y = np.array([5.0, 4, 3, 2, 1, 0, 0, 0, 0, 0])
    assert _corner(x, y) == 5
    outwards = np.concatenate([[-3.0, -2.0, -1.0], x]), np.concatenate([[5.0, 5.0, 5.0], y])
    assert _corner(*outwards) == 8
