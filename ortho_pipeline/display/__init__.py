"""Presentation, whatever it is of: numbers as people read them, notices, SVG drawings.

Knows no result and imports nothing above `files`.
"""
