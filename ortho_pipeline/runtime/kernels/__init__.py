"""How kernels are compiled and kept; they are made with `runtime.compiled`."""
