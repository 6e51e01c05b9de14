"""Other results of a block: files of its ground points, and its orthos."""
