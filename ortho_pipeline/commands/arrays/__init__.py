"""Orthos as arrays in Python: pixels that are made when they are asked for."""
