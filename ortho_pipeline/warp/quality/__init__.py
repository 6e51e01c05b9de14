"""Layers beside an ortho: how accurate each of its pixels is, and how it was seen.

`sight` is what all of them stand on: image points of places in the ortho, and how they move on the ground.
"""
