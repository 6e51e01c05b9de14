"""`ortho stack`: finished orthos of one place at many dates, made to agree with each other."""
