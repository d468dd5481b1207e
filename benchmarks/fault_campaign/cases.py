"""The table of faults: what breaks, where, and the words in which a warning would name it.

A fault is one function. It changes the vehicle, whose configuration stays that of the healthy
one (`on_vehicle`), or the streams of the log (`on_log`). Cases without a fault are healthy: every other
case is compared with the healthy one of the same scenario, grade, aids and configuration.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from fault_campaign import earth
from fault_campaign.instruments import Streams
from fault_campaign.judge import Clock, NoTrace, on_time
from fault_campaign.motion import Motion, mounting
from fault_campaign.vehicle import Vehicle

Rng = np.random.Generator
OnVehicle = Callable[[Vehicle], None]
OnLog = Callable[[Streams, Motion, Rng], None]
Ground = Callable[[earth.Array, Rng], earth.Array]  # its velocity at some times, north and east, shape (n, 2) [m/s]
ACC, GYR, MAG = (tuple(f"{name}_{axis}" for axis in "xyz") for name in ("acc", "gyr", "mag"))
DVL, WATER = (tuple(f"{name}_v{axis}" for axis in "xyz") for name in ("dvl", "dvl_water"))
FIX = ("fix_north", "fix_east")
AUDIT = "audit"  # found with another simulator and recorded dives
AHRS_DEPTH = ("ahrs", "depth")
WAVES = "survey, waves"
WITH_FIXES, MAG_FIXES = ("ahrs", "depth", "fix"), ("mag", "depth", "fix")
TURNED = NoTrace(
    "If the whole dive is rotated about the vertical, it obeys the same equations. Only position fixes, or a gyro that "
    "measures the Earth's rate, show where north is.",
    ("position", "heading"),
    "constant error of the heading",
)
DRIFTING = NoTrace(
    "A heading that drifts steadily gives the log of a gyro whose bias differs by as much: the acceleration that tells "
    "them apart, of 0.3 mm/s² at 0.5 m/s, is lost in the accelerometer's noise. Only position fixes show it.",
    ("position", "heading"),
    "constant error of the heading",
)
LIFTED = NoTrace(
    "If the whole dive is shifted vertically, it obeys the same equations: gravity changes by 0.003 mm/s² per metre. "
    "Only a start at a known depth shows the offset.",
    ("depth",),
    "constant error of the depth",
)
ADRIFT = NoTrace(
    "A bottom that takes 20 s to reach 0.12 m/s changes the DVL's velocity by 6 mm/s². In that time the gyro's noise "
    "tilts the vertical by 0.18°, which is 31 mm/s²: a test that knows when and how the bottom moves has 1.4 sds to "
    "find it. Only position fixes, or a better gyro, show it.",
    ("position",),
    "bottom.*(rest|still|mov)",
)
OTHER_AXES = NoTrace(
    "A log shows the angles between its sensors, but only `imu.mount_rpy_deg` states which axes are the vehicle's. "
    "So heading and `dvl_yaw` have its error, and the track does not.",
    ("heading", "dvl_yaw"),
)


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Attributes
    ----------
    name, breaks : identifier, and what is wrong in a few words
    says : regular expression that a warning which names the cause matches
    source : where such a fault was reported
    scenario, grade, aids : what dives, with what
    on_vehicle, on_log : the fault
    config : keys of the configuration beside those that describe the vehicle
    wrong_config : keys that are wrong; the healthy case does not have them
    clock : how late the clock is that stamps the estimate, as a function of the stamp [s]
    dvl_rate, fix_rate : pings per second, where they are not 5, and fixes, where they are not 0.5
    event : of `EVENTS`: what befalls the healthy dive, too
    second_file : sensors in a file of their own, replayed by `rovgraph online` beside the other
    no_trace : why nothing in the log can show the fault
    """

    name: str
    breaks: str
    says: str = ""
    source: str = AUDIT
    scenario: str = "survey"
    grade: str = "mti"
    aids: Sequence[str] = AHRS_DEPTH
    on_vehicle: OnVehicle | None = None
    on_log: OnLog | None = None
    config: dict[str, Any] = field(default_factory=dict)
    wrong_config: dict[str, Any] = field(default_factory=dict)
    clock: Clock = on_time
    dvl_rate: float | None = None
    fix_rate: float | None = None
    event: str = ""
    second_file: Sequence[str] = ()
    no_trace: NoTrace | None = None

    @property
    def healthy(self) -> bool:
        """Nothing is wrong."""
        return self.on_vehicle is None and self.on_log is None and not self.wrong_config

    @property
    def setting(self) -> tuple[Any, ...]:
        """What a faulty case has in common with its healthy one."""
        common = self.scenario, self.grade, tuple(self.aids), repr(self.config), self.dvl_rate
        return (*common, *self.second_file, *(more for more in (self.fix_rate, self.event) if more))


# --- what several faults share -------------------------------------------------------------------


def between(table: pd.DataFrame, begin: float, end: float = np.inf) -> "pd.Series[bool]":
    """Rows of a stretch of time [s]."""
    return (table["time"] >= begin) & (table["time"] < end)


def later(sensor: str, seconds: float) -> OnLog:
    """Stamps that are late."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        streams[sensor]["time"] += seconds

    return fault


def jump(sensor: str, begin: float, seconds: float) -> OnLog:
    """A clock that is set forward."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        table.loc[between(table, begin), "time"] += seconds

    return fault


def add(sensor: str, columns: Sequence[str], values: Sequence[float], begin: float, end: float) -> OnLog:
    """A bias for a while."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        table.loc[between(table, begin, end), list(columns)] += np.asarray(values)

    return fault


def multiply(sensor: str, columns: Sequence[str], factor: float) -> OnLog:
    """A wrong unit or sign."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        streams[sensor][list(columns)] *= factor

    return fault


def hold(sensor: str, columns: Sequence[str], begin: float, end: float = np.inf) -> OnLog:
    """Frozen at the last value."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        frozen = between(table, begin, end)
        table.loc[frozen, list(columns)] = table.loc[frozen, list(columns)].iloc[0].to_numpy()

    return fault


def silent(sensor: str, begin: float, end: float) -> OnLog:
    """Nothing for a while."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        streams[sensor] = table[~between(table, begin, end)].reset_index(drop=True)

    return fault


def outliers(sensor: str, columns: Sequence[str], share: float, size: float, one_sided: bool = False) -> OnLog:
    """Single wild values; ``one_sided``: all in one direction."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        wild = rng.random(len(table)) < share
        error = rng.normal(0.0, size, (len(table), len(columns)))
        table[list(columns)] += wild[:, None] * (np.abs(error) if one_sided else error)

    return fault


def gauss_markov(rng: Rng, t: earth.Array, sd: float, seconds: float, columns: int) -> earth.Array:
    """A first-order Gauss-Markov process at times t, shape (n, columns)."""
    values = rng.normal(0.0, sd, (len(t), columns))
    for k in range(1, len(t)):
        keep = np.exp(-(t[k] - t[k - 1]) / seconds)
        values[k] = keep * values[k - 1] + np.sqrt(1.0 - keep**2) * values[k]
    return values


def correlated(sensor: str, columns: Sequence[str], sd: float, seconds: float) -> OnLog:
    """An error that lasts."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        table[list(columns)] += gauss_markov(rng, table["time"].to_numpy(), sd, seconds, len(columns))

    return fault


def noisier(factor: float) -> OnLog:
    """More white noise on everything but the IMU."""
    sds = {"dvl": (DVL, 0.005), "ahrs": (("ahrs_yaw",), np.deg2rad(0.5)), "depth": (("depth",), 0.02)}

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        for sensor, (columns, sd) in sds.items():
            shape = (len(streams[sensor]), len(columns))
            streams[sensor][list(columns)] += rng.normal(0.0, sd * np.sqrt(factor**2 - 1.0), shape)

    return fault


# --- the DVL -------------------------------------------------------------------------------------


def dvl_ramp(streams: Streams, motion: Motion, rng: Rng) -> None:
    table = streams["dvl"]
    table["dvl_vx"] += 0.3 * np.clip((table["time"] - 80.0) / 60.0, 0.0, 1.0) * between(table, 80.0, 140.0)


def dvl_false_lock(streams: Streams, motion: Motion, rng: Rng) -> None:
    table = streams["dvl"]
    wrong = between(table, 90.0, 110.0)
    table.loc[wrong, list(DVL)] = np.array([0.9, -0.7, 0.15]) + rng.normal(0.0, 0.01, (int(wrong.sum()), 3))


def dvl_bursts(streams: Streams, motion: Motion, rng: Rng) -> None:
    """A serial buffer is read once a second, and each ping stamped a millisecond after the other."""
    table = streams["dvl"]
    read = np.ceil(table["time"])
    table["time"] = read + 0.001 * table.groupby(read).cumcount()


def dvl_flip(columns: Sequence[str]) -> OnLog:
    return multiply("dvl", columns, -1.0)


def dvl_swapped(streams: Streams, motion: Motion, rng: Rng) -> None:
    streams["dvl"][["dvl_vx", "dvl_vy"]] = streams["dvl"][["dvl_vy", "dvl_vx"]].to_numpy()


def dvl_in_ned(streams: Streams, motion: Motion, rng: Rng) -> None:
    """The DVL turns its velocities into Earth axes itself."""
    table = streams["dvl"]
    table[list(DVL)] = motion.v_n(table["time"].to_numpy()) + rng.normal(0.0, 0.005, (len(table), 3))


def dvl_sentinel(streams: Streams, motion: Motion, rng: Rng) -> None:
    table = streams["dvl"]
    table.loc[between(table, 90.0, 110.0), list(DVL)] = -32.768


def dvl_zeros(streams: Streams, motion: Motion, rng: Rng) -> None:
    table = streams["dvl"]
    table.loc[between(table, 90.0, 110.0), list(DVL)] = 0.0


def dvl_single(share: float, factor: float) -> OnLog:
    """Single pings times a factor."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams["dvl"]
        table.loc[rng.random(len(table)) < share, list(DVL)] *= factor

    return fault


def dvl_one_beam(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Of four beams, 30 degrees from the vertical, the first measures half the velocity for 60 s."""
    slant, upright = np.sin(np.pi / 6.0), np.cos(np.pi / 6.0)
    beams = np.array([[slant, 0.0, upright], [-slant, 0.0, upright], [0.0, slant, upright], [0.0, -slant, upright]])
    table = streams["dvl"]
    rows = between(table, 80.0, 140.0)
    along = table.loc[rows, list(DVL)].to_numpy() @ beams.T
    table.loc[rows, list(DVL)] = along * np.array([0.5, 1.0, 1.0, 1.0]) @ np.linalg.pinv(beams).T


def dvl_published_twice(streams: Streams, motion: Motion, rng: Rng) -> None:
    """A driver publishes at twice the rate of the pings, the old values with a new stamp in between."""
    again = streams["dvl"].copy()
    again["time"] += 0.1
    streams["dvl"] = pd.concat([streams["dvl"], again], ignore_index=True).sort_values("time", ignore_index=True)


def dvl_held_between(streams: Streams, motion: Motion, rng: Rng) -> None:
    """One ping a second, published five times a second."""
    table = streams["dvl"]
    latest = np.arange(len(table)) // 5 * 5
    table[list(DVL)] = table[list(DVL)].to_numpy()[latest]


def over_moving_ground(sensor: str, columns: Sequence[str], velocity_n: Ground) -> OnLog:
    """What the DVL measures against moves."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams[sensor]
        t = table["time"].to_numpy()
        v_n = np.column_stack([velocity_n(t, rng), np.zeros(len(t))])
        table[list(columns)] -= np.einsum("nji,nj->ni", motion.C_nb(t), v_n) @ mounting((180.0, 0.0, -45.0))

    return fault


def for_a_while(north: float, east: float, begin: float, end: float, within: float = 0.0) -> Ground:
    """A velocity between two times that comes and goes ``within`` some seconds."""

    def velocity_n(t: earth.Array, rng: Rng) -> earth.Array:
        size = np.clip(np.minimum(t - begin, end - t) / within, 0.0, 1.0) if within else (t >= begin) & (t < end)
        return size[:, None] * np.array([north, east])

    return velocity_n


def bed_load(t: earth.Array, rng: Rng) -> earth.Array:
    """Sand that the river carries: 0.3 m/s rms, over 60 s."""
    return gauss_markov(rng, t, 0.3 / np.sqrt(2.0), 60.0, 2)


def no_lock(begin: float, end: float) -> OnLog:
    """The bottom is out of reach for a while."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams["dvl"]
        rows = between(table, begin, end)
        table.loc[rows, "dvl_valid"] = 0.0
        table.loc[rows, list(DVL)] = np.nan

    return fault


def dvl_terrain(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Slope and rough ground: 2 % of the speed, for as long as the ground is the same."""
    table = streams["dvl"]
    scale = gauss_markov(rng, table["time"].to_numpy(), 0.02, 30.0, 1)
    table[list(DVL)] *= 1.0 + scale


def dvl_figure_of_merit(sd: float) -> OnLog:
    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        streams["dvl"]["dvl_sd"] = sd

    return fault


def dvl_half_the_pings(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Bottom lock comes and goes for 1 to 5 s."""
    table = streams["dvl"]
    lost = np.repeat(rng.random(100) < 0.5, rng.integers(5, 25, 100))[: len(table)]
    table.loc[lost, "dvl_valid"] = 0.0
    table.loc[lost, list(DVL)] = np.nan


# --- IMU, compasses, depth, fixes, clocks ------------------------------------------------------------


def imu_vibration(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Thrusters at 63 Hz while under way, sampled without a filter before."""
    table = streams["imu"]
    t = table["time"].to_numpy()
    phase = 2.0 * np.pi * 63.0 * t + np.cumsum(rng.normal(0.0, 0.3, len(t)))
    for k, column in enumerate(ACC):
        table[column] += (t > 10.0) * 20.0 * np.sin(phase + k)
    for k, column in enumerate(GYR):
        table[column] += (t > 10.0) * 0.2 * np.sin(phase + 1.0 + k)


def imu_clipped(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Vibration beyond a range of 2 g, which cuts off what points along gravity."""
    imu_vibration(streams, motion, rng)
    streams["imu"][list(ACC)] = streams["imu"][list(ACC)].clip(-19.6, 19.6)


def clipped(columns: Sequence[str], limit: float) -> OnLog:
    """Values of the IMU beyond its range."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        streams["imu"][list(columns)] = streams["imu"][list(columns)].clip(-limit, limit)

    return fault


def acc_clipped(streams: Streams, motion: Motion, rng: Rng) -> None:
    """A thruster's bearing fails at 90 s: 8 m/s^2 at 63 Hz, with a range of 1.5 g."""
    table = streams["imu"]
    t = table["time"].to_numpy()
    phase = 2.0 * np.pi * 63.0 * t + np.cumsum(rng.normal(0.0, 0.3, len(t)))
    for k, column in enumerate(ACC):
        table[column] += (t > 90.0) * 8.0 * np.sin(phase + k)
    clipped(ACC, 14.7)(streams, motion, rng)


def imu_restarts(gyr_deg: float, acc: float) -> OnLog:
    """Silent from 90 s to 93 s; then biases are others, by ``gyr_deg`` [deg/s] and ``acc`` [m/s^2] on each axis."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        for sensor in ("imu", "ahrs"):
            silent(sensor, 90.0, 93.0)(streams, motion, rng)
        signs = np.array([1.0, -1.0, 1.0])
        add("imu", GYR, np.deg2rad(gyr_deg) * signs, 93.0, np.inf)(streams, motion, rng)
        add("imu", ACC, acc * signs, 93.0, np.inf)(streams, motion, rng)

    return fault


def imu_in_batches(streams: Streams, motion: Motion, rng: Rng) -> None:
    """A buffer of 20 samples, stamped when it is read, a microsecond apart."""
    table = streams["imu"]
    read = np.ceil(table["time"] / 0.2 - 1e-6) * 0.2
    table["time"] = read + 1e-6 * table.groupby(read).cumcount()


def imu_samples_lost(streams: Streams, motion: Motion, rng: Rng) -> None:
    table = streams["imu"]
    streams["imu"] = table[rng.random(len(table)) > 0.05].reset_index(drop=True)


def imu_doubled_stamps(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Every other sample has the stamp of the one before."""
    table = streams["imu"]
    table["time"] = table["time"].to_numpy()[np.arange(len(table)) // 2 * 2]


def imu_stamped_on_arrival(streams: Streams, motion: Motion, rng: Rng) -> None:
    """5 ms of jitter, and now and then a queue of 100 ms that is worked off at once."""
    table = streams["imu"]
    t = table["time"].to_numpy()
    held = np.repeat(rng.random(len(t) // 10 + 1) < 0.01, 10)[: len(t)]
    freed = np.where(held, t[np.minimum(np.arange(len(t)) // 10 * 10 + 9, len(t) - 1)], t)
    table["time"] = np.maximum.accumulate(freed + rng.exponential(0.005, len(t))) + 1e-6 * np.arange(len(t))


def imu_clock_fast(streams: Streams, motion: Motion, rng: Rng) -> None:
    streams["imu"]["time"] *= 1.01


def imu_milliseconds(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Stamps in steps of 16 ms: samples share stamps."""
    streams["imu"]["time"] = np.floor(streams["imu"]["time"] / 0.016) * 0.016


def imu_end_of_period(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Averages stamped at the end of their period."""
    streams["imu"]["time"] += 0.005


def imu_warms_up(streams: Streams, motion: Motion, rng: Rng) -> None:
    """A gyro's bias goes 0.3 deg/s within minutes after power-up."""
    table = streams["imu"]
    drift = np.deg2rad(0.3) * (1.0 - np.exp(-table["time"].to_numpy() / 90.0))
    table[list(GYR)] += drift[:, None] * np.array([0.5, -0.7, 1.0])


def flu(names: Sequence[Sequence[str]]) -> OnLog:
    """Axes forward, port, up that are taken for forward, starboard, down."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        for _x, y, z in names:
            streams["imu"][[y, z]] *= -1.0

    return fault


def ahrs_map(change: Callable[[earth.Array], earth.Array]) -> OnLog:
    """A heading of another convention."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        streams["ahrs"]["ahrs_yaw"] = change(streams["ahrs"]["ahrs_yaw"].to_numpy())

    return fault


def ahrs_drifts(streams: Streams, motion: Motion, rng: Rng) -> None:
    """No magnetometer in it: the gyro's heading, 2 degrees a minute."""
    table = streams["ahrs"]
    table["ahrs_yaw"] = (table["ahrs_yaw"] + np.deg2rad(2.0) / 60.0 * table["time"]) % (2.0 * np.pi)


def ahrs_turned(begin: float, degrees: float | None = None) -> OnLog:
    """Another offset from some time on; None = the heading of that time becomes zero."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table = streams["ahrs"]
        rows = between(table, begin)
        turned = -table.loc[rows, "ahrs_yaw"].iloc[0] if degrees is None else np.deg2rad(degrees)
        table.loc[rows, "ahrs_yaw"] = np.mod(table.loc[rows, "ahrs_yaw"] + turned, 2.0 * np.pi)

    return fault


def mag_axes(change: Sequence[Sequence[float]]) -> OnLog:
    """Axes of the magnetometer that are not those of the IMU."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        streams["mag"][list(MAG)] = streams["mag"][list(MAG)].to_numpy() @ np.array(change).T

    return fault


def depth_zeroed(streams: Streams, motion: Motion, rng: Rng) -> None:
    """The autopilot restarts under water and takes the depth there for the surface."""
    table = streams["depth"]
    rows = between(table, 60.0)
    table.loc[rows, "depth"] -= table.loc[rows, "depth"].iloc[0]


def depth_spikes(streams: Streams, motion: Motion, rng: Rng) -> None:
    """An overflow now and then."""
    table = streams["depth"]
    table.loc[rng.random(len(table)) < 0.05, "depth"] += 65.536


def depth_steps(streams: Streams, motion: Motion, rng: Rng) -> None:
    streams["depth"]["depth"] = streams["depth"]["depth"].round(1)


def fix_rotated(angle: Callable[[earth.Array], earth.Array]) -> OnLog:
    """The ship is 60 m away, and its heading wrong by as much [rad]."""

    def fault(streams: Streams, motion: Motion, rng: Rng) -> None:
        table, ship = streams["fix"], np.array([60.0, -20.0])
        a = angle(table["time"].to_numpy())
        north, east = (table[list(FIX)].to_numpy() - ship).T
        turned = [np.cos(a) * north - np.sin(a) * east, np.sin(a) * north + np.cos(a) * east]
        table[list(FIX)] = ship + np.column_stack(turned)

    return fault


def fix_by_heading(streams: Streams, motion: Motion, rng: Rng) -> None:
    """The vehicle's frame bends the sound: 2.5 m off, in a direction that goes round twice as it turns once."""
    table = streams["fix"]
    heading = motion.heading(table["time"].to_numpy())
    table[list(FIX)] += 2.5 * np.column_stack([np.cos(2.0 * heading), np.sin(2.0 * heading)])


def fix_of_two_datums(streams: Streams, motion: Motion, rng: Rng) -> None:
    """A quarter of them, now and then, are 6 m off."""
    table = streams["fix"]
    table.loc[rng.random(len(table)) < 0.25, list(FIX)] += np.array([4.8, 3.6])


def fix_swapped(streams: Streams, motion: Motion, rng: Rng) -> None:
    streams["fix"][["fix_north", "fix_east"]] = streams["fix"][["fix_east", "fix_north"]].to_numpy()


def fix_returns_wrong(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Silent for 80 s, and wrong by 30 m for the 15 s in which they return."""
    silent("fix", 60.0, 140.0)(streams, motion, rng)
    add("fix", ["fix_north", "fix_east"], [24.0, 18.0], 140.0, 155.0)(streams, motion, rng)


def all_clocks_jump(streams: Streams, motion: Motion, rng: Rng) -> None:
    for sensor in streams:
        jump(sensor, 90.0, 8.0)(streams, motion, rng)


def rows_doubled(streams: Streams, motion: Motion, rng: Rng) -> None:
    """Two recordings of the same dive merged."""
    for sensor, table in streams.items():
        streams[sensor] = pd.concat([table, table], ignore_index=True)


def change(part: str, **values: Any) -> OnVehicle:
    """The vehicle is another than the one that is described."""

    def fault(vehicle: Vehicle) -> None:
        for name, value in values.items():
            setattr(getattr(vehicle, part), name, value)

    return fault


def constantly(seconds: float) -> Clock:
    """A clock that is late by as much all the time."""
    return lambda stamps: np.full_like(stamps, seconds)


SKEW = np.array([[1.0, 0.01, -0.01], [0.0, 1.0, 0.01], [0.0, 0.0, 1.0]])
SOFT_IRON = np.array([[1.06, 0.03, 0.0], [0.03, 0.95, 0.02], [0.0, 0.02, 1.0]])
SCALE = {"calibration": {"dvl_scale": {"estimate": True, "sd": 0.01}}}
CAUTIOUS = {
    "dvl": {"velocity_sd_mps": [0.015, 0.015, 0.009]},
    "heading": {"ahrs_sd_deg": 1.5},
    "depth": {"sd_m": 0.06},
}
UNCALIBRATED = {"calibration": {"ahrs_offset": None, "ahrs_deviation": None}, "heading": {"ahrs_sd_deg": None}}
TIME_OFFSET = {"calibration": {"dvl_time_offset": {"estimate": True, "sd": 0.1}}}

CLOCK = r"\bclocks?\b|\blate|\blag|stamp|time offset|time_offset|synchron|delay"
MOUNT = r"mount|axis|axes|sign\b|turned|flipp|mirror|orientation|upside"
DVL_WRONG = r"dvl.*(reject|inconsisten|disagree|contradict|bias|\block|gate|outlier)"
FROZEN = r"frozen|froze|stuck|same value|repeat|stands still|constant"
NOISE = r"nois|scatter|mean square|chi-square|vibrat|autocorrel|correlat"

MAG_AXES = r"(mag|heading|compass).*(ax[ei]s|swap|hand|mirror|sign|revers)"
MOVED = r"bottom.*(mov|drift)|(mov|drift).*bottom|current|water"
CHANGED = r"jump|\bstep|chang|restart|another|from [\d.]+ s on"

EVENTS: dict[str, OnLog] = {
    "fixes end": silent("fix", 100.0, np.inf),
    "no bottom for 70 s": no_lock(70.0, 140.0),
}

HEALTHY: tuple[Case, ...] = (
    Case("survey", "nothing"),
    Case("survey, waves", "nothing", scenario=WAVES),
    Case("long survey", "nothing", scenario="long survey"),
    Case("survey of 20 minutes", "nothing", scenario="survey of 20 minutes"),
    Case("survey of 20 minutes, waves", "nothing", scenario="survey of 20 minutes, waves"),
    Case("dives", "nothing", scenario="dives"),
    Case("hover", "nothing", scenario="hover"),
    Case("transit", "nothing", scenario="transit"),
    Case("survey with fixes", "nothing", aids=WITH_FIXES),
    Case("transit with fixes", "nothing", scenario="transit", aids=WITH_FIXES),
    Case("magnetometer", "nothing", aids=("mag", "depth")),
    Case("magnetometer, little turning", "nothing", scenario="transit", aids=("mag", "depth")),
    Case("two compasses", "nothing", aids=("mag", "dvl_heading", "depth"), scenario="dives"),
    Case("tactical", "nothing", grade="tactical"),
    Case("tactical, waves", "nothing", grade="tactical", scenario=WAVES),
    Case("tactical, long transit", "nothing", grade="tactical", scenario="long transit"),
    Case("FOG", "nothing", grade="fog"),
    Case(
        "FOG under way, DVL 1 Hz",
        "nothing",
        grade="fog",
        scenario="moving start",
        dvl_rate=1.0,
    ),
    Case("figures of eight", "nothing", scenario="eights"),
    Case("figures of eight, dvl_scale estimated", "nothing", scenario="eights", config=SCALE),
    Case("two files, online", "nothing", scenario=WAVES, second_file=("dvl",)),
    Case("dvl_time_offset estimated", "nothing", config=TIME_OFFSET),
    Case("tactical, survey of 4 minutes", "nothing", scenario="survey of 4 minutes", grade="tactical"),
    Case("survey of 4 minutes", "nothing", scenario="survey of 4 minutes"),
    Case("fixes every second", "nothing", scenario="survey of 4 minutes", aids=WITH_FIXES, fix_rate=1.0),
    Case("fixes every second, of 100 s", "nothing", scenario="survey of 4 minutes", aids=WITH_FIXES, fix_rate=1.0,
         event="fixes end"),
    Case("compass not calibrated", "nothing", config=UNCALIBRATED),
    Case("compass not calibrated, fixes", "nothing", config=UNCALIBRATED, aids=WITH_FIXES),
    Case("magnetometer with fixes", "nothing", scenario="transit", aids=MAG_FIXES),
    Case("magnetometer, waves", "nothing", scenario=WAVES, aids=("mag", "depth")),
    Case("brisk turns", "nothing", scenario="brisk turns"),
    Case("water track", "nothing", aids=("ahrs", "depth", "dvl_water"), event="no bottom for 70 s"),
    Case("start within 1 m, fixes", "nothing", aids=WITH_FIXES, config={"start": {"position_sd_m": 1.0}}),
    Case("figures of eight, gyro scale 0.2 %", "nothing", scenario="eights", grade="mti, gyro scale 0.2 %"),
    Case("sds three times too large", "nothing", config=CAUTIOUS),
    Case("FOG, sds three times too large", "nothing", grade="fog", config=CAUTIOUS),
)  # fmt: skip

FAULTS: tuple[Case, ...] = (
    # the DVL's velocity
    Case("dvl bias", "+0.3 m/s for 20 s", DVL_WRONG, on_log=add("dvl", ["dvl_vx"], [0.3], 90.0, 110.0)),
    Case("dvl ramp", "to +0.3 m/s within 60 s", DVL_WRONG, on_log=dvl_ramp),
    Case("dvl frozen", "last value for 60 s", f"dvl.*({FROZEN})", on_log=hold("dvl", DVL, 80.0, 140.0)),
    Case("dvl false lock", "constant nonsense for 20 s", DVL_WRONG, on_log=dvl_false_lock),
    Case("dvl silent 240 s", "and back", r"dvl.*(gap|silen|without|nothing for)", scenario="long survey",
         on_log=silent("dvl", 60.0, 300.0)),
    Case("dvl silent 200 s, tactical", "and back", r"dvl.*(gap|silen|without|nothing for)",
         scenario="long transit", grade="tactical", on_log=silent("dvl", 60.0, 260.0)),
    Case("dvl y flipped", "sign of one axis", MOUNT, on_log=dvl_flip(["dvl_vy"])),
    Case("dvl y and z flipped", "forward-port-up not declared", MOUNT, on_log=dvl_flip(["dvl_vy", "dvl_vz"])),
    Case("dvl turned 90 degrees", "mounting typed wrong", MOUNT,
         wrong_config={"dvl": {"mount_rpy_deg": [180.0, 0.0, 45.0]}}),
    Case("dvl scale 1 %", "sound speed", r"scale|sound speed", on_vehicle=change("dvl", scale=0.01)),
    Case("dvl tilted", "2 degrees between IMU and DVL", r"tilt|dvl_roll|dvl_pitch|mount",
         on_vehicle=change("dvl", mount_rpy_deg=(181.5, 1.5, -45.0))),
    Case("dvl arm", "15 cm off", r"arm", on_vehicle=change("dvl", arm=(0.35, 0.1, 0.3))),
    Case("dvl arm, 20 minutes", "15 cm off", r"arm", scenario="survey of 20 minutes",
         on_vehicle=change("dvl", arm=(0.35, 0.1, 0.3))),
    # clocks
    Case("dvl 0.1 s late", "stamps", CLOCK, scenario=WAVES, on_log=later("dvl", 0.1)),
    Case("dvl 0.087 s late", "as an A50 stamped on arrival", CLOCK, scenario=WAVES, on_log=later("dvl", 0.087)),
    Case("dvl 0.3 s late", "stamps", CLOCK, scenario=WAVES, on_log=later("dvl", 0.3)),
    Case("dvl 0.1 s late, level", "the same without waves", CLOCK, on_log=later("dvl", 0.1)),
    Case("dvl 3.2 s late", "stamps", CLOCK, on_log=later("dvl", 3.2)),
    Case("dvl 0.1 s late, estimated", "and dvl_time_offset estimated", CLOCK, on_log=later("dvl", 0.1),
         config=TIME_OFFSET),
    Case("dvl in bursts", "stamped on arrival, read once a second", CLOCK, scenario=WAVES, on_log=dvl_bursts),
    Case("dvl of another epoch", "Unix time beside time since boot", CLOCK, on_log=later("dvl", 1.7e9)),
    Case("two files, online, 55 years apart", "Unix time beside time since boot", CLOCK, scenario=WAVES,
         second_file=("dvl",), on_log=later("dvl", 1.7e9)),
    Case("two files, online, 87 ms apart", "an A50 stamped on arrival", CLOCK, scenario=WAVES,
         second_file=("dvl",), on_log=later("dvl", 0.087)),
    Case("imu 50 ms late", "stamps", CLOCK, scenario=WAVES, on_log=later("imu", 0.05), clock=constantly(0.05)),
    Case("imu clock jumps", "by 2 s", CLOCK + r"|jump|\bset\b", on_log=jump("imu", 90.0, 2.0)),
    Case("dvl clock jumps", "by 2 s", CLOCK + r"|jump|\bset\b", on_log=jump("dvl", 90.0, 2.0)),
    # the IMU
    Case("imu tilted", "mounted 2, 1, 3 degrees off", MOUNT + "|tilt",
         on_vehicle=change("imu", mount_rpy_deg=(2.0, 1.0, 3.0)), no_trace=OTHER_AXES),
    Case("gyro scale 0.5 %", "held", r"gyr.*scale|scale.*gyr", scenario="eights",
         on_vehicle=change("imu", gyr_matrix=1.005 * np.eye(3))),
    Case("gyro not orthogonal", "1 %", r"orthogonal|gyr.*scale|scale.*gyr", on_vehicle=change("imu", gyr_matrix=SKEW)),
    Case("FOG without Earth rate", "earth_rotation forgotten", r"earth.?(rate|rotation)", grade="fog",
         wrong_config={"environment": {"earth_rotation": False}}),
    Case("tactical without Earth rate", "earth_rotation forgotten", r"earth.?(rate|rotation)", grade="tactical",
         wrong_config={"environment": {"earth_rotation": False}}),
    Case("vibration", "20 m/s^2 at 63 Hz, 0.2 rad/s", NOISE, on_log=imu_vibration),
    # other aids
    Case("depth stuck", "while it dives", f"depth.*({FROZEN})", scenario="dives",
         on_log=hold("depth", ["depth"], 28.0)),
    Case("depth offset", "2 m after 60 s", r"depth.*(offset|jump|disagree|contradict|reject|shift)", scenario="dives",
         on_log=add("depth", ["depth"], [2.0], 60.0, np.inf)),
    Case("depth of a wrong surface", "818 hPa: 8.3 m too deep throughout", r"depth.*(surface|offset|pressure)",
         on_vehicle=change("depth", offset=8.3), no_trace=LIFTED),
    Case("fixes 2 s late", "USBL", CLOCK, aids=WITH_FIXES, scenario="transit",
         on_log=later("fix", 2.0)),
    Case("fixes correlated", "over 30 s", r"fix.*(correlat|reject|disagree|contradict)|autocorrel", aids=WITH_FIXES,
         on_log=correlated("fix", ["fix_north", "fix_east"], 1.0, 30.0)),
    Case("fixes 8 m off", "for 60 s", r"fix.*(reject|jump|disagree|contradict|off\b)", aids=WITH_FIXES,
         on_log=add("fix", ["fix_north", "fix_east"], [6.4, 4.8], 80.0, 140.0)),
    Case("fixes at one point", "throughout", f"fix.*({FROZEN}|one point|one place)", aids=WITH_FIXES,
         on_log=hold("fix", ["fix_north", "fix_east"], 0.0)),
    Case("ahrs correlated", "2 degrees over 60 s", r"(ahrs|heading).*(correlat|drift|lasts|disagree)|autocorrel",
         on_log=correlated("ahrs", ["ahrs_yaw"], np.deg2rad(2.0), 60.0)),
    Case("noise", "three times what is stated", NOISE, on_log=noisier(3.0)),
    Case("magnetometer of 9134 uT", "50 uT times 183", r"mag.*(field|unit|implausib|magnitude|uT|µT)",
         aids=("mag", "depth"), on_log=multiply("mag", MAG, 182.7)),
    # from issue trackers: drivers of DVLs
    Case("dvl zeros", "for an error, valid", r"dvl.*(frozen|zero)", "ROS DVL drivers", on_log=dvl_zeros),
    Case("dvl sentinel", "-32.768 m/s, valid", r"dvl.*(32\.7|sentinel|faster|left out)", "Nortek readers",
         on_log=dvl_sentinel),
    Case("dvl published twice", "old values, new stamps", f"dvl.*({FROZEN}|twice)", "ROS DVL drivers",
         on_log=dvl_published_twice),
    Case("dvl held", "1 Hz published at 5 Hz", f"dvl.*({FROZEN})", "Water Linked integrations",
         on_log=dvl_held_between),
    Case("dvl in Earth axes", "instead of its own", r"earth axes|frame|" + MOUNT, "RDI drivers", on_log=dvl_in_ned),
    Case("dvl x and y swapped", "ENU body", MOUNT, "MAVROS", on_log=dvl_swapped),
    Case("dvl mm/s", "as m/s", r"dvl.*(unit|faster|mm/s|fast)", "Water Linked integrations",
         on_log=multiply("dvl", DVL, 1000.0)),
    Case("dvl on water", "water track as bottom track for 40 s, 0.25 m/s", DVL_WRONG + "|water|current", "MAVLink",
         on_log=over_moving_ground("dvl", DVL, for_a_while(0.2, -0.15, 80.0, 120.0))),
    Case("dvl terrain", "2 % over 30 s", r"dvl.*(scale|correlat)|autocorrel", "DVL users", on_log=dvl_terrain),
    Case("dvl figure of merit", "ten times too good", r"dvl.*(sd|nois|mean square|chi)", "AD2CP readers",
         on_log=dvl_figure_of_merit(0.0005)),
    Case("dvl outliers", "30 % of the pings, 0.5 m/s", r"dvl.*(reject|outlier)", "SubjuGator",
         on_log=outliers("dvl", DVL, 0.3, 0.5)),
    Case("dvl lock comes and goes", "half of the time", r"dvl.*(lock|valid)", "ArduSub", on_log=dvl_half_the_pings),
    Case("dvl sound speed 3 %", "fresh water's in the sea", r"scale|sound speed", "LABUST",
         on_vehicle=change("dvl", scale=-0.03)),
    Case("dvl arm unsigned", "z typed upwards", r"arm", "LABUST, oplab_pipeline",
         wrong_config={"dvl": {"lever_arm_m": [0.25, 0.0, -0.3]}}, scenario=WAVES),
    # from issue trackers: IMUs and autopilots
    Case("imu forward-port-up", "not declared", MOUNT, "MAVROS, VectorNav", on_log=flu([ACC, GYR])),
    Case("gyro forward-port-up", "accelerometer converted, gyro not", MOUNT, "MAVROS", on_log=flu([GYR])),
    Case("gyro in deg/s", "as rad/s", r"gyr.*(unit|deg/s|degree)|turn", "ROS IMU drivers",
         on_log=multiply("imu", GYR, 57.29578)),
    Case("accelerometer in g", "as m/s^2", r"(acc|gravity|imu).*(unit|gravity| g\b)", "ROS IMU drivers",
         on_log=multiply("imu", ACC, 1.0 / 9.80665)),
    Case("gyro bias 3 deg/s", "not calibrated at boot", r"gyr.*bias", "ArduSub",
         on_vehicle=change("imu", gyr_bias=np.deg2rad([1.0, -1.0, 3.0]))),
    Case("gyro bias 1 deg/s, in waves", "no rest to see it", r"gyr.*bias", "ArduSub", scenario=WAVES,
         on_vehicle=change("imu", gyr_bias=np.deg2rad([0.5, -0.5, 1.0]))),
    Case("gyro warms up", "0.3 deg/s in minutes", r"gyr.*(bias|drift)", "PX4, iNav", on_log=imu_warms_up),
    Case("accelerometer bias", "0.3 m/s^2", r"acc.*bias", "PX4",
         on_vehicle=change("imu", acc_bias=np.array([0.3, -0.2, 0.1]))),
    Case("vibration clipped", "at 2 g", NOISE + "|clip|saturat", "PX4, ArduPilot", on_log=imu_clipped),
    Case("imu samples lost", "5 %", r"imu.*(gap|lost|missing|drop)", "MicroStrain drivers", on_log=imu_samples_lost),
    Case("imu stamps doubled", "two samples, one stamp", r"imu.*(same time|stamp|repeat)", "ZED, Orbbec",
         on_log=imu_doubled_stamps),
    Case("imu stamps coarse", "16 ms", r"imu.*(same time|stamp|repeat|resolution)", "ZED", on_log=imu_milliseconds),
    Case("imu stamped on arrival", "5 ms of jitter, queues of 100 ms", CLOCK + "|jitter|irregular", "Xsens drivers",
         scenario=WAVES, on_log=imu_stamped_on_arrival),
    Case("imu stamped at the end", "of its averaging period", CLOCK, "PX4", scenario=WAVES,
         on_log=imu_end_of_period, clock=constantly(0.005)),
    Case("imu clock 1 % fast", "against all others", CLOCK + "|too fast", "Xsens drivers", on_log=imu_clock_fast),
    Case("all clocks jump", "NTP: 8 s", CLOCK + r"|jump|gap|\bset\b|silent", "ROS, rtabmap", on_log=all_clocks_jump,
         clock=lambda stamps: np.clip(stamps - 90.0, 0.0, 8.0)),
    Case("rows doubled", "two recordings merged", r"repeat|twice|same time", "rosbag users", on_log=rows_doubled),
    Case("gravity of the equator", "9.78 m/s^2", r"gravity", "iNav",
         wrong_config={"environment": {"gravity_mps2": earth.GRAVITY_EQUATOR}}),
    # from issue trackers: headings
    Case("heading ENU", "anticlockwise from east", r"ENU|anticlockwise|sign|mirror|follow", "robot_localization",
         on_log=ahrs_map(lambda yaw: np.mod(0.5 * np.pi - yaw, 2.0 * np.pi))),
    Case("heading 90 degrees off", "north at west", r"heading|ahrs|turned", "MicroStrain",
         on_log=ahrs_map(lambda yaw: np.mod(yaw + 0.5 * np.pi, 2.0 * np.pi)), no_trace=TURNED),
    Case("heading 90 degrees off, fixes", "north at west", r"(heading|ahrs).*(fix|offset|turned|off)", "MicroStrain",
         aids=WITH_FIXES, on_log=ahrs_map(lambda yaw: np.mod(yaw + 0.5 * np.pi, 2.0 * np.pi))),
    Case("heading in degrees", "as radians", r"(unit|degree|deg\b|rad)", "robot_localization",
         on_log=ahrs_map(lambda yaw: np.rad2deg(yaw))),
    Case("declination's sign", "9 degrees off", r"declination|heading.*fix|fix.*heading", "robot_localization",
         aids=WITH_FIXES, wrong_config={"environment": {"declination_deg": -4.5}}),
    Case("heading frozen", "for 60 s", f"(ahrs|heading).*({FROZEN}|follow)", "ublox users",
         on_log=hold("ahrs", ["ahrs_yaw"], 60.0, 120.0)),
    Case("heading drifts", "2 degrees a minute", r"(ahrs|heading).*(drift|correlat|disagree)|autocorrel", "ArduSub",
         on_log=ahrs_drifts, no_trace=DRIFTING),
    Case("thruster current", "hard iron of 5 % of the field at 0.5 m/s",
         r"mag.*(field|iron|interfer|correlat|disagree)",
         "PX4, fusioncore", aids=("mag", "depth"),
         on_vehicle=change("field", hard_iron_per_speed=np.array([0.1, 0.05, -0.05]))),
    Case("steel", "hard iron of 30 % for 30 s", r"mag.*(field|iron|interfer|reject|disagree)", "PX4",
         aids=("mag", "depth"), on_log=add("mag", MAG, [8.0, -10.0, 6.0], 90.0, 120.0)),
    Case("soft iron", "6 %", r"mag.*(soft|iron|calibrat)", "SubjuGator", aids=("mag", "depth"),
         on_vehicle=change("field", soft_iron=SOFT_IRON)),
    # from issue trackers: depth and fixes
    Case("fresh water's density", "2.6 % of the depth", r"densit|depth.*scale", "BlueOS", scenario="dives",
         on_vehicle=change("depth", density=0.026)),
    Case("depth upwards", "sign", r"depth.*(mirror|sign|upwards|downwards)", "MAVROS", scenario="dives",
         on_log=multiply("depth", ["depth"], -1.0)),
    Case("depth spikes", "5 %, 65.536 m", r"depth.*(reject|spike|outlier|overflow)", "OpenROV", on_log=depth_spikes),
    Case("depth in steps", "0.1 m", r"depth.*(step|resolution|repeat|frozen)", "ArduSub", on_log=depth_steps),
    Case("USBL multipath", "20 % of the fixes, one-sided", r"fix.*(reject|outlier)", "Blueye", aids=WITH_FIXES,
         on_log=outliers("fix", ["fix_north", "fix_east"], 0.2, 15.0, one_sided=True)),
    Case("fixes return wrong", "30 m for 15 s after 80 s without", r"fix.*(reject|jump|disagree)", "fusioncore",
         aids=WITH_FIXES, on_log=fix_returns_wrong),
    Case("fixes turned", "the ship's heading 8 degrees off", r"fix.*(heading|turned|disagree|reject)|heading.*fix",
         "USBL users", aids=WITH_FIXES, on_log=fix_rotated(lambda t: np.full_like(t, np.deg2rad(8.0)))),
    Case("fixes swapped", "north and east", r"fix.*(swap|turned|mirror|disagree|reject)|heading.*fix", "MAVROS",
         aids=WITH_FIXES, on_log=fix_swapped),
    Case("antenna's arm", "3 m forgotten", r"arm|fix.*(reject|disagree)", "robot_localization", aids=WITH_FIXES,
         on_vehicle=change("fix", arm=(-3.0, 0.0, -0.4))),
    Case("last fix repeated", "after 60 s, under water", f"fix.*({FROZEN}|one point)", "ArduSub, u-blox",
         aids=WITH_FIXES, on_log=hold("fix", ["fix_north", "fix_east"], 60.0)),
    # what the DVL measures against moves
    Case("dvl on a hull", "adrift with 0.15 m/s for 160 s, within 2 s", f"{DVL_WRONG}|{MOVED}",
         scenario="survey of 4 minutes",
         on_log=over_moving_ground("dvl", DVL, for_a_while(0.12, -0.09, 40.0, 200.0, within=2.0))),
    Case("dvl on a hull, tactical", "adrift with 0.15 m/s for 160 s, within 5 s", f"{DVL_WRONG}|{MOVED}",
         scenario="survey of 4 minutes", grade="tactical",
         on_log=over_moving_ground("dvl", DVL, for_a_while(0.12, -0.09, 40.0, 200.0, within=5.0))),
    Case("dvl on a hull, fixes", "adrift with 0.15 m/s for 160 s, within 5 s", f"{DVL_WRONG}|{MOVED}",
         scenario="survey of 4 minutes", aids=WITH_FIXES, fix_rate=1.0,
         on_log=over_moving_ground("dvl", DVL, for_a_while(0.12, -0.09, 40.0, 200.0, within=5.0))),
    Case("dvl on a cloud", "0.12 m/s for 90 s, within 20 s", f"{DVL_WRONG}|{MOVED}", no_trace=ADRIFT,
         on_log=over_moving_ground("dvl", DVL, for_a_while(-0.07, 0.1, 60.0, 150.0, within=20.0))),
    Case("dvl on a cloud, FOG", "0.12 m/s for 90 s, within 20 s", f"{DVL_WRONG}|{MOVED}", grade="fog",
         on_log=over_moving_ground("dvl", DVL, for_a_while(-0.07, 0.1, 60.0, 150.0, within=20.0))),
    Case("dvl on a cloud, fixes", "0.12 m/s for 90 s, within 20 s", f"{DVL_WRONG}|{MOVED}", aids=WITH_FIXES,
         on_log=over_moving_ground("dvl", DVL, for_a_while(-0.07, 0.1, 60.0, 150.0, within=20.0))),
    Case("moving bed, fixes", "0.3 m/s over 60 s", f"{DVL_WRONG}|{MOVED}", "records of river ADCPs",
         scenario="survey of 4 minutes", aids=WITH_FIXES, fix_rate=1.0,
         on_log=over_moving_ground("dvl", DVL, bed_load)),
    Case("moving bed, fixes of 100 s", "0.3 m/s over 60 s", f"{DVL_WRONG}|{MOVED}", "records of river ADCPs",
         scenario="survey of 4 minutes", aids=WITH_FIXES, fix_rate=1.0, event="fixes end",
         on_log=over_moving_ground("dvl", DVL, bed_load)),
    Case("current turns", "by 0.2 m/s while the bottom is out of reach", r"\bcurrent",
         aids=("ahrs", "depth", "dvl_water"), event="no bottom for 70 s",
         on_log=over_moving_ground("dvl_water", WATER, for_a_while(-0.16, 0.12, 90.0, 1000.0, within=10.0))),
    # single pings, and what stands for none
    Case("dvl single zeros", "15 % of the pings", r"dvl.*zero", "oce 777, okmr_auv 56", on_log=dvl_single(0.15, 0.0)),
    Case("dvl half values", "20 % of the pings", r"dvl.*(half|outlier|reject|slow)", on_log=dvl_single(0.2, 0.5)),
    Case("dvl one beam", "at half its velocity for 60 s", DVL_WRONG + "|beam", on_log=dvl_one_beam),
    Case("dvl sd 9999", "for unknown", r"dvl.*(9999|unknown|sentinel|figure of merit)|dvl_sd",
         "kobuki 383, vectornav 69", on_log=dvl_figure_of_merit(9999.0)),
    Case("dvl faster than allowed", "1 m/s, dvl.max_speed_mps 0.6", r"dvl.*(fast|max_speed)", scenario="transit",
         wrong_config={"dvl": {"max_speed_mps": 0.6}}),
    # changes under way
    Case("imu restarts", "3 s, then other biases", f"(imu|gyr|acc).*({CHANGED}|bias)", on_log=imu_restarts(0.3, 0.03)),
    Case("imu restarts, tactical", "3 s, then other biases", f"(imu|gyr|acc).*({CHANGED}|bias)", grade="tactical",
         on_log=imu_restarts(0.07, 0.015)),
    Case("ahrs restarts", "its heading is zero at 90 s", f"(ahrs|heading|compass).*({CHANGED})", "i2cdevlib 486",
         on_log=ahrs_turned(90.0)),
    Case("compass beside a tool", "8 degrees from 90 s on", f"(ahrs|heading|compass).*({CHANGED})",
         on_log=ahrs_turned(90.0, 8.0)),
    Case("compass beside a tool, FOG", "8 degrees from 90 s on", f"(ahrs|heading|compass).*({CHANGED})", grade="fog",
         on_log=ahrs_turned(90.0, 8.0)),
    Case("depth zeroed", "under way, at 60 s", f"depth.*(zero|tare|depth_offset|{CHANGED})", "ArduPilot 11260",
         scenario="dives", on_log=depth_zeroed),
    # ranges, axes and stamps
    Case("gyro clipped", "at 75 deg/s", r"gyr.*(clip|satur|range)|(clip|satur).*gyr", "PX4 19523, Reefwing-AHRS 2",
         scenario="brisk turns", on_log=clipped(GYR, np.deg2rad(75.0))),
    Case("accelerometer clipped", "at 1.5 g, by vibration from 90 s on", r"clip|satur|range|vibrat", "betaflight 797",
         grade="tactical", on_log=acc_clipped),
    Case("imu in batches", "of 20 samples, stamped when read", CLOCK + "|burst|batch", "OrbbecSDK 37",
         on_log=imu_in_batches),
    Case("magnetometer x and y swapped", "left-handed", MAG_AXES, "PX4 7929",
         aids=("mag", "depth"), on_log=mag_axes([[0, 1, 0], [1, 0, 0], [0, 0, 1]])),
    Case("magnetometer z reversed", "left-handed", MAG_AXES, "iNav 5318",
         aids=("mag", "depth"), scenario=WAVES, on_log=mag_axes([[1, 0, 0], [0, 1, 0], [0, 0, -1]])),
    # compasses, fixes and the start
    Case("compass 20 degrees off", "a boat's, not calibrated", r"(heading|ahrs|compass).*(check|calibrat|offset)",
         config=UNCALIBRATED, on_log=ahrs_turned(0.0, 20.0), no_trace=TURNED),
    Case("compass 20 degrees off, fixes", "a boat's, not calibrated",
         r"(heading|ahrs|compass).*(fix|offset|turned|off)", config=UNCALIBRATED, aids=WITH_FIXES,
         on_log=ahrs_turned(0.0, 20.0)),
    Case("fixes of two datums", "a quarter 6 m off", r"fix.*(datum|two|reject|outlier|disagree|contradict)",
         aids=WITH_FIXES, on_log=fix_of_two_datums),
    Case("fixes 18 s late", "heading by magnetometer", CLOCK, scenario="transit", aids=MAG_FIXES,
         on_log=later("fix", 18.0)),
    Case("fixes about a swinging ship", "its heading swings by 4 degrees in 50 s",
         r"fix.*(turn|rotat|ship|swing|heading|disagree|reject|contradict|correlat|last)", scenario="transit",
         aids=MAG_FIXES, on_log=fix_rotated(lambda t: np.deg2rad(4.0) * np.sin(2.0 * np.pi * t / 50.0))),
    Case("fixes swapped, magnetometer", "north and east", r"fix.*(swap|turned|mirror|disagree|reject)|heading.*fix",
         "MAVROS", scenario="transit", aids=MAG_FIXES, on_log=fix_swapped),
    Case("fixes by heading", "2.5 m, about the vehicle",
         r"fix.*(heading|turn|disagree|reject|contradict|correlat|last)", aids=WITH_FIXES, on_log=fix_by_heading),
    Case("start 20 m off", "sd 1 m", r"start.*(fix|off|disagree|contradict|position)|position.*start", aids=WITH_FIXES,
         config={"start": {"position_sd_m": 1.0}}, wrong_config={"start": {"north_m": 16.0, "east_m": -12.0}}),
)  # fmt: skip

CASES = {case.name: case for case in (*HEALTHY, *FAULTS)}
