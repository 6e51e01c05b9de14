"""Many images in one adjustment: their points and local frame, datum, fit, and the intersection of their rays.

Rooms in it, bottom to top: `equations` (least squares), `heights` (of a DEM), `variances` (sigmas of observations),
`reliability` (gross errors), `relative` (how images lie to each other). Imports `estimation` and what is below; no
raster.
"""
