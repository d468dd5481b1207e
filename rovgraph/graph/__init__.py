"""The factor graph: the only place that touches GTSAM graphs, factors and solvers.

docs/architecture.md says which module does what.
"""
