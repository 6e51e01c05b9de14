"""What a scene costs besides its pixels: things that are the same for all scenes of a process are made once."""

from __future__ import annotations

import email.parser
import importlib.metadata

import pyproj

from ortho_pipeline import commands
from ortho_pipeline.host import Host
from ortho_pipeline.models import rational, rpc_kernel
from ortho_pipeline.options import SurfaceOptions


def test_a_second_scene_asks_proj_and_the_package_for_nothing_that_is_known(tiny, tmp_path, monkeypatch) -> None:
    """Each scene had five transformations made, ten milliseconds each, and the package's metadata parsed twice."""
    asked: list[str] = []

    def counted(owner, name):
        original = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *given, **named: asked.append(name) or original(*given, **named))

    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    commands.rectify(tiny.image, tmp_path / "first", surface=surface)
    counted(pyproj.transformer, "_Transformer")
    counted(pyproj.CRS, "to_3d")
    counted(importlib.metadata, "version")
    counted(email.parser.Parser, "parsestr")
    commands.rectify(tiny.image, tmp_path / "second", surface=surface)
    assert asked == []


def test_metadata_of_a_distribution_are_parsed_once_for_all_of_its_plugins(monkeypatch) -> None:
    """The package's own were parsed twice for each of its twelve plugins."""
    parsed: list[object] = []
    parse = email.parser.Parser.parsestr
    monkeypatch.setattr(email.parser.Parser, "parsestr", lambda *given: parsed.append(given) or parse(*given))
    plugins = Host(installed=True).plugins()
    assert len(plugins) > 10
    assert {one.version for one in plugins if one.bundled} == {importlib.metadata.version("ortho-pipeline")}
    # And once for what this test asks.
    assert len(parsed) == len({one.distribution for one in plugins}) + 1


def test_an_inverse_of_few_points_takes_polynomials_once_a_step(tiny, monkeypatch) -> None:
    """Polynomials were evaluated twice for each step of Newton's method: for the place and for its slopes."""
    made: list[object] = []
    polynomial = rpc_kernel.polynomial
    monkeypatch.setattr(rpc_kernel, "polynomial", lambda *given: made.append(given) or polynomial(*given))
    steps: list[object] = []
    projected = rational.RPC.projected
    monkeypatch.setattr(rational.RPC, "projected", lambda *given: steps.append(given) or projected(*given))
    tiny.model.image_to_ground([[10.0, 20.0], [200.0, 150.0]], [700.0, 710.0])
    # And once to see that it closes.
    assert len(made) == len(steps) + 1 > 2
