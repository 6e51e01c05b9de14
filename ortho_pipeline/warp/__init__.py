"""Orthoimages: the lattice and its proof, compiled kernels, this engine and GDAL's, mosaics.

Imports `surface`, `exchange`, `imaging` and what is below. A new resampling kernel begins in `resampling_kernel`, whose
docstring says where else.
"""
