"""Caches of pixels: GDAL's block cache, and windows of remote rasters that are read ahead."""
