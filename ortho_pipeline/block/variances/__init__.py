"""Variance components of a block: the sigmas that its observations turn out to have, and how certain these are.

Imports `points` of its house, `equations`, and what is below.
"""
