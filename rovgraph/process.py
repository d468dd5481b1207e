"""What a process of rovgraph leaves undone: threads that wait for one another, and looking for garbage."""

import gc
import os

GARBAGE = 100_000  # objects made and not freed before the collector looks; Python's own is 700
# a library's pool of threads would spin beside kernels that need none, and in workers fight over the same cores
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def be_frugal() -> None:
    """One thread for each library, unless the environment says otherwise; to be called before NumPy is imported.

    The collector of cycles would look at a million objects of a dive again and again, and hardly find any.
    """
    gc.set_threshold(GARBAGE)
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)
