"""Stamps that misbehave: left out, continued, moved or named, in logs and native files; every remedy works."""

import gzip
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bags import START as BAG_START
from bags import Sent, imu, marine_dvl, write
from wire import sentence

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.log.stamps import COUNTERS, LEAP_S, ROLLOVER_S, known_offset, mend, unwrapped
from rovgraph.readers.formats import read_recording
from rovgraph.readers.merging import merge
from rovgraph.readers.recording import Channel, Clock, Recording
from rovgraph.readers.stamps import put_in_order

DAY, WEEK, HOUR = 86400.0, 604800.0, 3600.0
UNIX = 1_740_564_858.0  # 2025-02-26 10:14:18 UTC
ALL = np.arange(0.0, 60.0, 0.1)
NEW_YEAR = 1_767_225_600.0


def at(time: np.ndarray, rows: slice, value: float) -> np.ndarray:
    out = time.copy()
    out[rows] = value
    return out


def set_by(by: float, at_row: int = 300) -> np.ndarray:
    """A clock whose stamps change by so much."""
    return np.where(np.arange(len(ALL)) < at_row, UNIX + ALL, UNIX + ALL + by)


def full(wrap: float, before: float = 30.0) -> np.ndarray:
    return (wrap - before + ALL) % wrap


# stamps as recorded, those that are used, what is said
MENDED: dict[str, tuple[np.ndarray, np.ndarray, str]] = {
    "one zero": (at(UNIX + ALL, slice(9, 10), 0.0), np.delete(UNIX + ALL, 9), "that was not set (0.0 s), left out"),
    "two seconds of 1980": (at(UNIX + ALL, slice(99, 119), 3.2e8), np.delete(UNIX + ALL, slice(99, 119)), "20 of 600"),
    "1980 at first": (at(UNIX + ALL, slice(0, 180), 315964800.0), UNIX + ALL[180:], "180 of 600 rows"),
    "32 bits, all set": (at(UNIX + ALL, slice(7, 9), 4294967295.0), np.delete(UNIX + ALL, slice(7, 9)), "2 of 600"),
    "32 bits of us, all set": (at(ALL, slice(7, 8), 4294.967295), np.delete(ALL, 7), "1 of 600"),
    "one stamp of its own": (at(ALL + 5.0, slice(7, 8), 4000.0), np.delete(ALL + 5.0, 7), "of another time"),
    "an hour back": (set_by(-HOUR), UNIX + ALL - HOUR, "is set by -3600 s"),
    "five hours and a half back": (set_by(-5.5 * HOUR), UNIX + ALL - 5.5 * HOUR, "is set by -19800 s"),
    "leap seconds": (set_by(-LEAP_S), UNIX + ALL - LEAP_S, "is set by -18 s"),
    "1024 weeks back": (set_by(-ROLLOVER_S), UNIX + ALL, "1024 weeks off"),
    "1024 weeks on": (set_by(ROLLOVER_S), UNIX + ALL + ROLLOVER_S, "1024 weeks off"),
    "a date that stays at midnight": (set_by(-DAY), UNIX + ALL, "date that comes late"),
}  # fmt: skip
WRAPS = {
    what: (full(wrap), wrap - 30.0 + ALL, f"count {what} and wrap") for wrap, what in COUNTERS.items() if wrap > 60.0
}


@pytest.mark.parametrize("case", MENDED | WRAPS)
def test_stamps_are_put_right_and_that_is_said(case):
    recorded, expected, told = (MENDED | WRAPS)[case]
    time, said = mend(recorded, "file")
    np.testing.assert_allclose(time[np.isfinite(time)], expected, atol=1e-6)
    assert len(said) == 1 and told in said[0]


@pytest.mark.parametrize("wrap", COUNTERS)
def test_a_counter_goes_on_with_a_row_that_comes_late(wrap):
    step = min(wrap / 500.0, 0.5)
    true = wrap - 350.5 * step + step * np.arange(3000)
    swapped = true.copy()
    swapped[350], swapped[351] = true[351], true[350]  # one before a wrap is written after it
    time, said = mend(swapped % wrap, "file")
    np.testing.assert_allclose(np.sort(time), true, atol=1e-6 * wrap)
    assert COUNTERS[wrap] in said[0]


def test_a_late_row_does_not_wrap_a_counter_again():
    assert unwrapped(np.array([98.0, 99.0, 0.0, 99.5, 1.0]), 100.0).tolist() == [98.0, 99.0, 100.0, 99.5, 101.0]


@pytest.mark.parametrize(
    "time", [np.append(ALL, ALL), np.append(ALL, ALL + 3e5), np.append(UNIX + ALL, UNIX + ALL - 500)]
)
def test_two_dives_in_one_file_are_refused_with_the_line_to_cut_at(time):
    with pytest.raises(InputError, match=r"file: line 602: time (goes back|jumps) .*Cut the file before that line"):
        mend(time, "file", 2 + np.arange(len(time)))
    with pytest.raises(InputError, match=r"row 601: .*Give each dive a file of its own$"):
        mend(time, "file")


STILL = {
    "six digits": ([float(f"{t:g}") for t in UNIX + ALL], "written with too few digits"),
    "single precision": (np.float32(UNIX + ALL).astype(float), "written with too few digits"),
    "whole seconds": (np.round(UNIX + 0.03 * np.arange(600)), "written with too few digits"),
    "a clock that stopped": (np.full(600, UNIX + 0.123), "they stand still"),
    "no clock": (np.full(600, 1.0), "they stand still"),
}


@pytest.mark.parametrize("case", STILL)
def test_stamps_that_do_not_go_on_are_called_that(case):
    time, told = STILL[case]
    with pytest.raises(InputError, match=f"file: .*{told}"):
        mend(np.array(time), "file")


def test_measurements_at_the_same_time_are_no_stamps_that_stand_still():
    time = np.repeat(ALL, 8)  # eight sensors in rows of their own
    np.testing.assert_array_equal(mend(time, "file")[0], time)


# Logs


def rows(time: Sequence[float], name: str = "depth") -> pd.DataFrame:
    return pd.DataFrame({"time": time, name: 5.0 + 0.01 * np.arange(len(time))})


def written(path: Path, frame: pd.DataFrame) -> Path:
    frame.to_csv(path, index=False)
    return path


def quietly(*files: Path, **more: object) -> rg.Log:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rg.read_log(list(files), **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz", "log.parquet"])
@pytest.mark.parametrize("case", ["two seconds of 1980", "32 bits of microseconds", "an hour back"])
def test_a_log_is_read_alike_in_every_form_alone_and_beside_another_file(tmp_path, name, case):
    recorded, expected, told = (MENDED | WRAPS)[case]
    path, frame = tmp_path / name, rows(recorded)
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    with pytest.warns(rg.DataWarning) as said:
        alone = rg.read_log(path)
    assert sum(told in str(each.message) for each in said) == 1
    other = written(tmp_path / "other.csv", rows(expected, "dvl_altitude"))
    for log in (alone, quietly(path, other, shift={"other.csv": 0.0})):
        np.testing.assert_allclose(log["depth"].time, expected, atol=1e-6)


def test_lines_of_stamps_that_are_left_out_are_those_of_the_file(tmp_path):
    path = written(tmp_path / "log.csv", rows(at(UNIX + ALL, slice(100, 120), 315964800.0)))
    with pytest.warns(rg.DataWarning, match=r"20 of 600 rows .*in lines 102 to 121"):
        rg.read_log(path)


def test_a_file_of_two_dives_can_be_read_after_the_cut_that_is_advised(tmp_path):
    frame = rows(np.append(100.0 + ALL, 50.0 + ALL))
    whole = written(tmp_path / "log.csv", frame)
    with pytest.raises(InputError, match="line 602: time goes back"):
        rg.read_log(whole)
    lines = whole.read_text().splitlines(keepends=True)
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    first.write_text("".join(lines[:601]))
    second.write_text("".join([lines[0], *lines[601:]]))
    assert len(rg.read_log(first)["depth"]) == len(rg.read_log(second)["depth"]) == 600
    both = quietly(first, second, shift={"second.csv": 200.0})
    np.testing.assert_allclose(both["depth"].time, np.append(100.0 + ALL, 250.0 + ALL))


def test_a_sensor_whose_stamps_stand_still_is_taken_by_arrival_where_that_is_recorded(tmp_path):
    depth, altitude = rows(np.full(600, UNIX + 0.5)), rows(UNIX + ALL, "dvl_altitude")
    both = pd.concat([depth.assign(received=UNIX + ALL), altitude.assign(received=UNIX + ALL)])
    path = written(tmp_path / "log.csv", both.sort_values("received", kind="stable"))
    with pytest.raises(InputError, match=r"depth: all stamps are .*they stand still.*--times arrival"):
        rg.read_log(path)
    for times in ("arrival", {"depth": "arrival"}, {"log.csv": "arrival"}):
        log = quietly(path, times=times)
        np.testing.assert_allclose(log["depth"].time, UNIX + ALL, atol=1e-6)
    other = written(tmp_path / "other.csv", rows(UNIX + ALL, "dvl_altitude"))
    with pytest.warns(rg.DataWarning, match=r"its stamps stand still at .*those of arrival are taken"):
        log = rg.read_log([path, other])
    np.testing.assert_allclose(log["depth"].time, UNIX + ALL, atol=1e-6)


def test_times_that_are_not_recorded_are_refused(tmp_path):
    path = written(tmp_path / "log.csv", rows(ALL))
    with pytest.raises(InputError, match=r"times: no arrivals are recorded in log\.csv; leave out --times"):
        rg.read_log(path, times="arrival")
    with pytest.raises(InputError, match=r"times: log\.csv: .*no arrivals are recorded; leave it out of --times"):
        rg.read_log(path, times={"depth": "arrival"})
    with pytest.raises(InputError, match=r"times sonar: is neither a sensor nor a file; known are .*depth, log"):
        rg.read_log(path, times={"sonar": "arrival"})
    with pytest.raises(InputError, match="times: expected 'arrival'"):
        rg.read_log(path, times="stamps")


# Bags: the recorder's times


def messages(stamp: Callable[[float], float]) -> list[Sent]:
    sent = [imu(t, (0, 0, 9.8), (0, 0, 0.01 * t), stamp=stamp(t)) for t in np.arange(0.0, 20.0, 0.02).tolist()]
    return sorted(
        [*sent, *(marine_dvl(t, (0.5, 0, 0)) for t in np.arange(0.1, 20, 0.2).tolist())], key=lambda s: s.time
    )


STUCK: dict[str, Callable[[float], float]] = {
    "the second stands still": lambda t: 1.0 + t % 1.0,
    "one stamp": lambda t: 1.7e9 + 0.5,
    "empty": lambda t: 0.0,
}


@pytest.mark.parametrize("form", ["ros1", "mcap"])
@pytest.mark.parametrize("case", STUCK)
def test_headers_that_stand_still_are_replaced_by_the_recorders_times(tmp_path, form, case):
    path = write(tmp_path / ("dive.bag" if form == "ros1" else "dive"), form, messages(STUCK[case]))
    recording = read_recording(path)
    channel = next(c for c in recording.channels if c.sensor == "imu")
    np.testing.assert_allclose(channel.columns["time"] - BAG_START, np.arange(0.0, 20.0, 0.02), atol=0.01)
    assert any(
        f"/imu/data: stamps {'are empty' if case == 'empty' else 'stand still'}" in w for w in recording.warnings
    )


def test_the_recorders_times_are_taken_for_one_topic_where_that_is_asked(tmp_path):
    path = write(tmp_path / "dive.bag", "ros1", messages(lambda t: BAG_START + t + 0.4))
    late = quietly(path)["imu"].time[0] - BAG_START
    assert late == pytest.approx(0.4, abs=0.01)
    for times in ("arrival", {"imu": "arrival"}):
        assert quietly(path, times=times)["imu"].time[0] - BAG_START == pytest.approx(0.0, abs=0.01)


# Clocks of several files


def nmea(start: float, seconds: int, dated: bool = True) -> bytes:
    """A fix each second of a vehicle that goes round, with or without a date."""
    lines = []
    for k in range(seconds):
        day = pd.Timestamp(round(1e9 * (start + k)))
        t = (start + k) % 1000.0
        place = f"50{10.0 + 0.002 * np.sin(0.3 * t):07.4f},N,00806.{1000 + round(3 * t):04d},E"
        lines.append(sentence(f"GPGGA,{day:%H%M%S}.00,{place},1,09,0.9,1.0,M,48.0,M,,"))
        if dated:
            lines.append(sentence(f"GPRMC,{day:%H%M%S}.00,A,{place},0.3,90.0,{day:%d%m%y},,,A"))
    return b"".join(lines)


CLOCKS = {  # start of the NMEA file, whether it has dates, what is said
    "1024 weeks": (UNIX - ROLLOVER_S, True, "1024 weeks off"),
    "two hours": (UNIX + 2.0 * HOUR, True, "+2 h from UTC, a time zone"),
    "minus nine and a half hours": (UNIX - 9.5 * HOUR, True, "-9.5 h from UTC, a time zone"),
    "no date": (UNIX, False, "no date: whole days are added"),
    "no date, two hours": (UNIX + 2.0 * HOUR, False, "+2 h from UTC, a time zone"),
}


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
@pytest.mark.parametrize("case", CLOCKS)
def test_clocks_of_a_receiver_are_put_on_that_of_a_log(tmp_path, name, case):
    start, dated, told = CLOCKS[case]
    log, fixes = tmp_path / name, tmp_path / "fixes.nmea"
    frame = rows(UNIX + ALL)
    frame.to_parquet(log) if name.endswith("parquet") else frame.to_csv(log, index=False)
    fixes.write_bytes(nmea(start, 60, dated))
    with pytest.warns(rg.DataWarning, match=f"fixes.nmea: .*{told.replace('+', '.')}.*: moved by"):
        read = rg.read_log([log, fixes])
    np.testing.assert_allclose(read["fix"].time, UNIX + np.arange(60.0), atol=1e-6)


@pytest.mark.parametrize("start", [NEW_YEAR - 30.0, UNIX - UNIX % DAY - 30.0])
def test_times_of_day_go_on_over_midnight_and_new_year_beside_a_log_with_a_date(tmp_path, start):
    log, fixes = written(tmp_path / "log.csv", rows(start + ALL)), tmp_path / "fixes.nmea"
    fixes.write_bytes(nmea(start, 60, dated=False))
    read = quietly(log, fixes)
    np.testing.assert_allclose(read["fix"].time, start + np.arange(60.0), atol=1e-6)


def test_a_zone_that_is_not_sure_is_named_with_the_shift_to_paste(tmp_path):
    frame = pd.concat([rows(UNIX + 10.0 * np.arange(2000.0))])  # over more than five hours
    log, fixes = written(tmp_path / "log.csv", frame), tmp_path / "fixes.nmea"
    fixes.write_bytes(nmea(UNIX + 8.0 * HOUR, 60))
    with pytest.raises(
        InputError, match=r"Perhaps its stamps are .* from UTC, .*: --shift fixes\.nmea=-\d+ if"
    ) as said:
        rg.read_log([log, fixes])
    shift = float(str(said.value).partition("fixes.nmea=")[2].partition(" ")[0])
    moved = quietly(log, fixes, shift={"fixes.nmea": shift})
    assert UNIX <= moved["fix"].time[0] <= UNIX + 20_000.0


@pytest.mark.parametrize(("cycle", "apart"), [(0.0, 3 * DAY), (0.0, 400.0 * DAY), (0.0, 123.0 * WEEK)])
def test_what_no_clock_is_off_by_is_no_known_offset(cycle, apart):
    assert known_offset((UNIX, UNIX + 60.0), (UNIX + apart, UNIX + apart + 60.0), cycle) is None


def test_instruments_with_times_of_day_alone_are_put_together():
    def recording(path: str, sensor: str, start: float) -> Recording:
        columns = {"time": start + ALL, sensor: np.ones(len(ALL))}
        return Recording(path, path, (Channel(sensor, columns, sensor, "", "day"),), {"day": Clock("day", cycle=DAY)})

    merged = merge([recording("a", "depth", 40_000.0), recording("b", "dvl_altitude", 40_000.0 + DAY)], {}, {})
    first = [merged.frame.loc[merged.frame[name].notna(), "time"].min() for name in ("depth", "dvl_altitude")]
    assert first[0] == first[1]


def test_stamps_of_a_channel_are_put_right_by_what_the_recorder_kept():
    received = UNIX + ALL
    stamps = np.where(np.arange(len(ALL)) < 300, 5.0 + ALL, received - 0.01)
    channel = Channel("depth", {"time": stamps, "depth": ALL}, "depths", "", "own", received, "host")
    ordered, said = put_in_order(channel, "file")
    np.testing.assert_allclose(ordered.columns["time"], received - 0.01, atol=0.02)
    assert "its clock was set by" in said[0]
    with pytest.raises(InputError, match=r"stamps of a clock that was not set|time jumps"):
        put_in_order(replace(channel, received=None, columns={**channel.columns, "time": stamps}), "file")


def test_gzipped_sentences_are_read_as_plain_ones(tmp_path):
    path = tmp_path / "fixes.nmea.gz"
    path.write_bytes(gzip.compress(nmea(UNIX, 60)))
    assert len(quietly(path)["fix"]) == 60
