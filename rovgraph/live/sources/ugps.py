"""A Water Linked Underwater GPS, live: its HTTP interface is polled (`rovgraph.readers.ugps`).

An answer that is given again is dropped, and a position that is not valid: its coordinates go on with numbers. While
the locator is lost the interface answers with HTTP 500; that, and an interface that cannot be reached, are reported and
tried again.
"""

import json
import threading
import time
import urllib.request
from collections.abc import Iterator
from http.client import HTTPException
from typing import Any
from urllib.error import HTTPError, URLError

import numpy as np

from rovgraph.live.message import SHIP_GEODETIC, Message, Reading
from rovgraph.live.sources.source import STOP_S, Chunk, LineDecoder, Notify
from rovgraph.model.config import Config
from rovgraph.readers.records import Refused, json_object
from rovgraph.readers.ugps import VALID, UgpsAnswer, ugps_answer
from rovgraph.sensors import SENSORS

LOCATOR, TOPSIDE = "position/acoustic/raw", "position/master"
EXPECTED = {LOCATOR: VALID, TOPSIDE: ("lat",)}  # names of which each answer has one
LOST_HTTP = 500
RATE_HZ = 5.0  # the locator sends about twice a second
TOPSIDE_S = 0.5  # between its answers
TIMEOUT_S = 2.0 * STOP_S
LONGEST = 1 << 16  # bytes of an answer


class UgpsPolling:
    """The link: a line of JSON for each answer of the locator, that of the topside in it from time to time.

    Parameters
    ----------
    host, port : of the interface
    rate : of polling [Hz]
    notify : takes warnings
    """

    def __init__(self, host: str, port: int, rate: float, notify: Notify) -> None:
        self._base, self._step, self._notify = f"http://{host}:{port}/api/v1", 1.0 / rate, notify
        self._open = urllib.request.build_opener(urllib.request.ProxyHandler({})).open

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        topside, due = -np.inf, time.monotonic()
        while not stop.is_set():
            answers, arrival = {LOCATOR: self._answer(LOCATOR)}, time.time()
            if time.monotonic() - topside >= TOPSIDE_S and not stop.is_set():
                answers[TOPSIDE], topside = self._answer(TOPSIDE), time.monotonic()
            if known := {path: answer for path, answer in answers.items() if answer is not None}:
                yield Chunk(json.dumps(known).encode() + b"\n", arrival)
            due = max(due + self._step, time.monotonic())
            stop.wait(due - time.monotonic())

    def _answer(self, path: str) -> Any:
        """What it answers; None where it does not."""
        try:
            with self._open(f"{self._base}/{path}", timeout=TIMEOUT_S) as response:
                answer = json.loads(response.read(LONGEST))
        except HTTPError as error:
            lost = "as while the position is lost; trying again" if error.code >= LOST_HTTP else "is this a UGPS?"
            self._notify(f"HTTP {error.code}", f"{path}: HTTP {error.code}, {lost}")
        except (OSError, HTTPException) as error:
            reason = error.reason if isinstance(error, URLError) else error
            self._notify("unreachable", f"{path}: {getattr(reason, 'strerror', None) or reason}; trying again")
        except (ValueError, RecursionError):
            self._notify("not JSON", f"{path}: expected JSON; is this a UGPS?")
        else:
            if isinstance(answer, dict) and not answer.keys().isdisjoint(EXPECTED[path]):
                return answer
            self._notify("no answer", f"{path}: expected an object with {EXPECTED[path][0]}; is this a UGPS?")
        return None


def ugps(url: str, notify: Notify, config: Config) -> LineDecoder:
    """Decoder of the answers."""
    last: list[UgpsAnswer] = []

    def parse(line: bytes, arrival: float) -> Message | None:
        row = json_object(line)
        found = _of_topside(ugps_answer({TOPSIDE: row.get(TOPSIDE)}))
        answer = ugps_answer({LOCATOR: row.get(LOCATOR)})
        if answer.valid is not None and (not last or answer.said != last[0].said):
            last[:] = [answer]
            if answer.valid:
                values = dict(zip(("usbl_x", "usbl_y", "usbl_z"), answer.xyz, strict=True))
                cells = [values.get(name, np.nan) for name in SENSORS["usbl"].column_names]
                found.append(Reading("usbl", np.array(cells)))
                if config.usbl.frame != "ship":
                    needed = "usbl: {frame: ship, stamp: arrival, one_way: true}"
                    notify("frame", f"positions are relative to the topside; state {needed}", True)
            elif not found:
                raise Refused("not valid", "a position of the locator is not valid, and left out")
            else:
                notify("not valid", "a position of the locator is not valid, and left out")
        return Message(url, arrival, None, tuple(found)) if found else None

    return LineDecoder(parse, notify)


def _of_topside(answer: UgpsAnswer) -> list[Reading]:
    lat, lon, heading = answer.topside
    found = [Reading(SHIP_GEODETIC, np.array([lat, lon, np.nan]))] if np.isfinite(lat + lon) else []
    return [*found, Reading("ship_heading", np.array([heading]))] if np.isfinite(heading) else found
