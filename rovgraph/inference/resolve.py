"""What a configuration leaves to the log: `resolve` completes it, one pass for each subject.

A pass looks at the log and at what is resolved so far, and states values together with the line that says so
(`Resolution.assume`). `PASSES` has them in the order in which they need each other.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rovgraph.dates import is_unix
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.assumptions import nothing_checks, unchecked, unchecked_compass
from rovgraph.inference.gyrocompassing import with_earth_rate, without_turns
from rovgraph.kernels.assembly import NOISIER
from rovgraph.kernels.earth import normal_gravity
from rovgraph.log import Log
from rovgraph.log.reading import length_of_way, water_at
from rovgraph.model.calibration import ACOUSTICS, AUTO, CONSIDERED, TABLE
from rovgraph.model.config import GOOD_GYRO_DPS, Config, beliefs, with_priors_stated
from rovgraph.model.config_sections import HIGHEST_LATITUDE_DEG
from rovgraph.model.grids import convergence_and_scale, warn_outside
from rovgraph.model.origin import Frame, frame_of
from rovgraph.problem.acoustics import unusable_acoustics
from rovgraph.problem.beams import beam_sensors
from rovgraph.problem.layers import layer_sensors, with_knots
from rovgraph.problem.motion import SCALES, has_constant_velocity, motion_model, scatter, ticks
from rovgraph.sensors import SENSORS
from rovgraph.sensors.compass import reference
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.dvl_sound import SoundCorrection
from rovgraph.sensors.earth_field import (
    BLACKOUT_NT,
    CAUTION_NT,
    EarthField,
    decimal_year,
    declination_per_km,
    earth_field,
)
from rovgraph.sensors.instruments import OFFSETS, heading_sources
from rovgraph.sensors.pressure import waves_at_surface

WITHIN_S = 30.0  # from the log's start: first headings and fixes
ENOUGH_SAMPLES = 100  # that show the IMU's noise
TILT = "vehicle_tilt"
BOTTOM = "bottom_velocity"
BOAT_ACC = 0.5  # noise density of a boat's acceleration: less takes its turns for those of the bottom [m/s2/rtHz]


@dataclass
class Resolution:
    """A dive whose configuration is being completed.

    Attributes
    ----------
    log : the dive, or its first seconds
    config : as far as it is resolved
    expected : streams that may still come, beside those of the log
    in_use : streams that are used, or may still be
    assumptions : what was assumed, one line each
    by_gyro : whether the gyro shows the heading at the start, by the Earth's rate
    """

    log: Log
    config: Config
    expected: frozenset[str] = frozenset()
    in_use: set[str] = field(default_factory=set)
    assumptions: list[str] = field(default_factory=list)
    by_gyro: bool = False

    def assume(self, line: str, **values: Any) -> None:
        """Note an assumption, and what it states: sections with their keys."""
        self.assumptions.append(line)
        self.config = self.config.with_values(**values)

    @property
    def sources(self) -> list[str]:
        """Heading sources of the log that are used."""
        return heading_sources(self.config, self.log.sensors)

    def refuse(self, why: str) -> InputError:
        """The error of a log that cannot be estimated."""
        return InputError(f"{self.log.source}: {why}")


def resolve(log: Log, config: Config, expected: Collection[str] = ()) -> Resolution:
    """Complete a configuration by a log.

    Parameters
    ----------
    log, config, expected : of `rovgraph.inference.initialise.initialise`

    Raises
    ------
    InputError : the log lacks what an estimate needs, or contradicts the configuration
    """
    dive = Resolution(log, config, frozenset(expected), {*log.sensors, *expected})
    for resolve_subject in PASSES:
        resolve_subject(dive)
    return dive


def _motion(dive: Resolution) -> None:
    """The motion model; without an IMU, `ticks` take the place of its samples."""
    log, config = dive.log, dive.config
    config = config.with_values(motion={"model": motion_model(config, log.sensors)})
    dive.config = config
    if not has_constant_velocity(config):
        if "imu" not in log:
            raise dive.refuse("no IMU, columns acc_x..acc_z and gyr_x..gyr_z are needed, or else roll and pitch")
        dive.in_use.discard(TILT)
        return
    if TILT not in log:
        raise dive.refuse("motion.model constant_velocity needs columns roll and pitch")
    for asked, key in _needs_imu(dive):
        if asked:
            raise dive.refuse(f"{key} needs an IMU, columns acc_x..acc_z and gyr_x..gyr_z")
    _bed_that_may_move(dive)
    why = "the IMU is left out" if "imu" in log else "the log has no IMU"
    motion, given = dive.config.motion, dive.config.calibration
    held: dict[str, Any] = {name: {"estimate": False} for name in SCALES}
    for name in unseen(log.sensors):
        entry = getattr(given, name)
        if entry.estimate is True and not (name in given.model_fields_set and "estimate" in entry.model_fields_set):
            held[name] = {"estimate": CONSIDERED}
    dive.assume(
        f"{why}: constant velocity between measurements, walking by {motion.acc:g} m/s2/rtHz, "
        f"and attitude by {motion.gyr:g} rad/s/rtHz (motion.acc, motion.gyr)",
        calibration=held,
        environment={"earth_rotation": False},
    )
    dive.log = replace(log, streams={**log.streams, "imu": ticks(log)})


def _bed_that_may_move(dive: Resolution) -> None:
    """A vehicle with neither IMU nor depth is a boat, and rivers move their beds: they are surveyed for that.

    Only position fixes would show it, so it is estimated unless the configuration states otherwise.
    """
    bottom, motion = getattr(dive.config.calibration, BOTTOM), dive.config.motion
    if "depth" in dive.log or "dvl" not in dive.log or bottom.estimate != AUTO:
        return
    dive.assume(
        f"no depth either, so it is a boat, under which the bed may move by {bottom.sd:g} m/s; "
        f"calibration.{BOTTOM}: {{estimate: false}} if it rests",
        calibration={BOTTOM: {"estimate": True}},
        motion={} if "acc" in motion.model_fields_set else {"acc": BOAT_ACC},
    )


def unseen(sensors: Collection[str]) -> list[str]:
    """Calibration variables that a dive without an IMU does not show: against no gyro, deviation curves need fixes.

    How a heading walks is a poor gyro: it would take a curve for likely that makes the vehicle turn less.
    """
    return [] if "fix" in sensors else [name for name in TABLE if name.endswith("_deviation")]


def _needs_imu(dive: Resolution) -> list[tuple[bool, str]]:
    """Features that need an IMU: whether each is requested, and by which key."""
    config, priors = dive.config, beliefs(dive.config)
    shown_by_imu = (*SCALES, *(name for name in priors if name.endswith("_time_offset")))
    return [
        (config.graph.hydrodynamics, "graph.hydrodynamics"),
        (
            "mag" in dive.sources and config.environment.dip_deg is None,
            "environment.dip_deg: null, as the heading is a magnetometer's,",
        ),
        *((priors[name].estimate, f"calibration.{name}: {{estimate: true}}") for name in shown_by_imu),
    ]


def _velocities_and_positions(dive: Resolution) -> None:
    """Acoustic streams that cannot be used, and pings by their beams."""
    log, config = dive.log, dive.config
    unusable = unusable_acoustics(config, dive.in_use)
    beams, why_not = beam_sensors(config, log.streams)
    if not log.sensors - unusable.keys() & {"dvl", "fix", *ACOUSTICS} and not beams:
        raise dive.refuse(
            "neither DVL (dvl_vx, dvl_vy, dvl_vz) nor position fixes, one of them is needed"
            + "".join(f"; {sensor} is left out: {why}" for sensor, why in unusable.items())
        )
    dive.in_use -= unusable.keys()
    dive.in_use |= {*beams}
    dive.assumptions += [f"{sensor} is left out: {why}" for sensor, why in unusable.items() if sensor in log]
    if beams:
        dive.assume(f"pings of the DVL by their {len(beams) - 1} beams, at {config.dvl.beams.angle_deg:g} deg")
    dive.assumptions += [why_not] if why_not else []


def _layers(dive: Resolution) -> None:
    """Profiles of the water, with the knots of the current."""
    layers, why_not = layer_sensors(dive.config, dive.log.streams, dive.expected)
    if layers:
        dive.config = with_knots(dive.config, dive.log.streams, whole=not dive.expected)
        knots, spacing = dive.config.water.knots, dive.config.water.knot_m
        about = f"{knots} knots {spacing:.3g} m apart about the vehicle's depth"
        said = "one, that of the cells' depth" if knots == 1 else about
        dive.assume(f"profiles of the water are used; the current: {said}")
        if "dvl_water" in dive.log:
            dive.assume("dvl_water is left out: it is a mean of the cells of the profiles")
        dive.in_use -= {"dvl_water"}
        dive.in_use |= {*layers}
    dive.assumptions += [why_not] if why_not else []


def _thrusters(dive: Resolution) -> None:
    """Thruster signals: used where hydrodynamics are asked for and they do not come later."""
    log, config = dive.log, dive.config
    dive.in_use -= {"thruster"}
    if not config.graph.hydrodynamics or ("thruster" in dive.expected and "thruster" not in log):
        return
    wanted = len(config.vehicle.thrusters)
    if "thruster" not in log:
        raise dive.refuse("graph.hydrodynamics needs thruster signals, columns thruster_1, thruster_2, ...")
    if len(log["thruster"].columns) != wanted:
        raise dive.refuse(
            f"{len(log['thruster'].columns)} thruster columns, vehicle.thrusters has {wanted}; "
            "describe every thruster in the configuration"
        )
    dive.in_use |= {"thruster"}


def convergence(log: Log, config: Config) -> float | None:
    """Where grid north points at the origin [deg]; None where no compass is relative to it, or it is stated.

    Raises
    ------
    InputError : the grid or the place is not known
    """
    of_grid = [source for source in heading_sources(config, log.sensors) if reference(config, source) == "grid"]
    env = config.environment
    if not of_grid or env.convergence_deg is not None:
        return None
    if env.grid is None or log.origin is None:
        lacking = "environment.grid, such as EPSG:32632" if env.grid is None else "the origin or fixes on Earth"
        raise InputError(f"{of_grid[0]} is relative to a grid's north, which needs {lacking}, or convergence_deg")
    return float(convergence_and_scale(env.grid, *np.array(log.origin))[0])


def field_by_place(log: Log) -> EarthField | None:
    """The Earth's field where a dive begins; None where the log knows no place or date."""
    if log.origin is None or not is_unix(log.start):
        return None
    return earth_field(*log.origin, 0.0, decimal_year(log.start))


def slope_by_place(log: Log) -> tuple[float, float]:
    """Change of the declination by a kilometre north and east where a dive begins [deg/km]; 0 where it is not known."""
    if log.origin is None:
        return 0.0, 0.0
    north, east = declination_per_km(*log.origin, decimal_year(log.start))
    return round(north, 5), round(east, 5)


def declination_by_place(log: Log, config: Config) -> EarthField | None:
    """The field that the declination is taken from: where none is stated, and no compass may have taken it already."""
    norths = [reference(config, source) for source in heading_sources(config, log.sensors)]
    if "declination_deg" in config.environment.model_fields_set or None in norths or "magnetic" not in norths:
        return None
    return field_by_place(log)


def dip_of_log(log: Log) -> float:
    """Dip of the field by the magnetometer against gravity [deg], the median of the log."""
    imu, mag = log["imu"], log["mag"]
    f = np.column_stack([np.interp(mag.time, imu.time, a) for a in imu.data[:, :3].T])
    sine = -np.sum(f * mag.data, axis=1) / (np.linalg.norm(f, axis=1) * np.linalg.norm(mag.data, axis=1))
    return float(np.rad2deg(np.arcsin(np.clip(np.nanmedian(sine), -1.0, 1.0))))


def _norths(dive: Resolution) -> None:
    """The norths of the compasses in use: convergence by the grid, declination, dip and blackout by place and date."""
    log, config, sources = dive.log, dive.config, dive.sources
    if (found := convergence(log, config)) is not None:
        line = f"environment.convergence_deg {found:.3f}, of {config.environment.grid} at the origin"
        dive.assume(line, environment={"convergence_deg": found})
    magnetic = [source for source in sources if reference(config, source) in ("magnetic", None)]
    earths = field_by_place(log) if magnetic else None
    if earths is None:
        return
    weak = f"the horizontal field is {earths.horizontal_nt:.0f} nT by WMM2025"
    if earths.horizontal_nt < BLACKOUT_NT and config.heading.sources is None:
        line = f"no heading from {', '.join(magnetic)}: {weak}; name it under heading.sources to use it"
        dive.assumptions.insert(0, line)
        kept = tuple(SENSORS[source].heading_source for source in sources if source not in magnetic)
        dive.config = dive.config.with_values(heading={"sources": kept})
        return
    if earths.horizontal_nt < CAUTION_NT:
        dive.assume(f"compasses show little here: {weak}, and storms turn them by many degrees")
    expired = ", which ends before that date: use a newer rovgraph, or state it" if earths.expired else ""
    if (taken := declination_by_place(log, config)) is not None and earths.horizontal_nt >= BLACKOUT_NT:
        slope = config.environment.declination_per_km_deg or slope_by_place(log)
        dive.assume(
            f"environment.declination_deg {taken.declination_deg:.2f} within {taken.declination_sd_deg:.1f} deg, by "
            f"WMM2025 at the origin and the date of the log, by km north and east "
            f"{slope[0]:+.4f} and {slope[1]:+.4f} deg{expired}",
            environment={"declination_deg": round(taken.declination_deg, 2), "declination_per_km_deg": slope},
            calibration=_no_better_than(config, magnetic, taken.declination_sd_deg),
        )
    if "mag" in sources and config.environment.dip_deg is None:
        dive.assume(
            f"environment.dip_deg {earths.dip_deg:.1f}, by WMM2025{expired}",
            environment={"dip_deg": round(earths.dip_deg, 2)},
        )


def _no_better_than(config: Config, sources: Sequence[str], sd_deg: float) -> dict[str, Any]:
    """Offsets of compasses that are stated better than the declination is known, as well as that is."""
    entries = {}
    for name in (OFFSETS[source] for source in sources):
        entry = getattr(config.calibration, name)
        own = 0.0 if entry.estimate is False else entry.sd_deg
        if own is not None:  # the sd of one that is not stated is far larger
            entries[name] = {"estimate": True, "sd_deg": float(np.hypot(own, sd_deg))}
    return entries


def _grid_of_results(dive: Resolution) -> None:
    """What the grid of the results is like at the origin.

    Raises
    ------
    InputError : no such grid; it does not reach there
    """
    grid = dive.config.environment.grid
    if grid is not None and dive.log.origin is not None:
        lat, lon = dive.log.origin
        warn_outside(lon, lat, grid)
        north, scale = (float(x) for x in convergence_and_scale(grid, *np.array([lat, lon])))
        turned_by = f"its north is {north:+.3f} deg from true north at the origin"
        dive.assume(f"results are in {grid}, too: {turned_by}, where a metre is {scale:.5f} m of the grid")


def _magnetometer(dive: Resolution) -> None:
    """Magnitude and dip of the field, by the log where place and date do not give them."""
    env = dive.config.environment
    if "mag" not in dive.sources:
        return
    if env.field_norm is None:
        norm = float(np.median(np.linalg.norm(dive.log["mag"].data, axis=1)))
        dive.assume(f"environment.field_norm {norm:.4g}, the median of the log", environment={"field_norm": norm})
    if env.dip_deg is None:
        dip, hint = dip_of_log(dive.log), ""
        if not beliefs(dive.config)["field_dip"].estimate:
            hint = ", and held, with the error of the levelling in it: give it, or estimate calibration.field_dip"
        dive.assume(f"environment.dip_deg {dip:.1f}, from the log{hint}", environment={"dip_deg": dip})


def _frame(dive: Resolution) -> None:
    """The frame of the dive, with the latitude and the Earth's rotation."""
    log, config, env = dive.log, dive.config, dive.config.environment
    frame = _frame_of(log, config)
    values: dict[str, Any] = {"frame": frame}
    if log.origin is not None and (env.latitude_deg is None or frame == "earth"):
        values["latitude_deg"] = log.origin[0]
    dive.config = config.with_values(environment=values)
    if frame == "earth":
        _on_earth(dive, chosen=env.frame == "auto")
    env = dive.config.environment
    if env.earth_rotation and env.latitude_deg is None:
        raise InputError(
            "environment.earth_rotation needs environment.latitude_deg or origin_lat_deg, as the log has no fix_lat"
        )


def _frame_of(log: Log, config: Config) -> Frame:
    """That of the log's origin, or by the latitude alone.

    Raises
    ------
    InputError : its fixes are in the other one
    """
    if log.origin is None:
        way = length_of_way(log["dvl"].time, log["dvl"].data[:, :3]) if "dvl" in log else 0.0
        return config.frame_at(config.environment.latitude, way=way)
    frame = frame_of(log.origin)
    if config.environment.frame not in ("auto", frame):
        raise InputError(
            f"{log.source}: was read in frame {frame}, and environment.frame is {config.environment.frame}; "
            "read it with this configuration"
        )
    return frame


def _on_earth(dive: Resolution, chosen: bool) -> None:
    """What frame "earth" sets: the Earth's rotation, and gravity at the origin where it is not stated.

    Raises
    ------
    InputError : the latitude is unknown, or too high
    """
    config, env = dive.config, dive.config.environment
    latitude, values = env.latitude_deg, dict[str, Any]()
    if latitude is None:
        raise InputError(
            "environment.frame: earth needs environment.latitude_deg or origin_lat_deg, as the log has no fix_lat"
        )
    if abs(latitude) > HIGHEST_LATITUDE_DEG:
        raise InputError(
            f"environment.frame: earth reaches to latitude {HIGHEST_LATITUDE_DEG:g} deg, and the origin is at "
            f"{latitude:.4g}; state environment.frame: flat"
        )
    if not has_constant_velocity(config):
        if env.earth_rotation is False:
            raise InputError("environment.frame: earth turns with the Earth; remove environment.earth_rotation: false")
        values["earth_rotation"] = True
    text = f"frame earth: WGS 84 at latitude {latitude:.4g} deg, with the Earth's rotation"
    if chosen:
        good = config.imu.gyr_bias_sd_dps <= GOOD_GYRO_DPS
        text += f" ({'as the gyro is good' if good else 'as the way is too long for a plane'})"
    if env.gravity_mps2 is None:
        values["gravity_mps2"] = normal_gravity(float(np.deg2rad(latitude)))
        text += f" and normal gravity, {values['gravity_mps2']:.5f} m/s2 at the origin"
    dive.assume(text, environment=values)


def _gravity(dive: Resolution) -> None:
    """Gravity by latitude and by the depth at the start, which holds for the dive."""
    env, depth = dive.config.environment, dive.config.start.down_m
    if env.gravity_mps2 is not None:
        return
    if env.latitude is None or has_constant_velocity(dive.config):
        dive.config = dive.config.with_values(environment={"gravity_mps2": env.gravity})
        return
    if depth is None:
        depth = float(np.median(dive.log["depth"].data[:9, 0])) if "depth" in dive.log else 0.0
    gravity = float(env.gravity_at(depth))
    dive.assume(
        f"environment.gravity_mps2 {gravity:.4f}, normal gravity at latitude {env.latitude:.1f} and a depth of "
        f"{depth:.0f} m",
        environment={"gravity_mps2": gravity},
    )


def sample_density(time: Array, samples: Array) -> float:
    """Noise density that samples show by themselves, robust against knocks [unit/rtHz].

    Parameters
    ----------
    time : ndarray, shape (n,)
    samples : ndarray, shape (n, 3)
    """
    return float(np.mean(1.4826 * np.median(np.abs(scatter(time, samples)), axis=0)))


def _noise(dive: Resolution) -> None:
    """Raise the IMU's noise densities to what its samples scatter in this dive."""
    imu, noise = dive.log["imu"], dive.config.imu.noise
    if len(imu) < ENOUGH_SAMPLES or has_constant_velocity(dive.config):
        return
    for name, columns in (("acc", slice(0, 3)), ("gyr", slice(3, 6))):
        seen, believed = sample_density(imu.time, imu.data[:, columns]), getattr(noise, name)
        if seen > NOISIER * believed:
            line = f"imu.noise.{name} {seen:.2g} instead of {believed:.2g}: the samples scatter that much"
            dive.assume(line, imu={"noise": {name: seen}})


def _waves(dive: Resolution) -> None:
    """The waves' pressure at the surface, where depths scatter there far more than they should."""
    log, depth = dive.log, dive.config.depth
    if "depth" not in log or depth.waves_m is not None:
        return
    seen, waves = waves_at_surface(log["depth"].time, log["depth"]["depth"]), 0.0
    if seen > NOISIER * depth.sd_m:
        waves = round(float(np.sqrt(seen**2 - depth.sd_m**2)), 3)
        dive.assume(f"depth.waves_m {waves:g}, as depths scatter at the surface; less further down")
    dive.config = dive.config.with_values(depth={"waves_m": waves})


def _sound(dive: Resolution) -> None:
    """How the DVL was corrected for the speed of sound; where it was not, its scale keeps its wide prior."""
    log, config = dive.log, dive.config
    stream = next((log[sensor] for sensor in ("dvl", BEAMS, "dvl_water") if sensor in log), None)
    if not config.knows_sound_speed or stream is None:
        return
    worked_with, true = SoundCorrection(config).speeds(water_at(stream.time, log.streams))
    ratio = true / worked_with
    if np.isfinite(ratio).all():
        what = "vertical velocities" if config.dvl.beams.phased else "velocities"
        dive.assume(
            f"speed of sound {_span(true, 0)} m/s, the DVL worked with {_span(worked_with, 0)}: its {what} and ranges "
            f"are multiplied by {_span(ratio, 3)}"
        )
        return
    lacking = "water_temperature" if np.isfinite(worked_with).all() else "dvl_sound_speed"
    dive.assume(
        f"the DVL is not corrected for the speed of sound: the log has no {lacking}; state dvl.sound_speed_mps and "
        "dvl.sound_speed_set_mps",
        dvl={"sound_speed_set_mps": None},
    )


def _span(values: Array, digits: int) -> str:
    low, high = (f"{v:.{digits}f}" for v in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _heading(dive: Resolution) -> None:
    """What the heading rests on, and with it the priors of compasses; what no sensor checks."""
    log, sources = dive.log, dive.sources
    compass = unchecked_compass(dive.config, heading_sources(dive.config, dive.in_use), log.sensors)
    dive.config = config = with_priors_stated(dive.config, compass)
    begin = log["imu"].time[0]
    shown = any(len(log[source].between(begin, begin + WITHIN_S)) for source in sources)
    if config.start.heading_deg is None and not shown:
        dive.by_gyro, dive.config = True, with_earth_rate(log, config, sources)
        dive.assume(f"heading from the Earth's rate by the gyro, {without_turns(dive.config, log.origin)}")
    else:
        dive.assume("heading from " + (", ".join(sources) or "start.heading_deg alone: it will drift"))
    resting = unchecked(dive.config, sources, log.sensors, dive.expected, dive.by_gyro)
    if compass:
        line = nothing_checks(resting.pop(0), turns_show=not has_constant_velocity(config))
        dive.assumptions.insert(0, line)
    dive.assumptions += resting


PASSES: tuple[Callable[[Resolution], None], ...] = (
    _motion,
    _velocities_and_positions,
    _layers,
    _thrusters,
    _norths,
    _grid_of_results,
    _magnetometer,
    _frame,
    _gravity,
    _noise,
    _waves,
    _sound,
    _heading,
)
