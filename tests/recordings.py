"""What tests of native files share."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.readers.formats import ReadingOptions, read_recording
from rovgraph.readers.recording import Channel, Recording
from rovgraph.simulate import Choices


def close(got: object, expected: object, atol: float = 1e-6) -> None:
    """Equal but for ``atol``; stamps are too large for a relative tolerance."""
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=atol)


def read(data: bytes, folder: Path, **choose: str) -> Recording:
    """A file of these bytes, as its format's reader has it."""
    path = folder / "dive.bin"  # content tells what it is, not its name
    path.write_bytes(data)
    return read_recording(path, ReadingOptions(choose=choose))


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


def check_dive_comes_back(written: Callable[[rg.Log], bytes], folder: Path, shift: float = 0.0) -> None:
    """A simulated dive, its IMU and magnetometer written in a native format, is smoothed as its own log is.

    Parameters
    ----------
    written : content of a file with the IMU and the magnetometer of a log
    shift : from the log's time to that of the file [s]
    """
    config = rg.Config().changed(heading={"sources": ["mag"]}, start={"heading_deg": 0.0})
    frame = rg.simulate("circle", config, 1, Choices(duration=40.0)).dive.log_frame
    simulated = rg.Log.from_frame(frame, config)
    path = folder / "dive.bin"
    path.write_bytes(written(simulated))
    rest = [name for name in frame if not name.startswith(("acc_", "gyr_", "mag_"))]
    frame.loc[frame[rest[1:]].notna().any(axis=1), rest].to_csv(folder / "rest.csv", index=False)
    with pytest.warns(rg.DataWarning, match="check the mounting"):
        log = rg.read_log([path, folder / "rest.csv"], config, shift={"rest.csv": shift})
    for sensor in ("imu", "mag"):
        close(log[sensor].data, simulated[sensor].data, atol=1e-9)
        close(log[sensor].time - shift, simulated[sensor].time, atol=1e-4)
    tracks = [rg.smooth(each, config, "smoothed").smoothed.trajectory for each in (simulated, log)]
    close(tracks[1].at(tracks[0].time[1:-1] + shift).p_n, tracks[0].p_n[1:-1], atol=0.02)
