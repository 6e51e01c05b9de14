"""Many images in one adjustment: their points, the solver, its blunders and variances, intersection.

Imports `estimation` and what is below; no raster.
"""
