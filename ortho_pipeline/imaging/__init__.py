"""Measurements in pixels: edges, resolution, the registration of bands and images.

Imports `surface` and what is below.
"""
