"""The pages that people read, their plots and words, and the STAC item.

Imports `warp` and what is below. A new plot is a function in `plots`, a line in its list,
and its place in `templates`.
"""
