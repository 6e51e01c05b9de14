"""A stack: scenes of one place at many dates, which one network of matched pairs makes agree."""
