"""Files that lie elsewhere: stores and servers, STAC documents, what is delivered there and what is kept of it here.

`obstore` is loaded when the first of them is asked for.
"""
