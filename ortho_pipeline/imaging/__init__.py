"""Measurements in pixels: edges, resolution, ellipses, the registration of bands and images.

Imports `surface` and what is below.
"""
