"""The frame camera: collinearity, lens, and its start by resection."""

from __future__ import annotations

from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.frame.orientation import exterior_sigmas
from ortho_pipeline.models.frame.working_frame import TOPOCENTRIC

__all__ = ["TOPOCENTRIC", "FrameCamera", "exterior_sigmas"]
