"""Heights of the ground, and how rays meet them: DEMs and flat ground, footprints, the accuracy of a DEM.

Imports `raster` and what is below. Visibility and angles of view belong here.
"""
