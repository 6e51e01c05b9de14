"""Rays of all images at once: the compiled loop against the models, one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.projection import rays
from ortho_pipeline.block.projection.rays import linearised
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models import RPC, ImageCorrection, SensorModel
from ortho_pipeline.models.correction import COEFFICIENTS, FREE

SIZE = 2000


@pytest.fixture(scope="module")
def rpc() -> RPC:
    """Return the RPC of a scene across the antimeridian, whose longitudes jump by 360 degrees."""
    camera = LineScanner.over(
        33.0, 37.0, 800.0, image_width=SIZE, image_height=SIZE, gsd=2.5, off_nadir_deg=17.0, heights=(0.0, 1600.0)
    )  # fmt: skip
    return replace(export_rpc(camera).rpc, lon_off=179.999)


def test_all_images_at_once_are_the_models_one_by_one(rpc: RPC, monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    models: list[SensorModel] = [rpc]
    for kind in FREE:
        free = [name in FREE[kind] for name in COEFFICIENTS]
        values = random.normal(0, (8, 3e-3, 3e-3) * 2) * free
        models.append(ImageCorrection(rpc, kind, (SIZE / 2, SIZE / 3), values))
    models += [models[-1].without(["col_per_row"]), ImageCorrection.identity(models[2], "shift", (0.0, 0.0))]
    # Some of the points lie beyond what the RPC is meant for, others nowhere; one ray in seven belongs to no image.
    centre, half = rpc.domain
    ground = centre + random.uniform(-1.6, 1.6, (400, 3)) * half
    ground[:, 0] = (ground[:, 0] + 180.0) % 360.0 - 180.0
    ground[::50] = np.nan
    frame = GroundFrame(np.array([179.99, 37.01, 0.0]))
    places = frame.places(frame.of_geodetic(ground))
    count = 150 * len(models)
    point, scale = random.integers(0, len(ground), count), random.uniform(0.1, 5.0, count)
    image = np.arange(count) % (len(models) + 1)
    of_images = [np.flatnonzero(image == n) for n in range(len(models))]
    found = linearised(places, models, of_images, point, scale, 6)
    for model, used in zip(models, of_images, strict=True):
        wanted, by_point, by_params = places.linearised(model, point[used])
        np.testing.assert_allclose(found.image[used], wanted, rtol=0, atol=1e-8)
        seen = used[np.isfinite(wanted[:, 0])]
        assert 20 < len(seen) < len(used) - 10
        by_point, by_params = by_point * scale[used, None, None], by_params * scale[used, None, None]
        np.testing.assert_allclose(found.by_point[used], by_point, rtol=0, atol=1e-10)
        own = by_params.shape[2]
        np.testing.assert_allclose(found.by_params[seen, :, :own], by_params[np.isfinite(wanted[:, 0])], rtol=1e-10)
        assert not found.by_params[seen, :, own:].any()
        lost = np.setdiff1d(used, seen)
        assert np.isnan(found.by_point[lost]).any(axis=(1, 2)).all()
        assert not own or np.isnan(found.by_params[lost]).any(axis=(1, 2)).all()
    of_none = np.flatnonzero(image == len(models))
    assert not any(part[of_none].any() for part in (found.image, found.by_point, found.by_params))
    monkeypatch.setattr(rays, "_SHARE", 100)
    in_parts = linearised(places, models, of_images, point, scale, 6)
    for name in ("image", "by_point", "by_params"):
        np.testing.assert_array_equal(getattr(in_parts, name), getattr(found, name))
    alone = linearised(places, models, of_images, point, scale, 0)
    np.testing.assert_array_equal(alone.by_point, found.by_point)
    assert alone.by_params.shape == (count, 2, 0)
