"""Tie points between overlapping scenes by `imaging.matching`: pairs of scenes, and tracks through many scenes."""

from ortho_pipeline.imaging.ties.pairs import Pair, PairSummary, TieSettings
from ortho_pipeline.imaging.ties.tracks import Ties, tie

__all__ = ["Pair", "PairSummary", "TieSettings", "Ties", "tie"]
