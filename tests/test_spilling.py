"""Long columns are kept in temporary files: the same log comes out, memory is bounded, and no file stays."""

import os
import subprocess
import sys
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from autopilot_files import DataFlashWriter, autopilot_messages, dataflash_of, packed, short_dive, tlog

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.log import disk_columns
from rovgraph.log.disk_columns import (
    FlatTable,
    GrowingColumn,
    computed,
    every,
    holds,
    median_step,
    spilled,
    steps,
    taken,
)
from rovgraph.readers import read_recording
from rovgraph.readers.recording import Channel
from rovgraph.readers.stamps import put_in_order

CONVERT = """
import resource, sys, tempfile
from rovgraph.cli.app import main
{before}
sys.argv[1:] = ["convert", {path!r}, "--out", {out!r}]
main()
"""
linux = pytest.mark.skipif(sys.platform != "linux", reason="what a process holds is read from the system")


@pytest.fixture
def short(monkeypatch):
    """Every column is a long one."""
    monkeypatch.setattr(disk_columns, "PIECE", 7)
    monkeypatch.setattr(disk_columns, "IN_MEMORY", 0)
    monkeypatch.setattr(disk_columns, "NEW", 30)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder, frame = tmp_path_factory.mktemp("files"), short_dive(5.0)
    made = {name: folder / f"dive.{name}" for name in ("BIN", "tlog")}
    made["BIN"].write_bytes(dataflash_of(frame, 0.0, 101_325.0))
    sent = [(1.75e9 + time, packed(message)) for time, message in autopilot_messages(frame, 0.0, 101_325.0)]
    made["tlog"].write_bytes(tlog(*sent))
    return made


def imu_log(path: Path, rows: int) -> Path:
    """A `.BIN` that holds nothing but an IMU at 400 Hz."""
    head = DataFlashWriter().bytes()
    one = DataFlashWriter().add("IMU", 0, 0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8, 1, 1).bytes()[len(head) :]
    with path.open("wb") as file:
        file.write(head)
        for begin in range(0, rows, 100_000):
            messages = np.tile(np.frombuffer(one, np.uint8), (min(100_000, rows - begin), 1))
            stamps = 2500 * np.arange(begin, begin + len(messages), dtype="<u8")
            messages[:, 3:11] = stamps.view("u1").reshape(-1, 8)
            file.write(messages.tobytes())
    return path


def converted(path: Path, before: str = "") -> "tuple[subprocess.CompletedProcess[str], Path]":
    out = path.with_name("log.csv")
    code = CONVERT.format(before=before, path=str(path), out=str(out))
    return subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True), out


def columns(*values):
    """As columns in files."""
    return [spilled(np.asarray(each)) for each in values]


@pytest.mark.parametrize("count", [1, 7, 8, 100, 701])
def test_in_pieces_is_computed_what_the_whole_column_gives(short, count):
    rng = np.random.default_rng(count)
    values, table = rng.standard_normal(count), rng.standard_normal((count, 3))
    (held,), mask, index = columns(values), values > 0.0, rng.permutation(count)
    np.testing.assert_array_equal(held, values)
    np.testing.assert_array_equal(computed(lambda a, b: a[:, None] * b, held, table), values[:, None] * table)
    np.testing.assert_array_equal(taken(held, mask), values[mask])
    np.testing.assert_array_equal(taken(held, index), values[index])
    np.testing.assert_array_equal(taken(table, mask), table[mask])
    np.testing.assert_array_equal(steps(held, lambda step: step < 0.0), 1 + np.flatnonzero(np.diff(values) < 0.0))
    for step in (1, 3, 50):
        np.testing.assert_array_equal(every(held, step), values[::step])
    assert holds(np.isfinite, held)
    assert not holds(np.isfinite, *columns(np.append(values, np.nan)))


@pytest.mark.parametrize("count", [2, 3, 8, 9, 100, 1001])
@pytest.mark.parametrize("digits", [1, 17])
def test_a_median_in_pieces_is_that_of_numpy_to_the_last_bit(short, count, digits):
    time = 1.7e9 + np.sort(np.random.default_rng(count).uniform(0.0, 50.0, count)).round(digits)
    assert median_step(time) == np.median(np.diff(time))


def test_a_column_and_a_table_hold_what_they_were_given(short):
    column, table = GrowingColumn("i4"), FlatTable(2)
    for k in range(50):
        column.extend(np.arange(k))
        table.append((k, -k))
    np.testing.assert_array_equal(column.array(), np.concatenate([np.arange(k) for k in range(50)]))
    assert len(table) == 50
    np.testing.assert_array_equal(table.table(), np.column_stack([np.arange(50), -np.arange(50)]))
    with pytest.raises(ValueError, match="read-only"):
        table.table()[0, 0] = 1.0


@pytest.mark.parametrize("name", ["BIN", "tlog"])
def test_a_log_from_files_is_that_from_memory_to_the_byte(files, name, tmp_path, request):
    def written(folder: str) -> list[bytes]:
        (tmp_path / folder).mkdir()
        paths = rg.convert(files[name]).save(tmp_path / folder / "log.csv", tmp_path / folder / "vehicle.yaml")
        return [path.read_bytes() for path in paths]

    whole = written("whole")
    request.getfixturevalue("short")
    assert written("pieces") == whole


def test_stamps_that_are_nearly_in_order_are_sorted_as_any(short):
    time = np.arange(100.0)
    time[[40, 41]] = time[[41, 40]] - [0.3, -0.3]  # 0.4 s back
    channel, said = put_in_order(Channel("depth", {"time": time, "depth": 2.0 * time}, "depth"), "dive")
    assert said == ["dive: depth: 1 rows are earlier than a row above them, sorted"]
    np.testing.assert_array_equal(channel.columns["time"], np.sort(time))
    np.testing.assert_array_equal(channel.columns["depth"], 2.0 * np.sort(time))


def test_what_reading_allocates_does_not_grow_with_the_rows(monkeypatch, tmp_path):
    monkeypatch.setattr(disk_columns, "PIECE", 1 << 12)
    monkeypatch.setattr(disk_columns, "IN_MEMORY", 1 << 15)
    most = []
    for rows in (400_000, 1_200_000):
        path = imu_log(tmp_path / f"{rows}.BIN", rows)
        tracemalloc.start()
        recording = read_recording(path)
        assert len(recording.channels[0].columns["time"]) == rows
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] - most[0] < 800_000  # bytes, one a row; in memory they are 36


@linux
@pytest.mark.slow
def test_memory_of_a_conversion_grows_by_less_than_a_stamp_for_each_row(tmp_path):
    most = []
    for rows in (2_000_000, 8_000_000):
        before = "import atexit; atexit.register(lambda: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))"
        done, out = converted(imu_log(tmp_path / "dive.BIN", rows), before)
        assert done.returncode == 0, done.stderr
        most.append(1024 * int(done.stdout.split()[-1]))
        out.unlink()
        out.with_name("log.report.json").unlink()
    assert most[1] - most[0] < 8 * 6_000_000


@pytest.mark.slow
@linux
@pytest.mark.parametrize(
    "before",
    ["resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000,) * 2)", "tempfile.tempdir = '/no/such/folder'"],
    ids=["full", "missing"],
)
def test_no_space_for_temporary_files_is_one_line_and_writes_nothing(before, tmp_path):
    path = imu_log(tmp_path / "dive.BIN", 400_000)
    done, _ = converted(path, before)
    told = " ".join(done.stderr.split())
    assert done.returncode == 2, told
    assert told.startswith("error: no temporary file can be written in /")
    assert told.endswith("; set TMPDIR to a folder with more space")
    assert [each.name for each in tmp_path.iterdir()] == ["dive.BIN"]


def test_damaged_stamps_are_left_out_without_a_warning_of_numpy(short, recwarn):
    time = np.append(np.arange(30.0), [np.inf, np.inf, -np.inf])
    channel, said = put_in_order(Channel("depth", {"time": time, "depth": np.ones(33)}, "depths"), "file")
    np.testing.assert_array_equal(channel.columns["time"], np.arange(30.0))
    assert said == ["file: depths: 3 rows without time left out"]
    assert not recwarn


@linux
def test_too_many_open_files_are_not_taken_for_a_full_disk(monkeypatch):
    import resource

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    monkeypatch.setattr(disk_columns, "IN_MEMORY", 0)
    columns = [disk_columns.GrowingColumn(float) for _ in range(100)]
    resource.setrlimit(resource.RLIMIT_NOFILE, (len([*Path("/proc/self/fd").iterdir()]) + 10, limits[1]))
    try:
        with pytest.raises(InputError, match=r"Too many open files.*ulimit -n"):
            for column in columns:
                column.extend(np.ones(3))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@linux
@pytest.mark.parametrize("error", [KeyboardInterrupt, InputError, None])
def test_no_temporary_file_stays(short, error, monkeypatch, tmp_path):
    path = imu_log(tmp_path / "dive.BIN", 300_000)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(disk_columns, "PIECE", 1 << 12)
    seen = []

    def interrupt(what: str, done: float) -> None:
        seen.append(len(temporary_files()))
        if error is not None and seen[-1]:
            raise error("enough")

    def temporary_files() -> list[str]:
        links = [Path(f"/proc/self/fd/{each}") for each in os.listdir("/proc/self/fd")]  # noqa: PTH208
        return [str(each.readlink()) for each in links if each.is_symlink() and "temporary" in str(each.readlink())]

    if error is None:
        with pytest.warns(rg.DataWarning, match="no parameters"):
            rg.convert(path, progress=interrupt).save(tmp_path / "log.csv")
    else:
        with pytest.raises(error):
            rg.convert(path, progress=interrupt)
    assert max(seen) > 0
    assert temporary_files() == []
    assert list((tmp_path / "temporary").iterdir()) == []
