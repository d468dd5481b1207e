"""Several recordings of one dive become one log: channels chosen, clocks joined, settings kept, or a clear refusal."""

import json
import subprocess
import sys
import tracemalloc
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from autopilot_files import DataFlashWriter, autopilot_messages, dataflash_of, packed, short_dive, tlog
from dives import changed, falcon, rms, simulated
from test_api import command

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.live.files import RECORDING
from rovgraph.model.config import completed
from rovgraph.readers.formats import ReadingOptions, formats
from rovgraph.readers.merging import Merged, merge
from rovgraph.readers.recording import Channel, Clock, Left, Recording
from rovgraph.readers.stamps import put_in_order
from rovgraph.simulate import Style, Waves

REAL = Path(__file__).parents[2] / "shared" / "data" / "ictineu"
DVL = ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid")
IMU = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
MAG = ("mag_x", "mag_y", "mag_z")
OTHER_SEA = Style(waves=Waves(heave=0.05, roll=0.1, pitch=0.08, frequency=0.29))
START = 1_750_000_000.0  # Unix time of the simulated dive's start [s]


@pytest.fixture(scope="module")
def dive() -> pd.DataFrame:
    """Three minutes round a structure, in waves."""
    return simulated(falcon(), 180.0, 1).dive.log_frame


def recording(
    path: str,
    frame: pd.DataFrame,
    clock: Clock,
    sensors: dict[str, Sequence[str]],
    offset: float = 0.0,
    drift: float = 0.0,
    **more: object,
) -> Recording:
    """Some sensors of a dive as another file would hold them, ``offset`` and ``drift`` later."""
    channels = []
    for sensor, columns in sensors.items():
        rows = frame[list(columns)].notna().all(axis=1)
        own = {name: frame.loc[rows, name].to_numpy(float) for name in ("time", *columns)}
        own["time"] = own["time"] * (1.0 + drift) + offset
        channels.append(Channel(sensor, own, f"{sensor} of {path}", "", clock.name))
    return Recording(path, "toy", tuple(channels), {clock.name: clock}, **more)  # type: ignore[arg-type]


def autopilot(dive: pd.DataFrame, clock: Clock | None = None, **sensors: Sequence[str]) -> Recording:
    return recording("auto.bin", dive, clock or Clock("boot"), sensors or {"imu": IMU, "mag": MAG})


def instrument(dive: pd.DataFrame, offset: float, drift: float = 0.0, clock: Clock | None = None) -> Recording:
    return recording("dvl.log", dive, clock or Clock("own"), {"dvl": DVL}, offset, drift)


def times(merged: Merged, column: str) -> np.ndarray:
    return merged.frame.loc[merged.frame[column].notna(), "time"].to_numpy()


@pytest.mark.parametrize(("duration", "seed"), [(120.0, 1), (120.0, 7), (420.0, 4)], ids=str)
def test_clocks_apart_by_a_period_of_regular_waves_are_not_taken_for_one_another(duration, seed):
    frame = simulated(falcon(), duration, seed).dive.log_frame
    merged = merge([autopilot(frame, imu=IMU, depth=("depth",)), instrument(frame, 3.0)], {}, {})
    late = times(merged, "dvl_vx") - frame.loc[frame["dvl_vx"].notna(), "time"].to_numpy()
    clock = next(c for c in merged.clocks if c.file == 1)
    assert np.abs(late).max() < 2.0 * clock.sd < 0.15


@pytest.mark.parametrize(("offset", "drift"), [(3.2, 0.0), (-40.0, 0.0), (1_735_689_600.0, 0.0), (3.2, 50e-6)], ids=str)
def test_clocks_apart_are_found_within_their_sd(dive, offset, drift):
    merged = merge([autopilot(dive), instrument(dive, offset, drift)], {}, {})
    late = times(merged, "dvl_vx") - dive.loc[dive["dvl_vx"].notna(), "time"].to_numpy()
    clock = next(c for c in merged.clocks if c.file == 1)
    assert "acceleration" in clock.how
    assert 0.0 < clock.sd < 0.07  # so that a quarter of a second would not pass
    span = float(np.ptp(times(merged, "dvl_vx")))
    assert np.abs(late).max() < 3.0 * (clock.sd + 0.5 * clock.drift_sd * span)


def test_a_compass_alone_joins_clocks_with_the_lag_that_it_may_have(dive):
    files = [autopilot(dive), recording("compass", dive, Clock("own"), {"dvl_heading": ("dvl_heading",)}, 77.0)]
    merged = merge(files, {}, {})
    clock = next(c for c in merged.clocks if c.file == 1)
    assert clock.sd > 0.2
    assert abs(times(merged, "dvl_heading")[0] - dive.loc[dive["dvl_heading"].notna(), "time"].iloc[0]) < clock.sd


def test_depth_is_joined_by_way_of_the_dvl_that_was_joined_before(dive):
    depth = recording("depth.txt", dive, Clock("own"), {"depth": ("depth",)}, 1000.0)
    merged = merge([autopilot(dive), depth, instrument(dive, 3.2)], {}, {})
    clock = next(c for c in merged.clocks if c.file == 1)
    assert "depth by" in clock.how
    assert abs(times(merged, "depth")[0] - dive.loc[dive["depth"].notna(), "time"].iloc[0]) < 3.0 * clock.sd


def test_what_shows_no_common_motion_is_refused_with_the_way_out(dive):
    altitude = recording("alt.txt", dive.assign(dvl_altitude=2.0), Clock("own"), {"dvl_altitude": ("dvl_altitude",)})
    with pytest.raises(InputError, match=r"^alt\.txt: clock own reads .* --shift dvl_altitude=SECONDS$"):
        merge([autopilot(dive), altitude], {}, {})


def test_another_dive_is_refused(dive):
    other = simulated(falcon(), 180.0, 7, "spiral", OTHER_SEA).dive.log_frame
    day = Clock("Unix", START, 0.0, "GPS")
    next_day = recording("other", other, Clock("Unix", START + 86400.0, 0.0, "GPS"), {"dvl": DVL})
    with pytest.raises(InputError, match=r"recorded 2025-06-16 .*, auto\.bin 2025-06-15 .*are they of one dive"):
        merge([autopilot(dive, day), next_day], {}, {})
    with pytest.raises(InputError, match="are they of one dive"):
        merge([autopilot(dive), recording("other", other, Clock("own"), {"dvl": DVL})], {}, {})


def test_unix_stamps_join_clocks_of_any_epoch_exactly(dive):
    boot, unix = Clock("boot", START, 0.0, "GPS week"), Clock("Unix", 0.0)
    merged = merge([autopilot(dive, boot), instrument(dive, START, clock=unix)], {}, {})
    assert merged.unix
    assert merged.warnings == ()
    assert times(merged, "dvl_vx") == pytest.approx(
        START + dive.loc[dive["dvl_vx"].notna(), "time"].to_numpy(), abs=1e-6
    )
    assert all("GPS week" in c.how or "Unix time" in c.how for c in merged.clocks)


def test_unix_stamps_that_motion_contradicts_are_corrected_and_told(dive):
    boot, unix = Clock("boot", START, 0.0, "GPS"), Clock("Unix", 0.0, 0.0, "the laptop's clock")
    files = [autopilot(dive, boot), instrument(dive, START + 3.2, clock=unix)]
    merged = merge(files, {}, {})
    assert any("dvl.log: its Unix time is +3.2" in text for text in merged.warnings)
    true = START + dive.loc[dive["dvl_vx"].notna(), "time"].iloc[0]
    assert times(merged, "dvl_vx")[0] == pytest.approx(true, abs=0.06)
    stated = merge(files, {}, {"dvl.log": -3.2})
    assert times(stated, "dvl_vx")[0] == pytest.approx(true, abs=1e-6)
    assert stated.warnings == ()


def test_a_clock_that_was_never_set_is_told_and_joined_by_motion(dive):
    boot, unset = Clock("boot", START, 0.0, "GPS"), Clock("Unix", 0.0)
    merged = merge([autopilot(dive, boot), instrument(dive, 12.0, clock=unset)], {}, {})
    assert any("reads 1970-01-01" in text and "not set" in text for text in merged.warnings)
    true = START + dive.loc[dive["dvl_vx"].notna(), "time"].iloc[0]
    assert times(merged, "dvl_vx")[0] == pytest.approx(true, abs=0.06)


def test_arrivals_join_clocks_of_one_file(dive):
    file = autopilot(dive, Clock("boot", START, 0.0, "GPS"))
    own = instrument(dive, 500.0).channels[0]
    rng = np.random.default_rng(1)
    received = own.columns["time"] - 500.0 + 0.003 + rng.exponential(0.02, len(own.columns["time"]))
    own = replace(own, received=received, receiver="boot")
    both = replace(file, channels=(*file.channels, own), clocks={**file.clocks, "own": Clock("own")})
    merged = merge([both], {}, {})
    clock = next(c for c in merged.clocks if c.name == "own")
    assert "arrivals by boot" in clock.how
    late = times(merged, "dvl_vx") - START - dive.loc[dive["dvl_vx"].notna(), "time"].to_numpy()
    assert np.abs(late).max() < 3.0 * clock.sd


def test_a_shift_of_a_sensor_moves_its_clock_and_beside_the_imu_that_sensor_alone(dive):
    merged = merge([autopilot(dive), instrument(dive, 3.2)], {}, {"dvl": -3.2})
    assert times(merged, "dvl_vx") == pytest.approx(dive.loc[dive["dvl_vx"].notna(), "time"].to_numpy(), abs=1e-9)
    alone = merge([autopilot(dive)], {}, {"mag": 0.5})
    assert times(alone, "mag_x")[0] - times(alone, "acc_x")[0] == pytest.approx(0.5)
    with pytest.raises(InputError, match=r"shift sonar: is neither a sensor nor a file; known are auto\.bin, dvl, "):
        merge([autopilot(dive), instrument(dive, 3.2)], {}, {"sonar": 1.0})
    with pytest.raises(InputError, match="its clock is that of the log"):
        merge([autopilot(dive), instrument(dive, 3.2)], {}, {"auto.bin": 1.0})


def test_one_channel_feeds_a_sensor_and_the_others_are_told(dive):
    both = autopilot(dive, imu=IMU, mag=MAG, dvl=DVL)
    files = [both, instrument(dive, 0.0)]
    first = merge(files, {}, {"dvl.log": 0.0})
    assert [(u.file, u.channel.sensor) for u in first.unused] == [(1, "dvl")]
    assert "dvl comes from auto.bin" in first.unused[0].reason
    for choice in ("dvl.log", "dvl", "dvl of dvl.log", "of dvl"):
        chosen = merge(files, {"dvl": choice}, {"dvl.log": 0.0})
        assert [u.file for u in chosen.unused] == [0 if choice != "dvl of auto.bin" else 1], choice
    with pytest.raises(InputError, match=r"choose dvl=/other: no such source of dvl; there are: auto.bin: dvl of"):
        merge(files, {"dvl": "/other"}, {})
    with pytest.raises(InputError, match="choose sonar: no file has this sensor; there are dvl, imu, mag"):
        merge(files, {"sonar": "x"}, {})


def test_a_field_along_the_axes_of_another_imu_is_left_out(dive):
    better = recording("imu.csv", dive, Clock("boot"), {"imu": IMU})
    merged = merge([better, autopilot(dive)], {}, {"auto.bin": 0.0})
    assert "mag_x" not in merged.frame
    assert any(u.channel.sensor == "mag" and "another imu" in u.reason for u in merged.unused)
    alone = recording("mag.csv", dive, Clock("boot"), {"mag": MAG})
    assert "mag_x" in merge([better, alone], {}, {"mag.csv": 0.0}).frame
    assert "mag_x" in merge([better, autopilot(dive)], {"mag": "auto.bin"}, {"auto.bin": 0.0}).frame


def channel(time: Sequence[float]) -> Channel:
    return Channel("depth", {"time": np.array(time, float), "depth": np.arange(len(time), dtype=float)}, "depths")


def test_few_stamps_of_another_epoch_are_left_out_and_counted():
    good = np.arange(100.0) + 1.7e9
    kept, said = put_in_order(channel([0.0, 1.0, *good[:50], 4.2e9, *good[50:], np.nan]), "a.log")
    assert kept.columns["time"] == pytest.approx(good)
    assert len(said) == 2
    assert "1 rows without time" in said[0]
    assert "3 of 103 rows have stamps of a clock that was not set" in said[1]


def test_rows_that_overlap_by_less_than_a_second_are_put_in_order_and_counted():
    kept, said = put_in_order(channel([0.0, 1.0, 0.5, 2.0]), "a.log")
    assert kept.columns["depth"].tolist() == [0.0, 2.0, 1.0, 3.0]
    assert "1 rows are earlier than a row above them" in said[0]


def test_one_wrong_stamp_costs_its_row_alone():
    for wrong in (4000.0, -50.0, 0.0):
        time = np.arange(0.0, 100.0, 0.1)
        time[500] = wrong
        ordered, said = put_in_order(Channel("depth", {"time": time, "depth": np.ones(1000)}, "depth"), "a.bin")
        assert ordered.columns["time"].tolist() == np.delete(np.arange(0.0, 100.0, 0.1), 500).tolist()
        assert "1 of 1000 rows have stamps of another time" in said[0]


def test_a_shift_that_is_no_number_is_refused(dive):
    with pytest.raises(InputError, match="shift dvl: nan is no number of seconds"):
        merge([autopilot(dive), instrument(dive, 0.0)], {}, {"dvl": float("nan")})


def test_a_clock_that_is_set_within_a_file_is_refused():
    with pytest.raises(
        InputError, match=r"^a\.log: depths: row 61: time goes back from 59\.000 to 0\.000 s, and 45% of the rows"
    ):
        put_in_order(channel([*np.arange(60.0), *np.arange(50.0)]), "a.log")
    with pytest.raises(InputError, match="no row has a time"):
        put_in_order(channel([np.nan, np.nan]), "a.log")


def test_settings_hold_where_the_configuration_states_nothing():
    config = rg.parse_config("dvl: {mount_rpy_deg: [180, 0, 0]}")
    settings = {
        "dvl": {"mount_rpy_deg": [0, 0, 90], "lever_arm_m": [0.2, 0, 0]},
        "environment": {"declination_deg": 4.0},
    }
    full, used = completed(config, settings, "a.bin")
    assert full.dvl.mount_rpy_deg == (180, 0, 0)
    assert full.dvl.lever_arm_m == (0.2, 0, 0)
    assert used == {"dvl.lever_arm_m": [0.2, 0, 0], "environment.declination_deg": 4.0}
    with pytest.raises(InputError, match=r"^a\.bin: .*mount"):
        completed(config, {"dvl": {"mount": 1}}, "a.bin")


def test_the_only_clock_of_a_log_has_no_time_offset_however_little_is_known_of_it(dive):
    calendar = Clock("calendar", 0.0, 21600.0, "taken for UTC")
    merged = merge([recording("gauge.log", dive, calendar, {"depth": ("depth",)}, START)], {}, {})
    assert merged.unix and dict(merged.settings) == {}


def test_settings_of_an_instrument_come_with_the_channel_that_feeds_it(dive):
    files = [
        replace(autopilot(dive, imu=IMU, dvl=DVL), settings={"dvl": {"mount_rpy_deg": [0, 0, 1]}, "name": "rov"}),
        replace(instrument(dive, 0.0), settings={"dvl": {"mount_rpy_deg": [0, 0, 2]}, "name": "other"}),
    ]
    first, second = merge(files, {}, {"dvl.log": 0.0}), merge(files, {"dvl": "dvl.log"}, {"dvl.log": 0.0})
    assert first.nested_settings() == {"dvl": {"mount_rpy_deg": [0, 0, 1]}, "name": "rov"}
    assert second.nested_settings() == {"dvl": {"mount_rpy_deg": [0, 0, 2]}, "name": "rov"}


# From files: a toy format, registered as another package would


class Toy:
    """Text: ``TOY`` and a JSON object of arrays; the DVL of a dive on a clock of its own."""

    name, title, extra = "toy", "toy DVL", ""

    def recognise(self, path: Path, head: bytes) -> float:
        return 1.0 if head.startswith(b"TOY") else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        text = path.read_text(encoding="utf-8").removeprefix("TOY")
        columns = {name: np.array(values) for name, values in json.loads(text).items()}
        options.progress(len(text), len(text))
        channels = (Channel("dvl", columns, "/dvl", "x forward, y starboard, z down", "own"),)
        settings = {"dvl": {"lever_arm_m": [0.24, 0.0, 0.33]}}
        left = (Left("/status", 7, "no column of a log"),)
        return Recording(str(path), self.name, channels, {"own": Clock("own")}, left, settings, ("z is taken down",))


class Entry:
    """An installed package's entry point."""

    name, value = "toy", "toys:FORMAT"

    def __init__(self, load: object) -> None:
        self.load = load


@pytest.fixture
def toy(monkeypatch):
    """The toy format, by an entry point; beside it a package that is broken."""

    def broken() -> None:
        raise ImportError("no module named toys")

    module = sys.modules["rovgraph.readers.formats"]
    monkeypatch.setattr(module, "entry_points", lambda group: [Entry(Toy), Entry(broken)])
    formats.cache_clear()
    with pytest.warns(rg.DataWarning, match="toy of toys:FORMAT cannot be loaded"):
        formats()
    yield
    formats.cache_clear()


@pytest.fixture
def files(dive, tmp_path, toy) -> list[Path]:
    """A dive in two files, the DVL's clock 3.2 s ahead."""
    log, dvl = tmp_path / "auto.csv", tmp_path / "dive.toy"
    rest = [name for name in dive if name == "time" or not name.startswith(("dvl", "thruster"))]
    dive[rest].dropna(how="all", subset=rest[1:]).to_csv(log, index=False)
    own = dive.loc[dive["dvl_vx"].notna(), ["time", *DVL]]
    own = own.assign(time=own["time"] + 3.2)
    dvl.write_text("TOY" + json.dumps({name: own[name].tolist() for name in own}), encoding="utf-8")
    return [log, dvl]


@pytest.mark.slow
def test_a_dive_in_two_files_comes_back_to_the_same_track(files, dive):
    config = changed(falcon(), graph={"find_noise": False})
    whole = rg.smooth(rg.Log.from_frame(dive.drop(columns="dvl_heading", errors="ignore"), config), config, "smoothed")
    stated = config.model_dump(exclude_unset=True)
    del stated["dvl"]["lever_arm_m"]
    config = type(config).model_validate(stated)
    log = rg.read_log(files, config)
    assert any("joined by" in note for note in log.notes)
    assert any("dvl.lever_arm_m: [0.24, 0.0, 0.33] (dive.toy)" in note for note in log.notes)
    result = rg.smooth(log, config, "smoothed")
    assert result.config.dvl.lever_arm_m == (0.24, 0.0, 0.33)
    assert set(log.notes) <= set(result.assumptions)
    one, other = (r.smoothed.trajectory for r in (whole, result))
    at = np.interp
    apart = [at(one.time, other.time, other.position[:, k]) - one.position[:, k] for k in (0, 1)]
    assert rms(np.hypot(*apart)) < 0.03
    assert abs(result.calibration["dvl_time_offset"].value) < 0.05


@pytest.mark.slow
def test_the_command_writes_what_the_library_does_and_smooth_reads_it_the_same(files, tmp_path, monkeypatch, capsys):
    out, mine = tmp_path / "log.csv", tmp_path / "mine"
    assert command(monkeypatch, "convert", *files, "--out", out, "--config-out", tmp_path / "v.yaml") == 0
    told = capsys.readouterr().out
    for part in ("/dvl", "x forward, y starboard, z down", "acceleration by imu and dvl", "/status", "z is taken down"):
        assert part in told
    mine.mkdir()
    converted = rg.convert(files)
    converted.save(mine / "log.csv", mine / "v.yaml")
    for name in ("log.csv", "v.yaml", "log.report.json"):
        assert (tmp_path / name).read_bytes() == (mine / name).read_bytes()
    report = json.loads((tmp_path / "log.report.json").read_text(encoding="utf-8"))
    assert report["columns"]["dvl_vx"] == "dive.toy: /dvl"
    assert report["files"][1]["left"] == [{"name": "/status", "count": 7, "reason": "no column of a log"}]
    assert report["clocks"][1]["offset_s"] == pytest.approx(-3.2, abs=3.0 * report["clocks"][1]["sd_s"])
    config = rg.load_config(tmp_path / "v.yaml")
    assert config.dvl.lever_arm_m == (0.24, 0.0, 0.33)
    assert "lever_arm_m: [0.24, 0.0, 0.33]  # dive.toy" in (tmp_path / "v.yaml").read_text(encoding="utf-8")
    assert "not known" in (tmp_path / "v.yaml").read_text(encoding="utf-8")
    written, direct = rg.read_log(out, config), rg.read_log(files)
    for sensor in direct.sensors:
        np.testing.assert_allclose(written[sensor].time, direct[sensor].time, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(written[sensor].data, direct[sensor].data, rtol=1e-8, atol=1e-9)
    assert command(monkeypatch, "convert", *files, "--out", out) == 2
    assert "exists; choose another name or give --force" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["log.csv.gz", "log.parquet"])
def test_a_log_is_written_as_its_name_says(files, tmp_path, name):
    converted = rg.convert(files, shift={"dvl": -3.2})
    converted.save(tmp_path / name)
    again = rg.read_log(tmp_path / name)
    np.testing.assert_allclose(again["dvl"].data, converted.log["dvl"].data, rtol=1e-8)


@pytest.mark.slow
def test_a_large_log_is_converted_in_few_bytes_a_sample_and_shows_how_far_it_is(tmp_path):
    """NumPy tells tracemalloc of its arrays."""
    second = DataFlashWriter()
    for k in range(400):
        second.add("IMU", 2500 * k, 0, 0.1, 0.2, 0.3, 0.01 * k, 0.0, -9.8, 1, 1)
        if k % 40 == 0:
            second.add("ATT", 2500 * k, 0, 0, 0)
    head = len(DataFlashWriter().bytes())
    rows, seconds, body = 400, 400, bytearray(second.bytes()[head:])
    starts = [at for at in range(len(body) - 8) if body[at : at + 2] == b"\xa3\x95"]
    stamps = np.ndarray(len(body) - 7, "<u8", body, 0, (1,))
    path = tmp_path / "long.BIN"
    with path.open("wb") as file:
        file.write(second.bytes()[:head])
        for _ in range(seconds):
            file.write(body)
            stamps[[at + 3 for at in starts]] += 10**6
    told = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        rg.convert(path).save(tmp_path / "warm.csv")  # whatever is loaded or kept once
        tracemalloc.start()
        converted = rg.convert(path)
        converted.save(tmp_path / "log.csv", tmp_path / "v.yaml", progress=lambda what, done: told.append((what, done)))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert most < 50 * rows * seconds + 18e6  # a row is 32 bytes in the log; a block of the file and its rows
    assert {what for what, _ in told} == {"writing log.csv"}
    assert len(told) > 20 and told[-1][1] == 1.0 and [done for _, done in told] == sorted(done for _, done in told)
    with (tmp_path / "log.csv").open("rb") as file:
        assert sum(1 for _ in file) == 1 + (rows + 10) * seconds


def test_values_that_are_left_out_are_told_with_the_log_that_lacks_them(tmp_path):
    """`convert` writes what the files hold; what reads them, and the log that was written, says what it cannot use."""
    table = "time,depth,fix_north,fix_east,fix_sd\n" + "".join(f"{k},{k},{k},0,{k - 2}\n" for k in range(9))
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_text(table if name == "one.csv" else "time,dvl_altitude\n1,5\n2,5\n", encoding="utf-8")
    files = [tmp_path / "one.csv", tmp_path / "two.csv"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        converted = rg.convert(files, shift={"two.csv": 0.0})
        converted.save(tmp_path / "log.csv")
    for read in (lambda: converted.log, lambda: rg.read_log(tmp_path / "log.csv")):
        with pytest.warns(rg.DataWarning, match="fix_sd: 3 times 0 or less"):
            log = read()
        assert any("fix_sd: 3 times" in text for text in log.warnings)
    assert converted.log is converted.log


def test_nothing_is_left_where_writing_fails(files, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    converted = rg.convert(files, shift={"dvl": -3.2})
    with pytest.raises(InputError, match=r"expected a name that ends in \.csv\.gz, \.csv, \.parquet"):
        converted.save(out / "log.txt")
    (out / "v.yaml").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        converted.save(out / "log.csv", out / "v.yaml")
    with pytest.raises(InputError, match="cannot be written"):
        converted.save(out / "log.csv", tmp_path / "nowhere" / "v.yaml")
    with pytest.raises(InputError, match="one of the files that are read"):
        converted.save(files[0], force=True)
    assert [path.name for path in out.iterdir()] == ["v.yaml"]


def test_the_commands_read_several_files(files, tmp_path, monkeypatch, capsys):
    shift = ("--shift", "dvl=-3.2")
    assert command(monkeypatch, "check", *files, *shift) in (0, 2)
    assert "dvl from dive.toy: /dvl" in capsys.readouterr().out
    assert command(monkeypatch, "check", *files, "--shift", "dvl") == 2
    assert "--shift dvl: expected NAME=VALUE" in capsys.readouterr().err
    assert command(monkeypatch, "check", *files, "--shift", "dvl=soon") == 2
    assert "--shift dvl=soon: expected seconds, a number" in capsys.readouterr().err


def test_a_log_with_other_columns_and_units_beside_a_native_file(files, toy):
    frame = pd.read_csv(files[0])
    frame[["gyr_x", "gyr_y", "gyr_z"]] *= 180.0 / np.pi
    frame.rename(columns={"time": "stamp", "gyr_x": "p"}).assign(remark="x").to_csv(files[0], index=False)
    config = rg.parse_config("{columns: {time: stamp, gyr_x: p}, units: {gyr: deg/s}}")
    log = rg.read_log(files, config, shift={"dvl": -3.2})
    np.testing.assert_allclose(np.rad2deg(log["imu"]["gyr_x"]), frame["gyr_x"].dropna(), rtol=1e-9)
    assert log.config is not None and log.config.columns == config.columns
    assert rg.check(log, config).source == "auto.csv + dive.toy"


def test_the_format_of_the_manual_reads_its_file(tmp_path, dive):
    """docs/formats.md: a format of your own, as it stands there."""
    text = (Path(__file__).parents[1] / "docs" / "formats.md").read_text(encoding="utf-8")
    code = text.rpartition("```python\n")[2].partition("```")[0]
    made: dict[str, Any] = {}
    exec(compile(code, "docs/formats.md", "exec"), made)
    rows = dive.loc[dive["dvl_vx"].notna(), ["time", *DVL[:3]]].to_numpy()
    path = tmp_path / "my.txt"
    path.write_text("".join(f"$MYDVL,{','.join(map(repr, row.tolist()))}\n" for row in rows), encoding="utf-8")
    assert made["FORMAT"].recognise(path, path.read_bytes()[:64]) == 1.0
    (own,) = made["FORMAT"].read(path, ReadingOptions()).channels
    assert own.columns["dvl_vy"] == pytest.approx(rows[:, 2])
    assert merge([made["FORMAT"].read(path, ReadingOptions())], {}, {}).frame["dvl_vz"].notna().all()


HOSTILE = {
    "torn": (b"TOY{", "cannot be read as a toy DVL .*damaged"),
    "binary": (b"\x7fELF\x02\x01\xff\xfe\x00\x81" * 9, "is binary data in an unknown format; .*toy DVL"),
    "zip": (b"PK\x03\x04rest", "is a ZIP archive; unpack it first"),
    "ulog": (b"ULog\x01\x12\x35\x01" + bytes(30), "is a PX4 ULog; convert it with ulog2csv"),
    "rowe": (b"\x80" * 16 + bytes(40), "is a recording of a Rowe DVL or ADCP, which is not read"),
    "foxglove": (b'[{"topic": "/imu", "receiveTime": {}, "message": {}}]', "is an export of Foxglove as JSON"),
    "track": (b"time,north,east\n0,1,2\n", "is a track, not a log; rovgraph evaluate"),
    "empty": (b"", "is empty"),
    "table": (b"a,b\n1,2\n", "no column time"),
}


@pytest.mark.parametrize(("content", "message"), HOSTILE.values(), ids=HOSTILE)
def test_what_is_no_log_is_named(files, tmp_path, content, message):
    bad = tmp_path / "bad.dat"
    bad.write_bytes(content)
    for paths in (bad, [files[0], bad]):
        with pytest.raises(InputError, match=message), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rg.read_log(paths)


def test_a_configuration_or_a_results_folder_is_no_log(files, tmp_path):
    (tmp_path / "v.yaml").write_text("dvl:\n  scale_sd: 0\n", encoding="utf-8")
    with pytest.raises(InputError, match="is a configuration; give it with --config"):
        rg.read_log(tmp_path / "v.yaml")
    (tmp_path / "summary.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="is a results folder; rovgraph evaluate"):
        rg.read_log(tmp_path)
    (tmp_path / "trajectory_filtered.csv").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match=r"evaluate .*trajectory_filtered\.csv"):
        rg.read_log(tmp_path)
    (tmp_path / RECORDING).write_text("", encoding="utf-8")
    with pytest.raises(InputError, match=r"is the folder of a live dive; its log is .*received\.csv"):
        rg.read_log(tmp_path)
    with pytest.raises(InputError, match="no such file; check the name"):
        rg.read_log([files[0], tmp_path / "missing.bin"])


def test_a_dive_at_sea_in_two_files_is_joined_by_its_compass():
    """Ictineu: noise hides the DVL's acceleration, and its compass turns 0.7 s later than the gyro."""
    if not REAL.is_dir():
        pytest.skip("the dive's log is not at hand")
    frame = pd.read_csv(REAL / "log.csv.gz")
    auto = recording("auto", frame, Clock("a"), {"imu": IMU})
    dvl = recording("dvl", frame, Clock("b"), {"dvl": DVL[:3], "dvl_heading": ("dvl_heading",)}, 3.2)
    merged = merge([auto, dvl], {}, {})
    clock = next(c for c in merged.clocks if c.file == 1)
    late = times(merged, "dvl_vx")[0] - frame.loc[frame["dvl_vx"].notna(), "time"].iloc[0]
    assert clock.sd < 0.4
    assert abs(late) < 3.0 * clock.sd
    assert merged.nested_settings()["calibration"]["dvl_time_offset"]["estimate"] is True


# From two files of one autopilot


@pytest.fixture(scope="module")
def boxes(tmp_path_factory) -> list[Path]:
    """Two logs of one dive by one autopilot, without a DVL: one with its own clock, one as a ground station has it."""
    pytest.importorskip("pymavlink")
    folder = tmp_path_factory.mktemp("boxes")
    frame = short_dive(5.0)
    frame = frame.drop(columns=[name for name in frame if name.startswith("dvl")])
    (folder / "box.BIN").write_bytes(dataflash_of(frame, 0.0, 101_325.0))
    sent = [(START + time, packed(message)) for time, message in autopilot_messages(frame, 0.0, 101_325.0)]
    (folder / "box.tlog").write_bytes(tlog(*sent))
    return [folder / "box.BIN", folder / "box.tlog"]


@pytest.mark.parametrize("choice", ["box.BIN", "IMU 0", "imu 0"])
def test_a_choice_names_a_file_or_what_one_of_several_files_has(boxes, choice):
    converted = rg.convert(boxes[::-1], choose={"imu": choice}, shift={"depth": 0.0})
    assert converted.report["columns"]["acc_x"].startswith("box.BIN: IMU 0")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="what a process holds is read from /proc")
def test_a_log_of_one_message_that_does_not_fit_into_memory_is_refused_and_not_called_damaged(tmp_path):
    path, out = tmp_path / "long.BIN", tmp_path / "log.csv"
    one = DataFlashWriter().add("IMU", 0, 0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8, 1, 1).bytes()
    head = len(DataFlashWriter().bytes())
    with path.open("wb") as file:
        file.write(one + one[head:] * 4_000_000)
    code = f"""
import resource, sys
import rovgraph as rg
from rovgraph.readers import formats
from rovgraph.cli.app import main
formats()
held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + 60_000_000,) * 2)
sys.argv[1:] = ["convert", {str(path)!r}, "--out", {str(out)!r}]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    told = " ".join(done.stderr.split())
    assert done.returncode == 2, told
    assert "long.BIN: what it holds does not fit into the memory that is free; split it" in told
    assert [each.name for each in tmp_path.iterdir()] == ["long.BIN"]


def test_a_choice_that_no_file_has_is_refused_with_those_of_all(boxes):
    with pytest.raises(InputError, match=r"choose imu=IMU 7: .* there are: box\.BIN: IMU 0.*box\.tlog: HIGHRES_IMU"):
        rg.convert(boxes, choose={"imu": "IMU 7"})


def test_a_configuration_to_begin_with_is_written_for_any_sensors_and_any_name(boxes, tmp_path):
    converted = rg.convert(boxes[0])
    converted.save(tmp_path / "a\nb.csv", tmp_path / "vehicle.yaml")
    assert "dvl" not in rg.load_config(tmp_path / "vehicle.yaml").model_fields_set
    for config_out in ("log.csv", "log.report.json"):
        with pytest.raises(InputError, match="is to be written twice"):
            converted.save(tmp_path / "log.csv", tmp_path / config_out)
