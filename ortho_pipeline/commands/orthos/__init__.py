"""Finished orthos: open them as scenes, verify how accurate they are, align them with a reference."""
