"""Finished orthos as scenes: the grid of a map, and the smooth correction of one."""
