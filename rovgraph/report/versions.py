"""Versions of what a result was computed with."""

import platform
from importlib.metadata import PackageNotFoundError, version

LIBRARIES = ("numpy", "scipy", "pandas", "numba", "gtsam")


def versions() -> dict[str, str | None]:
    """Python and library -> version; None where a library is not installed, as GTSAM on Windows."""
    return {"python": platform.python_version(), **{name: _installed(name) for name in LIBRARIES}}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
