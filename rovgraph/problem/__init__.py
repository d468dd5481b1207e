"""A dive as arrays: keyframes, the IMU's motion between them, and rows of measurements.

May import `rovgraph.rules`, `log`, `sensors`, `model`, `kernels` and what is below; no solver.

Begin with `problem` (`Problem`, which all solvers take), then `assembly` (makes a problem from a log, or from
measurements as they arrive) and `measurements` (rows, linearised).
"""
