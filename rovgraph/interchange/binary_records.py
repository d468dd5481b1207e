"""Records of one kind that lie anywhere in a binary file, as one structured array."""

import mmap
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ROWS = 8192  # records gathered at a time


def layout(*fields: tuple[str, str, int]) -> np.dtype[np.void]:
    """Fields of a record: name, type, and first byte."""
    names, formats, offsets = zip(*fields, strict=True)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets})


def gathered(
    content: bytes | mmap.mmap, fields: np.dtype[np.void], at: Sequence[int], length: Sequence[int], least: int
) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
    """Records, shape (n,), and which of them are there; zeros stand for what they lack.

    Parameters
    ----------
    at, length : first byte of each, -1 = there is none, and its bytes
    least : bytes of a record that is worth reading
    """
    raw = np.frombuffer(content, np.uint8)
    first, size = np.array(at, dtype=np.int64), np.array(length, dtype=np.int64)
    out = np.zeros(len(first), dtype=fields)
    there = (first >= 0) & (size >= least)
    place = np.arange(fields.itemsize)
    for start in range(0, len(first), ROWS):
        rows = slice(start, start + ROWS)
        inside = there[rows, None] & (place < size[rows, None])
        index = np.where(inside, first[rows, None] + place, 0)
        out[rows] = np.where(inside, raw[index], 0).astype(np.uint8).view(fields)[:, 0]
    return out, there
