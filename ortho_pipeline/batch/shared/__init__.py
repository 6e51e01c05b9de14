"""One run by many workers on many machines, which share nothing but a folder of objects: parts, leases, results."""
