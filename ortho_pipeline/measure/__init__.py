"""Measuring by hand: a local page on which points are clicked in a scene and its reference, with the fit live.

The page shows the reference rendered into the scene's own pixels, so that a click in one predicts itself in the other.
Imports everything below; starlette and uvicorn, an extra, are loaded when a page is served.
"""
