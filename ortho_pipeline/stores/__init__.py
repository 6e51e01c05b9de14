"""Remote files: stores and servers, STAC documents, uploads, and the local cache.

`obstore` is loaded when the first of them is asked for.
"""
