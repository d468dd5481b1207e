"""The error-state Kalman filter over a whole dive, its smoother, and the filter on data as they arrive."""
