"""Presentation: numbers as people read them, notices, SVG drawings, pages.

Knows no result and imports nothing above `files`.
"""
