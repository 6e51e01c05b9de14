"""What the process runs on: kernels that are compiled, its memory and its threads."""
