"""Scenes of known truth, and what the reproductions of papers have in common: scanner, waves, terrain, tables, page.

Imports `display`, `points` and `models.base`, so that truth shares no code with what it tests.
"""
