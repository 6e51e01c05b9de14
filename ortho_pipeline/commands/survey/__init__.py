"""The contents of a folder, the next command for it, and a pipeline file for its scenes."""
