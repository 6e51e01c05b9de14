"""Least squares of a block: what is observed, its equations, points eliminated from them, and steps to a minimum.

Imports `points` and `local_frame` of its house, `estimation`, and what is below; nothing of the other rooms in `block`.
"""
