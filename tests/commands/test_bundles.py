"""Images of one acquisition with models of their own: points of the panchromatic one in the pixels of the colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from seeds import SIZE, rpc

from ortho_pipeline.commands.control.points import read_control
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError
from ortho_pipeline.hookspecs import Piece, Scene
from ortho_pipeline.options import PointOptions
from ortho_pipeline.points import formats
from ortho_pipeline.surface.flat import FlatSurface

OFF = np.array([3.0, -2.0])


@pytest.fixture
def colours(tmp_path: Path) -> Scene:
    """A scene four times as coarse, which sees what is high two of its pixels further down; its sharp sister."""
    model = rpc().scaled(4.0)
    parallax = np.eye(20)[3] * 2.0 / model.row_scale
    model = replace(model, row_num=model.row_num + parallax, row_den=np.eye(20)[0])
    sharp = Piece(tmp_path / "pan.tif", size=SIZE, model=replace(rpc(), row_den=np.eye(20)[0]), scale=0.25)
    return Scene("rpc", tmp_path / "ms.tif", SIZE[0] // 4, SIZE[1] // 4, {"rpc": model}, "made", pieces=(sharp,))


def measured(scene: Scene, tmp_path: Path, *, heights: bool = True) -> tuple[PointOptions, np.ndarray]:
    """Write points that were measured in the panchromatic image, all off by the same; return their ground too."""
    (pan,) = scene.pieces
    image = np.array([[10.0, 20.0], [50.0, 40.0], [30.0, 60.0]])
    ground = pan.model.image_to_ground(image, pan.model.h_off + np.array([-300.0, 0.0, 400.0]) * heights)
    lines = ["id,image,col,row,x,y,h,sigma_image"]
    for k, ((x, y), (lon, lat, h)) in enumerate(zip((image + OFF).tolist(), ground.tolist(), strict=True)):
        lines.append(f"{k},pan.tif,{x},{y},{lon},{lat},{h if heights else ''},0.4")
    (tmp_path / "p.csv").write_text("\n".join(lines))
    return PointOptions(gcps=tmp_path / "p.csv", crs="EPSG:4326", vertical="ellipsoid"), ground


@pytest.mark.parametrize("heights", [True, False], ids=["heights", "surface"])
def test_errors_are_taken_over_and_parallax_is_not(colours: Scene, tmp_path: Path, heights: bool) -> None:
    options, ground = measured(colours, tmp_path, heights=heights)
    surface = None if heights else FlatSurface(float(ground[0, 2]))
    points = read_control(colours, Request(colours, points=options), surface)
    np.testing.assert_allclose(points.image, colours.model.ground_to_image(ground) + OFF / 4, atol=1e-6)
    np.testing.assert_allclose(points.sigma_image, 0.1)
    # What is added to the image plainly, as to a registered band, would be off by up to a pixel and a half.
    assert not heights or np.ptp((points.image - (colours.pieces[0].model.ground_to_image(ground) + OFF) / 4)[:, 1]) > 1
    # A correction is of this image alone, whatever its sister sees.
    assert colours.shared_model is colours.model
    cropped = replace(colours, pieces=(replace(colours.pieces[0], offset=(-5.0, -5.0)),))
    assert cropped.shared_model is colours.model


def test_the_file_of_points_is_read_once(colours: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options, _ = measured(colours, tmp_path)
    read: list[object] = []
    load = formats.load_text
    monkeypatch.setattr(formats, "load_text", lambda path: (read.append(path), load(path))[1])
    read_control(colours, Request(colours, points=options))
    assert read == [options.gcps]


def test_what_is_not_seen_is_refused(colours: Scene, tmp_path: Path) -> None:
    options, _ = measured(colours, tmp_path)
    elsewhere = replace(colours.model, lon_off=colours.model.lon_off + 20.0)
    with pytest.raises(InputError, match=r"of pan.tif is not visible in this image"):
        read_control(replace(colours, models={"rpc": elsewhere}), Request(colours, points=options))
