"""Files of NMEA sentences and GPX tracks: fixes and headings at their times."""

from datetime import UTC, datetime
from pathlib import Path

import gpxpy.gpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close
from wire import sentence

from rovgraph.errors import InputError
from rovgraph.interchange.formats import Options, read_recording
from rovgraph.interchange.recording import Channel, Recording

MIDNIGHT = datetime(2024, 3, 2, tzinfo=UTC).timestamp()


def read(data: bytes, folder: Path, **choose: str) -> Recording:
    path = folder / "ship.txt"
    path.write_bytes(data)
    return read_recording(path, Options(choose=choose))


def first(recording: Recording, sensor: str) -> Channel:
    return next(channel for channel in recording.channels if channel.sensor == sensor)


def gga(clock: str, minutes: float, talker: str = "GP", quality: int = 1) -> bytes:
    return sentence(f"{talker}GGA,{clock},50{minutes:07.4f},N,00806.0000,E,{quality},09,0.9,10.0,M,47.0,M,,")


def rmc(clock: str, date: str) -> bytes:
    return sentence(f"GPRMC,{clock},A,5000.0000,N,00806.0000,E,0.1,0.0,{date},,,A")


def test_times_go_on_over_midnight_and_before_the_first_date(tmp_path):
    data = [
        gga("235958.00", 0.1),
        gga("235959.00", 0.2),
        gga("000000.50", 0.3),
        rmc("000001.00", "020324"),
        gga("000002.00", 0.4),
    ]
    recording = read(b"".join(data), tmp_path)
    fixes = first(recording, "fix").columns
    close(fixes["time"] - MIDNIGHT, [-2.0, -1.0, 0.5, 2.0], atol=1e-3)
    close(fixes["fix_lat"], 50.0 + np.array([0.1, 0.2, 0.3, 0.4]) / 60.0)
    close(fixes["fix_sd"], 2.7)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [0.0]


def test_without_a_date_times_count_from_midnight_and_are_not_unix_time(tmp_path):
    recording = read(b"".join([gga("235959.00", 0.1), gga("000001.00", 0.2), gga("000002.00", 0.3)]), tmp_path)
    close(first(recording, "fix").columns["time"], [86399.0, 86401.0, 86402.0])
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]
    assert "no sentence has a date" in recording.notes[0]


def test_headings_lie_evenly_between_sentences_with_a_time(tmp_path):
    hdg = [sentence(f"HEHDG,{heading},,,2.5,E") for heading in (10.0, 20.0, 30.0)]
    recording = read(b"".join([hdg[0], rmc("120000.00", "020324"), *hdg, rmc("120004.00", "020324")]), tmp_path)
    ahrs = first(recording, "ahrs").columns
    close(ahrs["time"] - MIDNIGHT, 43200.0 + np.array([1.0, 2.0, 3.0]))
    close(np.rad2deg(ahrs["ahrs_yaw"]), [10, 20, 30])
    assert recording.settings == {"environment": {"declination_deg": 2.5}}


def test_a_true_heading_says_so(tmp_path):
    recording = read(b"".join([gga("120000.00", 0.1), sentence("HEHDT,90.0,T"), gga("120001.00", 0.2)]), tmp_path)
    assert recording.settings == {"environment": {"declination_deg": 0.0}}
    assert any("relative to true north" in warning for warning in recording.warnings)


def test_heading_pitch_and_roll_of_one_sentence(tmp_path):
    hpr = sentence("PTNTHPR,85.9,N,-0.9,N,0.8,N")
    recording = read(b"".join([gga("120000.00", 0.1), hpr, gga("120001.00", 0.2)]), tmp_path)
    ahrs = first(recording, "ahrs").columns
    got = [ahrs[name][0] for name in ("ahrs_yaw", "ahrs_pitch", "ahrs_roll")]
    close(np.rad2deg(got), [85.9, -0.9, 0.8])


def test_of_several_talkers_one_can_be_chosen_and_the_ships_acoustic_positions_are_no_fixes(tmp_path):
    both = [gga(f"12000{k}.00", 0.1 * k, talker) for k in range(5) for talker in ("GP", "UB")]
    usbl = sentence("PSIMSSB,120000.00,B01,A,,C,H,M,1.0,2.0,30.0,0.1,N,,")
    data = b"".join([*both, usbl, gga("120006.00", 0.7, quality=0), b"$GPGGA,broken*00\r\n", b"\xff\x00\n"])
    recording = read(data, tmp_path, fix="UBGGA")
    assert [channel.source for channel in recording.channels] == ["UBGGA", "GPGGA"]
    assert "not of the ship" in recording.warnings[0]
    assert {each.name: each.count for each in recording.left if each.name != "lines"} == {"PSIMSSB": 1, "GPGGA": 1}
    assert sum(each.count for each in recording.left if each.name == "lines") == 2


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (sentence("HEHDT,90.0,T") * 5, "no sentence has a time"),
        (sentence("GPGSV,1,1,01,09,12,123,44") * 5, "neither fixes nor headings; other sentences: GPGSV: 5"),
    ],
)
def test_a_file_without_use_is_refused_by_what_it_holds(data, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(data, tmp_path)


BASE = b"".join(
    [gga("120000.00", 0.1), sentence("HEHDT,90.0,T"), rmc("120001.00", "020324"), gga("120002.00", 0.2)] * 3
)


@settings(max_examples=50, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(BASE)
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


def gpx(times: bool = True) -> bytes:
    track = gpxpy.gpx.GPX()
    track.tracks.append(gpxpy.gpx.GPXTrack())
    track.tracks[0].segments.append(gpxpy.gpx.GPXTrackSegment())
    for k in range(5):
        time = datetime.fromtimestamp(MIDNIGHT + k, UTC) if times else None
        point = gpxpy.gpx.GPXTrackPoint(50.0 + 1e-5 * k, 8.0, time=time, horizontal_dilution=1.5)
        track.tracks[0].segments[0].points.append(point)
    return track.to_xml().encode()


def test_points_of_a_gpx_track_are_fixes(tmp_path):
    recording = read(gpx(), tmp_path)
    fixes = first(recording, "fix").columns
    close(fixes["time"], MIDNIGHT + np.arange(5))
    close(fixes["fix_lat"], 50.0 + 1e-5 * np.arange(5))
    close(fixes["fix_sd"], 4.5)
    assert "see that its fixes are of the vehicle" in recording.warnings[0]


@pytest.mark.parametrize(
    ("data", "said"),
    [(gpx(times=False), "5 points of a track, none with a time"), (gpx()[:200], "is no whole GPX file")],
)
def test_a_gpx_file_that_is_cut_off_or_without_times_is_refused(data, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(data, tmp_path)
