"""STAC items in place of the files of a command."""
