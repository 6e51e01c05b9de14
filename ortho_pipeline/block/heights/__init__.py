"""Heights of a surface under the points of a block: what is observed, what it has in common, when it stands."""
