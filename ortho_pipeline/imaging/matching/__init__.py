"""Automatic matching: control points from a reference orthoimage, tie points between scenes.

Imports `surface` and the rooms below; it needs only the projections of a sensor model.
"""

from ortho_pipeline.imaging.matching.matcher import REASONS, Matches, MatchSettings, match
from ortho_pipeline.imaging.matching.targets import OtherScene, Reference, SceneView, Target, open_references

__all__ = [
    "REASONS",
    "MatchSettings",
    "Matches",
    "OtherScene",
    "Reference",
    "SceneView",
    "Target",
    "match",
    "open_references",
]
