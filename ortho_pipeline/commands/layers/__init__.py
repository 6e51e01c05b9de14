"""Layers beside an ortho: what they are made from."""
