"""Observations of an adjustment, of one image and of a block: the types that both have.

An image point has `ImageErrors`. In the fit of one image they contain the errors of the known ground. A block keeps the
ground as an unknown, and observes it by `OnPoints`. A parameter that is known beforehand has a `Prior`. An error that
many points have in common is a `CommonUnknown`. A tie is image points of one place without ground.
"""
