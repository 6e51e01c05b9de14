"""STAC: items in place of files, whose assets are chosen by their roles, and collections of them to look in."""
