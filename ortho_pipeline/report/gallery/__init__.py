"""What a reader sees of a matching: the chips themselves, where they lie, and how they scatter.

`matches` joins candidates and adjusted points, `plots` draws the map and the histograms, `chips` makes the gallery.
"""
