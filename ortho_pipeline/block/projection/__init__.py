"""Rays of all images of a block at once: image points and their partials, of common models by one compiled loop.

Imports `local_frame` of its house, and what is below.
"""
