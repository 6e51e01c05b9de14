"""Every read and write of pixels by GDAL: the checks before GDAL opens a file, windows, orthos, quicklooks.

Imports `points` and what is below; a raster's model is not known here.
"""
