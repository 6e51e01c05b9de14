"""Least squares and what can be said about its result: fits, blunders, regularisation, tests, comparison.

Imports `models` and what is below; no raster, no file of a user.
"""
