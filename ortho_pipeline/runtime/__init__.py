"""The process: compiled kernels, memory, threads and signals."""
