"""Many scenes: configuration, plan, records, executors, the run itself.

Imports `commands` and what is below. A new executor is a function in `executors`.
"""
