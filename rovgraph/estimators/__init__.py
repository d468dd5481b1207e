"""Estimators: each turns a log and a configuration into an `Estimate`."""
