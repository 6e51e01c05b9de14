"""Experiments of the papers, one module each: their tables beside ours."""
