"""From messages to navigation solutions: the online mode without its connections.

A message's stamp is converted to the estimator's clock, its readings are screened for faults and passed to the filter.
`Navigator.solution` propagates the newest keyframe to the present with the IMU.
"""

import math
import time as host
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rovgraph.diagnosis.alarm import verdict_of
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.bottom import Bottom, bottom_under
from rovgraph.inference.chart import read_chart
from rovgraph.inference.filter import ErrorLayout
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.fixed_lag import FilterSnapshot, FixedLag
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels.assembly import FIRST_KNOT
from rovgraph.live.alarms import LiveAlarms
from rovgraph.live.beacons import SHOWN_SD_M, UnplacedBeacons
from rovgraph.live.clocks import Clocks
from rovgraph.live.crossovers import LiveCrossovers, LiveMatch
from rovgraph.live.intake import ANYWHERE_M, Intake, Startup, can_join, is_late, joined, origin_of, unlocated
from rovgraph.live.message import Message, Reading
from rovgraph.live.reinitialisations import Reinitialisations
from rovgraph.live.sensor_faults import Crosscheck, Faults, Health, Incoherence
from rovgraph.live.solution import (
    BeaconPlace,
    CrossingPlace,
    CurrentAt,
    Event,
    RangeCircle,
    SensorHealth,
    ShipPose,
    Solution,
)
from rovgraph.log import Log, Measurement, Stream
from rovgraph.model.calibration import ACOUSTICS, BEAM_SENSORS, LAYERS, LAYOUT, MOUNT, TABLE, beacon_names
from rovgraph.model.config import Config
from rovgraph.model.origin import Origin, flat_error, outgrows_plane
from rovgraph.problem.assembly import InsertResult
from rovgraph.problem.initial_conditions import InitialConditions, restored
from rovgraph.rules import sd_of_lag
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry, beams_of

if TYPE_CHECKING:
    from rovgraph.inference.graph.isam2 import IncrementalEstimator

ALTITUDE_S = 3.0  # longest age of an altitude
PLACE_OF_RANGES = (*MOUNT, "dvl_lever_arm", "dvl_scale")  # calibration variables
RANGE_S = 15.0  # longest age of an acoustic range that is shown
TICK_S = 0.1  # between looks for sensors that have fallen silent
NO_GAP_IS_TOO_LONG_S = 1e9
SOMEWHERE = 0.0, 0.0  # before a first fix says where
UNEXPECTED = "began after the first seconds, and is not used"


@dataclass
class Navigator:
    """Live estimate of one dive.

    Attributes
    ----------
    config : what is believed of vehicle and sensors
    patient : wait for the thread that smooths, so that a replay can be repeated
    reinitialise : the filter from the smoothed dive so far, now and then
    smooth : have iSAM2 estimate the whole dive as it goes; the filter continues from its newest keyframe
    clocks, faults, health, alarms : of the sources, of the sensors, and of the estimate
    isam2 : iSAM2, where it was asked for; it takes each keyframe that the lag has passed
    engine : None until the first seconds are over
    time : of the newest measurement, or of the last `tick` [s]
    passed : snapshots that the lag has passed, since they were last taken
    left_out : (sensor or source, reason) -> count
    updates, update_s : count of updates of the filter, and the time that the newest took [s]
    """

    config: Config
    patient: bool = False
    reinitialise: bool = True
    smooth: bool = False
    clocks: Clocks = field(default_factory=Clocks)
    faults: Faults = field(init=False)
    health: Health = field(default_factory=Health)
    alarms: LiveAlarms = field(default_factory=LiveAlarms)
    engine: FixedLag | None = None
    isam2: "IncrementalEstimator | None" = None
    time: float = -np.inf
    passed: list[FilterSnapshot] = field(default_factory=list)
    left_out: Counter[tuple[str, str]] = field(default_factory=Counter)
    updates: int = 0
    update_s: float = 0.0

    def __post_init__(self) -> None:
        self._intake = Intake(self.config, self.left_out)
        self.faults = Faults(self.config)
        self._crosscheck = Crosscheck(self.config)
        self._startup = Startup(self.config.with_values(imu={"max_gap_s": NO_GAP_IS_TOO_LONG_S}))
        self._reinitialisations = self._smoothing_now_and_then()
        self._adopted = -1  # newest keyframe of iSAM2 that the filter has gone on from
        self._incoherence = Incoherence()
        self._beacons: UnplacedBeacons | None = None  # until the dive begins
        self._exchanges: list[Measurement] = []  # as they came, while the whole dive is kept
        self._events: list[Event] = []
        self._heard: dict[str, frozenset[str]] = {}  # source -> sensors, until the dive begins
        self._distance, self._here = 0.0, np.full(3, np.nan)
        self._arrival, self._ticked = 0.0, -np.inf
        self._sounded: Measurement | None = None  # newest ranges, or altitude
        self._bottom: Bottom | None = None  # that these show, once a solution has placed them
        self._beam_seen: dict[str, float] = {}  # when each was valid last [s]
        self._outgrown = False  # the plane, which has been said
        self._crossings: tuple[CrossingPlace, ...] = ()  # that were looked at last
        self._located = self.config.start.located  # where the fixes count from

    def _smoothing_now_and_then(self) -> Reinitialisations | None:
        """With crossovers, where these are asked for."""
        if not self.reinitialise or self.smooth:
            return None
        chart = read_chart(self.config.chart, self.config.environment.origin or SOMEWHERE)
        return Reinitialisations(self.patient, LiveCrossovers(chart) if self.config.matches_bottom else None)

    @property
    def _crossovers(self) -> LiveCrossovers | None:
        return None if self._reinitialisations is None else self._reinitialisations.crossovers

    @property
    def origin(self) -> Origin | None:
        """Latitude and longitude [deg] of north = east = 0, where they are known."""
        return self._intake.origin

    @property
    def waited(self) -> float:
        """Time waited for the thread that smooths, as only a replay does that is faster than it [s]."""
        return 0.0 if self._reinitialisations is None else self._reinitialisations.waited

    @property
    def waits_for(self) -> str:
        """Why there is no estimate yet; empty where there is, or while the first seconds go by."""
        return "" if self.engine is not None else self._startup.waits_for

    def waiting(self, sources: Sequence[str]) -> str:
        """What the first solution waits for, and what each source has sent so far; empty once there is an estimate.

        Parameters
        ----------
        sources : their URLs
        """
        if self.engine is not None:
            return ""
        heard = (f"{url}: {', '.join(sorted(self._heard.get(url, ()))) or 'nothing yet'}" for url in sources)
        return "; ".join([self._startup.expects, *heard])

    def take(self, message: Message) -> Sequence[tuple[float, tuple[Reading, ...]]]:
        """Take a message; its readings with their times [s], and none where those cannot be known."""
        time = self.clocks.time(message)
        while self.clocks.news:
            clock, text = self.clocks.news.pop()
            self.say(clock, "clock", text)
        if time is None:
            self.left_out[message.source, "impossible stamp"] += 1
            return []
        self._arrival = message.arrival
        if self.engine is None:
            self._hear(message)
        rows = self._intake.timed(time, message.readings)
        for at, readings in rows:
            for reading in readings:
                if (measurement := self._intake.measurement(at, reading)) is not None:
                    self._consider(measurement)
        while self._intake.news:
            sensor, text = self._intake.news.pop()
            self.say(sensor, "assumed", text)
        return rows

    def take_fix(self, north: float, east: float, sd: float) -> tuple[Reading, ...]:
        """Take a position that a person gives, of this moment, in metres; its reading, to be recorded."""
        reading = self._intake.fix(north, east, sd)
        if (measurement := self._intake.measurement(self.time, reading)) is None:
            return ()
        self._consider(measurement, by_hand=True)
        return (reading,)

    def _hear(self, message: Message) -> None:
        """Note which sensors a source has; the display's thread reads it, so it is replaced, not changed."""
        known = self._heard.get(message.source, frozenset())
        if new := {r.sensor for r in message.readings} - known:
            self._heard = {**self._heard, message.source: known | new}

    def replay(self, log: Log, told: float = -np.inf) -> None:
        """Take what had been received before, on the estimator's clock; events up to ``told`` [s] are told already."""
        if self.origin is None:
            self._intake.origin = log.origin
        known = self.engine.snapshots[0].time if self.engine is not None else -np.inf
        if self._reinitialisations is not None:
            self._reinitialisations.patient = True
        if (crossovers := self._crossovers) is not None:
            crossovers.held = True  # until all of it is there
        for measurement in log.measurements():
            if measurement.time > known:
                accepted = self._intake.measurement(measurement.time, Reading(measurement.sensor, measurement.values))
                if accepted is not None:
                    self._consider(accepted, by_hand=accepted.sensor == "fix")  # some may be
        if self._reinitialisations is not None:
            self._reinitialisations.patient = self.patient
        if crossovers is not None:
            crossovers.held = False
        self._events = [event for event in self._take_events() if event.time > told + 1e-6]  # as rounded there

    def say(self, source: str, kind: str, text: str) -> None:
        """Add an event to the next solution."""
        self._events.append(Event(self.time, source, kind, text))

    def lose_isam2(self, reason: str) -> None:
        """Continue with the filter alone."""
        self.isam2 = None
        self.say("isam2", "lost", reason)

    def tick(self, time: float) -> None:
        """Advance the time, with measurements or without."""
        self.time = max(self.time, time)
        self.faults.tick(self.time)

    def finish(self) -> None:
        """No more measurements: take what is held back."""
        for watch in self.faults.watches.values():
            for m in watch.release():
                self._use(m)
        self._events += self._crosscheck.finish()
        if self.engine is None and (initial := self._startup.begin(self.origin)) is not None:
            self._begin(initial)
        if self.engine is not None:
            self.engine.finish()
            self.engine.snapshots.extend(self.passed[-1:])  # for a last solution
        self.close()

    def close(self) -> None:
        """Wait for the thread no more."""
        if self._reinitialisations is not None:
            self._reinitialisations.close()

    def solution(self) -> Solution | None:
        """Where the vehicle is now; None before the beginning."""
        engine = self.engine
        if engine is None or not engine.snapshots:
            return None
        keyframe, known = engine.ahead(self.time)
        t = engine.trajectory([keyframe], [known])
        beacons = self._beacons
        unplaced = () if beacons is None else beacons.shown(known, engine.filter.layout)
        latitude, longitude = self._intake.geodetic(t.p_n[0])
        return Solution(
            time=float(t.time[0]),
            position=t.p_n[0],
            velocity=t.v_n[0],
            rpy=t.rpy[0],
            position_sd=t.p_sd[0],
            velocity_sd=t.v_sd[0],
            rpy_sd=t.rpy_sd[0],
            cov_north_east=float(t.cov_p[0, 0, 1]),
            latitude=latitude,
            longitude=longitude,
            origin=self.origin,
            calibration=self._calibration(engine, known) | ({} if beacons is None else beacons.calibration(unplaced)),
            current=self._current(engine, known),
            sensors=self._sensors(),
            events=self._take_events(),
            verdict=self.alarms.verdict,
            alarms=self.alarms.active,
            distance=self._travelled(t.p_n[0], t.p_sd[0]),
            predicted_s=float(t.time[0]) - engine.snapshots[-1].time,
            latency_s=None if self.clocks.trust else max(host.time() - self._arrival, 0.0),
            update_s=self.update_s,
            crossings=self._crossings,
            **self._below(engine, known, t),
            **self._acoustics(engine, known, t.p_n[0], unplaced),
        )

    def state(self) -> dict[str, Any] | None:
        """The state to continue from after a crash, as plain values and arrays; None before the beginning."""
        if self.engine is None or not self.engine.snapshots:
            return None
        return {
            "beginning": self.engine.initial.dump(),
            "engine": self.engine.state(),
            "clocks": self.clocks.state(),
            "origin": self.origin,
            "frame": self._intake.frame,
            "travelled": [self._distance, *self._here.tolist()],
            "used": dict(self.health.used),
            "rejected": dict(self.health.rejected),
            "incoherence": np.array(self._incoherence.state()),
            "faults": self.faults.state(),
            "surface": np.array(self._intake.pressure.surface.state()),
            "fix_beacon": self._intake.beacon,
            "beacons": {} if self._beacons is None else self._beacons.state(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from the state of another; the filter is not reinitialised any more."""
        self._intake.origin = origin_of(state)
        self.close()
        self._reinitialisations = None
        self._begin(restored(state["beginning"]), state["engine"])
        self.clocks.restore(state["clocks"])
        self.time = state["engine"]["keyframe"][1]  # what was received since is read again
        self._distance, self._here = state["travelled"][0], np.array(state["travelled"][1:])
        self._incoherence.restore(state["incoherence"].tolist())
        self.faults.restore(state["faults"])
        self._intake.pressure.surface.restore(state["surface"].tolist())
        self._intake.beacon = state["fix_beacon"]
        if self._beacons is not None:
            self._beacons.restore(state["beacons"])
        self.health.used.update(state["used"])
        self.health.rejected.update(state["rejected"])
        self._located |= self.health.used["fix"] + self.health.rejected["fix"] > 0

    def _consider(self, m: Measurement, by_hand: bool = False) -> None:
        """Screen one measurement, of a sensor or of a person, and pass it to the filter."""
        if m.time > self.time:
            self.time = m.time
        if m.sensor in (BEAMS, "dvl_altitude"):
            self._sound(m)
        verdict = self.faults.accept(m) if by_hand else self.faults.look(m)
        if m.sensor != "imu" and self.time > self._ticked + TICK_S:  # other sensors reveal an IMU outage
            self.faults.tick(self.time)
            self._ticked = self.time
        if verdict.retract_since is not None and self.engine is not None:
            self.engine.retract(m.sensor, verdict.retract_since)
            kept = (one for one in self._exchanges if one.sensor != m.sensor or one.time < verdict.retract_since)
            self._exchanges = list(kept)
        for one in (*verdict.late, *[m] * verdict.use):
            self._use(one)
        if not verdict.use and verdict.count:
            self.left_out[m.sensor, verdict.reason or self.faults.watches[m.sensor].state] += verdict.count

    def _use(self, m: Measurement) -> None:
        """Give a measurement to what compares sensors, and to the engine."""
        self._events += self._crosscheck.add(m)
        if self._incoherence.keeps_out(m.sensor, m.time):
            self.left_out[m.sensor, "incoherent"] += 1
        elif self.engine is None:
            if (initial := self._startup.add(m, self.origin)) is not None:
                self._begin(initial)
        else:
            self._feed(self.engine, m)

    def _begin(self, initial: InitialConditions, state: Mapping[str, Any] | None = None) -> None:
        """The first seconds are over, or an estimate continues from its state."""
        config = initial.config
        self._intake.frame = "earth" if config.environment.frame == "earth" else "flat"
        if self.smooth:
            from rovgraph.inference.graph.isam2 import UPDATE_S, IncrementalEstimator  # GTSAM is not everywhere

            self.isam2 = IncrementalEstimator(initial, UPDATE_S)
        self._beacons = UnplacedBeacons(initial, self.say, self.left_out, gathers=not self.smooth)
        keeps_all = self.smooth or self._reinitialisations is not None
        self.engine = FixedLag(initial, config.graph.lag_s, config.online.hold_s, self._pass, True, keeps_all)
        if state is not None:
            self.engine.restore(state)
            return
        for text in initial.assumptions:
            self.say("start", "assumed", text)
        for text in self._startup.doubts:
            self.say("start", "warning", text)
        if self._crossovers is None and config.matches_bottom:
            text = "crossovers and charts correct no track of --engine isam2; smooth the recorded log"
            self.say("start", "warning", text)
        self._located |= any(m.sensor == "fix" for m in self._startup.measurements)
        for measurement in self._startup.measurements:
            self._feed(self.engine, measurement)
        self._startup.measurements = []

    def _feed(self, engine: FixedLag, m: Measurement) -> None:
        began = host.perf_counter()
        joining = self._joined(engine, m)
        if joining is None or self._keeps(joining, m):
            return
        engine = joining
        if (crossovers := self._crossovers) is not None:
            crossovers.take(m)
        before = engine.snapshots[-1] if engine.snapshots else None
        outcome = engine.add(m)
        if outcome != InsertResult.IN:
            self.left_out[m.sensor, outcome.value] += 1
        if engine.snapshots and engine.snapshots[-1] is not before:
            waited = self._continue_from_smoothed(engine)
            if (stretch := self._incoherence.step(engine)) is not None:
                self.alarms.taken_out(stretch)
            engine = self._believe_what_is_shown(engine)
            self.health.step(engine.snapshots)
            self.faults.tick(self.time)
            self.updates, self.update_s = self.updates + 1, host.perf_counter() - began - waited

    def _keeps(self, engine: FixedLag, m: Measurement) -> bool:
        """Keep an exchange as it came, as long as the whole dive is kept; whether it does not touch the track yet."""
        if not engine.keeps_all or self.smooth:
            self._exchanges.clear()
        elif m.sensor in ACOUSTICS:
            self._exchanges.append(m)
        return self._beacons is not None and self._beacons.take(engine, m)

    def _continue_from_smoothed(self, engine: FixedLag) -> float:
        """Continue from the dive so far as it is smoothed, where that is ready; the time waited for it [s]."""
        waited = 0.0
        if self._reinitialisations is not None:
            verdict = verdict_of(self.alarms.history.values())
            waited = self._reinitialisations.step(engine, self._crosscheck.dvl_contradicted, self.origin, verdict)
            engine.keeps_all = self._reinitialisations.pending
            if (adopted := self._reinitialisations.adopted) is not None:
                self.alarms.reinitialised(adopted)
                self._reinitialisations.adopted = None
                if self._beacons is not None:
                    self._beacons.reinitialised(adopted.time, adopted.p_n)
            if (crossed := self._reinitialisations.crossed) is not None:
                self._cross(crossed)
                self._reinitialisations.crossed = None
        if self.isam2 is not None and self.passed and self.isam2.updated > self._adopted:
            self._adopt(engine, self.isam2)
        return waited

    def _cross(self, crossed: LiveMatch) -> None:
        """Say what crossovers have shown, from which the filter goes on."""
        self._crossings = crossed.places
        if (crossovers := self._crossovers) is not None and (news := crossovers.tell(crossed)) is not None:
            self.say("crossovers", *news)
            self._here = np.full(3, np.nan)  # the vehicle did not move

    def _believe_what_is_shown(self, engine: FixedLag) -> FixedLag:
        """A filter with the place of a beacon, or the latency of stamps, that the dive shows; the same without any."""
        placed = None if self._beacons is None else self._beacons.place(engine, self._exchanges)
        late = None if placed is not None else self._with_latency(engine)
        changed = placed or late
        if changed is None:
            return engine
        self._go_on_with(changed)
        if self._reinitialisations is not None:  # the dive so far is smoothed with it
            self._reinitialisations.anew(changed)
        return changed

    def _with_latency(self, engine: FixedLag) -> FixedLag | None:
        """A filter that estimates how late acoustic stamps are, where that was said and the whole dive is kept."""
        late, self._crosscheck.late = self._crosscheck.late, {}
        if "usbl" not in late or not self._exchanges:
            return None
        lag, sd = late["usbl"]
        stated = {"usbl_time_offset": {"estimate": True, "mean": lag, "sd": sd_of_lag(sd)}}
        initial = replace(engine.initial, config=engine.initial.config.with_values(calibration=stated))
        self._crosscheck.config = self._crosscheck.config.with_values(calibration=stated)

        def revised(known: Gaussian, layout: ErrorLayout) -> Gaussian:
            c = known.c.copy()
            c[LAYOUT["usbl_time_offset"]] = lag
            return replace(known, c=c)

        again = [m for m in self._exchanges if m.sensor == "usbl"]
        self.say("usbl", "assumed", f"its stamps are taken to be {lag:.1f} s late from now on, which is estimated")
        return engine.continued(initial, revised, again)

    def _joined(self, engine: FixedLag, m: Measurement) -> FixedLag | None:
        """The filter that a measurement is for: one with its sensor; None where it cannot be used."""
        if is_late(m, engine):
            if self.smooth or not can_join(m, engine):
                self._leave_unexpected(m.sensor)
                return None
            engine = self._go_on_with(joined(engine, m.sensor))
            self.say(m.sensor, "joined", f"{m.sensor}: began after the first seconds, and is used from now on")
        elif m.sensor == "fix" and not self._located and engine.snapshots:
            self._located = True
            if not self.smooth:
                engine = self._go_on_with(unlocated(engine))
                self.say("fix", "joined", "fix: began after the first seconds; the position goes on from it")
        return engine

    def _leave_unexpected(self, sensor: str) -> None:
        if self.smooth and not self.left_out[sensor, UNEXPECTED]:
            self.say(sensor, "unused", f"{sensor}: {UNEXPECTED} before what was recorded is smoothed")
        self.left_out[sensor, UNEXPECTED] += 1

    def _go_on_with(self, engine: FixedLag) -> FixedLag:
        self.engine = engine
        self._incoherence.forget()
        self.alarms.forget_smoothed()
        if self._reinitialisations is not None:
            self._reinitialisations.again()
        return engine

    def _adopt(self, engine: FixedLag, isam2: "IncrementalEstimator") -> None:
        """Have the filter continue from iSAM2's newest keyframe."""
        newest = self.passed[-1]
        if isam2.updated == newest.index:
            engine.adopt_passed(engine.filter.considering(isam2.known, newest.known), newest.gates)
            self._adopted = isam2.updated

    def _pass(self, snapshot: FilterSnapshot) -> None:
        assert self.engine is not None
        self.passed.append(snapshot)
        if self._reinitialisations is not None:
            self._reinitialisations.take(snapshot)
        if self.isam2 is not None:
            try:
                self.isam2.take(self.engine.assembly.problem, snapshot.index, snapshot.known, snapshot.met)
            except InputError as error:
                self.lose_isam2(str(error))
        self.health.passed(snapshot)
        self._incoherence.passed(snapshot)
        if self._beacons is not None:
            self._beacons.passed(snapshot)
        self.alarms.passed(snapshot, self.engine.filter, self.faults.watches, self.time)

    def _take_events(self) -> tuple[Event, ...]:
        """All that happened since they were last taken."""
        if self._reinitialisations is not None:
            for text in self._reinitialisations.news:
                self.say("reinitialisation", "lost", text)
            self._reinitialisations.news = []
        events = list(self._events)
        self._events = []
        for teller in (self.faults, self._incoherence, self.health, self.alarms):
            events += teller.events
            teller.events = []
        return tuple(events)

    def _calibration(self, engine: FixedLag, known: Gaussian) -> dict[str, tuple[float, float]]:
        """Estimated calibration by label: value and sd."""
        c, sd, columns = known.c.tolist(), np.sqrt(known.covariance.diagonal()).tolist(), engine.filter.layout.columns
        return {
            label: (value, value_sd)
            for name in engine.filter.unknowns.estimated
            if name not in LAYERS
            for label, value, value_sd in zip(TABLE[name].labels, c[LAYOUT[name]], sd[columns[name]], strict=True)
        }

    def _current(self, engine: FixedLag, known: Gaussian) -> tuple[CurrentAt, ...]:
        """The current at its knots."""
        knots = [name for name in LAYERS if name in engine.filter.unknowns.estimated]
        first = float(engine.assembly.problem.keyframes[-1, FIRST_KNOT])
        if not knots or not np.isfinite(first):
            return ()
        sd, columns = np.sqrt(known.covariance.diagonal()), engine.filter.layout.columns
        depths = range(int(first), int(first) + len(knots))
        spacing = engine.initial.config.water.knot_m
        return tuple(
            CurrentAt(spacing * j, *known.c[LAYOUT[name]].tolist(), *sd[columns[name]].tolist())
            for j in depths
            for name in [knots[j % len(knots)]]
        )

    def _sound(self, m: Measurement) -> None:
        """Note which beams are valid, and ranges for the next solution: an altitude where beams have none."""
        ranges = m.sensor != BEAMS
        if m.sensor == BEAMS:
            beams = beams_of(m.values[None])
            moving = beams.valid[0] & np.isfinite(beams.velocity[0])
            self._beam_seen |= {BEAM_SENSORS[k]: m.time for k in np.array(beams.numbers)[moving].tolist()}
            known = np.isfinite([*beams.range[0], *beams.distance[0]]).any()
            ranges = bool(known) and beam_geometry(self.config.dvl) is not None
        newest = self._sounded
        old = newest is None or newest.sensor != BEAMS or m.time - newest.time > ALTITUDE_S
        if ranges and (old or m.sensor == BEAMS):
            self._sounded, self._bottom = m, None

    def _sensors(self) -> dict[str, SensorHealth]:
        """All sensors, and the single beams that the estimate uses."""
        used = () if self.engine is None else self.engine.initial.instruments
        seen = {sensor: self._beam_seen.get(sensor, -np.inf) for sensor in used if sensor in BEAM_SENSORS}
        return self.health.of(self.faults.watches, self.time) | self.health.of_beams(seen, self.time)

    def _below(self, engine: FixedLag, known: Gaussian, t: Trajectory) -> dict[str, Any]:
        """Altitude and depth of the bottom by the newest ranges."""
        m = self._sounded
        if m is None or not self.time - m.time < ALTITUDE_S:
            return {}
        if self._bottom is None:
            beliefs = engine.filter.beliefs
            constants = {
                label: (float(value), beliefs[name].sd if beliefs[name].considered else 0.0)
                for name in PLACE_OF_RANGES
                for label, value in zip(TABLE[name].labels, known.c[LAYOUT[name]], strict=True)
            }
            stream = Stream(m.sensor, (), t.time, m.values[None], np.array([m.row]))
            calibration = constants | self._calibration(engine, known)
            self._bottom = bottom_under(t, {m.sensor: stream}, self.config, calibration)
        if self._bottom is None:
            return {}
        moved = replace(t, time=self._bottom.time)
        found = {name: float(values[0]) for name, values in self._bottom.under(moved).items()}
        names = ("altitude", "altitude_sd", "bottom_depth", "bottom_depth_sd")
        return {name: found[name] for name in names} if math.isfinite(found["altitude"]) else {}

    def _acoustics(
        self, engine: FixedLag, known: Gaussian, p_n: Array, unplaced: Sequence[BeaconPlace]
    ) -> dict[str, Any]:
        """Ship, beacons, with those that may lie on either side, and the newest ranges, for the page."""
        acoustics, columns = engine.assembly.acoustics, engine.filter.layout.columns
        if not acoustics.instruments:
            return {}
        c, P = known.c, known.covariance
        beacons, down = {}, {}
        for k, beacon in enumerate(self.config.beacons):
            place, depth = beacon_names(k)
            cov = (
                P[columns[place], columns[place]]
                if place in columns
                else np.eye(2) * engine.filter.beliefs[place].sd ** 2
            )
            if cov.trace() < SHOWN_SD_M**2:
                (north, east), sd = c[LAYOUT[place]].tolist(), np.sqrt(cov.diagonal()).tolist()
                beacons[k] = BeaconPlace(str(beacon.name), north, east, sd[0], sd[1], float(cov[0, 1]))
                down[k] = float(c[LAYOUT[depth]][0])
        ranges = []
        for heard in acoustics.heard.values():
            if self.time - heard.time > RANGE_S or (heard.beacon >= 0 and heard.beacon not in beacons):
                continue
            north, east, depth_m = heard.place
            if heard.beacon >= 0:
                north, east, depth_m = beacons[heard.beacon].north, beacons[heard.beacon].east, down[heard.beacon]
            level = heard.length**2 - (float(p_n[2]) - depth_m) ** 2
            if level > 0.0:
                name = beacons[heard.beacon].name if heard.beacon >= 0 else ""
                ranges.append(RangeCircle(name, north, east, math.sqrt(level)))
        ship = acoustics.ship()
        return {
            "ship": None if ship is None else ShipPose(*ship),
            "beacons": (*beacons.values(), *unplaced),
            "ranges": tuple(ranges),
        }

    def _travelled(self, p_n: Array, sd: Array) -> float:
        """Distance over ground, in steps of a metre at least: less is noise; none to where a first fix puts it."""
        if sd.max() > 0.5 * ANYWHERE_M:
            self._here = np.full(3, np.nan)
            return self._distance
        step = math.dist(p_n.tolist(), self._here.tolist())
        if not step < 1.0:
            self._distance += step if np.isfinite(step) else 0.0
            self._here = p_n
            self._watch_plane(math.hypot(p_n[0], p_n[1]))
        return self._distance

    def _watch_plane(self, away: float) -> None:
        """Report once that a plane which was not stated is wrong by now, ``away`` from its origin [m]."""
        if self._outgrown or self.origin is None or self.config.environment.frame != "auto":
            return
        latitude = self.origin[0]
        if self._intake.frame == "flat" and outgrows_plane(latitude, away, away):
            self._outgrown = True
            off = flat_error(latitude, away)
            self.say(
                "origin",
                "warning",
                f"{away / 1e3:.1f} km from the origin a flat frame is wrong by {off:.0f} m; state environment.frame: "
                "earth before the next dive",
            )
