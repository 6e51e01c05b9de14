"""Coordinate systems, height datums and geoids, the ellipsoid and its local frames.

Imports `files` and what is below; the only room that knows pyproj's pitfalls.
"""
