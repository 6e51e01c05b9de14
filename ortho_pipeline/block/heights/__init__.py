"""Heights of a DEM under the points of a block: as observations, with the errors that they share."""
