"""Converts the stamps of all sources to the estimator's clock.

The estimator's time is that of the clock that stamps the IMU. Any other clock is compared with it through the host's:
the least delay between a message's sending and its arrival, of the last minute, is taken as the transport delay, which
is the same for all. Where an instrument also reports when it sent a message, its processing time is subtracted, so that
only the transport delay remains; for others the stamp counts as the time of sending. Two clocks that agree from the
start within `AGREE_S` (`AGREE_SENT_S` where only the transport delay remains) are taken as synchronised, and their
stamps as accurate to the millisecond; later drift is corrected. Clocks that do not agree (seconds since switching on,
say) are shifted by the difference of their least delays.

The stamps of recordings are used unchanged. Stamps of another epoch than the IMU's are shifted by the recorded
arrivals, and refused without them.

A stamp that is suddenly seconds off is left out. When the following stamps agree with it, the clock was set: it is
shifted, so that time is continuous. A counter that wraps is continued at once. Stamps that stand still for `STILL_S`
while messages arrive are replaced by the arrivals, until the stamps move on.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rovgraph.errors import InputError
from rovgraph.live.message import Message
from rovgraph.log.stamps import COUNTERS, counter_range

AGREE_S = 0.5
AGREE_SENT_S = 0.1
EPOCH_S = 86400.0  # recorded stamps that are further apart are of different epochs
JUMP_S = 5.0  # a delay that differs by more from the one before is no delay
CONFIRM_S, CONFIRM = 2.0, 5  # so long, and so many stamps, until a clock counts as set
STILL_S, STILL_RANGE_S, STILL = 2.5, 1.0, 5  # so long, within so much, in so many messages, until stamps stand still
WINDOW_S = 60.0  # over which the least delay is taken
PIECES = 6  # that the window is kept in


@dataclass
class _LeastDelay:
    """The least delay, arrival minus leaving, over a sliding window."""

    pieces: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=PIECES))

    def add(self, arrival: float, delay: float) -> None:
        if not self.pieces or arrival - self.pieces[-1][0] > WINDOW_S / PIECES:
            self.pieces.append((arrival, delay))
        elif delay < self.pieces[-1][1]:
            self.pieces[-1] = (self.pieces[-1][0], delay)

    @property
    def value(self) -> float:
        return min(delay for _, delay in self.pieces)

    def shift(self, by: float) -> None:
        for k, (arrival, delay) in enumerate(self.pieces):
            self.pieces[k] = (arrival, delay + by)


@dataclass
class _Clock:
    """One clock of one source."""

    name: str
    delay: _LeastDelay = field(default_factory=_LeastDelay)
    shift: float = 0.0  # what was put right when it was set
    apart: float | None = None  # from the IMU's clock at the start; None = not compared yet
    odd: list[tuple[float, float]] = field(default_factory=list)  # arrival, delay
    newest: float | None = None  # its newest stamp


@dataclass
class _Moves:
    """Whether the stamps of one sensor move on.

    Attributes
    ----------
    arrival, stamp : when they last did by `STILL_RANGE_S` [s]
    count : of messages since then
    still : they stand still
    """

    arrival: float
    stamp: float
    count: int = 0
    still: bool = False


@dataclass
class Clocks:
    """Times of messages by the estimator's clock.

    Attributes
    ----------
    trust : stamps are as they should be: of recorded data
    news : what happened to clocks since it was last emptied: (clock, text)
    odd : count of messages left out for their stamp
    """

    trust: bool = False
    news: list[tuple[str, str]] = field(default_factory=list)
    odd: int = 0
    _clocks: dict[tuple[str, str], _Clock] = field(default_factory=dict)
    _moves: dict[tuple[str, str, str], _Moves] = field(default_factory=dict)  # by source, clock and sensor
    _base: _Clock | None = None

    def time(self, message: Message) -> float | None:
        """Of a message's measurements [s]; None = unknown, leave it out.

        A message of a source without a clock is as old as the IMU's newest at its arrival.

        Raises
        ------
        InputError : recordings whose clocks are of different epochs, and whose arrivals do not give the shift
        """
        if message.stamp is None:
            return message.arrival if self._base is None else message.arrival - self._base.delay.value
        clock = self._clocks.get((message.source, message.clock)) or self._met(message)
        if self._base is None and any(r.sensor == "imu" for r in message.readings):
            self._base, clock.apart = clock, 0.0
        if self._stands_still(message, clock):
            base = clock if self._base is None else self._base
            return message.arrival - base.delay.value
        unwrapped, processing = self._unwrapped(message.stamp, clock), message.latency or 0.0
        stamp = unwrapped + clock.shift
        if self.trust:
            clock.delay.add(message.arrival, message.arrival - stamp - processing)
            return self._recorded(stamp, clock)
        if self._is_odd(clock, message.arrival, message.arrival - stamp - processing):
            self.odd += 1
            return None
        stamp = unwrapped + clock.shift  # it may have been set
        clock.delay.add(message.arrival, message.arrival - stamp - processing)
        return stamp + self._correction(clock, AGREE_S if message.latency is None else AGREE_SENT_S)

    def now(self, host: float) -> float | None:
        """The estimator's time at a time of the host's clock; None before the first IMU sample, and in a replay."""
        return None if self.trust or self._base is None else host - self._base.delay.value

    def state(self) -> dict[str, Any]:
        """State of the clocks, as plain values."""
        return {
            "base": None if self._base is None else self._base.name,
            "clocks": [
                {**vars(clock), "source": list(key), "delay": [list(p) for p in clock.delay.pieces], "odd": []}
                for key, clock in self._clocks.items()
            ],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what another has learnt."""
        for known in state["clocks"]:
            delay = _LeastDelay()
            delay.pieces.extend((arrival, least) for arrival, least in known["delay"])
            clock = _Clock(known["name"], delay, known["shift"], known["apart"])
            self._clocks[known["source"][0], known["source"][1]] = clock
            if clock.name == state["base"]:
                self._base = clock

    def _unwrapped(self, stamp: float, clock: _Clock) -> float:
        """A stamp, continued where a counter wraps; of a late message from before that, less its range [s]."""
        newest = stamp if clock.newest is None else clock.newest
        if late := counter_range(stamp, newest):
            return stamp - late
        if wrap := counter_range(newest, stamp):
            clock.shift += wrap
            self.news.append((clock.name, f"its stamps count {COUNTERS[wrap]} and wrap; time goes on"))
        clock.newest = stamp
        return stamp

    def _stands_still(self, message: Message, clock: _Clock) -> bool:
        """Whether the stamps of a sensor stand still while its messages come."""
        assert message.stamp is not None
        sensor = message.readings[0].sensor if message.readings else ""
        key = message.source, message.clock, sensor
        if (moves := self._moves.get(key)) is None:
            moves = self._moves[key] = _Moves(message.arrival, message.stamp)
        if abs(message.stamp - moves.stamp) > STILL_RANGE_S:
            moves.arrival, moves.stamp, moves.count = message.arrival, message.stamp, 0
            if moves.still:
                moves.still = False
                self.news.append((sensor, f"the stamps of {sensor} move on, and are used again"))
        moves.count += 1
        known = clock.delay.pieces and (self._base is None or self._base.delay.pieces)
        if known and not moves.still and moves.count >= STILL and message.arrival - moves.arrival >= STILL_S:
            moves.still = True
            text = f"the stamps of {sensor} stand still at {message.stamp:.10g} s; times of arrival are used"
            self.news.append((sensor, text))
        return moves.still

    def _met(self, message: Message) -> _Clock:
        """A clock that has not been read before."""
        clock = _Clock(f"{message.source} {message.clock}".strip())
        self._clocks[message.source, message.clock] = clock
        return clock

    def _recorded(self, stamp: float, clock: _Clock) -> float:
        """The time of a recording's stamp."""
        base = self._base
        if base is None or base.newest is None or abs(stamp - base.newest) < EPOCH_S:
            return stamp
        time = stamp + self._correction(clock, AGREE_S)
        if abs(time - base.newest) > EPOCH_S:
            raise InputError(
                f"{clock.name}: its clock reads {stamp:.1f} s where that of {base.name} reads {base.newest:.1f} s; "
                "recordings of different epochs cannot be put together: put both on one clock"
            )
        return time

    def _correction(self, clock: _Clock, within: float) -> float:
        """What a clock is shifted by; one that is ``within`` so much at first is taken for synchronised [s]."""
        if clock is self._base or self._base is None:
            return 0.0
        apart = clock.delay.value - self._base.delay.value
        if clock.apart is None:
            agree = abs(apart) < within
            clock.apart = apart if agree else 0.0
            if not agree:
                self.news.append((clock.name, f"its clock differs by {-apart:.3g} s from the IMU's and is shifted"))
        return apart - clock.apart

    def _is_odd(self, clock: _Clock, arrival: float, delay: float) -> bool:
        """Whether a stamp is seconds off; where they all are, the clock is shifted."""
        if not clock.delay.pieces or abs(delay - clock.delay.value) < JUMP_S:
            clock.odd.clear()
            return False
        if clock.odd and abs(delay - clock.odd[-1][1]) > JUMP_S:
            clock.odd.clear()
        clock.odd.append((arrival, delay))
        if len(clock.odd) < CONFIRM or arrival - clock.odd[0][0] < CONFIRM_S:
            return True
        by = min(d for _, d in clock.odd) - clock.delay.value
        clock.shift += by
        clock.odd.clear()
        self.news.append((clock.name, f"its clock was set by {-by:.1f} s; time goes on as before"))
        return False
