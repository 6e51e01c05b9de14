"""Measuring in several images: their points, the bundle adjustment that is shown of them, and their session."""
