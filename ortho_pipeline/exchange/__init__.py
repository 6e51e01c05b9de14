"""Models in and out: RPC files and tags, model files, GCPs and geolocation arrays, crops.

Imports `surface` and the rooms below.
"""
