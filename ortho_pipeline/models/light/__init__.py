"""What light does between ground and camera: the air bends its way, and a camera that moves sees it come aslant."""

from __future__ import annotations

from ortho_pipeline.models.light.path import AS_GIVEN, LightPath

__all__ = ["AS_GIVEN", "LightPath"]
