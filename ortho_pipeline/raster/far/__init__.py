"""Rasters on other machines: their windows are read before their turn."""
