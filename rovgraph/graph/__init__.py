"""The factor graph: the only place that touches GTSAM graphs, factors and solvers.

docs/architecture.md says which module does what.
"""

from rovgraph.errors import InputError

try:
    import gtsam  # noqa: F401
except ImportError as error:
    raise InputError(f"places and isam2 need GTSAM, which is missing ({error}): pip install gtsam") from None
