"""Orthos as arrays in Python: computed when they are needed."""
