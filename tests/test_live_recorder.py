"""The recording and the checkpoint: what survives a crash, a full disk and a damaged file."""

import json
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from rovgraph.errors import InputError
from rovgraph.live.files import ARRAY, Recorder, read_checkpoint, recorded_columns, write_checkpoint
from rovgraph.live.message import GEODETIC, Reading
from rovgraph.live.warnings import Warnings
from rovgraph.log import STREAMS, read_log
from rovgraph.log.streams import labels
from rovgraph.sensors import SENSORS

HEADER = recorded_columns()
EPOCH = 1.7e9
RNG = np.random.default_rng(3)


def imu(t: float) -> list[Reading]:
    return [Reading("imu", np.array([0.01 * t, 0.1, -9.81, 0.2, np.sin(t), 1e-7 / 3.0]))]


def read_quietly(path: Path, **how: bool):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_log(path, **how)


def test_a_recording_has_one_writer(tmp_path):
    first = Recorder(tmp_path / "r.csv")
    with pytest.raises(InputError, match="another run is recording there"):
        Recorder(tmp_path / "r.csv")
    first.close()
    Recorder(tmp_path / "r.csv").close()


def test_every_sensor_comes_back_as_the_very_same_numbers(tmp_path):
    """With all their optional columns, and no warning about the columns that stayed empty."""
    recorder = Recorder(tmp_path / "r.csv")
    sent = {
        sensor: RNG.normal(size=(20, len(columns))) * 10.0 ** RNG.integers(-9, 4, (20, len(columns)))
        for sensor, columns in STREAMS.items()
        if sensor != "pressure"  # is ignored beside depth
    }
    for sensor in sent:
        sent[sensor][:, [column.flag for column in SENSORS[sensor].columns]] = 1.0
    for sensor in sent:
        for k, name in enumerate(STREAMS[sensor]):
            sent[sensor][:, k] = np.abs(sent[sensor][:, k]) if name.endswith("_sd") else sent[sensor][:, k]
            sent[sensor][:, k] = np.arange(20.0) if name in labels() else sent[sensor][:, k]
    sent["thruster"] = RNG.normal(size=(20, 6))
    times = EPOCH + np.cumsum(RNG.uniform(0.001, 0.1, 20))
    for k, t in enumerate(times):
        recorder.write(t, t + 0.01, [Reading(sensor, data[k]) for sensor, data in sent.items()])
    recorder.close()
    log = read_quietly(tmp_path / "r.csv", as_received=True)  # and fixes of all beacons
    assert log.sensors == set(sent)
    for sensor, data in sent.items():
        np.testing.assert_allclose(log[sensor].data, data, rtol=1e-15)
        np.testing.assert_allclose(log[sensor].time, times, rtol=3e-16)


def test_a_ping_without_bottom_lock_and_a_fix_in_degrees_come_back(tmp_path):
    recorder = Recorder(tmp_path / "r.csv")
    recorder.write(1.0, EPOCH, [Reading("dvl", np.array([np.nan, np.nan, np.nan, 0.0, np.nan]))])
    recorder.write(2.0, EPOCH, [Reading(GEODETIC, np.array([58.3, 8.6, 1.5, 2.5, -0.7]))])
    recorder.write(3.0, EPOCH, [Reading(GEODETIC, np.array([58.3001, 8.6, np.nan]))])
    recorder.close()
    log = read_quietly(tmp_path / "r.csv")
    assert log["dvl"]["dvl_valid"].tolist() == [0.0]
    assert log.origin == (58.3, 8.6)
    of_unknown_noise = [11.14, 0, np.nan, np.nan, np.nan, np.nan]
    np.testing.assert_allclose(log["fix"].data, [[0, 0, 1.5, 2.5, -0.7, np.nan], of_unknown_noise], atol=0.01)


def test_the_arrival_is_the_last_column(tmp_path):
    recorder = Recorder(tmp_path / "r.csv")
    recorder.write(1.0, EPOCH + 0.25, imu(1.0))
    recorder.close()
    header, row = (tmp_path / "r.csv").read_text().splitlines()
    assert header == ",".join(HEADER)
    assert header.endswith(",received")
    assert row.endswith(",1700000000.250000")


def test_rows_that_arrived_late_are_put_in_the_order_of_time_without_complaint(tmp_path):
    recorder = Recorder(tmp_path / "r.csv")
    for t in (1.0, 2.0, 9.0, 3.0, 10.0):
        recorder.write(t, EPOCH + t, imu(t))
    recorder.close()
    assert read_quietly(tmp_path / "r.csv")["imu"].time.tolist() == [1.0, 2.0, 3.0, 9.0, 10.0]


def until(true: Callable[[], bool], within: float = 30.0) -> None:
    end = time.monotonic() + within
    while not true():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.005)


def test_rows_reach_the_operating_system_while_the_recording_goes_on(tmp_path):
    recorder = Recorder(tmp_path / "r.csv")
    for t in (1.0, 2.0):
        recorder.write(t, EPOCH, imu(t))
        until(lambda t=t: (tmp_path / "r.csv").read_bytes().count(b"\n") == 1 + t)
    recorder.close()


def test_rows_wait_a_fifth_of_a_second_at_most_for_the_operating_system_and_a_second_for_the_disk(
    tmp_path, monkeypatch
):
    waits = set()

    class Stop(threading.Event):
        def wait(self, timeout=None):
            waits.add(timeout)
            return super().wait(timeout)

    monkeypatch.setattr("rovgraph.live.files.threading", SimpleNamespace(Event=Stop, Thread=threading.Thread))
    recorder = Recorder(tmp_path / "r.csv")
    until(lambda: len(waits) == 2)
    recorder.close()
    assert min(waits) <= 0.2 and max(waits) <= 1.0


CRASHES = """
import itertools, os, sys, time
import numpy as np
from rovgraph.live import files as recorder
from rovgraph.live.message import Reading

def write(file, data, write=os.write):
    count = write(file, data)
    print(data[:count].count(b"\\n"), flush=True)  # rows that the operating system has, the first time a header
    return count

recorder.os.write = write
recording = recorder.Recorder(sys.argv[1])
for k in itertools.count():
    recording.write(float(k), time.time(), [Reading("imu", np.full(6, float(k)))])
    time.sleep(0.001)
"""


@pytest.mark.slow
def test_a_kill_loses_only_what_was_not_yet_handed_over_and_the_recording_goes_on(tmp_path):
    path = tmp_path / "r.csv"
    child = subprocess.Popen([sys.executable, "-c", CRASHES, path], stdout=subprocess.PIPE, text=True)
    told = [child.stdout.readline() for _ in range(10)]
    child.kill()
    told += child.communicate()[0].splitlines(keepends=True)
    assert child.returncode == -signal.SIGKILL
    content = path.read_bytes()
    whole = content[: content.rindex(b"\n") + 1]
    header, *rows = [line.split(b",") for line in whole.splitlines()]
    assert {len(row) for row in (header, *rows)} == {len(HEADER)}
    assert [float(row[0]) for row in rows] == list(range(len(rows)))
    assert len(rows) + 1 >= sum(int(line) for line in told if line.endswith("\n")) > 10
    recorder = Recorder(path)
    recorder.write(len(rows), EPOCH, imu(1.0))
    recorder.close()
    assert len(read_quietly(path)["imu"]) == len(rows) + 1


@pytest.mark.parametrize("tail", [b"1700000000.5,0.1", b"17", b"\0" * 5000, b"1.5" + b"\0" * 200_000])
def test_a_torn_end_is_dropped_when_the_recording_goes_on(tmp_path, tail):
    path = tmp_path / "r.csv"
    for t in (1.0, 2.0):
        recorder = Recorder(path)
        recorder.write(t, EPOCH, imu(t))
        recorder.close()
        whole = path.read_bytes()
        path.write_bytes(whole + tail)
    Recorder(path).close()
    assert path.read_bytes() == whole
    assert read_quietly(path)["imu"].time.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("cut", [0, 1, 10, len(",".join(HEADER))])
def test_a_torn_header_is_written_again(tmp_path, cut):
    path = tmp_path / "r.csv"
    path.write_text(",".join(HEADER)[:cut])
    Recorder(path).close()
    assert path.read_text() == ",".join(HEADER) + "\n"


@pytest.mark.parametrize("content", ["time,depth\n1,2\n", "hello", ",".join(HEADER) + ",more\n", "\0\0\0"])
def test_a_file_that_is_no_recording_is_refused_and_left_as_it_is(tmp_path, content):
    path = tmp_path / "r.csv"
    path.write_text(content)
    with pytest.raises(InputError, match="not a recording that can be continued"):
        Recorder(path)
    assert path.read_text() == content


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        Recorder(tmp_path / "missing" / "r.csv")
    with pytest.raises(InputError, match="cannot be written"):
        Recorder(tmp_path)


FULL_DISK = """
import json, resource, sys, time
import numpy as np
from rovgraph.live.warnings import Warnings
from rovgraph.live.message import Reading
from rovgraph.live.files import Recorder
said = []
recorder = Recorder(sys.argv[1], Warnings(lambda *about: said.append(about)))
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
for k in range(1000):
    recorder.write(float(k), 0.0, [Reading("imu", np.full(6, float(k)))])
    if k % 100 == 0:
        time.sleep(0.05)
end = time.monotonic() + 30.0
while not said and time.monotonic() < end:
    time.sleep(0.01)
full = len(said)
if "free" in sys.argv:
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
recorder.close()
print(json.dumps([said, full, recorder.lost]))
"""


def full_disk(*arguments) -> tuple[list[list[str]], int, int]:
    done = subprocess.run([sys.executable, "-c", FULL_DISK, *arguments], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_a_full_disk_is_complained_of_once_and_nothing_is_lost_when_there_is_space_again(tmp_path):
    said, full, lost = full_disk(tmp_path / "r.csv", "free")
    assert [kind for _, kind, _ in said] == ["disk"]
    assert "still trying" in said[0][2]
    assert (full, lost) == (1, 0)
    assert read_quietly(tmp_path / "r.csv")["imu"].time.tolist() == list(range(1000))


@pytest.mark.slow
def test_a_disk_that_stays_full_keeps_what_it_took_and_the_loss_is_counted(tmp_path):
    said, _, lost = full_disk(tmp_path / "r.csv")
    assert [kind for _, kind, _ in said] == ["disk", "lost"]
    kept = (tmp_path / "r.csv").read_bytes()
    assert len(kept) <= 20_000
    assert kept.count(b"\n") - 1 + lost == 1000
    Recorder(tmp_path / "r.csv").close()
    assert len(read_quietly(tmp_path / "r.csv")["imu"]) == 1000 - lost


def test_a_ninth_thruster_is_complained_of(tmp_path):
    said = []
    recorder = Recorder(tmp_path / "r.csv", Warnings(lambda *about: said.append(about)))
    for t in (1.0, 2.0):
        recorder.write(t, EPOCH, [Reading("thruster", np.ones(9))])
    recorder.close()
    assert [kind for _, kind, _ in said] == ["left out"]


# checkpoints

numbers = st.sampled_from(["?", "i1", "<i4", ">i8", "u2", "<f4", "<f8", ">f8", "c16"]).map(np.dtype)
arrays = numbers.flatmap(lambda dtype: nps.arrays(dtype, nps.array_shapes(min_dims=0, max_dims=3, min_side=0)))
plain = st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats() | st.text()
keys = st.text().filter(lambda key: key != ARRAY)
states = st.dictionaries(
    keys,
    st.recursive(plain | arrays, lambda inner: st.lists(inner) | st.dictionaries(keys, inner), max_leaves=12),
    max_size=5,
)


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and (a == b or (a != a and b != b))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("checkpoint")


@settings(deadline=None, max_examples=100)
@given(states)
def test_a_checkpoint_comes_back_as_it_was(folder, state):
    write_checkpoint(folder / "a", state)
    assert same(read_checkpoint(folder / "a"), state)


def test_arrays_that_were_read_are_the_callers_own_whatever_their_order_in_memory(tmp_path):
    state = {"a": np.arange(12.0).reshape(3, 4).T, "b": np.float64(2.5), "c": (1, np.int64(2))}
    write_checkpoint(tmp_path / "a", state)
    read = read_checkpoint(tmp_path / "a")
    np.testing.assert_array_equal(read["a"], state["a"])
    read["a"] += 1.0
    assert (read["b"], read["c"]) == (2.5, [1, 2])


@settings(deadline=None, max_examples=200)
@given(st.data())
def test_any_damage_to_a_checkpoint_is_found(folder, data):
    path = folder / "b"
    write_checkpoint(path, {"a": np.arange(5.0), "b": [1, "x", None]})
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content = content[:place]
    else:
        content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"to start again|is not a checkpoint|continue with the version") as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value)


def test_no_checkpoint_and_one_of_another_version_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_checkpoint(tmp_path / "missing")
    write_checkpoint(tmp_path / "a", {})
    (tmp_path / "a").write_bytes((tmp_path / "a").read_bytes().replace(b"checkpoint 10 ", b"checkpoint 3 "))
    with pytest.raises(InputError, match="of version 3, expected 10"):
        read_checkpoint(tmp_path / "a")


@pytest.mark.parametrize("value", [object(), b"bytes", np.array(["text"]), np.array([None]), {1: 2}, {ARRAY: 1}])
def test_what_cannot_be_kept_is_refused_with_its_place_and_the_old_file_stands(tmp_path, value):
    write_checkpoint(tmp_path / "a", {"old": 1})
    with pytest.raises(TypeError, match=r"state\['x'\]\[1\]"):
        write_checkpoint(tmp_path / "a", {"x": [0, value]})
    assert read_checkpoint(tmp_path / "a") == {"old": 1}


def test_a_checkpoint_that_fails_leaves_the_old_one_and_no_rest(tmp_path, monkeypatch):
    write_checkpoint(tmp_path / "a", {"old": 1})

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_checkpoint(tmp_path / "a", {"new": 2})
    monkeypatch.undo()
    assert read_checkpoint(tmp_path / "a") == {"old": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


CHECKPOINTS = """
import sys, numpy as np
from rovgraph.live.files import write_checkpoint
k = 0
while True:
    k += 1
    write_checkpoint(sys.argv[1], {"k": k, "a": np.full(40_000, k)})
    print(k, flush=True)
"""


@pytest.mark.slow
def test_a_kill_while_checkpoints_are_written_leaves_a_whole_one(tmp_path):
    for _ in range(3):
        child = subprocess.Popen([sys.executable, "-c", CHECKPOINTS, tmp_path / "a"], stdout=subprocess.PIPE, text=True)
        child.stdout.readline()
        time.sleep(RNG.uniform(0.02, 0.1))
        child.kill()
        told = [int(line) for line in child.communicate()[0].splitlines()]
        read = read_checkpoint(tmp_path / "a")
        assert (read["a"] == read["k"]).all()
        assert read["k"] >= max(told, default=1)
