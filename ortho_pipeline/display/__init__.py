"""How things look, whatever they are: numbers as people read them, SVG drawings, HTML for notebooks.

Knows no result and imports nothing above `errors`.
"""
