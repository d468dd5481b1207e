"""Files of Doppler instruments, byte by byte with `struct`, for tests of their readers."""

import struct
import time
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from scipy.spatial.transform import Rotation

BEAM, INSTRUMENT, SHIP, EARTH = range(4)
BAD = -32768
UNIX = 1_400_000_000.0
ANGLE = np.deg2rad(30.0)


def in_mm(velocity: Sequence[float]) -> list[int]:
    """Velocities [m/s] in mm/s, none as the instruments mark it."""
    return [BAD if not np.isfinite(v) else round(1000.0 * v) for v in velocity]


def trdi_values(velocity: Sequence[float], system: int, rpy: Sequence[float], up: bool = False) -> np.ndarray:
    """A vehicle's velocity (forward, starboard, down) in the four values of an instrument of Teledyne, not negated.

    Parameters
    ----------
    rpy : roll, pitch and heading, which turn the axes of ship and Earth [rad]
    """
    forward, starboard, down = np.asarray(velocity, dtype=float)
    if system == EARTH:
        north, east, below = Rotation.from_euler("ZYX", rpy[::-1]).apply([forward, starboard, down])
        return np.array([east, north, -below, 0.001])
    if system == SHIP:
        ahead, right, below = Rotation.from_euler("ZYX", [0.0, rpy[1], rpy[0]]).apply([forward, starboard, down])
        return np.array([right, ahead, -below, 0.001])
    x, y, z = (-starboard, forward, down) if up else (starboard, forward, -down)
    if system == INSTRUMENT:
        return np.array([x, y, z, 0.001])
    sine, cosine = np.sin(ANGLE), np.cos(ANGLE)
    return np.array([z * cosine + x * sine, z * cosine - x * sine, z * cosine - y * sine, z * cosine + y * sine])


def calendar_bytes(stamp: float) -> tuple[int, ...]:
    """Year in the century, month, day, hour, minute, second, hundredths."""
    whole, hundredths = divmod(round(100.0 * stamp), 100)
    date = time.gmtime(whole)
    return (date.tm_year % 100, *date[1:6], hundredths)


def pd0_ensemble(
    stamp: float = UNIX,
    values: Sequence[float] = (0.1, -0.5, 0.02, 0.001),
    system: int = SHIP,
    rpy: Sequence[float] = (0.0, 0.0, 1.0),
    depth: float = 5.0,
    ranges: Sequence[float] = (3.0, 3.0, 3.0, 3.0),
    water: Sequence[float] = (np.nan,) * 4,
    up: bool = False,
    source: int = 0b1111101,
    bias: float = 0.0,
    alignment: float = 0.0,
    bottom: bool = True,
    date: Sequence[int] | None = None,
    more: Sequence[bytes] = (),
    profile: Sequence[Sequence[float]] = (),
) -> bytes:
    """An ensemble, its velocities those of the bottom [m/s]; roll, pitch, heading [rad], bias and alignment [deg].

    ``more`` are other records, ``profile`` velocities of the water in cells of 4 m, the first one at 6.5 m [m/s].
    """
    cells = struct.pack("<H", 0x0100) + b"".join(struct.pack("<4h", *in_mm(cell)) for cell in profile)
    fixed = bytearray(59)
    struct.pack_into("<B2xH", fixed, 9, len(profile), 400)
    struct.pack_into("<H", fixed, 32, 650)
    struct.pack_into("<HBBHxxB", fixed, 0, 0x0000, 50, 40, 0x4249 | (0x80 if up else 0) | 0x08, 4)
    struct.pack_into("<BhhB", fixed, 25, (system << 3) | 0b111, round(100 * alignment), round(100 * bias), source)
    fixed[58] = 30
    variable = bytearray(65)
    struct.pack_into("<HH7B", variable, 0, 0x0080, 1, *(calendar_bytes(stamp) if date is None else date))
    roll, pitch, heading = np.rad2deg(rpy)
    angles = round(100 * (heading % 360.0)) % 36000, round(100 * pitch), round(100 * roll)
    struct.pack_into("<HHHhh", variable, 14, 1500, round(10 * depth), *angles)
    track = bytearray(81)
    far = [round(100 * r) for r in ranges]
    struct.pack_into("<H14x4H4h", track, 0, 0x0600, *(r & 0xFFFF for r in far), *in_mm(values))
    heard = 200 if all(far) else 0
    struct.pack_into("<12B", track, 32, *[heard] * 4, *[80] * 4, *[100] * 4)
    struct.pack_into("<4h", track, 50, *in_mm(water))
    struct.pack_into("<4B", track, 77, *(r >> 16 for r in far))
    return ensemble(bytes(fixed), bytes(variable), cells, *[bytes(track)] * bottom, *more)


def winriver_gga(clock: str, before: float, lat: float, lon: float, quality: int = 2, hdop: float = 0.9) -> bytes:
    """Record 0x2022 of a fix, as WinRiver decodes it."""
    place = struct.pack("<dcdc", abs(lat), b"N" if lat >= 0 else b"S", abs(lon), b"E" if lon >= 0 else b"W")
    head = struct.pack("<HHHd7s10s", 0x2022, 104, 57, before, b"$GPGGA", clock.encode())
    return head + place + struct.pack("<BBf", quality, 9, hdop) + bytes(16)


def winriver_hdt(before: float, heading: float) -> bytes:
    """Record 0x2022 of a heading [deg]."""
    return struct.pack("<HHHd7sdc", 0x2022, 107, 16, before, b"$GPHDT", heading, b"T")


def vmdas_navigation(unix: float, lat: float, lon: float) -> bytes:
    """Record 0x2000 of VmDas; its first fix is a second before its last."""
    record, day = bytearray(78), datetime.fromtimestamp(unix, UTC)
    struct.pack_into("<HBBH", record, 0, 0x2000, day.day, day.month, day.year)
    of_day = (unix % 86400.0) * 1e4
    struct.pack_into("<I", record, 6, round(of_day - 1e4))
    angles = (round(angle * 2**31 / 180.0) for angle in (lat, lon))
    struct.pack_into("<Iii", record, 22, round(of_day), *angles)
    return bytes(record)


def ensemble(*records: bytes) -> bytes:
    offsets, at = [], 6 + 2 * len(records)
    for record in records:
        offsets.append(at)
        at += len(record)
    head = struct.pack("<2sHBB", b"\x7f\x7f", at, 0, len(records)) + struct.pack(f"<{len(records)}H", *offsets)
    return _summed(head + b"".join(records))


def _summed(data: bytes) -> bytes:
    return data + struct.pack("<H", sum(data) & 0xFFFF)


def pd4_frame(
    stamp: float = 3600.0,
    values: Sequence[float] = (0.1, 0.5, 0.02, 0.001),
    system: int = INSTRUMENT,
    tilted: bool = False,
    ranges: Sequence[float] = (3.0, 3.0, 3.0, 3.0),
    water: Sequence[float] = (np.nan,) * 4,
    rpy: Sequence[float] | None = None,
    depth: float = 5.0,
) -> bytes:
    """A PD4 frame, or a PD5 frame where it has an attitude; velocities are the vehicle's [m/s]."""
    second, hundredths = divmod(round(100 * stamp), 100)
    clock = second // 3600, second // 60 % 60, second % 60, hundredths
    size = 47 if rpy is None else 88
    data = struct.pack("<BBHB", 0x7D, rpy is not None, size - 2, system << 6 | tilted << 5 | 1)
    data += struct.pack("<4h4HB", *in_mm(values), *(round(100 * r) for r in ranges), 0)
    data += struct.pack("<4hHHB4BHHh", *in_mm(water), 10, 20, 0, *clock, 0, 1500, 1000)
    if rpy is not None:
        roll, pitch, heading = np.rad2deg(rpy)
        angles = round(100 * pitch), round(100 * roll), round(100 * heading % 36000)
        data += struct.pack("<BHhhH", 35, round(10 * depth), *angles) + bytes(32)
    return _summed(data)


def pd6_ping(
    stamp: float = UNIX,
    velocity: Sequence[float] = (0.5, 0.1, -0.02),
    rpy: Sequence[float] = (0.0, 0.0, 1.0),
    depth: float = 5.0,
    altitude: float = 3.0,
    good: bool = True,
    axes: Sequence[str] = ("BI", "BS", "BE"),
) -> bytes:
    """The sentences of a ping; velocity of the vehicle, forward, starboard, down [m/s]."""
    roll, pitch, heading = np.rad2deg(rpy)
    date = "".join(f"{part:02d}" for part in calendar_bytes(stamp))
    lines = [f":SA,{pitch:+6.2f},{roll:+6.2f},{heading % 360.0:6.2f}", f":TS,{date},35.0,+10.0,{depth:6.1f},1500.0,  0"]
    systems = {"BI": INSTRUMENT, "BS": SHIP, "BE": EARTH}
    for tag in axes:
        values = trdi_values(velocity, systems[tag], (0.0, 0.0, 0.0) if tag == "BS" else rpy)
        cells = [f"{1000.0 * v:+6.0f}" if good else "-32768" for v in values[: 4 if tag == "BI" else 3]]
        lines.append(f":{tag},{','.join(cells)},{'A' if good else 'V'}")
    lines.append(f":BD,       +0.00,       +0.00,       +0.00,{altitude:7.2f},  0.00")
    return "".join(line + "\r\n" for line in lines).encode()


def nortek_sum(data: bytes) -> int:
    words = struct.unpack(f"<{len(data) // 2}H", data[: len(data) & ~1])
    return (0xB58C + sum(words) + (data[-1] << 8 if len(data) % 2 else 0)) & 0xFFFF


def nortek_record(kind: int, family: int, data: bytes) -> bytes:
    head = struct.pack("<BBBBHH", 0xA5, 10, kind, family, len(data), nortek_sum(data))
    return head + struct.pack("<H", nortek_sum(head)) + data


def _nortek_date(stamp: float) -> tuple[int, ...]:
    date = time.gmtime(stamp)
    return (date.tm_year - 1900, date.tm_mon - 1, *date[2:6])


def dvl_record(stamp: float, velocity: Sequence[float], valid: bool = True, kind: int = 0x1B) -> bytes:
    """Record of a DVL; the second Z is the first."""
    data = bytearray(212)
    struct.pack_into("<BBI6BH", data, 0, 1, 36, 7, *_nortek_date(stamp), round(1e4 * (stamp % 1.0)))
    struct.pack_into("<HII", data, 14, 4, 0, 0xFFFFF if valid else 0xFFF)
    struct.pack_into("<3f", data, 24, 1500.0, 10.0, 0.5)
    struct.pack_into("<12f", data, 36, *[0.1] * 4, *[3.0] * 4, *[0.002] * 4)
    x, y, z = velocity if valid else (-32.768,) * 3
    struct.pack_into("<12f", data, 132, x, y, z, z, *[0.003] * 4, *[0.016] * 4)
    return nortek_record(kind, 0x10, bytes(data))


def signature_record(stamp: float, beams: Sequence[int], system: int = 2, heard: bool = True) -> bytes:
    """Bottom track of a Signature, four values in 0.1 mm/s."""
    head = bytearray(78)
    struct.pack_into("<BBHI6BH", head, 0, 1, 78, 0x32F, 7, *_nortek_date(stamp), round(1e4 * (stamp % 1.0)))
    struct.pack_into("<IHhhH", head, 20, 5000, 9000, 100, -200, 4 << 12 | system << 10)
    struct.pack_into("<b", head, 60, -4)
    far = [2500] * 4 if heard else [-1022] * 4
    data = struct.pack("<4i4i4H", *beams, *far, *[3 if heard else 65535] * 4)
    return nortek_record(0x17, 0x10, bytes(head) + data)


def profile_record(stamp: float, values: np.ndarray, system: int, beams: int = 4) -> bytes:
    """Average of a profile by a Signature, cells of 2 m after 0.5 m, shape (cells, 4); roll 3, pitch -2, heading 90."""
    head = bytearray(76)
    struct.pack_into("<BBHI6BH", head, 0, 3, 76, 0x20, 7, *_nortek_date(stamp), round(1e4 * (stamp % 1.0)))
    packed = beams << 12 | system << 10 | len(values)
    struct.pack_into("<HhIHhhHHH", head, 16, 15000, 1000, 5000, 9000, -200, 300, packed, 2000, 50)
    struct.pack_into("<b9xI", head, 58, -3, 0b10)
    raw = np.where(np.isfinite(values), np.round(1000.0 * np.nan_to_num(values)), BAD).astype("<i2")
    return nortek_record(0x16, 0x10, bytes(head) + raw.T.tobytes())


def nucleus_record(kind: int, stamp: float, values: Sequence[float], status: int = 0xFFFF, posix: bool = True) -> bytes:
    """A Nucleus's record of 32-bit numbers, behind 12 bytes that all have and 24 more."""
    second, rest = divmod(round(1e6 * stamp), 1_000_000)
    head = struct.pack("<BBBxIII20x", 1, 36, posix, second, rest, status)
    return nortek_record(kind, 0x20, head + struct.pack(f"<{len(values)}f", *values))


def nucleus_track(stamp: float, velocity: Sequence[float], status: int = 0x7FFF, kind: int = 0xB4) -> bytes:
    values = [*[0.1] * 3, *[3.0] * 3, *[0.002] * 3, *[0.0] * 6, *velocity, *[0.004] * 3, 0.01]
    return nucleus_record(kind, stamp, values, status)


def nucleus_ahrs(stamp: float, rpy: Sequence[float], depth: float, declination: float = 0.0) -> bytes:
    values = [*np.rad2deg(rpy), *[0.0] * 13, declination, depth]
    return nucleus_record(0xD2, stamp, values)
