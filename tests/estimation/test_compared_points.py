"""The points to which models are fitted side by side: the same for all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ortho_pipeline.estimation.choice.comparison import compare
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.points import Points

MODELS = ("affine2d", "affine3d", "dlt")


def seen(level: RPC, heights: np.ndarray) -> Points:
    """Return 24 points of a scene that looks a metre aside per 4 m of height, measured to 0.3 px."""
    random = np.random.default_rng(3)
    ground = np.column_stack([random.uniform([19.992, -30.008], [20.008, -29.992], (24, 2)), heights])
    image = level.ground_to_image(ground) + np.outer(heights - 500.0, (0.25, 0.0)) + random.normal(0, 0.3, (24, 2))
    return Points.of(image, ground, "EPSG:4979", sigma_image=0.3)


def with_blunder(points: Points) -> Points:
    image = points.image.copy()
    image[7] += (0.0, 40.0)
    return replace(points, image=image)


def test_a_point_that_most_models_reject_is_left_out_of_those_that_do_not_see_it(level: RPC) -> None:
    """A plane model is off by 50 px on such hills: 40 px are nothing to it."""
    points = with_blunder(seen(level, np.random.default_rng(4).uniform(300.0, 700.0, 24)))
    plane = fit_family("affine2d", points, size=(2000, 2000))
    assert not plane.rejected
    done = compare(points, MODELS, size=(2000, 2000))
    assert [one.id for one in done.left_out] == [points.ids[7]]
    kept = points.select(np.arange(24) != 7)
    for row in done.rows:
        assert row.fit is not None
        assert row.fit.points.ids == kept.ids
        assert row.fit.used.all()
        wanted = fit_family(row.model, kept, size=(2000, 2000), robust=False)
        np.testing.assert_allclose(row.fit.values, wanted.values, rtol=1e-9)


def test_a_point_that_a_poor_model_alone_rejects_is_used_by_it(level: RPC) -> None:
    """A plane model takes the only summit for a gross error."""
    heights = np.full(24, 500.0) + np.random.default_rng(4).uniform(-2.0, 2.0, 24)
    heights[[11, 12]] = 900.0, 300.0
    points = seen(level, heights)
    assert {name for name, _ in fit_family("affine2d", points, size=(2000, 2000)).rejected} >= {points.ids[11]}
    done = compare(points, (*MODELS, "rfm3"), size=(2000, 2000))
    assert not done.left_out
    rows = {row.model: row.fit for row in done.rows}
    # The last one has more parameters than these points determine.
    assert rows["rfm3"] is None
    assert [int(found.used.sum()) for found in rows.values() if found] == [24, 24, 24]
    plane = rows["affine2d"]
    assert plane is not None
    # Without heights the model cannot follow a summit 400 m above the rest: 100 px.
    assert np.abs(plane.residuals[:, 0]).max() == pytest.approx(100.0, rel=0.3)


def test_corrections_of_the_scenes_own_model_are_about_the_middle_of_its_image(level: RPC) -> None:
    """Far from it, a shift would depend on the slopes."""
    points = seen(level, np.full(24, 500.0))
    points = replace(points, image=points.image * 1.001 + (4.0, -3.0))
    done = compare(points, ("rpc", "rpc+affine"), own=level, size=(2000, 1200))
    for row, kind in zip(done.rows, ("none", "affine"), strict=True):
        assert row.fit is not None
        wanted = fit(ImageCorrection.identity(level, kind, (1000.0, 600.0)), points)
        np.testing.assert_allclose(row.fit.values, wanted.values, rtol=1e-9)
        np.testing.assert_allclose(row.fit.residuals, wanted.residuals, atol=1e-9)


def test_an_unsuited_model_has_its_warning_and_is_not_recommended(level: RPC) -> None:
    points = seen(level, np.random.default_rng(4).uniform(300.0, 700.0, 24))
    assert compare(points, MODELS, size=(2000, 2000)).recommended == "affine3d"
    why = {"affine3d": "this scanner turns while it scans", "poly5": "not asked for"}
    done = compare(points, MODELS, size=(2000, 2000), unsuited=why, significance=0.2)
    assert done.recommended == "dlt"
    told = {row.model: [one["text"] for one in row.notices if one["code"] == "unsuited-model"] for row in done.rows}
    assert told == {"affine2d": [], "affine3d": [why["affine3d"]], "dlt": []}
    assert {row.fit.significance for row in done.rows if row.fit} == {0.2}
