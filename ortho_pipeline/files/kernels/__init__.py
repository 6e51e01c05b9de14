"""How kernels are compiled and kept; they are made with `files.compiled`."""
