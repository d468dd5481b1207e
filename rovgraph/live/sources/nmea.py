"""NMEA 0183, live: headings, attitudes and fixes, and what acoustic systems tell.

`rovgraph.readers.nmea_sentences` and `rovgraph.readers.acoustic_sentences` read the sentences. Headings become the
log's `ahrs_yaw`, which is a compass's: a heading from true north is turned by the configuration's declination.

Beside acoustic sentences, fixes and headings are the ship's. A reply is passed on as it was measured where its axes are
those of ``usbl.frame``; else, and where the system has filtered it, it is added to the ship's position, and is a fix.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rovgraph.geometry import wrap_angle
from rovgraph.live.message import GEODETIC, SHIP_GEODETIC, Message, Reading
from rovgraph.live.sources.source import LineDecoder, Notify, Preferred
from rovgraph.log.stamps import DAY_S
from rovgraph.log.streams import label_number
from rovgraph.model.config import Config
from rovgraph.readers.acoustic_channels import INERTIAL, NO_GRID, Ship, label_of, on_ships_grid, positions
from rovgraph.readers.acoustic_sentences import (
    AcousticPosition,
    HeadDirections,
    Reply,
    ShipAttitude,
    Told,
    When,
    acoustic_sentence,
    told_by,
)
from rovgraph.readers.nmea_sentences import (
    ATTITUDES,
    DATES,
    FIXES,
    HEADINGS,
    TRUE,
    WITHOUT_CHECKSUM,
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
from rovgraph.readers.records import Refused
from rovgraph.sensors import SENSORS
from rovgraph.sensors.compass import TRUE_NORTH, declination, turns_true_headings

RELATIVE = ("PSIMSSB", "USBLLONG", "USRTH", "USRTH true", "MicronNav", "SeaTrac")
ON_EARTH = ("PTSAG", "PSONLLD", "PSONALL", "PSIMLBP")
REMEMBERED = 100  # of the ship's fixes and headings
MODEM = "modem"


def nmea(url: str, notify: Notify, config: Config, recorded: bool = False) -> LineDecoder:
    """Decoder of sentences.

    Parameters
    ----------
    recorded : a file, in which sentences arrive at the time of those before them

    Raises
    ------
    InputError : pynmea2 is not installed
    """
    return LineDecoder(NmeaDecoder(url, notify, config, recorded).message, notify)


class NmeaDecoder:
    """From a sentence to a message; see `nmea`."""

    def __init__(self, url: str, notify: Notify, config: Config, recorded: bool) -> None:
        self._url = url
        library()
        self._declination, self._turns = math.degrees(declination(config, "ahrs")), turns_true_headings(config)
        self._magnetic = config.environment.declination_deg - self._declination  # of a magnetic heading, for the log
        self._recorded = recorded
        self._times = SentenceTimes()
        self._notify = notify
        self._bare: int | None = 0  # sentences so far, as long as none has a checksum
        self._headings = Preferred(("PSIMSNS", *ATTITUDES, *HEADINGS, "PTSAH", "PSONALL"), notify)
        self._fixes = Preferred((*FIXES, "PTSAG", "PSONLLD"), notify)
        as_fixes = (f"{kind}, added to the ship's position" for kind in (*RELATIVE, *INERTIAL))
        on_earth = *ON_EARTH, "PSIMSSB in degrees"
        self._vehicle = Preferred((*RELATIVE, *on_earth, *INERTIAL, *as_fixes), notify)
        nothing = Config()
        self._usbl, self._stated, self._beacon = config.usbl, config.positioned_beacon, ""
        self._of_ship = config.usbl != nothing.usbl or config.ship != nothing.ship
        self._ship: deque[tuple[float, float, float]] = deque(maxlen=REMEMBERED)  # time, latitude, longitude
        self._pointing: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)  # time, heading
        self._directions = HeadDirections()
        self._read: dict[str, Callable[[Any, float], Reading | None]] = {
            **dict.fromkeys(HEADINGS, self._heading),
            **dict.fromkeys(FIXES, self._fix),
            **dict.fromkeys(DATES, lambda sentence, arrival: None),
        }

    def message(self, line: bytes, arrival: float) -> Message | None:
        """The readings of a sentence.

        Raises
        ------
        Refused : not a sentence, or not whole
        """
        if (acoustic := acoustic_sentence(line)) is not None:
            return self._acoustic(*acoustic, arrival)
        kind, text = sentence_of(line)
        if kind not in self._read and kind not in ATTITUDES:
            return None
        sentence = parsed(text, self._takes_without_checksum(text))
        attitude = attitude_of(text) if kind in ATTITUDES else None
        if attitude is not None and attitude[0] is not None:
            stamp: float | None = self._times.near(attitude[0], arrival)
        else:
            stamp = self._times.stamp(sentence, arrival)
        if self._recorded:
            if self._times.last is None:
                raise Refused("no time", "sentences before the first one with a time are left out")
            arrival = self._times.last
        if kind in ATTITUDES:
            reading = None if attitude is None else self._attitude(kind, attitude[1:], arrival)
        else:
            reading = self._read[kind](sentence, arrival)
        if reading is None:
            return None
        found = self._of_the_ship(reading, arrival if stamp is None else stamp) if self._of_ship else (reading,)
        return Message(self._url, arrival, stamp, found) if found else None

    def _of_the_ship(self, reading: Reading, time: float) -> tuple[Reading, ...]:
        """A fix or an attitude as the ship's."""
        if reading.sensor == GEODETIC:
            self._ship.append((time, float(reading.values[0]), float(reading.values[1])))
            return (Reading(SHIP_GEODETIC, reading.values),)
        yaw, roll, pitch = reading.values.tolist()
        return self._attitude_of_ship(float(wrap_angle(yaw + math.radians(self._declination))), roll, pitch, time)

    def _attitude_of_ship(self, heading: float, roll: float, pitch: float, time: float) -> tuple[Reading, ...]:
        found = []
        if math.isfinite(heading):
            self._pointing.append((time, heading))
            found.append(Reading("ship_heading", np.array([heading])))
        if math.isfinite(roll + pitch):
            found.append(Reading("ship_tilt", np.array([roll, pitch])))
        return tuple(found)

    def _acoustic(self, kind: str, text: str, arrival: float) -> Message | None:
        """The readings of an acoustic sentence.

        Raises
        ------
        Refused : it is not whole, or tells nothing that can be used
        """
        bare = self._takes_without_checksum(text) if text.startswith("$") and "," in text else False
        if not self._of_ship:
            self._of_ship = True
            self._notify("ship", "fixes and headings beside acoustic sentences are taken as the ship's", True)
        tellings = told_by(kind, text, bare)
        self._note_time(tellings[0].when, arrival)
        if self._recorded:
            if self._times.last is None:
                raise Refused("no time", "sentences before the first one with a time are left out")
            arrival = self._times.last
        for told in tellings:
            base = arrival if self._times.last is None else self._times.last
            time = told.when.time(base)
            if found := self._told(told, time):
                when = told.when
                if when.seconds is not None:
                    return Message(self._url, arrival, time, found)
                if when.sent is not None:
                    return Message(self._url, arrival, when.sent - when.age, found, MODEM, when.age)
                return Message(self._url, arrival, None, found)
        return None

    def _note_time(self, when: When, arrival: float) -> None:
        """Keep a date, and a time of day where no other sentence has one."""
        if when.day is not None and when.sent is not None:
            self._times.dated, self._times.last = True, when.sent
        elif when.seconds is not None and self._times.last is None and self._recorded:
            self._times.last = replace(when, cycle=DAY_S).time(arrival)

    def _told(self, told: Told, time: float) -> tuple[Reading, ...]:
        if isinstance(told, ShipAttitude):
            taken = self._headings.takes(told.kind, time)
            return self._attitude_of_ship(told.heading, told.roll, told.pitch, time) if taken else ()
        if isinstance(told, AcousticPosition) and told.of_ship:
            if not self._fixes.takes(told.kind, time) or not math.isfinite(told.lat):
                return ()
            return self._of_the_ship(Reading(GEODETIC, np.array([told.lat, told.lon, told.noise[0]])), time)
        if isinstance(told, AcousticPosition):
            return self._position(told, time)
        joined = self._directions.joined(told)
        return () if joined is None else self._reply(joined, time)

    def _is_vehicles(self, beacon: str) -> bool:
        """Whether a transponder is the vehicle's: the one that is stated, else the first that is heard."""
        if self._stated is not None:
            return label_number(self._stated) == label_number(beacon)
        self._beacon = self._beacon or beacon
        return beacon == self._beacon

    def _position(self, told: AcousticPosition, time: float) -> tuple[Reading, ...]:
        kind = "PSIMSSB in degrees" if told.kind == "PSIMSSB" else told.kind
        if not self._is_vehicles(told.beacon) or not self._vehicle.takes(kind, time):
            return ()
        lat, lon = told.lat, told.lon
        if told.grid:
            there = on_ships_grid(told.grid, *self._ship[-1][1:]) if self._ship else None
            if there is None:
                raise Refused("grid", f"{told.kind} is {NO_GRID}")
            lat, lon = there
        return (Reading(GEODETIC, np.array([lat, lon, *told.noise, label_of(told.beacon)])),)

    def _reply(self, told: Reply, time: float) -> tuple[Reading, ...]:
        """A reply as it was measured, or as a fix."""
        if told.frame == self._usbl.frame and not told.filtered:
            if not self._vehicle.takes(told.kind, time):
                return ()
            values = [told.columns.get(name, math.nan) for name in SENSORS["usbl"].column_names]
            if told.beacon:
                values[SENSORS["usbl"].column_names.index("usbl_beacon")] = label_number(told.beacon)
            return (Reading("usbl", np.array(values)),)
        if told.frame == "transducer" or not self._is_vehicles(told.beacon):
            return ()
        if not self._ship or not self._vehicle.takes(f"{told.kind}, added to the ship's position", time):
            return ()
        pointing = np.array(self._pointing).reshape(-1, 2).T
        ship = Ship(*np.array(self._ship).T, *pointing)
        x, y, _ = told.xyz
        lat, lon = positions(ship, np.array([time]), np.array([x]), np.array([y]), told.frame == "ship")
        if not np.isfinite(lat[0]):
            raise Refused("ship", f"{told.name}: the ship's position, or her heading (HDT), is not known")
        why = "filtered by the system" if told.filtered else f"not along the axes of usbl.frame: {self._usbl.frame}"
        self._notify("fixes", f"{told.name} is {why}: it is added to the ship's position, and is a fix", True)
        return (Reading(GEODETIC, np.array([lat[0], lon[0], told.sd, math.nan, math.nan, label_of(told.beacon)])),)

    def _takes_without_checksum(self, text: str) -> bool:
        """Whether sentences are taken without a checksum: many came, and none had one."""
        if has_checksum(text):
            self._bare = None
        elif self._bare is not None:
            self._bare += 1
            if self._bare == WITHOUT_CHECKSUM:
                self._notify(
                    "no checksum", "no sentence has a checksum: all are taken as they stand from here on", True
                )
        return self._bare is not None and self._bare >= WITHOUT_CHECKSUM

    def _attitude(self, kind: str, angles: Sequence[float | None], arrival: float) -> Reading | None:
        if (kind in TRUE and not self._can_turn(kind)) or not self._headings.takes(kind, arrival):
            return None
        heading, pitch, roll = np.deg2rad([np.nan if angle is None else angle for angle in angles])
        heading += np.deg2rad(-self._declination if kind in TRUE else self._magnetic)
        return Reading("ahrs", np.array([wrap_angle(heading), roll, pitch]))

    def _can_turn(self, kind: str) -> bool:
        """Whether a true heading can be given relative to the log's north."""
        if not self._turns:
            self._notify("true north", f"{kind} is left out: {TRUE_NORTH}", once=True)
        return self._turns

    def _heading(self, sentence: Any, arrival: float) -> Reading | None:
        found = heading_of(sentence)
        if found is None:
            return None
        heading, true = found
        kind = sentence.sentence_type
        if kind == "HDG" and (variation := east(sentence.variation, sentence.var_dir)) is not None:
            heading, true = heading + variation, True
        if (true and not self._can_turn(kind)) or not self._headings.takes(kind, arrival):
            return None
        heading += -self._declination if true else self._magnetic
        return Reading("ahrs", np.array([wrap_angle(np.deg2rad(heading)), np.nan, np.nan]))

    def _fix(self, sentence: Any, arrival: float) -> Reading | None:
        kind = sentence.sentence_type
        fix = fix_of(sentence)
        if fix is None or not self._fixes.takes(kind, arrival):
            return None
        return Reading(GEODETIC, np.array(fix))
