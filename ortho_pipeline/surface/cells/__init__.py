"""Heights that are found by themselves: the cells of a worldwide DEM under a scene, and where they come from."""
