"""Known heights of places, and their file formats."""
