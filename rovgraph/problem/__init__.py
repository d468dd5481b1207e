"""A dive as arrays: keyframes, the IMU's motion between them, and rows of measurements.

Imports `rovgraph.sensors`, `rovgraph.log` and what is below; no solver. Begin with `problem` (`Problem`, what all
solvers take), then `assembly` (what comes, from a file or a socket, becomes one) and `measurements` (rows, linearised).
"""
