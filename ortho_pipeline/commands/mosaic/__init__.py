"""Mosaics: orthos that share a grid in, one raster out."""
