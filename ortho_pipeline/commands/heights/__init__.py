"""Heights of a command: the DEM or flat ground of its options, its accuracy, and automatic DEMs."""
