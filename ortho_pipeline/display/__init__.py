"""What people see, whatever it is of: numbers as they read them, notices, SVG drawings, HTML for notebooks.

Knows no result and imports nothing above `files`.
"""
