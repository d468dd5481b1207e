"""The factor graph: the only place that touches GTSAM graphs, factors and solvers.

docs/architecture.md says which module does what.
"""

from rovgraph.errors import InputError

try:
    import gtsam  # noqa: F401
except ImportError as error:
    raise InputError(
        f"places and iSAM2 need GTSAM, which is missing ({error}); install it with: pip install gtsam "
        "(it has no package for Windows and 32 bits; there, use the batch engine without places)"
    ) from None
