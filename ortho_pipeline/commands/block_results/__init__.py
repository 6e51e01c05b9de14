"""What comes of a block besides models and report: its ground points as files, and its orthos."""
