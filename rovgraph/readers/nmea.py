"""Files of NMEA 0183 sentences: fixes and headings of a ship or of the vehicle, and acoustic fixes from a ship.

Most headings have no time of their own: they are put between the sentences around them that have one, by their place in
the file.

Acoustic positioning gives fixes of a vehicle by PSIMSSB beside the ship's own fixes and heading.

``$PSIMSSB,hhmmss.ss,transponder,status,error,coordinates,orientation,filter,x,y,depth,accuracy,...``: Cartesian
coordinates (C) [m] along starboard and bow (H), north and east (N) or east and north (E). Its clock is UTC or local
time, so that whole half hours of it do not count. Status A may stand without a reply: an error code (NRy) means that
there was none, and the position is then zero or extrapolated, as it is with filter P (predicted). M is measured, F
filtered, which follows turns late. ``$PSIMSNS,hhmmss.ss,transponder,transceiver,transducer,roll,pitch,heave,heading,``
has the ship's attitude at a ping. Source: Kongsberg Simrad, HiPAP/HPR 400 NMEA 0183 sentences, 850-160045.
"""

from array import array
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.log.stamps import DAY_S
from rovgraph.readers.formats import HEAD, ReadingOptions
from rovgraph.readers.nmea_sentences import (
    ATTITUDES,
    DATES,
    FIXES,
    HEADINGS,
    TILT,
    TRUE,
    SentenceTimes,
    attitude_of,
    east,
    fix_of,
    has_checksum,
    heading_of,
    library,
    number,
    parsed,
    sentence_of,
)
from rovgraph.readers.recording import Channel, Clock, Left, Recording, preferred_first
from rovgraph.readers.records import Refused

KIND, SHIPS_ATTITUDE = "PSIMSSB", "PSIMSNS"
HEAD_UP, NORTH_UP, EAST_FIRST = range(3)
ORIENTATIONS = {"H": HEAD_UP, "N": NORTH_UP, "E": EAST_FIRST}
HALF_HOUR_S = 1800.0
FAR_S = 30.0  # between the ship's fixes; in a longer gap it is not known where she was


@dataclass(frozen=True)
class Ship:
    """Where a ship was, and which way she pointed.

    Attributes
    ----------
    time : of her fixes, increasing, shape (n,) [s]
    lat, lon : shape (n,) [deg]
    heading_time, heading : relative to true north, shape (m,), m may be 0 [s], [rad]
    """

    time: Array
    lat: Array
    lon: Array
    heading_time: Array
    heading: Array


def relative_position(text: str, last: float | None) -> tuple[str, tuple[float, ...]]:
    """Name of the transponder, and numbers of a position relative to the ship.

    They are seconds since the last sentence with a time, x, y [m], orientation, accuracy [m], and 1 where the system
    has filtered it, else 0.

    Parameters
    ----------
    text : of the sentence, whose checksum is right
    last : time of that sentence, None = without one [s]

    Raises
    ------
    Refused : nothing that can be added to a ship's position
    """
    cells = [*text.partition("*")[0].split(",")[1:], *[""] * 14]
    clock, name, status, error, coordinates, orientation, filtered = cells[:7]
    if status != "A":
        raise Refused("no position", "the system marks it as not OK")
    if error.strip():
        raise Refused("no position", f"error {error.strip()}: not a reply")
    if filtered == "P":
        raise Refused("no position", "predicted, not measured")
    x, y, seconds = number(cells[7]), number(cells[8]), _seconds(clock)
    if coordinates != "C" or orientation not in ORIENTATIONS:
        raise Refused("no position", "not in Cartesian coordinates relative to a ship")
    if x is None or y is None or seconds is None or last is None:
        raise Refused("no position", "without a time or a coordinate")
    late = (seconds - last + 0.5 * HALF_HOUR_S) % HALF_HOUR_S - 0.5 * HALF_HOUR_S
    accuracy = number(cells[10])
    sd = accuracy if accuracy is not None and accuracy > 0.0 else np.nan
    return name, (late, x, y, float(ORIENTATIONS[orientation]), sd, float(filtered == "F"))


def ships_heading(text: str) -> float:
    """Heading of the ship in a PSIMSNS, relative to true north [rad].

    Raises
    ------
    Refused : it has none
    """
    cells = [*text.partition("*")[0].split(",")[1:], *[""] * 8]
    heading = number(cells[7])
    if heading is None or not 0.0 <= heading <= 360.0:
        raise Refused("no heading", "without the ship's heading")
    return float(np.deg2rad(heading))


def positions(ship: Ship, time: Array, x: Array, y: Array, orientation: Array) -> tuple[Array, Array]:
    """Latitude and longitude [deg] of a vehicle, shape (k,); NaN where the ship's position or heading is not known.

    Parameters
    ----------
    time : shape (k,) [s]
    x, y : as the sentence has them, shape (k,) [m]
    orientation : `HEAD_UP`, `NORTH_UP` or `EAST_FIRST`, shape (k,)
    """
    import pymap3d

    origin = float(np.median(ship.lat)), float(ship.lon[len(ship.lon) // 2]), 0.0
    ship_north, ship_east, _ = pymap3d.geodetic2ned(ship.lat, ship.lon, 0.0, *origin)
    heading = np.full(len(time), np.nan)
    if len(ship.heading_time):
        heading = np.interp(time, ship.heading_time, np.unwrap(ship.heading))
        heading[_away(time, ship.heading_time)] = np.nan
    sine, cosine = np.sin(heading), np.cos(heading)
    north = np.choose(orientation.astype(int), [y * cosine - x * sine, x, y])
    east = np.choose(orientation.astype(int), [y * sine + x * cosine, y, x])
    north, east = north + np.interp(time, ship.time, ship_north), east + np.interp(time, ship.time, ship_east)
    north[_away(time, ship.time)] = np.nan
    lat, lon, _ = pymap3d.ned2geodetic(north, east, 0.0, *origin)
    return np.asarray(lat), np.asarray(lon)


def _away(time: Array, known: Array) -> Array:
    """Which times have no known one within `FAR_S` on either side."""
    after = np.searchsorted(known, time).clip(1, max(len(known) - 1, 1))
    before = known[(after - 1).clip(0, len(known) - 1)]
    after_time = known[after.clip(0, len(known) - 1)]
    return np.asarray(np.maximum(np.abs(time - before), np.abs(time - after_time)) > FAR_S)


def _seconds(clock: str) -> float | None:
    """Seconds of the day of ``hhmmss.ss``."""
    if len(clock) < 6 or not clock[:6].isdigit() or number(clock) is None:
        return None
    return 3600.0 * int(clock[:2]) + 60.0 * int(clock[2:4]) + float(clock[4:])


UTC, DAY = "UTC of the sentences", "time of day of the sentences"
SHIP = ("PSIMLBP", "PUSBA", "PSONLLD")  # of acoustic systems: relative to the ship, or not decoded
NOON_S = 43_200.0
LONGEST = 1 << 12
FEW = 3  # whole sentences that make a file one of these
CONTROL = bytes(byte for byte in range(32) if not 9 <= byte <= 13)
BINARY = 0.02  # of a file's bytes, that no text has: sentences within them are another format's
_NORTH = "relative to magnetic north"
NO_CHECKSUM = "no sentence has a checksum: all are taken as they stand, damaged ones too"
FILTERED = "is filtered by the acoustic system, so its errors last: calibration.fix_error is estimated"


class Nmea:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "nmea"
    title = "NMEA 0183 sentences"
    extra = "online"

    def recognise(self, path: Path, head: bytes) -> float:
        if len(head) - len(head.translate(None, CONTROL)) > BINARY * len(head):
            return 0.0
        lines = [line for line in head.split(b"\n")[:50] if line.strip() and not line.startswith(b"#")]
        sentences = sum(b"$" in line and b"," in line and _is_sentence(line) for line in lines)
        return 0.8 if sentences >= min(FEW, len(lines)) and 2 * sentences >= len(lines) > 0 else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        library()
        size = path.stat().st_size
        with path.open("rb") as file:
            lines = [line.strip() for line in file.read(HEAD).split(b"\n")[:-1]] or [b""]
            file.seek(0)
            sentences = _Sentences(not any(has_checksum(line.decode("ascii", "replace")) for line in lines))
            while line := file.readline(LONGEST):
                options.progress(min(file.tell(), size), size)
                if line.strip():
                    sentences.take(line.strip())
        return sentences.recording(path, self.name, options)


FORMAT = Nmea()


def _is_sentence(line: bytes) -> bool:
    try:
        sentence_of(line.strip())
    except Refused:
        return False
    return True


def _ship(fixes: Channel, heading: Channel | None) -> Ship:
    where, none = fixes.columns, np.empty(0)
    pointing = (none, none) if heading is None else (heading.columns["time"], heading.columns["ahrs_yaw"])
    return Ship(where["time"], where["fix_lat"], where["fix_lon"], *pointing)


class _Sentences:
    """Takes sentences one by one; rows keep their place in the file.

    Attributes
    ----------
    bare : no sentence has a checksum
    """

    def __init__(self, bare: bool = False) -> None:
        self.bare = bare
        self._times = SentenceTimes()
        self._undated = 0  # rows of `_clock` before a date is known
        self._clock = array("d")  # place, time
        self._rows: dict[tuple[str, str], array[float]] = {}  # sensor and name -> place, values
        self._left: Counter[tuple[str, str]] = Counter()
        self._variation: list[float] = []
        self._place = 0

    def take(self, line: bytes) -> None:
        self._place += 1
        try:
            kind, text = sentence_of(line)
            name = text[1:].partition(",")[0]
            if kind in (KIND, SHIPS_ATTITUDE):
                parsed(text, self.bare)
                self._relative(kind, name, text)
            elif kind in (*ATTITUDES, TILT):
                parsed(text, self.bare)
                self._attitude(kind, name, text)
            elif kind in (*FIXES, *HEADINGS, *DATES):
                self._sentence(kind, name, parsed(text, self.bare))
            else:
                why = "relative to a ship: no fix of the vehicle" if kind in SHIP else "no measurement that a log has"
                self._left[name, why] += 1
        except Refused as refused:
            self._left["lines", f"{refused.kind}: skipped"] += 1

    def _sentence(self, kind: str, name: str, sentence: Any) -> None:
        before = self._times.dated
        time = self._times.stamp(sentence, NOON_S if self._times.last is None else self._times.last)
        if time is not None:
            if self._times.dated and not before:
                self._undated = len(self._clock) // 2
            self._clock.extend((self._place, time))
        if kind in FIXES and time is not None:
            if (fix := fix_of(sentence)) is None:
                self._left[name, "no fix"] += 1
            else:
                self._add("fix", name, *fix)
        elif kind in HEADINGS and (heading := heading_of(sentence)) is not None:
            if kind == "HDG" and (variation := east(sentence.variation, sentence.var_dir)) is not None:
                self._variation.append(variation)
            self._add("ahrs", name, *np.deg2rad([heading[0], np.nan, np.nan]))

    def _attitude(self, kind: str, name: str, text: str) -> None:
        found = attitude_of(text)
        if found is None:
            self._left[name, "no heading" if kind in ATTITUDES else "no pitch and roll"] += 1
            return
        time, *angles = found
        if time is not None:
            last = self._times.last
            self._clock.extend((self._place, self._times.near(time, NOON_S if last is None else last)))
        heading, pitch, roll = np.deg2rad([np.nan if angle is None else angle for angle in angles])
        self._add("vehicle_tilt" if kind == TILT else "ahrs", name, heading, roll, pitch)

    def _relative(self, kind: str, name: str, text: str) -> None:
        """A position relative to the ship, or her heading as the acoustic system has it."""
        try:
            if kind == SHIPS_ATTITUDE:
                self._add(kind, name, ships_heading(text))
                return
            transponder, values = relative_position(text, self._times.last)
        except Refused as refused:
            self._left[name, refused.text] += 1
        else:
            self._add(KIND, f"{name} {transponder}".strip(), *values)

    def _add(self, sensor: str, name: str, *values: float) -> None:
        self._rows.setdefault((sensor, name), array("d")).extend((self._place, *values))

    def recording(self, path: Path, format_: str, options: ReadingOptions) -> Recording:
        """All that was taken.

        Raises
        ------
        InputError : neither fix nor heading, no time
        """
        found = ", ".join(f"{name}: {count}" for (name, _), count in self._left.items()) or "none"
        if not self._rows:
            raise InputError(f"{path}: holds neither fixes nor headings; other sentences: {found}")
        if not self._clock:
            raise InputError(f"{path}: no sentence has a time; record ZDA, RMC or GGA beside the headings")
        place, time = np.frombuffer(self._clock).reshape(-1, 2).T.copy()
        clock = Clock(UTC, 0.0, 0.0, "its stamps are Unix time") if self._times.dated else Clock(DAY, cycle=DAY_S)
        if self._times.dated and 0 < self._undated < len(time):  # whole days until the first date
            step = time[self._undated] - time[self._undated - 1]
            time[: self._undated] += DAY_S * round(step / DAY_S)
        channels = [
            channel
            for sensor in ("ahrs", "vehicle_tilt", "fix")
            for channel in self._channels(path, sensor, place, time, clock, options)
        ]
        notes = [] if self._times.dated else ["no sentence has a date: times count from midnight of the first day"]
        said = [NO_CHECKSUM] if self.bare else []
        if any(sensor == KIND for sensor, _ in self._rows):
            channels, more = self._of_vehicle(path, channels, place, time, clock, options)
            said += more
        if not channels:
            raise InputError(f"{path}: holds neither fixes nor headings of the vehicle; other sentences: {found}")
        settings, warnings = self._look(channels, said)
        left = tuple(Left(name, count, why) for (name, why), count in sorted(self._left.items()))
        clocks = {clock.name: clock}
        return Recording(str(path), format_, tuple(channels), clocks, left, settings, tuple(notes), tuple(warnings))

    def _channels(
        self, path: Path, sensor: str, place: Array, time: Array, clock: Clock, options: ReadingOptions
    ) -> list[Channel]:
        names = {name: rows for (of, name), rows in self._rows.items() if of == sensor}
        rank = (*ATTITUDES, *HEADINGS, TILT, *FIXES)
        order = sorted(names, key=lambda n: (rank.index(n if n in ATTITUDES else n[-3:]), -len(names[n])))
        made = []
        later = sensor == "fix" and any(of == KIND for of, _ in self._rows)  # chosen beside the transponders
        for name in order if later else preferred_first(path, sensor, order, options.choose):
            table = np.frombuffer(names[name]).reshape(-1, 4)
            table = table[(table[:, 0] >= place[0]) & (table[:, 0] <= place[-1])]
            when = np.interp(table[:, 0], place, time)
            if sensor == "fix":
                new = table[:, 1:3].any(axis=1)
                new[1:] &= np.diff(when) > 0.0  # a ship at rest has the same place again
                self._left[name, "nowhere on Earth, or the one before repeated"] += int((~new).sum())
                table, when = table[new], when[new]
                columns = {"fix_lat": table[:, 1], "fix_lon": table[:, 2], "fix_sd": table[:, 3]}
            elif sensor == "vehicle_tilt":
                columns = {"roll": table[:, 2], "pitch": table[:, 3]}
            else:
                columns = {"ahrs_yaw": wrap_angle(table[:, 1]), "ahrs_roll": table[:, 2], "ahrs_pitch": table[:, 3]}
            if len(when):
                north = f", {'true north' if name.endswith(TRUE) else _NORTH}" if sensor == "ahrs" else ""
                frame = "" if sensor == "fix" else f"the instrument's{north}"
                made.append(Channel(sensor, {"time": when, **columns}, name, frame, clock.name))
        self._left = +self._left
        return made

    def _of_vehicle(
        self, path: Path, channels: list[Channel], place: Array, time: Array, clock: Clock, options: ReadingOptions
    ) -> tuple[list[Channel], list[str]]:
        """Fixes of transponders before the ship's own; the ship's headings are not the vehicle's, unless chosen."""
        fixes = {channel.source: channel for channel in channels if channel.sensor == "fix"}
        headings = {channel.source: channel for channel in channels if channel.sensor == "ahrs"}
        names = {name: rows for (of, name), rows in self._rows.items() if of == KIND}
        if not fixes:
            for name, rows in names.items():
                self._left[name, "relative to a ship whose fixes are not in the file"] += len(rows) // 7
            return channels, []
        receiver = next((name for name in fixes if name != options.choose.get("fix")), next(iter(fixes)))
        true = next((channel for name, channel in headings.items() if name.endswith(TRUE)), None)
        made = self._transponders(
            names, _ship(fixes[receiver], true or self._ships_heading(place, time)), place, time, clock
        )
        if not made and options.choose.get("fix") not in fixes:
            left = self._left.items()
            why = "; ".join(f"{name}: {count} {reason}" for (name, reason), count in left if KIND in name)
            raise InputError(
                f"{path}: holds acoustic positions, but none that can be placed ({why}); record the ship's heading "
                f"(HDT) beside them, or say --choose fix={receiver} if that receiver is the vehicle's"
            )
        labels = [*sorted(made, key=lambda name: -len(names[name])), *fixes]
        order = preferred_first(path, "fix", labels, options.choose)
        said = []
        if order[0] in made:
            said.append(f"{order[0]} is added to {receiver}: see that it counts from the antenna of that receiver")
            if np.frombuffer(names[order[0]]).reshape(-1, 7)[:, -1].any():
                said.append(f"{order[0]} {FILTERED}")
        if "ahrs" in options.choose:
            return [*headings.values(), *((made | fixes)[name] for name in order)], said
        for name, channel in headings.items():
            why = "of the ship, as acoustic positions are relative to her; choose ahrs=NAME if it is the vehicle's"
            self._left[name, why] += len(channel.columns["time"])
        return [(made | fixes)[name] for name in order], said

    def _transponders(
        self, names: "dict[str, array[float]]", ship: Ship, place: Array, time: Array, clock: Clock
    ) -> dict[str, Channel]:
        """Fixes of each transponder."""
        made = {}
        for name, rows in names.items():
            at, late, x, y, orientation, sd, _ = np.frombuffer(rows).reshape(-1, 7).T
            when = time[np.searchsorted(place, at, "right") - 1] + late
            lat, lon = positions(ship, when, x, y, orientation)
            known = np.isfinite(lat)
            if not known.all():
                self._left[name, "the ship's position, or her heading (HDT), is not known"] += int((~known).sum())
            if known.any():
                columns = {"fix_lat": lat[known], "fix_lon": lon[known], "fix_sd": sd[known]}
                made[name] = Channel("fix", {"time": when[known], **columns}, name, "", clock.name)
        return made

    def _ships_heading(self, place: Array, time: Array) -> Channel | None:
        """Of the acoustic system, where no gyrocompass has sentences of its own."""
        rows = next((rows for (of, _), rows in self._rows.items() if of == SHIPS_ATTITUDE), None)
        if rows is None:
            return None
        at, heading = np.frombuffer(rows).reshape(-1, 2).T
        return Channel("ahrs", {"time": np.interp(at, place, time), "ahrs_yaw": heading}, SHIPS_ATTITUDE)

    def _look(self, channels: list[Channel], said: list[str]) -> tuple[dict[str, Any], list[str]]:
        """Settings from the file, and possible errors beside ``said``."""
        warnings, environment = [*said], {}
        talkers = [channel.source for channel in channels if channel.sensor == "fix"]
        if talkers:
            others = f" (also: {', '.join(talkers[1:])}; choose fix=NAME)" if len(talkers) > 1 else ""
            warnings.append(
                f"fixes are those of {talkers[0]}{others}: see that they are of the vehicle, not of the ship"
            )
        heading = next((channel for channel in channels if channel.sensor == "ahrs"), None)
        if heading is not None:
            stamped = "" if heading.source == "PASHR" else "stamped by its place between sentences with a time; "
            warnings.append(f"{heading.source}: {stamped}see that it is of the vehicle")
            if heading.source.endswith(TRUE):
                kind = heading.source if heading.source in ATTITUDES else heading.source[-3:]
                warnings.append(
                    f"{kind} is relative to true north, a log's ahrs_yaw to magnetic: set declination_deg to 0"
                )
                environment["declination_deg"] = 0.0
            elif self._variation:
                environment["declination_deg"] = float(np.median(self._variation))
        settings: dict[str, Any] = {"environment": environment} if environment else {}
        if any(FILTERED in line for line in warnings):
            settings["calibration"] = {"fix_error": {"estimate": True}}
        return settings, warnings
