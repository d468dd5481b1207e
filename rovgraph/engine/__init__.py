"""One engine on NumPy arrays and compiled kernels: what is estimated without GTSAM."""
