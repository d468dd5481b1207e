"""Sentences of acoustic positioning systems: makers' printed examples, real lines, and lines made by their layout.

Which is which stands beside each; docs/formats.md says the same.
"""

import math
import re
import struct
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read
from wire import Heard, decoded, sentence

from rovgraph.errors import InputError
from rovgraph.live.message import GEODETIC, SHIP_GEODETIC, Message
from rovgraph.live.sources.json_lines import json_lines
from rovgraph.live.sources.nmea import nmea
from rovgraph.log.streams import STREAMS, label_number
from rovgraph.model.config import Config
from rovgraph.readers.acoustic_channels import from_utm, on_ships_grid
from rovgraph.readers.acoustic_sentences import (
    AcousticPosition,
    HeadDirections,
    Reply,
    ShipAttitude,
    Told,
    acoustic_sentence,
    crc16,
    told_by,
)
from rovgraph.readers.records import Refused

NOON = datetime(2024, 3, 2, 12, tzinfo=UTC).timestamp()
RAD = math.radians(1.0)


def told(line: bytes | str, bare: bool = False) -> Told:
    found = acoustic_sentence(line.encode() if isinstance(line, str) else line)
    assert found is not None
    return told_by(*found, bare)[0]


def reply(line: bytes | str, bare: bool = False) -> Reply:
    found = told(line, bare)
    assert isinstance(found, Reply)
    return found


def refused(line: bytes | str) -> str:
    with pytest.raises(Refused) as error:
        told(line)
    return error.value.text


# Kongsberg; real lines of a HiPAP, but for its axes, form and faults by the maker's description

HIPAP = "$PSIMSSB,083710.40,M17,A,,C,N,F,46.649,1.632,24.829,1.414,T,0.033681,*6C"


def test_a_real_reply_is_north_east_and_down_at_its_time():
    found = reply(HIPAP)
    assert (found.name, found.frame, found.filtered, found.sd) == ("PSIMSSB M17", "north", True, 1.414)
    assert found.xyz == (46.649, 1.632, 24.829)
    assert found.when.time(3600.0 * 10 + 37 * 60 + 11.0) == pytest.approx(3600.0 * 10 + 37 * 60 + 10.4)  # local time
    assert found.columns["usbl_angle_sd"] == pytest.approx(1.414 / math.hypot(46.649, 1.632, 24.829), rel=1e-3)


@pytest.mark.parametrize(
    ("axes", "frame", "xy"), [("H", "ship", (2.0, 1.0)), ("N", "north", (1.0, 2.0)), ("E", "north", (2.0, 1.0))]
)
def test_axes_of_a_reply(axes, frame, xy):
    found = reply(sentence(f"PSIMSSB,120000.00,B01,A,,C,{axes},M,1.0,2.0,3.0,0.5,N,,"))
    assert (found.frame, found.xyz) == (frame, (*xy, 3.0))


def test_degrees_move_the_later_fields_by_two():
    found = told(sentence("PSIMSSB,120000.00,B01,A,,D,N,M,5030.0000,N,00130.0000,W,24.8,1.4,N,,"))
    assert isinstance(found, AcousticPosition)
    assert (found.lat, found.lon, found.noise[0]) == (50.5, -1.5, 1.4)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("B01,A,NRy,C,N,F,0.000,0.000,0.000,20.000,T,0.003731,", "error NRy: not a reply"),
        ("B01,V,NRy,C,N,M,,,,,N,,", "error NRy: not a reply"),
        ("B01,V,,C,N,M,1,2,3,4,N,,", "marks it as not OK"),
        ("B01,A,,C,N,P,300.0,2,3,4,N,,", "predicted"),
        ("B01,A,,P,N,M,1,2,3,4,N,,", "neither in Cartesian"),
        ("B01,A,,C,X,M,1,2,3,4,N,,", "expected H, N or E"),
        ("B01,A,,C,N,M,,2,3,4,N,,", "without a coordinate"),
        ("B01,A,,C,N,M,650879.0,5688874.1,3,4,N,,", "more than 20 km"),
        ("B01,A,,D,N,M,9130.0,N,00130.0,W,2,1,N,,", "nowhere on Earth"),
    ],
)
def test_what_is_no_reply_is_refused(fields, said):
    assert re.search(said, refused(sentence(f"PSIMSSB,120000.00,{fields}")))


def test_just_within_20_km_is_a_reply():
    assert reply(sentence("PSIMSSB,120000.00,B01,A,,C,N,M,19990.0,0,100,1,N,,")).columns["usbl_x"] == 19990.0
    assert "20 km" in refused(sentence("PSIMSSB,120000.00,B01,A,,C,N,M,20000.0,0,100,1,N,,"))


def test_the_accuracy_20_and_0_are_unknown():
    for accuracy in ("20.000", "0.0", ""):
        found = reply(sentence(f"PSIMSSB,120000.00,B01,A,,C,N,M,1,2,3,{accuracy},N,,"))
        assert math.isnan(found.sd) and "usbl_angle_sd" not in found.columns


def test_the_ship_at_a_ping():
    found = told("$PSIMSNS,083710.30,M17,1,1,-1.27,-1.13,-0.04,250.87,,a0,0.000,,M121*28")
    assert isinstance(found, ShipAttitude)
    close(np.degrees([found.roll, found.pitch, found.heading]), [-1.27, -1.13, 250.87])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (HIPAP[:-2] + "6D", "checksum"),
        (HIPAP[:-3], "checksum"),
        (HIPAP[:40], "checksum"),
        (sentence("PSIMSSR,120000.00,B01,A,1,2,3"), "its layout is not known"),
        (sentence("PSONDEP,120000.00,1"), "its layout is not known"),
        (sentence("PSONUSBL,120000.00,1"), "its layout is not known"),
    ],
)
def test_wrong_checksums_lines_that_are_cut_and_unknown_layouts_are_refused(line, said):
    assert said in refused(line)


def test_appended_fields_change_nothing():
    line = "PSIMSSB,120000.00,B01,A,,C,N,M,1.0,2.0,3.0,0.5,N,,"
    assert reply(sentence(line)).columns == reply(sentence(line + ",more,fields,9.9")).columns
    assert reply(f"${line}", bare=True).columns == reply(sentence(line)).columns


# iXblue GAPS: the maker's printed examples, and real lines


def test_a_printed_position_of_a_gaps():
    found = told("$PTSAG,#16068,124544.449,18,12,2017,1,4305.25355,N,00631.76852,E,F,1013.10,1,9999.00*23")
    assert isinstance(found, AcousticPosition)
    close([found.lat, found.lon], [43.0 + 5.25355 / 60, 6.0 + 31.76852 / 60], atol=1e-9)
    assert (found.name, found.of_ship) == ("PTSAG 1", False)
    assert found.when.sent == datetime(2017, 12, 18, 12, 45, 44, 449000, UTC).timestamp()
    ship = told("$PTSAG,#16071,124546.173,18,12,2017,0,4305.25123,N,00631.79102,E,F,0002.89,1,9999.00*25")
    assert isinstance(ship, AcousticPosition) and ship.of_ship


def test_a_printed_relative_position_is_forward_and_starboard():
    found = reply("$PTSAX,#16069,124544.449,18,12,2017,1,17.95,-25.58,F,1013.10,1,9999.00*27")
    assert (found.frame, found.xyz) == ("ship", (17.95, -25.58, 1013.10))


def test_a_real_pair_of_axes_differs_by_the_ships_heading():
    ahead = reply("$PTSAX,#2383172,071216.870,05,04,2018,4,-412.45,526.85,F,0631.8,1,9999.0*23")
    north = reply("$PTSAY,#2383173,071216.870,05,04,2018,4,-651.98,150.33,F,0631.8,1,9999.0*2E")
    turns = [math.atan2(each.xyz[1], each.xyz[0]) for each in (north, ahead)]
    assert math.degrees(turns[0] - turns[1]) % 360.0 == pytest.approx(39.0, abs=0.05)


@pytest.mark.parametrize(
    ("id_", "mask", "said"),
    [("1", "E", ""), ("1", "7", ""), ("1", "3", "three hydrophones"), ("1", "0", "three hydrophones"),
     ("1", "", "three hydrophones"), ("-5", "F", "unknown transponder"), ("0", "0", "")],
)  # fmt: skip
def test_three_hydrophones_of_a_gaps_are_enough(id_, mask, said):
    line = sentence(f"PTSAG,#1,124544.449,18,12,2017,{id_},4305.25,N,00631.7,E,{mask},10.0,1,9999.0")
    if said:
        assert said in refused(line)
    else:
        assert isinstance(told(line), AcousticPosition)


def test_the_old_form_of_a_gaps_is_refused():
    assert "old form" in refused("$PTSAX,01,00100,00199,F,0301,1,9999*16")


# Sonardyne: real lines


@pytest.mark.parametrize(
    ("line", "name", "lat", "lon", "sd", "ship"),
    [
        ("$PSONLLD,133707.52,2401,A,51.3315406,-0.83563975,999.916,5.33,5.33,0.00,0.62,,,,*2A",
         "PSONLLD 2401", 51.3315406, -0.83563975, 5.33, False),
        ("$PSONLLD,133707.59,Ship 1,A,51.3306281,-0.83499295,0.000,0.08,0.08,0.00,0.01,,,,*1D",
         "PSONLLD Ship 1", 51.3306281, -0.83499295, 0.08, True),
        ("$PSONLLD,170004.53,ALVIN 914,A,28.8114807,-87.80925696,1951.156,13.96,13.96,0.00,2.62,,,,*6F",
         "PSONLLD ALVIN 914", 28.8114807, -87.80925696, 13.96, False),
    ],
)  # fmt: skip
def test_real_positions_of_a_ranger(line, name, lat, lon, sd, ship):
    found = told(line)
    assert isinstance(found, AcousticPosition)
    assert (found.name, found.lat, found.lon, found.of_ship) == (name, lat, lon, ship)
    assert found.noise[0] == pytest.approx(sd)


def test_eastings_and_northings_need_the_ship():
    ship = told("$PSONALL,Ship 1,CRP,134446.175,650879.00,5688874.16,0.00,180.00,,G,0.00,0.00,,0.109,0.001*51")
    assert isinstance(ship, ShipAttitude) and ship.heading == math.pi
    found = told("$PSONALL,2401,Transducer,134446.178,650778.88,5688917.56,1000.09,,,G,,,,7.521,0.606*3F")
    assert isinstance(found, AcousticPosition)
    assert (found.grid, found.noise[0]) == ((650778.88, 5688917.56), 7.521)
    near = on_ships_grid(found.grid, 51.33, -0.83)  # zone 30
    assert near is not None
    close(near, [51.3315406, -0.83563975], atol=2e-5)  # of its PSONLLD, minutes later
    assert on_ships_grid(found.grid[::-1], 51.33, -0.83) == near  # in either order
    assert on_ships_grid(found.grid, 51.33, 4.0) is None  # another zone
    assert on_ships_grid((650778.88, 5788917.56), 51.33, -0.83) is None


@pytest.mark.parametrize(
    ("east", "north", "zone", "south", "lat", "lon"),
    [
        (500000.0, 0.0, 31, False, 0.0, 3.0),
        (448251.795, 5411932.678, 31, False, 48.8582, 2.2945),  # Eiffel Tower
        (334873.199, 6252266.092, 56, True, -33.857, 151.215),  # Sydney; all as pyproj has them
    ],
)
def test_utm(east, north, zone, south, lat, lon):
    close(from_utm(east, north, zone, south), [lat, lon], atol=1e-6)


# Cerulean: the maker's printed example, which is printed with a wrong checksum

ROVL = "USRTH,358.5,1.5,2.8,142.8,52.8,37.2,2.8,-0.6,1.9,178.1,271.9,16,T,T,1,3313,B,-2,-2"


def test_a_printed_line_of_a_rovl_has_its_compass_bearings():
    assert "checksum" in refused(f"${ROVL}*4B")
    found = acoustic_sentence(sentence(ROVL))
    assert found is not None
    own, north = told_by(*found)
    assert isinstance(own, Reply) and isinstance(north, Reply)
    assert (own.frame, north.frame, own.beacon) == ("transducer", "north", "")
    for each, bearing in ((own, 1.5), (north, 37.2)):
        at = each.columns
        close([at["usbl_range"], at["usbl_bearing"] / RAD, at["usbl_elevation"] / RAD], [142.8, bearing, -2.8])


def test_a_rovl_that_is_not_locked_or_has_no_imu():
    assert "no transmitter" in refused(sentence("USRTH,,,,,,,,-0.6,1.9,178.1,271.9,16,T,T,1,3313,B,-2,-2"))
    line = sentence("USRTH,358.5,1.5,2.8,142.8,,,,,,,,16,T,T,1,0000,A,7,7,new,fields")
    found = acoustic_sentence(line)
    assert found is not None
    (only,) = told_by(*found)
    assert isinstance(only, Reply) and (only.name, only.frame) == ("USRTH 7", "transducer")
    assert "no transmitter" in refused(sentence("USRTH,358.5,1.5,2.8"))  # of a line cut by its sender


# EvoLogics: real lines

MODEM = (
    "+++AT:124:USBLLONG,10446.991981,10446.534643,3,-0.0604,-1.0888,-0.5851,-0.4233,-1.0020,-0.5901,0.0063,0.0269,"
    "-0.3295,825,-36,77,1.2375"
)


def test_a_real_line_of_a_modem_has_travel_time_direction_and_age():
    found = reply(MODEM)
    at = found.columns
    assert (found.name, found.frame) == ("USBLLONG 3", "transducer")
    assert at["usbl_travel_time"] == pytest.approx(2 * 825e-6)
    assert found.when.age == pytest.approx(0.457338)
    assert found.when.time(100.0) == pytest.approx(100.0 - 0.457338)
    b, e = at["usbl_bearing"], at["usbl_elevation"]
    x, y, z = -0.0604, 1.0888, 0.5851  # y to port and z up, turned
    close(
        [math.cos(e) * math.cos(b), math.cos(e) * math.sin(b), math.sin(e)], np.array([x, y, z]) / math.hypot(x, y, z)
    )


def test_modems_directions_go_with_their_ranges():
    long = (
        "USBLLONG,1464207778.381274,1464207778.075953,2,13.6015,3.1369,1.7311,13.6015,3.1369,1.7311,0.0000,-0.0000,"
        "0.0000,9377,-54,106,0.1698"
    )
    angles = "USBLANGLES,1464207778.381,1464207778.075953,2,0.2,0.1,0.2,0.1,0,0,0,-54,106,0.0121"
    pairs = HeadDirections()
    assert pairs.joined(reply(angles)) is None
    joined = pairs.joined(reply(long))
    assert joined is not None
    assert joined.columns == {
        "usbl_travel_time": pytest.approx(0.018754), "usbl_bearing": -0.2, "usbl_elevation": -0.1,
        "usbl_angle_sd": 0.0121,
    }  # fmt: skip
    later = pairs.joined(reply(long.replace("78.075953", "79.9")))
    assert later is not None and later.columns["usbl_bearing"] == pytest.approx(math.atan2(-3.1369, 13.6015))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (MODEM[:-6] + "-1.00", "negative"),
        (MODEM.replace("825", "0"), "no propagation time"),
        ("USBLANGLES,1,0.5,2,0.2,0.1,0.2,0.1,0,0,0,-54,106,-1.0", "negative"),
        (MODEM[:90], "shorter than it says"),
    ],
)
def test_modems_lines_that_are_not_valid_or_cut(line, said):
    assert said in refused(line)


# Tritech: the maker's printed example


def test_a_printed_line_of_a_micronnav():
    found = reply("%D0033082031,0,-18686,+4764,+4100,0.8,30,15315632")
    assert (found.name, found.frame) == ("MicronNav 0", "ship")
    close(found.xyz, [4.764, -18.686, 4.1])
    assert found.when.seconds == pytest.approx(15 * 3600 + 31 * 60 + 56.32)
    assert "four receivers" in refused("%D0033082031,0,-18686,+4764,+4100,0.8,22,15315632")
    assert "not raw" in refused("%D003E082030,0,503868.427,6025011.669,+4102,0.8,30,15315632")


# Blueprint SeaTrac: made by the layout in its manual


def seatrac(kind: int = 0x42, flags: int = 7, fit: int = 40, distance: int = 1234) -> str:
    fix = struct.pack("<BBBBhhhHHh", 15, 2, flags, 3, 900, -12, 8, 21, 15003, 871)
    if flags & 1:
        fix += struct.pack("<IiH", 13164, 822700, distance)
    if flags & 2:
        fix += struct.pack("<B4h3h", 4, 870, 865, 868, 871, 3127, -452, fit)
    if flags & 4:
        fix += struct.pack("<3h", 100, 200, 300)
    data = bytes([kind]) + fix
    return "$" + (data + crc16(data).to_bytes(2, "little")).hex().upper()


def test_a_fix_of_a_seatrac():
    found = reply(seatrac())
    assert (found.name, found.frame) == ("SeaTrac 2", "transducer")
    at = found.columns
    close([at["usbl_range"], at["usbl_bearing"] / RAD, at["usbl_elevation"] / RAD], [123.4, 312.7, 45.2])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (seatrac()[:-1] + "0", "checksum"),
        (seatrac()[:31], "checksum"),
        (seatrac(flags=1), "no range and direction"),
        (seatrac(fit=301), "fit error"),
        (seatrac(distance=0), "no range"),
        (seatrac(kind=0x43), "no reply"),
        (seatrac(kind=0x39), "other messages"),
        (seatrac(kind=0x10), "no measurement"),
    ],
)
def test_messages_of_a_seatrac_that_tell_nothing(line, said):
    assert said in refused(line)
    reply(seatrac(fit=300))


def test_the_checksum_of_a_seatrac_is_crc_16():
    assert crc16(b"123456789") == 0xBB3D  # CRC-16/ARC


# Files


def gga(second: float, lat: float = 50.0) -> bytes:
    clock = f"12{int(second) // 60:02d}{second % 60:05.2f}"
    return sentence(f"GPGGA,{clock},{int(lat):02d}{lat % 1 * 60:09.6f},N,00806.000000,E,4,09,0.9,10.0,M,47.0,M,,")


def hdt(heading: float) -> bytes:
    return sentence(f"HEHDT,{heading:.2f},T")


def dive(*more: str, seconds: int = 20, heading: bool = True) -> bytes:
    """A ship that lies, its heading 90 degrees; after each of its fixes the other lines, with ?? for the second."""
    said = [sentence("GPZDA,115959.00,02,03,2024,00,00")]
    for k in range(seconds):
        said += [gga(float(k)), hdt(90.0) if heading else b""]
        said += [_line(text.replace("??", f"{k:02d}")) for text in more]
    return b"".join([*said, gga(float(seconds))])


def _line(text: str) -> bytes:
    return text.encode() + b"\r\n" if text.startswith(("+", "%", "$", "USBL")) else sentence(text)


SSB = "PSIMSSB,1200??.40,B01,A,,C,H,M,10.0,20.0,30.0,0.5,N,,"


def test_measured_positions_are_read_as_they_are_with_the_ship_beside_them(tmp_path):
    recording = read(dive(SSB, "PSIMSNS,1200??.35,B01,1,1,2.0,-1.0,0.0,91.0,,,0.0,,M"), tmp_path)
    assert [c.sensor for c in recording.channels] == ["usbl", "ship", "ship_heading", "ship_heading", "ship_tilt"]
    usbl, heading = first(recording, "usbl"), first(recording, "ship_heading")
    close(usbl.columns["time"][:2] - NOON, [0.4, 1.4])
    close([usbl.columns[f"usbl_{axis}"][0] for axis in "xyz"], [20.0, 10.0, 30.0])
    close(usbl.columns["usbl_beacon"], label_number("B01"))
    assert recording.settings == {"usbl": {"frame": "ship"}}
    assert (usbl.source, heading.source) == ("PSIMSSB B01", "PSIMSNS")
    close(np.degrees(heading.columns["ship_heading"]), 91.0)
    close(heading.columns["time"][:2] - NOON, [0.35, 1.35])
    tilt = first(recording, "ship_tilt").columns
    close(np.degrees([tilt["ship_roll"][0], tilt["ship_pitch"][0]]), [2.0, -1.0])
    close(first(recording, "ship").columns["ship_sd"], 0.018)
    assert any("--choose fix=" in line for line in recording.warnings)
    hdts = read(dive(SSB, "PSIMSNS,1200??.35,B01,1,1,2.0,-1.0,0.0,91.0,,,0.0,,M"), tmp_path, ship_heading="HEHDT")
    assert first(hdts, "ship_heading").source == "HEHDT"


def test_north_up_needs_no_heading(tmp_path):
    recording = read(dive(SSB.replace(",H,", ",N,"), heading=False), tmp_path)
    assert recording.settings == {"usbl": {"frame": "north"}}
    assert [c.sensor for c in recording.channels] == ["usbl", "ship"]


@pytest.mark.parametrize(("extra", "said"), [("D,29.8", True), ("N,", False)])
def test_a_depth_of_the_transponders_own_sensor_is_told(extra, said, tmp_path):
    recording = read(dive(SSB.replace("N,,", f"{extra},")), tmp_path)
    assert any("taken twice" in line for line in recording.warnings) == said


def test_a_file_with_unknown_layouts_alone_is_refused_by_their_names(tmp_path):
    with pytest.raises(InputError, match=r"PSONDEP: 3 \(its layout is not known; record PSONLLD"):
        read(sentence("PSONDEP,120000.00,2401,99.9") * 3, tmp_path)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (SSB.replace("A,,", "A,NRy,"), "PSIMSSB: 20 error NRy: not a reply"),
        (SSB.replace("10.0,20.0", "435600.0,5538800.0"), "PSIMSSB: 20 more than 20 km away"),
        ("$" + SSB + "*00", "lines: 20 checksum"),
        ("PSIMSSR,1200??.0,B01,1,2,3", "PSIMSSR: 20 its layout is not known"),
    ],
)
def test_beside_sentences_without_a_reply_the_receiver_is_still_the_ships(line, why, tmp_path):
    recording = read(dive(line), tmp_path)
    assert [channel.sensor for channel in recording.channels] == ["ship", "ship_heading"]
    (said,) = recording.warnings
    assert f"no transponder was heard ({why}" in said
    assert said.endswith("--choose fix=GPGGA if they are the vehicle's")
    assert first(read(dive(line), tmp_path, fix="GPGGA"), "fix").source == "GPGGA"


def test_filtered_positions_are_raw_only_where_that_is_chosen(tmp_path):
    data = dive(SSB.replace(",M,10", ",F,10"))
    assert first(read(data, tmp_path), "fix").source == "PSIMSSB B01"
    raw = read(data, tmp_path, usbl="PSIMSSB B01")
    assert len(first(raw, "usbl").columns["time"]) == 20
    assert any("is filtered" in line for line in raw.warnings)


def test_water_linkeds_bridge_writes_forward_where_starboard_belongs(tmp_path):
    """As its olexoutput.py writes x = 7.3 forward, y = 1.0 starboard of a G2: always A and M, whole seconds."""
    recording = read(
        dive("PSIMSSB,1200??,UGPS,A,,C,H,M,7.30,1.00,0.70,T,,", "PSIMSNS,1200??,UGPS,1,1,,,,42.0,,,1.0,,"), tmp_path
    )
    usbl = first(recording, "usbl").columns
    close([usbl["usbl_x"][0], usbl["usbl_y"][0]], [1.0, 7.3])  # as the sentence says
    assert any("UGPS is a bridge" in line and "exchanged" in line for line in recording.warnings)
    close(np.degrees(first(recording, "ship_heading").columns["ship_heading"]), 42.0)
    assert [c.source for c in recording.channels if c.sensor == "ship_tilt"] == []


def test_a_gaps_gives_fixes_and_its_ship_unless_relative_positions_are_chosen(tmp_path):
    at = "1200??.200,02,03,2024"
    lines = [
        f"PTSAG,#1,{at},0,5000.00000,N,00806.00000,E,F,2.9,1,9999.0",
        f"PTSAG,#2,{at},4,5000.10000,N,00806.20000,E,F,30.0,1,9999.0",
        f"PTSAX,#3,{at},4,100.0,-20.0,F,30.0,1,9999.0",
        "PTSAH,0,39.0,0.0",
    ]
    data = b"".join(sentence(line.replace("??", f"{k:02d}")) for k in range(20) for line in lines)
    recording = read(data, tmp_path)
    fix = first(recording, "fix")
    assert fix.source == "PTSAG 4"
    close(fix.columns["time"][:2] - NOON, [0.2, 1.2])
    close(fix.columns["fix_lat"], 50.0 + 0.1 / 60.0)
    assert recording.clocks[fix.clock].unix_offset == 0.0
    raw = read(data, tmp_path, usbl="PTSAX 4")
    close([first(raw, "usbl").columns[f"usbl_{axis}"][0] for axis in "xyz"], [100.0, -20.0, 30.0])
    assert first(raw, "ship").source == "PTSAG 0"
    close(np.degrees(first(raw, "ship_heading").columns["ship_heading"]), 39.0)


def test_positions_of_a_ranger_alone_are_fixes_by_the_time_of_day(tmp_path):
    lines = [f"PSONLLD,1200{k:02d}.520,2401,A,51.3315406,-0.8356397,99.9,4.0,3.0,30.00,0.62,,,," for k in range(5)]
    recording = read(b"".join(sentence(line) for line in lines), tmp_path)
    fix = first(recording, "fix")
    close(fix.columns["time"], 43200.52 + np.arange(5))
    axes = np.array([[math.cos(np.pi / 6), -math.sin(np.pi / 6)], [math.sin(np.pi / 6), math.cos(np.pi / 6)]])
    covariance = axes @ np.diag([16.0, 9.0]) @ axes.T
    close(fix.columns["fix_sd"], math.sqrt(covariance[0, 0]))
    close(fix.columns["fix_east_sd"], math.sqrt(covariance[1, 1]))
    close(fix.columns["fix_cov_ne"], covariance[0, 1])
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]


def test_a_grid_is_read_in_the_ships_zone_and_said(tmp_path):
    line = "PSIMLBP,1200??.30,A1,R,A,U,447995.0,5540000.0,80.0,1.0,2.0,45.0,0.5"
    ship = [gga(float(k), 50.0087) for k in range(20)]
    sent = b"".join(a + sentence(line.replace("??", f"{k:02d}")) for k, a in enumerate(ship))
    recording = read(sent, tmp_path)
    fix = first(recording, "fix")
    assert fix.source == "PSIMLBP A1"
    close([fix.columns["fix_lat"][0], fix.columns["fix_lon"][0]], from_utm(447995.0, 5540000.0, 32, False), atol=1e-9)
    close(fix.columns["fix_sd"], math.sqrt(2.5))
    assert any("PSIMLBP: is on a grid" in line for line in recording.warnings)
    with pytest.raises(InputError, match=r"none that can be placed .*grid that is not stated"):
        read(b"".join(sentence(line.replace("??", f"{k:02d}")) for k in range(20)), tmp_path)


@pytest.mark.parametrize(
    ("lines", "frame", "stamp", "late"),
    [
        ((ROVL,), "transducer", "arrival", 0.0),
        ((MODEM,), "transducer", None, 0.457338),
        ((seatrac(),), "transducer", "arrival", 0.0),
        (("%D0033082031,0,-18686,+4764,+4100,0.8,30,1200??40",), "ship", None, None),
    ],
)
def test_systems_beside_a_ship_are_read_as_they_measure(lines, frame, stamp, late, tmp_path):
    recording = read(dive(*lines), tmp_path)
    usbl = first(recording, "usbl")
    assert len(usbl.columns["time"]) == 20
    expected = {"frame": frame} | ({"stamp": stamp} if stamp else {})
    assert recording.settings == {"usbl": expected}
    if late is None:
        close(usbl.columns["time"][:2] - NOON, [0.4, 1.4])
    else:  # between the ship's fixes, at a third and two thirds of their lines
        close(usbl.columns["time"][:2] - NOON + late, [2.0 / 3.0, 5.0 / 3.0], atol=1e-6)


def test_a_rovl_without_the_ships_heading_is_read_from_north(tmp_path):
    recording = read(dive(ROVL, heading=False), tmp_path)
    assert recording.settings["usbl"] == {"frame": "north", "stamp": "arrival"}
    close(np.degrees(first(recording, "usbl").columns["usbl_bearing"]), 37.2)


@pytest.mark.slow
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(dive(SSB, MODEM, seatrac(), ROVL, "%D0033082031,0,-1,+4,+4,0.8,30,1200??40", seconds=3))
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


# Live: the same readings


def live(data: bytes, config: Config, recorded: bool = True) -> tuple[list[Message], Heard]:
    heard = Heard()
    return decoded(nmea("n", heard, config, recorded), data, arrival=NOON), heard


def of(messages: list[Message], sensor: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of a sensor's readings, NaN where one has fewer."""
    found = [
        (m.arrival if m.stamp is None else m.stamp, r.values)
        for m in messages
        for r in m.readings
        if r.sensor == sensor
    ]
    out = np.full((len(found), max((len(values) for _, values in found), default=0)), np.nan)
    for row, (_, values) in zip(out, found, strict=True):
        row[: len(values)] = values
    return np.array([time for time, _ in found]), out


SNS = "PSIMSNS,1200??.35,B01,1,1,2.0,-1.0,0.0,91.0,,,0.0,,M"


def test_live_gives_what_the_file_gives(tmp_path):
    data = dive(SSB, SNS)
    config = Config().changed(usbl={"frame": "ship"})
    messages, heard = live(data, config)
    usbl = first(read(data, tmp_path), "usbl").columns
    time, values = of(messages, "usbl")
    close(time, usbl["time"])
    for name, column in zip(STREAMS["usbl"], values.T, strict=True):
        close(column, usbl.get(name, np.full(20, np.nan)))
    assert len(of(messages, GEODETIC)[0]) == len(of(messages, "ahrs")[0]) == 0
    ship = first(read(data, tmp_path), "ship").columns
    close(of(messages, SHIP_GEODETIC)[1][:, 0], ship["ship_lat"])
    close(of(messages, "ship_heading")[1][-1, 0], math.radians(91.0))  # of the pings, once they are heard
    close(of(messages, "ship_tilt")[1][0], np.radians([2.0, -1.0]))
    assert heard.kinds.keys() <= {"switched"}


@pytest.mark.parametrize("change", [(",M,10", ",F,10"), ("", "")])
def test_live_replies_are_fixes_where_they_are_filtered_or_their_axes_are_not_stated(change, tmp_path):
    data = dive(SSB.replace(*change), SNS)
    messages, heard = live(data, Config().changed(usbl={"frame": "ship"}) if change[0] else Config())
    file = first(read(data, tmp_path, fix="PSIMSSB B01"), "fix").columns
    time, values = of(messages, GEODETIC)
    at_start = 0 if change[0] else 1  # until an acoustic sentence is heard, a fix is the vehicle's
    close(time[-19:], file["time"][-19:], atol=1e-3)
    close(values[-18:, :2], np.column_stack([file["fix_lat"], file["fix_lon"]])[-18:], atol=1e-9)
    assert set(values[-18:, 5]) == set(file["fix_beacon"]) == {label_number("B01")}
    assert len(of(messages, "usbl")[0]) == 0 and len(time) <= 20 + at_start
    assert any("is a fix" in text for text in heard.texts)


def test_live_a_ship_is_known_by_a_sentence_without_a_reply():
    lines = [_line(SSB.replace("??", "00").replace("A,,", "A,NRy,")), gga(1.0)]
    source = nmea("n", Heard(), Config())
    found = [m for line in lines for m in decoded(source, line)]
    assert [reading.sensor for m in found for reading in m.readings] == [SHIP_GEODETIC]


def test_live_no_replies_and_predicted_positions_are_told_and_left_out():
    lines = (
        SSB.replace("A,,", "A,NRy,"),
        SSB.replace(",M,10", ",P,10"),
        HIPAP[1:].partition("*")[0].replace("A,,", "V,,"),
    )
    messages, heard = live(dive(*lines, seconds=5), Config().changed(usbl={"frame": "ship"}))
    assert len(of(messages, "usbl")[0]) == len(of(messages, GEODETIC)[0]) == 0
    assert heard.kinds["no reply"] == 5 and heard.kinds["no position"] == 10


def test_live_positions_on_earth_are_fixes_and_the_gaps_is_the_ship():
    lines = [
        "PTSAG,#1,120001.200,02,03,2024,0,5000.00000,N,00806.00000,E,F,2.9,1,9999.0",
        "PTSAG,#2,120001.200,02,03,2024,4,5000.10000,N,00806.20000,E,F,30.0,1,9999.0",
        "PTSAX,#3,120001.200,02,03,2024,4,100.0,-20.0,F,30.0,1,9999.0",
    ]
    messages, _ = live(b"".join(sentence(line) for line in lines), Config(), recorded=False)
    assert [r.sensor for m in messages for r in m.readings] == [SHIP_GEODETIC, GEODETIC]
    close(of(messages, GEODETIC)[0] - NOON, [1.2])


def test_live_a_modems_line_tells_its_own_time():
    messages, _ = live(MODEM.encode() + b"\r\n", Config(), recorded=False)
    (message,) = messages
    assert (message.clock, message.arrival) == ("modem", NOON)
    assert message.stamp == pytest.approx(10446.534643) and message.latency == pytest.approx(0.457338)
    (reading,) = message.readings
    assert reading.values.shape == (len(STREAMS["usbl"]),)
    close(reading.values[STREAMS["usbl"].index("usbl_beacon")], 3.0)


def test_live_another_transponder_is_left_out_of_fixes():
    data = dive(SSB, SSB.replace("B01", "B02"), SNS, seconds=5)
    config = Config().changed(usbl={"beacon": "B02"}, ship={"heading_deg": 0.0})
    messages, _ = live(data, config)
    assert len(of(messages, GEODETIC)[0]) == 5


def test_json_lines_have_the_ship_and_rows_without_a_reply_give_none():
    lines = (
        b'{"time": 1, "depth": 3.0}\n'
        b'{"time": 2, "usbl_x": 1, "usbl_y": 2, "usbl_z": 3, "usbl_beacon": "B01"}\n'
        b'{"time": 2.1, "usbl_x": 1, "usbl_y": 2}\n'
        b'{"time": 3, "ship_lat": 50.0, "ship_lon": 8.1, "ship_heading": 1.5}\n'
        b'{"time": 4, "ship_lat": 0, "ship_lon": 0}\n'
    )
    messages = decoded(json_lines("u", Heard(), Config()), lines)
    assert [[r.sensor for r in m.readings] for m in messages] == [["depth"], ["usbl"], ["ship_heading", SHIP_GEODETIC]]
