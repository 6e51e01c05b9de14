"""Pages of finished orthos that were verified or aligned."""
