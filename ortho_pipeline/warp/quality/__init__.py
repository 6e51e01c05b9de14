"""Layers of an ortho: accuracy, angles and visibility of each pixel.

`sight` is what all of them stand on: image points of places in the ortho, and how they move on the ground.
"""
