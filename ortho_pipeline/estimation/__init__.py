"""Least squares and its statistics: fits, gross errors, regularisation, tests, comparison of models.

Imports `models` and what is below; no raster, no file of a user.
"""
