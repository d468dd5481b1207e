"""Process settings: one thread per library, fewer garbage collections; and the progress of a long task."""

import contextlib
import ctypes
import functools
import gc
import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])
GARBAGE = 1_000_000  # objects made and not freed before the collector looks; Python's own is 700
# bytes of an array that glibc maps by itself, so that it goes back to the system when it is freed: its own limit rises
# to 32 MB, and much of what an hour's dive has freed stays with the process. The arrays of a dive of minutes may stay:
# the system clears what it hands out again
MAPPED, KEPT = 16 << 20, 32 << 20
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1
# a library's pool of threads would spin beside kernels that need none, and in workers fight over the same cores
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def limit_threads_and_gc() -> None:
    """One thread for each library, unless the environment says otherwise; to be called before NumPy is imported.

    The collector of cycles would look at a million objects of a dive again and again, and hardly find any.
    """
    gc.set_threshold(GARBAGE)
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # of another C library than glibc
            libc = ctypes.CDLL(None)
            libc.mallopt(_M_MMAP_THRESHOLD, MAPPED)
            libc.mallopt(_M_TRIM_THRESHOLD, KEPT)
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)


def stage(function: F) -> F:
    """A stage of a dive: when it ends, the system has back what it freed below `MAPPED`."""

    @functools.wraps(function)
    def whole(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        finally:
            if sys.platform == "linux":
                with contextlib.suppress(OSError, AttributeError):
                    ctypes.CDLL(None).malloc_trim(0)

    return cast(F, whole)


Progress = Callable[[str, float], None]  # the current task, and how much of it is done, from 0 to 1


def no_progress(what: str, done: float) -> None:
    """Show nothing."""
