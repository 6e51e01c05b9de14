"""Many images in one adjustment: their points and local frame, datum, fit, and the intersection of their rays.

Rooms in it, bottom to top: `equations` (least squares), `variances` (sigmas of observations), `reliability` (gross
errors). Imports `estimation` and what is below; no raster.
"""
