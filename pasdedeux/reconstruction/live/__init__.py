"""Live reconstruction: the chain that gives poses while images arrive, with bounded delay, and its kernels."""
