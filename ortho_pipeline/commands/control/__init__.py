"""What a scene is adjusted to: points that somebody measured, and matches with reference orthoimages."""
