"""The line scanner: orbit and attitude as splines, line camera, start values from metadata, constraints."""

from __future__ import annotations

from ortho_pipeline.models.pushbroom.scanner import Pushbroom

__all__ = ["Pushbroom"]
