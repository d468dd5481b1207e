"""Keyframes, and what filters and the chain smoother make of them: NumPy arrays and compiled kernels, no GTSAM."""
