"""When and how the images of a stack were acquired: dates in texts and file names, clouds and sun."""
