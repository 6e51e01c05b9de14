"""Many scenes: configuration, plan, records, executors, the run itself.

Imports `commands` and what is below. A new executor is a class in `executors` and its name
in `runner`.
"""
