"""Observations of an adjustment: the types that the fit of one image and a block have in common.

An image point has `ImageErrors`. In the fit of one image they include the errors of the known ground. A block has the
ground as an unknown, and observes it by `OnPoints`. Prior knowledge of a parameter is a `Prior`. An error common to
many points is a `CommonUnknown`. A tie consists of image points of one place without known ground.
"""
