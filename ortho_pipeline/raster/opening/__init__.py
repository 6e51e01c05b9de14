"""The gate before GDAL opens a raster: allowed drivers, and the files that a raster refers to."""
