"""RPCs have no pole and no fold in the box that they are meant for; dense samples of their own say so."""

import dataclasses
import itertools

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import read_rpc
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.models.rpc_box import RPC_TERMS, has_pole

NUMBERS = [f"{name}_{part}" for name in ("col", "row", "lon", "lat", "h") for part in ("off", "scale")]
COEFFICIENTS = ["col_num", "col_den", "row_num", "row_den"]


def terms_at(places):
    return np.prod(places[None] ** RPC_TERMS[:, None], axis=2)


DENSE = np.concatenate(
    [
        np.random.default_rng(5).uniform(-1, 1, (5000, 3)),
        np.array(list(itertools.product(np.linspace(-1, 1, 9), repeat=3))),
    ]
)
DENSE_TERMS = terms_at(DENSE)


def simple(**changes):
    fields = {
        "col_off": 5000.0, "row_off": 6000.0, "lon_off": 24.5, "lat_off": -33.6, "h_off": 700.0, "col_scale": 5000.0,
        "row_scale": 6000.0, "lon_scale": 0.1, "lat_scale": 0.1, "h_scale": 500.0,
        "col_num": np.eye(20)[1] + 0.02 * np.eye(20)[3], "row_num": -np.eye(20)[2] + 0.1 * np.eye(20)[3],
        "col_den": np.eye(20)[0], "row_den": np.eye(20)[0],
    }  # fmt: skip
    return RPC(**{**fields, **changes})


def test_a_pole_is_found_wherever_it_is_and_only_where_there_is_one():
    random = np.random.default_rng(3)
    found = 0
    for _ in range(400):
        denominator = np.concatenate([[1.0], random.normal(size=19) * random.choice([0.02, 0.1, 0.3])])
        lowest = (denominator @ DENSE_TERMS).min()
        if has_pole(denominator):
            found += 1
        else:
            assert lowest > 0
        if lowest <= 0:
            assert has_pole(denominator)
        # What the bound refuses has a pole, or comes so near one that samples cannot tell.
        if lowest > 0.1:
            assert not has_pole(denominator)
    assert 50 < found < 350


def test_a_pole_between_all_samples_is_found():
    # (x - 0.31)^2 + small: zero nowhere but near a plane that no regular grid has.
    x, xx = np.eye(20)[1], np.eye(20)[7]
    at_centre = 0.31**2 + 1e-6
    denominator = (xx - 0.62 * x + at_centre * np.eye(20)[0]) / at_centre
    assert has_pole(denominator)
    assert not has_pole((xx - 0.62 * x + (0.31**2 + 0.01) * np.eye(20)[0]) / (0.31**2 + 0.01))


@pytest.mark.parametrize("name", ["col_den", "row_den"])
def test_a_pole_in_the_box_is_refused_with_its_field_and_a_remedy(name):
    with pytest.raises(InputError, match="zero within its box") as caught:
        simple(**{name: np.eye(20)[0] - 1.2 * np.eye(20)[1]})
    assert caught.value.field == name
    assert caught.value.remedy


def test_a_fold_in_the_box_is_refused():
    with pytest.raises(InputError, match="several places on the ground"):
        simple(col_num=np.eye(20)[1] - 2.0 * np.eye(20)[7])
    with pytest.raises(InputError, match="x inf m on the ground"):
        simple(row_num=np.eye(20)[1])  # the image is a line


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lon_scale", 1e300),
        ("h_scale", 1e300),
        ("col_scale", 1e300),
        ("lat_off", 91.0),
        ("lat_scale", 1e-9),
        ("col_off", 1e12),
    ],
)
def test_numbers_of_no_scene_on_earth_are_refused_with_their_field(name, value):
    with pytest.raises(InputError) as caught:
        simple(**{name: value})
    assert name in str(caught.value.field)


@pytest.mark.parametrize("name", [name for name in NUMBERS if name.endswith("scale")])
def test_a_scale_of_zero_is_refused_with_its_field(name):
    with pytest.raises(InputError, match="cannot be zero") as caught:
        simple(**{name: 0.0})
    assert caught.value.field == name


def test_heights_may_have_a_scale_of_a_metre_and_longitudes_an_offset_of_zero():
    model = simple(h_scale=1.0, lon_off=0.0)
    assert (model.height_range, model.domain[0][0]) == ((699.0, 701.0), 0.0)


def test_coefficients_whose_pixels_are_too_large_for_numbers_are_refused():
    with pytest.raises(InputError, match="finite coefficients") as caught:
        simple(col_num=np.eye(20)[1] + 1e308 * np.eye(20)[13])
    assert caught.value.field == "col_num"


def test_a_pole_at_heights_far_from_the_middle_takes_these_heights_away():
    # 1 + 1.4 H is zero at H = -0.71, that is 343 m.
    model = simple(row_den=np.eye(20)[0] + 1.4 * np.eye(20)[3])
    low, high = model.height_range
    assert 343 < low < 450
    assert high == 1200
    assert model.height_limits[0] == low
    ground = np.array([[24.5, -33.6, low - 1.0], [24.5, -33.6, low + 1.0], [24.5, -33.6, 100.0]])
    np.testing.assert_array_equal(np.isfinite(model.ground_to_image(ground)[:, 0]), [False, True, False])
    assert low < model.reference_height < high


def test_negative_scales_count_coordinates_and_pixels_the_other_way():
    """The same camera as with positive ones, with a pole that takes the lower heights away."""
    model = simple(row_den=np.eye(20)[0] + 1.4 * np.eye(20)[3])
    signs = np.prod((-1.0) ** RPC_TERMS, axis=1)
    changes = {name: -getattr(model, name) for name in NUMBERS if name.endswith("_scale")}
    changes |= {name: getattr(model, name) * (signs if "den" in name else -signs) for name in COEFFICIENTS}
    turned = dataclasses.replace(model, **changes)
    np.testing.assert_allclose(turned.domain, model.domain)
    assert turned.height_range == pytest.approx(model.height_range)
    assert turned.height_limits == pytest.approx(model.height_limits)
    places = np.random.default_rng(6).uniform(-1.7, 1.7, (200, 3))
    ground = (model.lon_off, model.lat_off, model.h_off) + places * (0.1, 0.1, 500.0)
    image = model.ground_to_image(ground)
    seen = np.isfinite(image[:, 0])
    assert 20 < seen.sum() < 180
    np.testing.assert_allclose(turned.ground_to_image(ground), image, atol=1e-7)
    np.testing.assert_allclose(turned.image_to_ground(image[seen], ground[seen, 2]), ground[seen], atol=1e-9)


def test_mutants_that_are_accepted_have_no_pole_in_their_box():
    random = np.random.default_rng(14)
    accepted = unclear = 0
    for _ in range(1000):
        base = simple(
            col_den=np.concatenate([[1.0], random.normal(size=19) * 1e-3]),
            row_den=np.concatenate([[1.0], random.normal(size=19) * 1e-3]),
        )
        fields = {name: getattr(base, name) for name in NUMBERS + COEFFICIENTS}
        for _ in range(random.integers(1, 4)):
            if random.random() < 0.3:
                name = random.choice(NUMBERS)
                fields[name] *= float(random.choice([-1.0, 0.1, 10.0, 1e3, 1e300]))
            else:
                name = random.choice(COEFFICIENTS)
                fields[name] = fields[name].copy()
                fields[name][random.integers(20)] += random.choice([-1, 1]) * 10.0 ** random.integers(-3, 1)
        try:
            model = RPC(**fields)
        except InputError as error:
            unclear += not (error.field and error.remedy)
            continue
        accepted += 1
        low, high = sorted((height - model.h_off) / model.h_scale for height in model.height_range)
        within = (DENSE[:, 2] >= low) & (DENSE[:, 2] <= high)
        for denominator in (model.col_den, model.row_den):
            assert (denominator / denominator[0] @ DENSE_TERMS)[within].min() > 0
    assert accepted > 300
    assert unclear == 0


def test_what_is_checked_is_checked_again_in_a_changed_model():
    with pytest.raises(InputError):
        dataclasses.replace(simple(), col_den=np.eye(20)[0] - 1.2 * np.eye(20)[2])


FOLDERS = ("gdal/gcore/data", "gdal/alg/data", "gdal/utilities/data", "otb", "orthority/rpc", "rpcm", "shareloc/rpc")
FOLDERS += ("s2p/input_triplet", "sensors/asp_plot")


@pytest.mark.realdata
def test_real_rpcs_are_accepted_and_narrowed_only_where_they_have_poles_or_folds(real):
    narrowed = {}
    count, refused = 0, []
    for folder in FOLDERS:
        for path in sorted((real / folder).rglob("*")):
            if path.suffix.lower() not in (".tif", ".txt", ".rpb", ".xml", ".rpc", ".geom", ".ntf", ".vrt"):
                continue
            try:
                model = read_rpc(path)
            except InputError as error:
                refused += ["within its box" in error.message or "Earth" in error.message]
                continue
            count += 1
            reach = 1.5 * abs(model.h_scale)
            if model.height_limits != pytest.approx((model.h_off - reach, model.h_off + reach)):
                narrowed[path.name] = model.height_range
    assert count >= 50
    assert not any(refused)  # the others are no RPCs, or lack fields
    # EROS-A of GDAL's tests folds below 500 m, the Planet scene of its bug report has a pole at -4 m.
    assert set(narrowed) == {"md_eros.rpc", "md_eros.tif", "unstable_rpc_with_dem_source.tif"}


@pytest.mark.parametrize(
    ("bend", "heights"), [(-2.0, (200.0, 887.5)), (2.0, (512.5, 1200.0)), (-0.5, (200.0, 1200.0)), (-5.0, None)]
)
def test_heights_beyond_a_fold_are_taken_away(bend, heights):
    # The column is L (1 + bend H): its slope is zero at H = -1 / bend, and levels are an eighth of 500 m apart.
    column = np.eye(20)[1] + bend * np.eye(20)[5]
    if heights is None:  # at 0.2 of the half-height above the middle
        with pytest.raises(InputError, match="several places on the ground"):
            simple(col_num=column)
    else:
        assert simple(col_num=column).height_range == pytest.approx(heights)


def test_the_widest_pixel_is_100_km_at_its_latitude():
    # 180 degrees of longitude on 100 pixels are 200.4 km at the equator, 100 km at a latitude of 60.06 degrees.
    wide = {"lon_scale": 180.0, "col_scale": 100.0, "lon_off": 0.0}
    assert simple(lat_off=60.5, **wide).lat_off == 60.5
    with pytest.raises(InputError, match="a pixel of this RPC would be"):
        simple(lat_off=59.5, **wide)


def test_a_pole_between_the_middle_and_the_top_takes_the_top_away():
    # (1 - H / 0.53) (1 - H / 0.55) is negative between these heights alone: no level of 1/16 is in between.
    denominator = np.eye(20)[0] - (1 / 0.53 + 1 / 0.55) * np.eye(20)[3] + 1 / (0.53 * 0.55) * np.eye(20)[9]
    for side in (1.0, -1.0):
        turned = denominator * np.where(np.arange(20) == 3, side, 1.0)
        model = simple(row_num=-np.eye(20)[2], row_den=turned)
        low, high = sorted(side * (h - 700.0) / 500.0 for h in model.height_range)
        # The other side of the middle is sound: poles on one side take nothing of the other.
        assert low == -1.0
        assert 0.25 <= high < 0.53
