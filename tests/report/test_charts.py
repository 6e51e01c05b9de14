"""Plots for notebooks: what is drawn where."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from ortho_pipeline.report.notebook.charts import residual_axes, rmse_axes

matplotlib.use("Agg")


@pytest.fixture
def axes():
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def test_arrows_are_the_residuals_at_their_points_and_rows_go_down(axes):
    image = np.array([[0.0, 0.0], [1000.0, 500.0], [10.0, 20.0], [5.0, np.nan]])
    residuals = np.array([[0.3, -0.4], [0.1, 0.0], [90.0, 0.0], [1.0, 1.0]])
    found = residual_axes(image, residuals, ["control", "check", "out", "check"], "a fit", axes)
    assert found is axes
    assert axes.yaxis_inverted()
    arrows = {tuple(one.XY[0]): (one.U[0], one.V[0]) for one in axes.collections}
    assert arrows == {(0.0, 0.0): (0.3, -0.4), (1000.0, 500.0): (0.1, 0.0)}
    # The longest (0.5 px) is a tenth of what the points span.
    assert axes.collections[0].scale == pytest.approx(0.5 / 100)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["control", "check", "left out"]


def test_models_stand_in_their_order_and_the_recommended_is_named(axes):
    rmse_axes({"rpc": {"control": 7.0}, "rpc+shift": {"control": 0.2, "check": 0.3}}, "rpc+shift", axes)
    assert [text.get_text() for text in axes.get_yticklabels()] == ["rpc", "rpc+shift (recommended)"]
    drawn = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert drawn == {"control": [[7.0, 0.0], [0.2, 1.0]], "check": [[0.3, 1.0]]}
