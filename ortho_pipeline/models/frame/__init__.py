"""The frame camera: collinearity, lens, and its start by resection."""

from __future__ import annotations

from ortho_pipeline.models.frame.camera import TOPOCENTRIC, FrameCamera, exterior_sigmas

__all__ = ["TOPOCENTRIC", "FrameCamera", "exterior_sigmas"]
