"""Light between ground and camera: refraction by the air, and aberration by the motion of the camera."""

from __future__ import annotations

from ortho_pipeline.models.light.path import AS_GIVEN, LightPath

__all__ = ["AS_GIVEN", "LightPath"]
