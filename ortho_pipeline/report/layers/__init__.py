"""Layers next to an ortho in the report: their records, words and maps."""
