"""Heights of a command: the DEM or the flat ground that its options say, how accurate it is, and where it is found."""
