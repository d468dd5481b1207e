"""The first screen and the verdict, in plain words: how good the track is, what limits it, and what to do next time.

Sources of variance are grouped by what a person can change.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePath
from typing import Any

import numpy as np

from rovgraph.model.calibration import BEAM_SENSORS
from rovgraph.report.assumptions import leading
from rovgraph.report.pages.page import Opening, PageTable, Section
from rovgraph.report.pages.source import DiveSource, PageTrack
from rovgraph.report.pages.track import track_chart, track_notes
from rovgraph.report.units import duration, plus_minus, words

HEADING = (
    *("mag", "ahrs", "dvl_heading", "vehicle_heading", "hard_iron", "soft_iron", "field_"),
    *("dvl_compass", "vehicle_compass", "start attitude"),
)


@dataclass(frozen=True)
class Cause:
    """A group of sources.

    Attributes
    ----------
    sources : how their names in summary.json begin; a source belongs to the first group that has it
    text : what limits, in words
    advice : what to do next time
    known : whether no way travelled adds to it: it stands whatever the DVL sees
    """

    sources: tuple[str, ...]
    text: str
    advice: str
    known: bool = False


CAUSES = (
    Cause(
        ("start position",),
        "the position at the start",
        "take a position fix at the start, or state start.position_sd_m where it is known better",
        known=True,
    ),
    Cause(
        ("usbl", "range", "ship", "sound_speed", "beacon"),
        "the acoustic positioning (noise, alignment, beacons)",
        "move beside the ship or round the beacon, so that the alignment shows, or state usbl and range more precisely",
    ),
    Cause(
        ("water_layer", "adcp"),
        "the current, as profiles of the water show it",
        "stay at the surface with fixes for some minutes before the dive, with the ADCP on",
    ),
    Cause(("fix",), "the position fixes", "take better fixes, or state fix.sd_m where they are better", known=True),
    Cause(
        HEADING,
        "the heading (compasses and their calibration)",
        "turn two full circles in calm water to show the compasses, and calibrate the magnetometer",
    ),
    Cause(
        ("dvl_yaw", "dvl_roll", "dvl_pitch"),
        "the mounting of the DVL",
        "take position fixes at both ends of a long straight line, or measure the mounting and state its sd",
    ),
    Cause(
        ("dvl_scale",),
        "the scale of the DVL",
        "take position fixes at both ends of a long straight line, and state the sound speed",
    ),
    Cause(
        ("dvl",),
        "the small errors of the DVL's velocity, which add up over the way",
        "take a position fix now and then, or pass a place twice that a camera or a sonar recognises",
    ),
    Cause(
        ("imu", "gyr", "acc", "start bias", "start velocity"),
        "the noise and biases of the inertial unit",
        "use a DVL throughout or take position fixes more often, and state the unit's noise (rovgraph calibrate noise)",
    ),
    Cause(
        ("thruster", "drag", "current"),
        "the current and the model of the thrusters",
        "keep a DVL's bottom lock, or take position fixes more often",
    ),
)


def largest_cause(sources: Mapping[str, float]) -> tuple[Cause, float] | None:
    """The group that brings the most, and its share; None where the sources have no variance or no group."""
    total, found = sum(sources.values()), dict.fromkeys(CAUSES, 0.0)
    for name, variance in sources.items():
        cause = next((c for c in CAUSES if name.startswith(c.sources)), None)
        if cause is not None:
            found[cause] += variance
    cause = max(CAUSES, key=found.__getitem__)
    return (cause, found[cause] / total) if found[cause] > 0 else None


ALIKE = 0.97  # a radius at the end of this part of the largest is stated once
LOPSIDED = 1.5  # ratio of sd across and along beyond which one of them limits
MOST = 0.5  # of the variance: where that much is older than the way since the last fix, the way is not what limits
SHORT = 0.2  # displacement, as a part of the distance, below which directions mean little

GOOD = {
    "trusted": "Nothing in the log contradicts this track.",
    "doubtful": "Use this track with care: something in the log does not fit.",
    "wrong": "Do not use this track: the sensors contradict each other.",
}


def opening(source: DiveSource) -> Opening:
    """The first screen: map, verdict, where and when, and five numbers."""
    summary = source.summary
    named = (("alarm", "alarms"), ("warning", "warnings"), ("piece of advice", "pieces of advice"))
    lengths = (len(summary.get(key) or []) for key in ("alarms", "warnings", "advice"))
    return Opening(
        chart=track_chart(source),
        verdict=str(summary.get("verdict", "unknown")),
        sentences=[how_good(source), *_why(source), *limits(source)],
        facts=_facts(source),
        numbers=_five(source),
        counts=[f"{n} {one if n == 1 else many}" for n, (one, many) in zip(lengths, named, strict=True) if n],
        print_notes=print_notes(source),
        tables=[_numbers(source)],
    )


def verdict_section(source: DiveSource) -> Section:
    """Alarms, warnings, advice and assumptions behind the verdict."""
    summary = source.summary
    first, others = leading(summary.get("assumptions") or [])
    lists = {
        "Alarms": [f"{a.get('severity', '')}: {a.get('text', '')}" for a in summary.get("alarms") or []],
        "Warnings about the log": summary.get("warnings") or [],
        "Assumed: what matters for this track": first,
        "Assumed beside it": others,
        "Advice: no evidence of error": [str(a.get("text", "")) for a in summary.get("advice") or []],
    }
    notes = [source.other_version] if source.other_version else []
    lead = [*notes, *track_notes(source)]
    known = {name: lines for name, lines in lists.items() if lines}
    return Section("verdict", "Alarms and assumptions", lead, [_numbers(source)], known)


def _why(source: DiveSource) -> list[str]:
    """The first alarm without its remedy, of a dive that can be used with care."""
    alarms = source.summary.get("alarms") or []
    if source.summary.get("verdict") != "doubtful" or not alarms:
        return []
    return [f"Why: {str(alarms[0].get('text', '')).partition('; ')[0]}."]


def _facts(source: DiveSource) -> list[str]:
    """Vehicle, date and place as far as they are known, and the log."""
    facts = []
    unix = source.main["unix_time"][0]
    if np.isfinite(unix):
        facts.append(f"{datetime.fromtimestamp(float(unix), UTC):%d %B %Y, %H:%M} UTC".lstrip("0"))
    place = source.summary.get("origin")
    if isinstance(place, dict) and all(isinstance(place.get(k), int | float) for k in ("lat_deg", "lon_deg")):
        lat, lon = float(place["lat_deg"]), float(place["lon_deg"])
        facts.append(f"{abs(lat):.4f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.4f}° {'E' if lon >= 0 else 'W'}")
    return [*facts, " + ".join(PurePath(log).name for log in str(source.summary.get("log", "")).split(" + "))]


def _five(source: DiveSource) -> dict[str, str]:
    """Duration, distance, depth, and the sds of position and heading at the end."""
    summary, track = source.summary, source.main
    down = track["down"][np.isfinite(track["down"])]
    distance = summary.get("distance_m")
    ends = [_shortest(depth) for depth in (down.min(), down.max())] if len(down) else ["unknown"]
    heading = float(np.rad2deg(track["yaw_sd"][-1]))
    wrong = summary.get("verdict") == "wrong"  # the sds are those of a dive that did not happen
    return {
        "duration": duration(summary.get("duration_s")),
        "distance": f"{distance:.4g} m" if isinstance(distance, int | float) else "unknown",
        "depth": " to ".join(dict.fromkeys(ends)) + (" m" if len(down) else ""),
        "position sd at the end": "not valid" if wrong else _metres(track.horizontal_sd[-1]),
        "heading sd at the end": "not valid" if wrong else f"{heading:.2g}°" if np.isfinite(heading) else "unknown",
    }


def _shortest(depth: float) -> str:
    return f"{abs(depth) if abs(depth) < 0.05 else depth:.1f}"


def print_notes(source: DiveSource) -> dict[str, str]:
    """How the track was made, and by what, for the printed page."""
    summary = source.summary
    sensors = [f"{words(name)} ({n['used']})" for name, n in (summary.get("sensors") or {}).items() if n.get("used")]
    states, first = summary.get("keyframes"), leading(summary.get("assumptions") or [])[0]
    how = {
        "smoothed": "Maximum a posteriori estimate over the whole dive (factor graph)",
        "filtered": "Error-state filter: each time by what came before it",
    }.get(source.main.kind, "Dead reckoning from velocity and heading")
    method = f"{how}, {states or len(source.main)} states."
    if sensors:
        method += f" Measurements used: {', '.join(sensors)}."
    versions = {"rovgraph": summary.get("version"), **(summary.get("versions") or {})}
    signed = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    log = summary.get("input") or {}
    checksum = f"; log {log.get('path')}, SHA-256 {log.get('sha256')}" if log.get("sha256") else ""
    notes = {"Method": method, "Assumed": "; ".join(first), "Made with": f"{signed}{checksum}"}
    return {name: text for name, text in notes.items() if text}


def how_good(source: DiveSource) -> str:
    """The verdict and how far off the vehicle may be, in a sentence or two."""
    words = GOOD.get(str(source.summary.get("verdict")), "The verdict is not known.")
    if source.summary.get("verdict") == "wrong":
        return words  # its standard deviations are those of a dive that did not happen
    reach = source.main.ellipses[0]
    if not np.isfinite(reach).any():
        return f"{words} How far it may be off is not known."
    worst = int(np.nanargmax(reach))
    clock = source.clock
    when = clock(source.main["time"][worst : worst + 1])[0]
    limit = f"99 times in 100 the vehicle was within {_metres(reach[worst])} of it at the worst moment"
    trusted = words if source.summary.get("verdict") == "trusted" else f"{words} If the noise is as stated,"
    last = reach[-1] > ALIKE * reach[worst]
    moment = "the end" if last else f"{when:.0f} {clock.unit} after the start"
    further = f", and within {_metres(reach[-1])} at the end" if not last and np.isfinite(reach[-1]) else ""
    return f"{trusted} {limit} ({moment}){further}."


def limits(source: DiveSource) -> list[str]:
    """What limits the track, and what to do next time."""
    cause, advice = _cause(source)
    if not cause:
        return []
    return [f"What limits it: {cause}.", f"Next time: {advice}."]


def _cause(source: DiveSource) -> tuple[str, str]:
    """The largest cause of uncertainty, read from the estimate's own covariance, and its remedy."""
    alarms = source.summary.get("alarms") or []
    if source.summary.get("verdict") == "wrong" and alarms:
        text = str(alarms[0].get("text", ""))
        cause, _, remedy = text.partition("; ")
        return cause, remedy or "see the alarms below"
    track = source.main
    if not np.isfinite(track.horizontal_sd).any() or len(track) < 3:
        return "", ""
    found = largest_cause(_variance_sources(source))
    silent = _share_in_silence(source, track)
    if silent > 0.5 and not (found and found[0].known):
        return (
            f"{100 * silent:.0f} % of what the variance grew fell into times without a velocity from the DVL",
            "keep the DVL within its range of the bottom and see that it records throughout, or take a position fix "
            "after each silence",
        )
    if found:
        limit, share = found
        return f"{limit.text}: {100 * share:.0f} % of the position's variance where it is largest", limit.advice
    return _by_direction(source)


def _variance_sources(source: DiveSource) -> dict[str, float]:
    """Source -> variance [m^2], as the estimate found it; empty where it did not."""
    estimate = (source.summary.get("estimates") or {}).get(source.main.kind) or {}
    found = estimate.get("variance_sources") or {}
    return {str(name): float(variance) for name, variance in (found.get("m2") or {}).items()}


def _share_in_silence(source: DiveSource, track: PageTrack) -> float:
    """Share of the growth of the horizontal variance that fell into silences of the DVL."""
    growth = np.clip(np.diff(track.horizontal_sd**2, prepend=np.nan), 0.0, None)
    growth[~np.isfinite(growth)] = 0.0
    time = track["time"]
    inside = np.zeros(len(track), bool)
    for begin, end in source.silences:
        inside |= (time > begin) & (time <= end)
    total = float(growth.sum())
    return float(growth[inside].sum()) / total if total > 0 else 0.0


def _by_direction(source: DiveSource) -> tuple[str, str]:
    """Whether heading or speed limits: the sd across and along the way since the last fix."""
    main = source.main
    reach = main.ellipses[0]
    worst = int(np.nanargmax(reach))
    origin = _last_fix_before(source, main["time"][worst])
    ahead = np.array([main["north"][worst] - main["north"][origin], main["east"][worst] - main["east"][origin]])
    distance = float(np.hypot(*ahead))
    steps = np.hypot(np.diff(main["north"][origin : worst + 1]), np.diff(main["east"][origin : worst + 1]))
    since = "the last position fix" if origin else "the start"
    known = float(main.horizontal_sd[origin])
    if known**2 > MOST * main.horizontal_sd[worst] ** 2:
        return _position_there(source, known, since)
    if not {"dvl", "dvl_water", *BEAM_SENSORS} & _used(source):
        return (
            f"the errors of the inertial unit, which grow fast since {since}, as no DVL was used",
            "use a DVL, or take position fixes more often",
        )
    noise = (
        f"the small errors of the DVL's velocity, which add up over the way since {since}",
        "take a position fix now and then, or pass a place twice that a camera or a sonar recognises",
    )
    if distance < max(SHORT * float(np.nansum(steps)), 1.0):
        return noise
    u = ahead / distance
    cov = main["cov_north_east"][worst]
    cov = 0.0 if np.isnan(cov) else cov
    P = np.array([[main["north_sd"][worst] ** 2, cov], [cov, main["east_sd"][worst] ** 2]])
    across, along = (float(np.sqrt(max(d @ P @ d, 0.0))) for d in (np.array([-u[1], u[0]]), u))
    if across > LOPSIDED * along:
        return (
            f"the direction of travel (compass and mounting of the DVL), known to {np.rad2deg(across / distance):.1f}° "
            f"over the {distance:.0f} m from {since}",
            "take position fixes at both ends of a long straight line, and turn two full circles to show the compasses",
        )
    if along > LOPSIDED * across:
        return (
            f"the distance travelled (scale of the DVL), known to {100 * along / distance:.1f} % "
            f"over the {distance:.0f} m from {since}",
            "take position fixes at both ends of a long straight line, and state the sound speed",
        )
    return noise


def _position_there(source: DiveSource, known: float, since: str) -> tuple[str, str]:
    """Where most of the uncertainty stood at the last fix, or at the start, already."""
    if since == "the start":
        return (
            f"the position at the start, known to {_metres(known)} (one standard deviation)",
            "take a position fix at the start, or state start.position_sd_m where it is known better",
        )
    return (
        f"the position fixes, which give the position to {_metres(known)} (one standard deviation)",
        "take better fixes, or state fix.sd_m where they are better than that",
    )


def _used(source: DiveSource) -> set[str]:
    """Sensors of which a measurement counted; all that the summary names where residuals are missing."""
    rows = source.residuals
    return {*(source.summary.get("sensors") or {})} if rows is None else {*rows.loc[rows["weight"] > 0, "sensor"]}


def _last_fix_before(source: DiveSource, time: float) -> int:
    """Index of the epoch of the last fix that counted, 0 where there was none."""
    rows = source.residuals
    if rows is None:
        return 0
    fixes = rows.loc[(rows["sensor"] == "fix") & (rows["weight"] > 0) & (rows["time"] < time), "time"]
    return int(np.searchsorted(source.main["time"], fixes.iloc[-1])) if len(fixes) else 0


def _numbers(source: DiveSource) -> PageTable:
    """The dive in numbers."""
    s = source.summary
    end: dict[str, Any] = s.get("end") or {}

    def with_sd(name: str, unit: str) -> str:
        short = {"m": "m", "°": "deg"}[unit]
        number, sd = end.get(f"{name}_{short}"), end.get(f"{name}_sd_{short}")
        return plus_minus(np.nan if number is None else number, np.nan if sd is None else sd, unit)

    distance = s.get("distance_m")
    rows = [
        ("log", str(s.get("log", "unknown"))),
        ("duration", duration(s.get("duration_s"))),
        ("distance", f"{distance:.4g} m" if isinstance(distance, int | float) else "unknown"),
        ("end, north", with_sd("north", "m")),
        ("end, east", with_sd("east", "m")),
        ("end, down", with_sd("down", "m")),
        ("end, heading", with_sd("heading", "°")),
    ]
    return PageTable(f"The dive in numbers, {source.main.name}, ± one standard deviation", ("", ""), rows)


def _metres(value: float) -> str:
    if not np.isfinite(value):
        return "unknown"
    return f"{value:.2g} m" if value < 10 else f"{value:.0f} m"
