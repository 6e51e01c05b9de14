"""Remote files: stores and servers, STAC documents, uploads, and the local cache.

`obstore` is loaded when the first remote file is needed.
"""
