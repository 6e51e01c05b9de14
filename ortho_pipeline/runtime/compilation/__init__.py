"""How kernels are compiled and cached. `runtime.compiled` declares them."""
