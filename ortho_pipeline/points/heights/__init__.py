"""Known heights at places, and the formats that they are delivered in."""
