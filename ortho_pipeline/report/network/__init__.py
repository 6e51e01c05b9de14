"""The network of a block: where its images lie, what ties them, at what angles rays meet, and a card of each image."""
