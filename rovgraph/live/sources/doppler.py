"""Doppler instruments, live: PD4, PD5 and PD6, Cerulean's Tracker 650, Nortek's Nucleus, Water Linked's A50 and A125.

Their bytes are read as those of their files are (`rovgraph.readers.pd4`, `pd6`, `cerulean`, `nucleus` and
`waterlinked`).
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from rovgraph.live.message import Message, Reading, readings
from rovgraph.live.sources.source import Chunk, LineDecoder, Notify
from rovgraph.readers import cerulean, nucleus
from rovgraph.readers.nortek import NUCLEUS_FAMILIES, find_records
from rovgraph.readers.pd4 import SIZES, FrameCutter, decoded
from rovgraph.readers.pd6 import Pd6Sentences
from rovgraph.readers.recording import Channel
from rovgraph.readers.records import Refused, json_object, shown
from rovgraph.readers.trdi import channels_of
from rovgraph.readers.waterlinked import STAMPED, VELOCITIES, VelocityReport, beam_cells, velocity_report

PENDING = 1 << 14  # bytes that may be the beginning of a record; no Nucleus sends longer ones
PASSWORD = b"enter password"


class Pd4Decoder:
    """Frames of PD4 and PD5; their clock has no date."""

    def __init__(self, url: str, notify: Notify) -> None:
        self._url, self._notify = url, notify
        self._frames = FrameCutter()

    def feed(self, chunk: Chunk) -> Iterator[Message]:
        if chunk.fresh:
            self._frames = FrameCutter()
        skipped = self._frames.skipped
        for frame in self._frames.feed(chunk.data):
            row = np.frombuffer(frame.ljust(SIZES[1], b"\0"), np.uint8)[None]
            pings, refused = decoded(row)
            for reason in refused:
                self._notify("coordinates", reason)
            yield from _messages(channels_of(pings, constants=True), self._url, chunk.arrival)
        if self._frames.skipped > skipped:
            self._notify("malformed", "bytes that are no whole frame with a right checksum are skipped")


def pd6(url: str, notify: Notify) -> LineDecoder:
    """Decoder of PD6 sentences, stamped by the last ``:TS``."""
    sentences = Pd6Sentences()

    def parse(line: bytes, arrival: float) -> Message | None:
        cells = sentences.columns(line)
        if cells is None:
            raise Refused("malformed", f"expected a PD6 sentence, got {shown(line)}; it is skipped")
        found = readings(cells)
        return Message(url, arrival, sentences.time, found) if found else None

    return LineDecoder(parse, notify)


def tracker(url: str, notify: Notify) -> LineDecoder:
    """Decoder of a Tracker 650's sentences, stamped by the time since it was switched on."""

    def parse(line: bytes, arrival: float) -> Message | None:
        report = cerulean.ping(line)
        if report is None:
            if cerulean.SENTENCE.search(line) is None:
                raise Refused("malformed", f"expected a sentence of a Tracker 650, got {shown(line)}; it is skipped")
            return None
        return Message(url, arrival, report[0], readings(report[1]))

    return LineDecoder(parse, notify)


class NucleusDecoder:
    """Records of a Nucleus."""

    def __init__(self, url: str, notify: Notify) -> None:
        self._url, self._notify = url, notify
        self._rest = b""

    def feed(self, chunk: Chunk) -> Iterator[Message]:
        if PASSWORD in chunk.data:
            text = "the Nucleus asks for a password, which is not sent; read its serial port, or a port without one"
            self._notify("password", text)
        content = (b"" if chunk.fresh else self._rest) + chunk.data
        found = find_records(content, NUCLEUS_FAMILIES)
        cut = max(found.cut, len(content) - PENDING)
        self._rest = content[cut:]
        if found.skipped > len(content) - found.cut:
            self._notify("malformed", "bytes that are no whole record with right checksums are skipped")
        records = {kind: nucleus.said_of(content, found, kind) for kind in nucleus.KINDS}
        for clock, unix in (("boot", 0), ("unix", 1)):
            of_clock = {kind: each.only(each.common["flags"] & 1 == unix) for kind, each in records.items()}
            yield from _messages(nucleus.channels_of(of_clock, clock), self._url, chunk.arrival, clock)


def _messages(channels: Iterable[Channel], url: str, arrival: float, clock: str = "") -> Iterator[Message]:
    """A message for each time, in the order of time."""
    cells: dict[float, dict[str, float]] = {}
    for channel in channels:
        rows = zip(*(values.tolist() for values in channel.columns.values()), strict=True)
        for row in rows:
            values = dict(zip(channel.columns, row, strict=True))
            cells.setdefault(values.pop("time"), {}).update(values)
    for stamp in sorted(cells):
        if found := readings(cells[stamp]):
            yield Message(url, arrival, stamp, found, clock)


PORT = 16171
LONGEST_LATENCY_S = 5.0  # between validity and transmission; more is no latency


def waterlinked(url: str, notify: Notify) -> LineDecoder:
    """Decoder of a Water Linked DVL's reports."""
    return LineDecoder(lambda line, arrival: report_message(json_object(line), url, arrival, notify), notify)


def report_message(row: dict[str, Any], url: str, arrival: float, notify: Notify) -> Message | None:
    """The readings of a report; None without a measurement.

    Raises
    ------
    Refused : the report is to be skipped
    """
    if row.get("type") in VELOCITIES and not str(row.get("format")).startswith(STAMPED):
        text = f"format {shown(str(row.get('format')))}, expected {STAMPED}; update the DVL's software"
        raise Refused("unknown format", text)
    report = velocity_report(row)
    if report is None:
        return None
    if report.fault:
        notify("status", "the DVL reports a fault, such as being too hot; its velocities are used as long as valid")
    found = (*_readings(report), *readings(beam_cells(row)))
    return Message(url, arrival, report.validity, found, latency=_latency(report)) if found else None


def _latency(report: VelocityReport) -> float | None:
    if report.validity is None or report.transmission is None:
        return None
    latency = report.transmission - report.validity
    return latency if 0.0 <= latency < LONGEST_LATENCY_S else None


def _readings(report: VelocityReport) -> tuple[Reading, ...]:
    """Velocity, and altitude where there is one."""
    if report.water:
        return () if report.velocity is None else (Reading("dvl_water", np.array(report.velocity)),)
    if report.velocity is None:
        return (Reading("dvl", np.array([np.nan, np.nan, np.nan, 0.0, np.nan])),)
    found = [Reading("dvl", np.array([*report.velocity, 1.0, report.sd]))]
    if report.altitude is not None:
        found.append(Reading("dvl_altitude", np.array([report.altitude])))
    return tuple(found)
