"""Cross-correlations of whole dives, by FFT."""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from rovgraph.geometry import Array


class Correlator:
    """Cross-correlations of columns: sum over t of a_i(t) b_j(t + lag), shape (columns of a, of b, lags)."""

    def __init__(self, n: int, reach: int):
        self.reach, self.size = reach, next_fast_len(n + reach, real=True)

    def __call__(self, a: Array, b: Array) -> Array:
        A, B = (rfft(v, self.size, axis=0).T for v in (a, b))
        sums = irfft(A.conj()[:, None] * B, self.size, axis=-1)
        return np.concatenate([sums[..., -self.reach :], sums[..., : self.reach + 1]], axis=-1)
