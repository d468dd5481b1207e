"""Files of NMEA 0183 sentences: fixes and headings of a ship or of the vehicle.

A heading has no time of its own: it is put between the sentences around it that have one, by its place in the file.
"""

from array import array
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.interchange import nmea_usbl as usbl
from rovgraph.interchange.alternatives import preferred_first
from rovgraph.interchange.fixes import new_fixes
from rovgraph.interchange.formats import Options
from rovgraph.interchange.lines import Refused
from rovgraph.interchange.nmea_sentences import (
    DATES,
    FIXES,
    HEADINGS,
    Times,
    east,
    fix_of,
    heading_of,
    library,
    number,
    parsed,
    sentence_of,
)
from rovgraph.interchange.recording import Channel, Clock, Left, Recording
from rovgraph.stamps import DAY_S

UTC, DAY = "UTC of the sentences", "time of day of the sentences"
ATTITUDE = "PTNTHPR"  # True North's heading, pitch, roll
SHIP = ("PSIMLBP", "PUSBA", "PSONLLD")  # of acoustic systems: relative to the ship, or not decoded
NOON_S = 43_200.0
LONGEST = 1 << 12
FEW = 3  # whole sentences that make a file one of these
_NORTH = "relative to magnetic north"


class Nmea:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "nmea"
    title = "NMEA 0183 sentences"
    extra = "online"

    def recognise(self, path: Path, head: bytes) -> float:
        lines = [line for line in head.split(b"\n")[:50] if line.strip()]
        whole = sum(b"$" in line and b"," in line and b"*" in line[-6:] and _is_sentence(line) for line in lines)
        return 0.8 if whole >= min(FEW, len(lines)) and 2 * whole >= len(lines) > 0 else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        library()
        sentences = _Sentences()
        size = path.stat().st_size
        with path.open("rb") as file:
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


def _ship(fixes: Channel, heading: Channel | None) -> usbl.Ship:
    where, none = fixes.columns, np.empty(0)
    pointing = (none, none) if heading is None else (heading.columns["time"], heading.columns["ahrs_yaw"])
    return usbl.Ship(where["time"], where["fix_lat"], where["fix_lon"], *pointing)


class _Sentences:
    """Takes sentences one by one; rows know their place in the file."""

    def __init__(self) -> None:
        self._times = Times()
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
            if kind == usbl.KIND:
                self._relative(name, text)
                return
            if kind not in (*FIXES, *HEADINGS, *DATES, ATTITUDE):
                why = "relative to a ship: no fix of the vehicle" if kind in SHIP else "no measurement that a log has"
                self._left[name, why] += 1
                return
            self._sentence(kind, name, parsed(text))
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
        elif kind == ATTITUDE:
            self._attitude(name, sentence)
        elif kind in HEADINGS and (heading := heading_of(sentence)) is not None:
            if kind == "HDG" and (variation := east(sentence.variation, sentence.var_dir)) is not None:
                self._variation.append(variation)
            self._add("ahrs", name, *np.deg2rad([heading[0], np.nan, np.nan]))

    def _attitude(self, name: str, sentence: Any) -> None:
        """Degrees, which the instrument sends unless it was set to mils."""
        cells = [*sentence.data, *[""] * 6]
        values = [number(cells[k]) for k in (1, 3, 5)] if cells[0] == "HPR" else [number(cells[k]) for k in (0, 2, 4)]
        if values[0] is None or not 0.0 <= values[0] <= 360.0:
            self._left[name, "no heading"] += 1
            return
        heading, pitch, roll = np.deg2rad([np.nan if v is None else v for v in values])
        self._add("ahrs", name, heading, roll, pitch)

    def _relative(self, name: str, text: str) -> None:
        """A position relative to the ship."""
        parsed(text)
        try:
            transponder, values = usbl.relative_position(text, self._times.last)
        except Refused as refused:
            self._left[name, refused.text] += 1
        else:
            self._add(usbl.KIND, f"{name} {transponder}".strip(), *values)

    def _add(self, sensor: str, name: str, *values: float) -> None:
        self._rows.setdefault((sensor, name), array("d")).extend((self._place, *values))

    def recording(self, path: Path, format_: str, options: Options) -> Recording:
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
            for sensor in ("ahrs", "fix")
            for channel in self._channels(path, sensor, place, time, clock, options)
        ]
        notes = [] if self._times.dated else ["no sentence has a date: times count from midnight of the first day"]
        said: list[str] = []
        if any(sensor == usbl.KIND for sensor, _ in self._rows):
            channels, said = self._of_vehicle(path, channels, place, time, clock, options)
        if not channels:
            raise InputError(f"{path}: holds neither fixes nor headings of the vehicle; other sentences: {found}")
        settings, warnings = self._look(channels)
        warnings = said + warnings
        left = tuple(Left(name, count, why) for (name, why), count in sorted(self._left.items()))
        clocks = {clock.name: clock}
        return Recording(str(path), format_, tuple(channels), clocks, left, settings, tuple(notes), tuple(warnings))

    def _channels(
        self, path: Path, sensor: str, place: Array, time: Array, clock: Clock, options: Options
    ) -> list[Channel]:
        names = {name: rows for (of, name), rows in self._rows.items() if of == sensor}
        rank = (ATTITUDE, *HEADINGS, *FIXES)
        order = sorted(names, key=lambda n: (rank.index(n if n == ATTITUDE else n[-3:]), -len(names[n])))
        made = []
        later = sensor == "fix" and any(of == usbl.KIND for of, _ in self._rows)  # chosen beside the transponders
        for name in order if later else preferred_first(path, sensor, order, options.choose):
            table = np.frombuffer(names[name]).reshape(-1, 4)
            table = table[(table[:, 0] >= place[0]) & (table[:, 0] <= place[-1])]
            when = np.interp(table[:, 0], place, time)
            if sensor == "fix":
                new = new_fixes(when, table[:, 1], table[:, 2])
                self._left[name, "nowhere on Earth, or the one before repeated"] += int((~new).sum())
                table, when = table[new], when[new]
                columns = {"fix_lat": table[:, 1], "fix_lon": table[:, 2], "fix_sd": table[:, 3]}
            else:
                columns = {"ahrs_yaw": wrap_angle(table[:, 1]), "ahrs_roll": table[:, 2], "ahrs_pitch": table[:, 3]}
            if len(when):
                frame = "" if sensor == "fix" else "the instrument's, " + ("true north" if "HDT" in name else _NORTH)
                made.append(Channel(sensor, {"time": when, **columns}, name, frame, clock.name))
        self._left = +self._left
        return made

    def _of_vehicle(
        self, path: Path, channels: list[Channel], place: Array, time: Array, clock: Clock, options: Options
    ) -> tuple[list[Channel], list[str]]:
        """Fixes of transponders before the ship's own; the ship's headings are not the vehicle's, unless chosen."""
        fixes = {channel.source: channel for channel in channels if channel.sensor == "fix"}
        headings = {channel.source: channel for channel in channels if channel.sensor == "ahrs"}
        names = {name: rows for (of, name), rows in self._rows.items() if of == usbl.KIND}
        if not fixes:
            for name, rows in names.items():
                self._left[name, "relative to a ship whose fixes are not in the file"] += len(rows) // 6
            return channels, []
        own = next((name for name in fixes if name != options.choose.get("fix")), next(iter(fixes)))
        true = next((channel for name, channel in headings.items() if name.endswith("HDT")), None)
        made = self._transponders(names, _ship(fixes[own], true), place, time, clock)
        labels = [*sorted(made, key=lambda name: -len(names[name])), *fixes]
        order = preferred_first(path, "fix", labels, options.choose)
        said = []
        if order[0] in made:
            said.append(f"{order[0]} is added to {own}: see that it counts from the antenna of that receiver")
        if "ahrs" in options.choose:
            return [*headings.values(), *((made | fixes)[name] for name in order)], said
        for name, channel in headings.items():
            why = "of the ship, as acoustic positions are relative to her; choose ahrs=NAME if it is the vehicle's"
            self._left[name, why] += len(channel.columns["time"])
        return [(made | fixes)[name] for name in order], said

    def _transponders(
        self, names: "dict[str, array[float]]", ship: usbl.Ship, place: Array, time: Array, clock: Clock
    ) -> dict[str, Channel]:
        """Fixes of each transponder."""
        made = {}
        for name, rows in names.items():
            at, late, x, y, orientation, sd = np.frombuffer(rows).reshape(-1, 6).T
            when = time[np.searchsorted(place, at, "right") - 1] + late
            lat, lon = usbl.positions(ship, when, x, y, orientation)
            known = np.isfinite(lat)
            if not known.all():
                self._left[name, "the ship's position, or her heading (HDT), is not known"] += int((~known).sum())
            if known.any():
                columns = {"fix_lat": lat[known], "fix_lon": lon[known], "fix_sd": sd[known]}
                made[name] = Channel("fix", {"time": when[known], **columns}, name, "", clock.name)
        return made

    def _look(self, channels: list[Channel]) -> tuple[dict[str, Any], list[str]]:
        """Settings that the file knows, and what may be wrong."""
        warnings, environment = [], {}
        talkers = [channel.source for channel in channels if channel.sensor == "fix"]
        if talkers:
            others = f" (also: {', '.join(talkers[1:])}; choose fix=NAME)" if len(talkers) > 1 else ""
            warnings.append(
                f"fixes are those of {talkers[0]}{others}: see that they are of the vehicle, not of the ship"
            )
        heading = next((channel for channel in channels if channel.sensor == "ahrs"), None)
        if heading is not None:
            warnings.append(
                f"{heading.source}: stamped by its place between sentences with a time; see that it is of the vehicle"
            )
            if heading.source.endswith("HDT"):
                warnings.append("HDT is relative to true north, a log's ahrs_yaw to magnetic: set declination_deg to 0")
                environment["declination_deg"] = 0.0
            elif self._variation:
                environment["declination_deg"] = float(np.median(self._variation))
        return ({"environment": environment} if environment else {}), warnings
