"""Reliability of a block: tests of its residuals, gross errors that are left out, known points that it contradicts.

Imports `points` and `intersection` of its house, `equations`, `variances`, and what is below.
"""
