"""Files of NMEA 0183 sentences: fixes and headings of a ship or of the vehicle, and acoustic positioning from a ship.

Most headings have no time of their own: they are put between the sentences around them that have one, by their place in
the file.

In a file with acoustic sentences, fixes and headings are the ship's (`rovgraph.readers.acoustic_channels`).
"""

from array import array
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.log.stamps import DAY_S
from rovgraph.readers.acoustic_channels import Heard, ShipsFile
from rovgraph.readers.acoustic_sentences import HeadDirections, Reply, Told, When, acoustic_sentence, told_by
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
    parsed,
    sentence_of,
)
from rovgraph.readers.recording import Channel, Clock, Left, Recording, preferred_first
from rovgraph.readers.records import Refused

UTC, DAY, MODEM = "UTC of the sentences", "time of day of the sentences", "modem's time"
NOON_S = 43_200.0
SET_S = 1e9  # since 1970: a modem's clock that shows less has never been set
LONGEST = 1 << 12
FEW = 3  # whole sentences that make a file one of these
CONTROL = bytes(byte for byte in range(32) if not 9 <= byte <= 13)
BINARY = 0.02  # of a file's bytes, that no text has: sentences within them are another format's
_NORTH = "relative to magnetic north"
NO_CHECKSUM = "no sentence has a checksum: all are taken as they stand, damaged ones too"


class Nmea:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "nmea"
    title = "NMEA 0183 sentences"
    extra = "online"

    def recognise(self, path: Path, head: bytes) -> float:
        if len(head) - len(head.translate(None, CONTROL)) > BINARY * len(head):
            return 0.0
        lines = [line for line in head.split(b"\n")[:50] if line.strip() and not line.startswith(b"#")]
        sentences = sum(_is_sentence(line) for line in lines)
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
    if acoustic_sentence(line) is not None:
        return True
    try:
        sentence_of(line.strip())
    except Refused:
        return False
    return b"$" in line


class _Sentences:
    """Takes sentences one by one; rows keep their place in the file.

    Attributes
    ----------
    bare : no sentence has a checksum
    beside_ship : there are acoustic sentences, told or not, so receivers and compasses are those of a ship
    """

    def __init__(self, bare: bool = False) -> None:
        self.bare, self.beside_ship = bare, False
        self._times = SentenceTimes()
        self._undated = 0  # rows of `_clock` before a date is known
        self._clock = array("d")  # place, time
        self._spare = {DAY: array("d"), MODEM: array("d")}  # the same by acoustic sentences, which are late
        self._rows: dict[tuple[str, str], array[float]] = {}  # sensor and name -> place, values
        self._told: list[tuple[int, Told]] = []  # place, by acoustic sentences
        self._directions = HeadDirections()
        self._left: Counter[tuple[str, str]] = Counter()
        self._variation: list[float] = []
        self._place = 0

    def take(self, line: bytes) -> None:
        self._place += 1
        try:
            if (acoustic := acoustic_sentence(line)) is not None:
                self.beside_ship = True
                self._acoustic(*acoustic)
                return
            kind, text = sentence_of(line)
            name = text[1:].partition(",")[0]
            if kind in (*ATTITUDES, TILT):
                parsed(text, self.bare)
                self._attitude(kind, name, text)
            elif kind in (*FIXES, *HEADINGS, *DATES):
                self._sentence(kind, name, parsed(text, self.bare))
            else:
                self._left[name, "no measurement that a log has"] += 1
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

    def _acoustic(self, kind: str, text: str) -> None:
        """What an acoustic system tells, or why it cannot be used."""
        try:
            tellings = told_by(kind, text, self.bare)
        except Refused as refused:
            if refused.kind in ("checksum", "cut off"):
                raise
            self._left[kind, refused.text] += 1
            return
        for each in tellings:
            told: Told | None = self._directions.joined(each) if isinstance(each, Reply) else each
            if told is None:
                self._left[kind, "a direction, which is put to the USBLLONG of its time"] += 1
                continue
            self._note_time(told.when)
            self._told.append((self._place, told))

    def _note_time(self, when: When) -> None:
        """Keep a time that clocks may be taken from where no other sentence has one, and a date."""
        if when.day is not None and when.sent is not None:
            if not self._times.dated:
                self._undated = len(self._clock) // 2
            self._times.dated, self._times.last = True, when.sent
        elif when.seconds is not None and not self._clock:
            self._times.last = replace(when, cycle=DAY_S).time(NOON_S if self._times.last is None else self._times.last)
        if when.seconds is not None and not self._clock and self._times.last is not None:
            self._spare[DAY].extend((self._place, self._times.last))
        elif when.seconds is None and when.sent is not None:
            self._spare[MODEM].extend((self._place, when.sent))

    def _add(self, sensor: str, name: str, *values: float) -> None:
        self._rows.setdefault((sensor, name), array("d")).extend((self._place, *values))

    def recording(self, path: Path, format_: str, options: ReadingOptions) -> Recording:
        """All that was taken.

        Raises
        ------
        InputError : neither fix nor heading, no time
        """
        found = ", ".join(f"{name}: {count} ({why})" for (name, why), count in self._left.items()) or "none"
        if not self._rows and not self._told:
            raise InputError(f"{path}: holds neither fixes nor headings; other sentences: {found}")
        place, time, clock = self._clocked(path)
        channels = [
            channel
            for sensor in ("ahrs", "vehicle_tilt", "fix")
            for channel in self._channels(path, sensor, place, time, clock, options)
        ]
        notes = [] if clock.name != DAY else ["no sentence has a date: times count from midnight of the first day"]
        said = [NO_CHECKSUM] if self.bare else []
        settings: dict[str, Any] = {}
        if self.beside_ship:
            heard = self._heard(place, time)
            file = ShipsFile(path, clock, options.choose, self._left, channels, heard)
            channels, settings, more = file.channels()
            said += more
        if not channels:
            found = ", ".join(f"{name}: {count} ({why})" for (name, why), count in self._left.items())
            raise InputError(f"{path}: holds neither fixes nor headings of the vehicle; other sentences: {found}")
        more_settings, warnings = self._look(channels, said)
        left = tuple(Left(name, count, why) for (name, why), count in sorted(self._left.items()) if count)
        clocks = {clock.name: clock}
        settings |= more_settings
        return Recording(str(path), format_, tuple(channels), clocks, left, settings, tuple(notes), tuple(warnings))

    def _clocked(self, path: Path) -> tuple[Array, Array, Clock]:
        """Places in the file whose times are known, these times [s], and their clock.

        Raises
        ------
        InputError : no sentence has a time
        """
        modem = not self._clock and not self._spare[DAY]
        rows = self._clock or self._spare[DAY] or self._spare[MODEM]
        if not rows:
            raise InputError(f"{path}: no sentence has a time; record ZDA, RMC or GGA beside the others")
        place, time = np.frombuffer(rows).reshape(-1, 2).T.copy()
        if modem:
            known = time[0] >= SET_S
            return place, time, Clock(MODEM, 0.0, 0.0, "its stamps are Unix time") if known else Clock(MODEM)
        if self._times.dated and 0 < self._undated < len(time):  # whole days until the first date
            step = time[self._undated] - time[self._undated - 1]
            time[: self._undated] += DAY_S * round(step / DAY_S)
        clock = Clock(UTC, 0.0, 0.0, "its stamps are Unix time") if self._times.dated else Clock(DAY, cycle=DAY_S)
        return place, time, clock

    def _channels(
        self, path: Path, sensor: str, place: Array, time: Array, clock: Clock, options: ReadingOptions
    ) -> list[Channel]:
        names = {name: rows for (of, name), rows in self._rows.items() if of == sensor}
        rank = (*ATTITUDES, *HEADINGS, TILT, *FIXES)
        order = sorted(names, key=lambda n: (rank.index(n if n in ATTITUDES else n[-3:]), -len(names[n])))
        made = []
        later = sensor == "fix" and self._told  # chosen beside the transponders
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

    def _heard(self, place: Array, time: Array) -> Heard:
        """What acoustic systems told, at its times."""
        heard = Heard()
        for at, told in self._told:
            if told.when.seconds is None and not place[0] <= at <= place[-1]:
                self._left[told.kind, "before the first time, or after the last"] += 1
            else:
                heard.add(told.when.time(float(np.interp(at, place, time))), told)
        return heard

    def _look(self, channels: list[Channel], said: list[str]) -> tuple[dict[str, Any], list[str]]:
        """Settings from the file, and possible errors beside ``said``."""
        warnings, environment, settings = [*said], {}, {}
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
                settings["heading"] = {"ahrs_reference": "true"}
            elif self._variation:
                environment["declination_deg"] = float(np.median(self._variation))
        return settings | ({"environment": environment} if environment else {}), warnings
