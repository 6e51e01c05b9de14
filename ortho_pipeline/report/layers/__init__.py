"""Layers beside an ortho in the report: their records, words and maps."""
