"""Many scenes: configuration, plan, records, executors, the run itself.

Imports `commands` and what is below. A new executor begins in `executors` and is chosen in
`crew_of` there.
"""
