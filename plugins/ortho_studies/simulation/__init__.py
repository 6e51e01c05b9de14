"""Simulated scenes with known truth, and the common code of the reproductions: scanner, waves, terrain, tables, page.

It imports only `display`, `points` and `models.base`, so the truth shares no code with what it tests.
"""
