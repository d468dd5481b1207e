"""Files of NMEA sentences and GPX tracks: fixes and headings at their times."""

from datetime import UTC, datetime
from pathlib import Path

import gpxpy.gpx
import numpy as np
import pynmea2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymap3d import geodetic2ned
from recordings import check_refused_or_whole, close, first, read
from wire import sentence

from rovgraph.errors import InputError
from rovgraph.readers.formats import read_recording, recognise
from rovgraph.readers.recording import Recording

MIDNIGHT = datetime(2024, 3, 2, tzinfo=UTC).timestamp()


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
    assert recording.settings == {"heading": {"ahrs_reference": "true"}}


def test_heading_pitch_and_roll_of_one_sentence(tmp_path):
    hpr = sentence("PTNTHPR,85.9,N,-0.9,N,0.8,N")
    recording = read(b"".join([gga("120000.00", 0.1), hpr, gga("120001.00", 0.2)]), tmp_path)
    ahrs = first(recording, "ahrs").columns
    got = [ahrs[name][0] for name in ("ahrs_yaw", "ahrs_pitch", "ahrs_roll")]
    close(np.rad2deg(got), [85.9, -0.9, 0.8])


def test_of_several_talkers_one_can_be_chosen(tmp_path):
    both = [gga(f"12000{k}.00", 0.1 * k, talker) for k in range(5) for talker in ("GP", "UB")]
    data = b"".join([*both, gga("120006.00", 0.7, quality=0), b"$GPGGA,broken*00\r\n", b"\xff\x00\n"])
    recording = read(data, tmp_path, fix="UBGGA")
    assert [channel.source for channel in recording.channels] == ["UBGGA", "GPGGA"]
    assert "not of the ship" in recording.warnings[0]
    assert {each.name: each.count for each in recording.left if each.name != "lines"} == {"GPGGA": 1}
    assert sum(each.count for each in recording.left if each.name == "lines") == 2


# Acoustic positions relative to a ship


def usbl(clock: str, axes: str, x: float, y: float, name: str = "B01", status: str = "A", kind: str = "C") -> bytes:
    return sentence(f"PSIMSSB,{clock},{name},{status},,{kind},{axes},M,{x:.3f},{y:.3f},30.0,0.5,N,,")


def under_way(*more: bytes, heading: bytes = sentence("HEHDT,120.0,T")) -> bytes:
    """A ship that goes north by 1.5 m/s; after the fix of each second the other sentences."""
    meter = 1.0 / 1853.75  # minutes of latitude, at 50 degrees
    seconds = range(20)
    said = [
        gga(f"1200{k:02d}.00", 1.0 + 1.5 * k * meter) + heading + b"".join(more).replace(b"??", b"%02d" % k)
        for k in seconds
    ]
    return b"".join([rmc("115959.00", "020324"), *said])


def off(recording: Recording, north: float, east: float) -> float:
    """Largest distance of fixes from a place relative to the ship's path [m]."""
    fix = first(recording, "fix").columns
    began = MIDNIGHT + 12 * 3600.0
    start = 50.0 + 1.0 / 60.0
    got = geodetic2ned(fix["fix_lat"], fix["fix_lon"], 0.0, start, 8.1, 0.0)
    return float(np.hypot(got[0] - 1.5 * (fix["time"] - began) - north, got[1] - east).max())


@pytest.mark.parametrize(("axes", "x", "y"), [("N", 30.0, -40.0), ("E", -40.0, 30.0), ("H", None, None)])
@pytest.mark.parametrize("hours", [0, 2])
def test_positions_relative_to_a_ship_become_fixes_at_their_own_times(axes, x, y, hours, tmp_path):
    """The ship's fixes are of one second, the acoustic ones are sent with the next; their clock may be local time."""
    turn = np.deg2rad(120.0)
    if x is None:  # starboard and ahead
        x, y = 30.0 * -np.sin(turn) + -40.0 * np.cos(turn), 30.0 * np.cos(turn) + -40.0 * np.sin(turn)
    sent = [
        gga(f"1200{k:02d}.00", 1.0 + 1.5 * k / 1853.75)
        + sentence("HEHDT,120.0,T")
        + usbl(f"{12 + hours}00{max(k - 1, 0):02d}.40", axes, x, y)
        for k in range(20)
    ]
    recording = read(b"".join([rmc("115959.00", "020324"), *sent]), tmp_path, fix="PSIMSSB B01")
    assert [channel.source for channel in recording.channels] == ["PSIMSSB B01", "GPGGA", "GPRMC"]
    assert off(recording, 30.0, -40.0) < 0.3  # of 1e-4 minutes of the ship's fixes
    close(first(recording, "fix").columns["time"][1:] % 1.0, 0.4, atol=1e-3)
    close(first(recording, "fix").columns["fix_sd"], 0.5)
    assert "is added to GPGGA" in recording.warnings[0]
    assert {each.name for each in recording.left} == {"HEHDT"}


def test_the_transponder_with_most_positions_is_preferred_and_others_can_be_chosen(tmp_path):
    data = under_way(usbl("1200??.00", "N", 1.0, 1.0)) + usbl("120019.00", "N", 5.0, 5.0, "B02")
    assert first(read(data, tmp_path), "usbl").source == "PSIMSSB B01, PSIMSSB B02"
    assert read(data, tmp_path).settings["usbl"]["beacon"] == "B01"
    assert read(data, tmp_path, usbl="PSIMSSB B02").settings["usbl"]["beacon"] == "B02"
    for chosen in ("PSIMSSB B02", "GPGGA"):
        assert first(read(data, tmp_path, fix=chosen), "fix").source == chosen
    assert first(read(data, tmp_path, ahrs="HEHDT"), "ahrs").source == "HEHDT"


def test_acoustic_positions_that_cannot_be_placed_are_counted(tmp_path):
    bad = [
        usbl("120019.00", "N", 1.0, 1.0, status="V"),
        usbl("120019.00", "N", 1.0, 1.0, kind="U"),
        usbl("120019.00", "N", 1.0, 1.0, kind="P"),
        usbl("121019.00", "N", 1.0, 1.0),  # ten minutes after the ship's last fix
    ]
    recording = read(under_way() + b"".join(bad) + usbl("120019.00", "H", 1.0, 1.0), tmp_path, fix="PSIMSSB B01")
    assert first(recording, "fix").source == "PSIMSSB B01"
    assert len(first(recording, "fix").columns["time"]) == 1
    assert {each.reason for each in recording.left if each.name.startswith("PSIMSSB")} == {
        "the system marks it as not OK",
        "neither in Cartesian coordinates relative to a ship nor in degrees",
        "on a grid that is not stated, and not UTM of the ship's zone within 20 km of her",
        "the ship's position, or her heading (HDT), is not known",
    }
    without = under_way(usbl("1200??.00", "H", 1.0, 1.0), heading=b"")
    with pytest.raises(InputError, match=r"none that can be placed .*heading .*--choose fix=GPGGA"):
        read(without, tmp_path)  # the ship's own place is not the vehicle's
    assert first(read(without, tmp_path, fix="GPGGA"), "fix").source == "GPGGA"
    alone = usbl("120019.00", "N", 1.0, 1.0) * 5
    with pytest.raises(InputError, match=r"ship whose fixes are not in the file.*--choose usbl=.PSIMSSB B01"):
        read(alone, tmp_path)
    assert [c.sensor for c in read(alone, tmp_path, usbl="PSIMSSB B01").channels] == ["usbl"]


def ssb(clock: str, error: str = "", filtered: str = "M", x: float = 30.0, y: float = -40.0, axes: str = "N") -> bytes:
    return sentence(f"PSIMSSB,{clock},M17,A,{error},C,{axes},{filtered},{x:.3f},{y:.3f},30.0,1.4,T,0.03,")


def test_an_acoustic_position_that_is_no_reply_is_none_whatever_its_status(tmp_path):
    sent = [
        gga(f"1200{k:02d}.00", 1.0 + 1.5 * k / 1853.75)
        + ssb(f"1200{k:02d}.40")
        + ssb(f"1200{k:02d}.60", "NRy", "F", 0.0, 0.0)
        + ssb(f"1200{k:02d}.70", "", "P", 300.0, 0.0)
        for k in range(20)
    ]
    recording = read(b"".join([rmc("115959.00", "020324"), *sent]), tmp_path, fix="PSIMSSB M17")
    assert len(first(recording, "fix").columns["time"]) == 20 and off(recording, 30.0, -40.0) < 0.8
    reasons = {each.reason: each.count for each in recording.left if each.name.startswith("PSIMSSB")}
    assert reasons == {"error NRy: not a reply": 20, "predicted, not measured": 20}
    assert "fix_error" not in recording.settings.get("calibration", {})


def test_filtered_acoustic_positions_are_taken_with_an_error_that_lasts(tmp_path):
    recording = read(under_way(ssb("1200??.40", filtered="F")), tmp_path)
    assert sum("is filtered by the acoustic system" in line for line in recording.warnings) == 1
    assert recording.settings["calibration"] == {"fix_error": {"estimate": True}}


def test_the_acoustic_systems_own_heading_of_the_ship_turns_head_up_positions(tmp_path):
    turn = np.deg2rad(120.0)
    x, y = 30.0 * -np.sin(turn) + -40.0 * np.cos(turn), 30.0 * np.cos(turn) + -40.0 * np.sin(turn)
    said = (f"PSIMSNS,1200{k:02d}.30,M17,1,1,-1.27,-1.13,-0.04,120.0,,a0,0.000,,M121" for k in range(20))
    sent = [
        gga(f"1200{k:02d}.00", 1.0 + 1.5 * k / 1853.75) + sentence(text) + ssb(f"1200{k:02d}.40", x=x, y=y, axes="H")
        for k, text in enumerate(said)
    ]
    recording = read(b"".join([rmc("115959.00", "020324"), *sent]), tmp_path, fix="PSIMSSB M17")
    assert off(recording, 30.0, -40.0) < 0.8


def test_a_ship_at_rest_keeps_its_fixes(tmp_path):
    """Time decides, not the place: she lies at a jetty, and her vehicle is placed all along."""
    sent = [
        gga(f"12{k // 60:02d}{k % 60:02d}.00", 1.0) + sentence("HEHDT,120.0,T") + ssb(f"12{k // 60:02d}{k % 60:02d}.40")
        for k in range(300)
    ]
    recording = read(b"".join([rmc("115959.00", "020324"), *sent]), tmp_path, fix="PSIMSSB M17")
    assert len(first(recording, "fix").columns["time"]) == 300
    measured = read(b"".join([rmc("115959.00", "020324"), *sent]), tmp_path)
    assert [len(first(measured, sensor).columns["time"]) for sensor in ("usbl", "ship", "ship_heading")] == [
        300,
        300,
        299,
    ]
    assert len(next(c for c in recording.channels if c.source == "GPGGA").columns["time"]) == 300


@pytest.mark.parametrize(
    ("text", "yaw", "roll", "pitch"),
    [
        ("PASHR,120001.500,085.90,T,-00.80,+00.90,-00.84,0.151,0.075,0.555,1,0", 85.9, -0.8, 0.9),
        ("PTNTHTM,85.9,N,0.9,N,-0.8,N,62.0,1.0", 85.9, -0.8, 0.9),
        ("PSXN,23,-0.80,0.90,85.90,0.02", 85.9, -0.8, 0.9),
        ("PRDID,0.90,-0.80,85.90", 85.9, -0.8, 0.9),
    ],
)
def test_attitudes_of_makers_are_read_with_roll_to_starboard_and_bow_up(text, yaw, roll, pitch, tmp_path):
    data = rmc("120000.00", "020324") + sentence(text) + rmc("120002.00", "020324") + sentence(text) * 2
    recording = read(data + rmc("120004.00", "020324"), tmp_path)
    found = first(recording, "ahrs")
    close(np.rad2deg(found.columns["ahrs_yaw"]), yaw)
    close(np.rad2deg(found.columns["ahrs_roll"]), roll)
    close(np.rad2deg(found.columns["ahrs_pitch"]), pitch)
    assert ("true north" in found.frame) == text.startswith(("PASHR", "PSXN"))
    if text.startswith("PASHR"):  # the one with a time of its own
        close(found.columns["time"], MIDNIGHT + 12 * 3600.0 + 1.5)


def test_pitch_and_roll_of_a_transducer_measurement_are_a_tilt(tmp_path):
    data = rmc("120000.00", "020324") + sentence("YXXDR,A,1.5,D,PTCH,A,-2.5,D,ROLL,A,9.0,D,RUDDER")
    found = first(read(data + rmc("120004.00", "020324"), tmp_path), "vehicle_tilt")
    close(np.rad2deg([found.columns["pitch"][0], found.columns["roll"][0]]), [1.5, -2.5])


def test_sentences_without_checksums_are_read_where_none_has_one(tmp_path):
    bare = b"".join(line.partition(b"*")[0] + b"\r\n" for line in under_way().splitlines())
    recording = read(bare, tmp_path)
    assert len(first(recording, "fix").columns["time"]) == 20
    assert any("no sentence has a checksum" in line for line in recording.warnings)
    mixed = read(under_way() + b"$GPGGA,120100.00,5001.0000,N,00806.0000,E,1,9,1.0,1.0,M,48.0,M,,\r\n", tmp_path)
    assert len(first(mixed, "fix").columns["time"]) == 20
    assert any(each.name == "lines" and "checksum" in each.reason for each in mixed.left)


def test_a_binary_recording_with_sentences_inside_is_not_nmea(tmp_path):
    path = tmp_path / "dive.bin"
    path.write_bytes(b"".join(line + b"\r\n" + bytes(range(20)) for line in under_way().splitlines()))
    assert recognise(path) is None


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
    + [usbl("120001.50", "H", 3.0, 4.0), usbl("120001.60", "N", 3.0, 4.0, "B02")]
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


CASES = Path(__file__).parents[2] / "shared" / "cases"
REAL = CASES / "real-text" / "gpsd_rst39.log"


@pytest.mark.skipif(not REAL.is_file(), reason=f"no {REAL}")
def test_a_real_recording_has_the_values_of_pynmea2():
    """Fixes of GGA, and headings, pitch and roll of PASHR, at their own times."""
    sentences = [line for line in REAL.read_text(encoding="ascii").splitlines() if line.startswith("$")]
    recording = read_recording(REAL)
    parsed = [pynmea2.parse(line) for line in sentences if line.startswith("$GPGGA")]
    fixes = next(c for c in recording.channels if c.source == "GPGGA").columns
    close(fixes["fix_lat"], [each.latitude for each in parsed], atol=1e-12)
    close(fixes["fix_lon"], [each.longitude for each in parsed], atol=1e-12)
    of_day = [
        3600.0 * t.hour + 60.0 * t.minute + t.second + 1e-6 * t.microsecond for t in (p.timestamp for p in parsed)
    ]
    close(fixes["time"] % 86400.0, of_day, atol=1e-5)
    cells = [line.split(",") for line in sentences if line.startswith("$PASHR")]
    attitude = first(recording, "ahrs").columns
    assert len(attitude["time"]) == len(cells) == 100
    for name, place in (("ahrs_yaw", 2), ("ahrs_roll", 4), ("ahrs_pitch", 5)):
        close(np.rad2deg(attitude[name]), [wrap(float(row[place])) for row in cells], atol=1e-9)


def wrap(degrees: float) -> float:
    return (degrees + 180.0) % 360.0 - 180.0
