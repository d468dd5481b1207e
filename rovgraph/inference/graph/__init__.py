"""The factor graph in GTSAM: the only package that imports gtsam.

May import the rest of `rovgraph.inference` and what is below. Begin with `batch` (a dive as a graph, solved by
Gauss-Newton), then `optimum` (its covariances), `places` (association of landmarks), `isam2` (the incremental graph)
and `values` (GTSAM's `Values` to and from a `State`).
"""

from rovgraph.errors import InputError

try:
    import gtsam  # noqa: F401
except ImportError as error:
    raise InputError(
        f"places and iSAM2 need GTSAM, which is missing ({error}); install it with: pip install gtsam "
        "(it has no package for Windows and 32 bits; there, use the batch engine without places)"
    ) from None
