"""Measurements in pixels: edges, resolution, ellipses, the registration of bands and images.

Imports `raster` and what is below; no sensor model beyond a shift.
"""
