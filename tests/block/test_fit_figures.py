"""Figures of an adjusted block, number by number: which rays and points count, and what is published of each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chains import Chain, fly, with_control

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.network import network_of
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform


@pytest.fixture(scope="module")
def fit() -> BlockFit:
    """Return a block of three images with drawn residuals, some of them unknown, and some unused rays and ground."""
    block = fly(Chain(images=3, convergence_deg=15.0, overlap=0.7, ties=40, errors=2.0, pairwise=False), 3)
    found = adjust(block.start, with_control(block, "i1", count=6), robust=False)
    random = np.random.default_rng(1)
    rays = found.points.rays
    roles = found.points.roles.copy()
    roles[np.flatnonzero(roles == "tie")[:9]] = "check"
    ground = np.where((roles == "check")[:, None], found.points.ground[found.points.control][0], found.points.ground)
    residuals = [random.normal(0, (1.0, 3.0), (rays, 2)) for _ in range(3)]
    residuals[0][::11, 1] = residuals[1][::7, 0] = residuals[2][::5] = np.nan
    objects = random.normal(1.0, (1.0, 2.0, 4.0), (40, 3))
    objects[np.flatnonzero(roles == "check")[0], 2] = np.nan
    return replace(
        found, points=replace(found.points, roles=roles, ground=ground), residuals=residuals[0],
        back_projected=residuals[1], raw_residuals=residuals[2], object_residuals=objects,
        used_rays=random.random(rays) < 0.8, used_ground=(roles == "control") & (random.random(40) < 0.7), sigma0=0.7,
    )  # fmt: skip


@pytest.mark.parametrize("role", ["control", "check", "tie"])
@pytest.mark.parametrize("which", ["residuals", "back_projected", "raw_residuals"])
def test_root_mean_squares_of_an_image_are_over_what_was_used(fit: BlockFit, which: str, role: str) -> None:
    """At the adjusted ground rays that were used; of control at its ground those whose ground was used, too."""
    points = fit.points
    sizes = []
    for number, image in enumerate(points.images):
        rows = []
        for ray, (col, row) in enumerate(getattr(fit, which)):
            point = points.point[ray]
            if points.image[ray] != number or points.roles[point] != role or math.isnan(col + row):
                continue
            if not fit.used_rays[ray] and (role == "control" or which == "residuals"):
                continue
            if role == "control" and which != "residuals" and not fit.used_ground[point]:
                continue
            rows.append((col, row))
        found = fit.image_rms(image, role, which)
        assert found is not None
        col, row = np.sqrt(np.square(rows).mean(axis=0))
        assert (found.col, found.row, found.total, found.n) == pytest.approx(
            (col, row, math.hypot(col, row), len(rows))
        )
        sizes.append(found.n)
        assert getattr(getattr(fit.record.images[image].rms, which), role) == found
    assert sum(sizes) < (points.roles[points.point] == role).sum()
    with pytest.raises(InputError, match="no role 'nobody'"):
        fit.image_rms("i0", "nobody")
    with pytest.raises(InputError, match="no residuals 'other'"):
        fit.image_rms("i0", role, "other")


def test_what_is_published_of_points_and_rays_is_theirs(fit: BlockFit) -> None:
    record = fit.record
    for k, point in enumerate(record.points):
        assert (point.id, point.role, point.used_ground) == (fit.points.ids[k], fit.points.roles[k], fit.used_ground[k])
        assert point.ground == pytest.approx(tuple(fit.ground[k]))
        sigmas = np.sqrt(np.diag(fit.ground_covariance[k]))
        assert point.sigma == pytest.approx(tuple(sigmas))
        wanted = [None if math.isnan(value) else pytest.approx(value) for value in fit.object_residuals[k]]
        assert list(point.residual) == wanted
    for k, ray in enumerate(record.rays):
        assert ray.id == fit.points.ids[fit.points.point[k]]
        assert (ray.image, ray.used) == (fit.points.images[fit.points.image[k]], fit.used_rays[k])
        assert list(ray.measured) == fit.points.measured[k].tolist()
        for found, wanted in ((ray.residual, fit.residuals[k]), (ray.back_projected, fit.back_projected[k])):
            assert list(found) == [None if math.isnan(value) else value for value in wanted]
    for number, (name, image) in enumerate(record.images.items()):
        assert image.rays == int((fit.used_rays & (fit.points.image == number)).sum())
        values = {key: (one.value, one.sigma) for key, one in image.parameters.items()}
        own = fit.models[name].params
        sigmas = np.sqrt(np.diag(fit.covariance))[2 * number : 2 * number + 2]
        assert list(values) == ["col_shift", "row_shift"]
        assert list(values.values()) == [
            pytest.approx((value, sigma)) for value, sigma in zip(own, sigmas, strict=True)
        ]
    assert record.object_rms.control == fit.object_rms("control")
    assert record.object_rms.check == fit.object_rms("check")


def test_a_sentence_tells_the_size_and_the_accuracy(fit: BlockFit) -> None:
    checks = fit.object_residuals[fit.points.check][1:]
    east, north, up = np.sqrt((checks**2).mean(axis=0))
    assert repr(fit) == (
        f"<block of 3 images, 40 points: sigma0 0.7; RMSE {math.hypot(east, north):.2f} m, height {up:.2f} m at "
        "8 check points>"
    )
    assert repr(replace(fit, sigma0=None)).startswith("<block of 3 images, 40 points: sigma0 unknown;")
    known = fit.known_in(GEODETIC)
    np.testing.assert_allclose(
        known, ground_transform(fit.points.crs, GEODETIC)(fit.points.ground), rtol=0, atol=1e-9, equal_nan=True
    )


# -- the network -------------------------------------------------------------------------------------------------------


def test_angles_of_the_network_are_of_used_rays_and_of_the_widest_pair_of_a_point(fit: BlockFit) -> None:
    """Rays of a frame start at one place: angles are those between the directions to these places."""
    points = fit.points
    whole = replace(fit, used_rays=np.ones(points.rays, dtype=bool))
    found, everything = network_of(fit), network_of(whole)
    largest = np.array(everything.largest_deg, dtype=float)
    stations = {k: fit.models[name].model.exterior[:3] for k, name in enumerate(points.images)}  # type: ignore[attr-defined]
    ground = ground_transform(GEODETIC, "EPSG:32636")(fit.ground)
    pairs: dict[tuple[str, str], list[float]] = {}
    widest = np.full(len(points), np.nan)
    for k in range(len(points)):
        mine = np.flatnonzero((points.point == k) & fit.used_rays)
        for a in range(len(mine)):
            for b in range(a + 1, len(mine)):
                ends = sorted((points.image[mine[a]], points.image[mine[b]]))
                one, other = (stations[end] - ground[k] for end in ends)
                angle = math.degrees(math.acos(one @ other / np.linalg.norm(one) / np.linalg.norm(other)))
                pairs.setdefault((points.images[ends[0]], points.images[ends[1]]), []).append(angle)
                widest[k] = np.fmax(widest[k], angle)
    assert {(pair.first, pair.second): pair.points for pair in found.pairs} == {
        pair: len(angles) for pair, angles in pairs.items()
    }
    for pair in found.pairs:
        assert pair.angle_deg == pytest.approx(np.median(pairs[pair.first, pair.second]), rel=2e-3)
    np.testing.assert_allclose(np.array(found.largest_deg, dtype=float), widest, rtol=2e-3)
    assert np.nansum(widest) < np.nansum(largest)
    known = widest[np.isfinite(widest)]
    assert found.angles is not None
    assert found.angles.points == len(known) < 40
    figures = found.angles.least, found.angles.median, found.angles.greatest
    assert figures == pytest.approx((known.min(), np.median(known), known.max()), rel=2e-3)


def test_the_largest_part_of_a_network_is_the_first(fit: BlockFit) -> None:
    points = fit.points
    apart = replace(fit, used_rays=points.image != 0)
    assert network_of(apart).parts == (("i1", "i2"), ("i0",))
    assert network_of(replace(fit, used_rays=points.image == 1)).parts == (("i0",), ("i1",), ("i2",))
    assert [(pair.first, pair.second) for pair in network_of(apart).pairs] == [("i1", "i2")]
