"""Files that lie elsewhere: objects of stores and servers, and what is kept of them on this machine.

The room of `obstore`, which is loaded when the first of them is asked for.
"""
