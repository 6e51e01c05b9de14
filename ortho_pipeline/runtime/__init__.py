"""The process: compiled kernels, memory and threads."""
