"""Compiled kernels of matching: pixels of chips, and shifts between them."""
