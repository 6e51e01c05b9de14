"""What users of RAPORIO ask of an adjustment: tests of each parameter, a choice of them, weights and distances."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import PointOptions


def points_of(tiny: Any, **more: Any) -> PointOptions:
    return PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid", **more)


def run(tiny: Any, *options: str) -> Any:
    given = [str(tiny.image), "--gcps", str(tiny.gcps), "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]
    return CliRunner().invoke(cli, ["fit", *given, *options])


def test_every_parameter_is_printed_with_its_tests(tiny):
    done = run(tiny, "--correction", "affine")
    assert done.exit_code == 0, done.stderr
    document = json.loads(run(tiny, "--correction", "affine", "--json").stdout)
    statistics = document["statistics"]
    lines = {line.split()[0]: line for line in done.stdout.splitlines() if line.startswith("  ")}
    for name, parameter in document["parameters"].items():
        t, p, total = (statistics[key][name] for key in ("t", "p", "total_correlation"))
        assert t == pytest.approx(parameter["value"] / parameter["sigma"])
        assert f" {t:.1f} " in lines[name]
        assert ("< 0.001" if p < 0.001 else f"{p:.3f}") in lines[name]
        assert f"{total:.3f}" in lines[name]
        assert ("not justified" in lines[name]) == (p > 0.05)
    # The bias of the scene is a shift.
    assert set(statistics["not_justified"]) == {"col_per_col", "col_per_row", "row_per_col", "row_per_row"}
    assert document["covariance"]["control"]["statement"] in done.stdout


def test_the_significance_is_the_users(tiny):
    document = json.loads(run(tiny, "--correction", "affine", "--json").stdout)
    p = document["statistics"]["p"]
    between = np.mean(sorted(p.values())[-2:])
    strict = json.loads(run(tiny, "--correction", "affine", "--significance", str(between), "--json").stdout)
    assert strict["statistics"]["not_justified"] == [max(p, key=p.__getitem__)]
    assert strict["statistics"]["significance"] == pytest.approx(between)
    kept = commands.fit(tiny.image, points_of(tiny, correction="affine", prune=True, significance=0.999))
    assert len(kept.fit.param_names) > len(commands.fit(
        tiny.image, points_of(tiny, correction="affine", prune=True)
    ).fit.param_names)  # fmt: skip
    assert run(tiny, "--significance", "0").exit_code == 2


def test_parameters_are_chosen_by_name(tiny):
    whole = commands.fit(tiny.image, points_of(tiny, correction="affine")).fit
    assert whole.param_names[:1] == ("col_shift",)
    chosen = commands.fit(tiny.image, points_of(tiny, correction="affine", params="col_shift, row_shift")).fit
    shift = commands.fit(tiny.image, points_of(tiny, correction="shift")).fit
    assert chosen.param_names == ("col_shift", "row_shift")
    np.testing.assert_allclose(chosen.values, shift.values, atol=1e-9)
    np.testing.assert_allclose(chosen.residuals, shift.residuals, atol=1e-9)
    # A family from the points: affine12 without its two products is affine3d.
    twelve = commands.fit(tiny.image, points_of(tiny, fit_model="affine12")).fit
    eight = commands.fit(tiny.image, points_of(tiny, fit_model="affine3d")).fit
    names = ",".join(name for name in twelve.param_names if name in eight.param_names)
    again = commands.fit(tiny.image, points_of(tiny, fit_model="affine12", params=names)).fit
    assert len(twelve.param_names) == 12
    np.testing.assert_allclose(again.residuals, eight.residuals, atol=1e-8)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"correction": "affine", "params": "col_shift,nonsense"}, "points.params"),
        ({"correction": "affine", "params": " , "}, "points.params"),
        ({"correction": "shift", "ridge": "1e-5"}, "points.ridge"),
        ({"fit_model": "rfm1", "ridge": "strong"}, "points.ridge"),
        ({"fit_model": "rfm1", "ridge": "-1"}, "points.ridge"),
    ],
)
def test_what_makes_no_sense_is_refused(tiny, options, field):
    with pytest.raises(InputError) as caught:
        commands.fit(tiny.image, points_of(tiny, **options))
    assert caught.value.field == field
    assert caught.value.remedy


def test_the_weight_of_the_regularisation_is_the_users(tiny):
    tiny.write(tiny.gcps, tiny.points(20))
    for text, expected in (("1e-4", 1e-4), ("none", None)):
        assert commands.fit(tiny.image, points_of(tiny, fit_model="rfm1", ridge=text)).fit.ridge == expected
    found = commands.fit(tiny.image, points_of(tiny, fit_model="rfm1", ridge="gcv")).fit.ridge
    assert commands.fit(tiny.image, points_of(tiny, fit_model="rfm1")).fit.ridge == found
    strong, weak = (
        np.abs(commands.fit(tiny.image, points_of(tiny, fit_model="rfm1", ridge=text)).fit.values[-6:]).max()
        for text in ("1e3", "1e-6")
    )
    assert strong < 0.01 * weak


def test_the_distance_of_neighbours_is_the_users(tiny):
    tiny.write(tiny.gcps, tiny.points(30))
    found = commands.fit(tiny.image, points_of(tiny, near=700.0)).to_json()["covariance"]["control"]
    assert found["near_m"] == 700.0
    assert found["classes"][0]["to_m"] == 700.0
    other = commands.fit(tiny.image, points_of(tiny)).to_json()["covariance"]["control"]
    assert other["near_m"] != 700.0
