"""What tests of native files share."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.interchange.formats import Options, read_recording
from rovgraph.interchange.recording import Channel, Recording


def close(got: object, expected: object, atol: float = 1e-6) -> None:
    """Equal but for ``atol``; stamps are too large for a relative tolerance."""
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=atol)


def read(data: bytes, folder: Path, **choose: str) -> Recording:
    """A file of these bytes, as its format's reader has it."""
    path = folder / "dive.bin"  # content tells what it is, not its name
    path.write_bytes(data)
    return read_recording(path, Options(choose=choose))


def first(recording: Recording, sensor: str) -> Channel:
    """The channel of a sensor that the reader prefers."""
    return next(channel for channel in recording.channels if channel.sensor == sensor)


def check_refused_or_whole(read: Callable[[bytes, Path], Recording], data: bytes, folder: Path) -> None:
    """Reading damaged bytes ends in one line, or in channels that are whole."""
    try:
        recording = read(data, folder)
    except InputError as refused:
        assert "\n" not in str(refused)
        return
    for channel in recording.channels:
        assert len({len(v) for v in channel.columns.values()}) == 1
        assert np.isfinite(channel.columns["time"]).all()
