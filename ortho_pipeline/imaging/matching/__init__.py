"""Matching: control points from a reference orthoimage, tie points between scenes, without a hand.

Imports `surface` and what is below; a sensor model is only asked where it puts things.
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
