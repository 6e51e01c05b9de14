"""What the card of an image of a block says of its rays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from ortho_pipeline.report.network.cards import rays_text


def ray(name: str, used: bool = True) -> Any:
    return SimpleNamespace(id=name, image="A", used=used)


def test_what_was_held_out_is_not_called_left_out():
    roles = {"g": "control", "c": "check", "m": "check", "w": "check", "t": "tie", "u": "tie"}
    rays = [ray("g"), ray("c"), ray("t"), ray("m", False), ray("w", False), ray("u", False)]
    said = rays_text(rays, roles, {("w", "A")})
    assert said == ("1 control, 1 check, 1 tie; 1 reserved for checking; 1 measurement rejected; 1 without effect")
    assert rays_text(rays[:2], roles, ()) == "1 control, 1 check"
    assert rays_text([ray("w", False)], roles, {("w", "A")}) == "none; 1 measurement rejected"
