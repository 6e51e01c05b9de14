"""A fit is the same bytes with any number of threads of BLAS, and so on any number of processors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.rpc import rpc_of_dataset
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import open_dataset

#: Of points: enough that the sums of BLAS are shared out.
COUNT = 200


@pytest.fixture
def many(tiny):
    """Points of groups that share errors, as matches do: their covariances are matrices that BLAS shares out."""
    points = read_points(
        tiny.write(tiny.folder / "many.csv", tiny.points(COUNT)), crs="EPSG:4979", vertical="ellipsoid"
    )
    waves = 0.3 * np.sin(points.image[:, ::-1] / 40)
    return replace(points, image=points.image + waves, groups=np.arange(COUNT) // 4)


def fitted(many, model) -> bytes:
    found = fit(ImageCorrection.identity(model, "affine", (0.0, 0.0)), many, robust=False)
    return b"".join(np.asarray(part).tobytes() for part in (found.values, found.covariance, found.residuals))


def test_a_fit_does_not_depend_on_threads(many, tiny):
    model, found = rpc_of_dataset(open_dataset(tiny.image))[0], []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            found.append(fitted(many, model))
    assert found[1:] == found[:-1]
