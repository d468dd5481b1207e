"""Named motions. Initial heading and the phases of the waves are drawn."""

from collections.abc import Callable

import numpy as np

from fault_campaign.motion import Motion, Profile

TURN = np.pi / 2.0
Builder = Callable[[], Motion]


def _survey(seconds: float = 180.0) -> Motion:
    """At rest for 8 s, then legs of 15 s at 0.5 m/s with turns of 90 degrees, and a halt on every second leg."""
    surge, heading, side = [(8.0, 4.0, 0.5)], [], 1.0
    for k, begin in enumerate(np.arange(25.0, seconds - 12.0, 20.0)):
        if k % 2 == 0:
            surge += [(begin - 8.0, 3.0, -0.5), (begin - 4.0, 3.0, 0.5)]
        heading.append((begin, 6.0, side * TURN))
        side = -side if k % 2 else side
    heave = [(40.0, 3.0, 0.1), (60.0, 3.0, -0.1)]
    return _motion(seconds, heading, surge, heave)


def _eights() -> Motion:
    """Figures of eight at 0.5 m/s."""
    heading = [(12.0, 50.0, 4.0 * TURN), (62.0, 50.0, -4.0 * TURN), (112.0, 50.0, 4.0 * TURN)]
    return _motion(180.0, heading, [(8.0, 4.0, 0.5)])


def _transit(seconds: float = 200.0) -> Motion:
    """Level, at 1 m/s, two turns of 90 degrees."""
    return _motion(seconds, [(70.0, 10.0, TURN), (130.0, 10.0, -TURN)], [(8.0, 6.0, 1.0)])


def _dives() -> Motion:
    """A survey between 2 and 12 m depth."""
    survey = _survey()
    heave = [(30.0, 4.0, 0.3), (60.0, 4.0, -0.3), (90.0, 4.0, -0.3), (115.0, 4.0, 0.3), (130.0, 4.0, 0.2)]
    surge, sway, _ = survey.velocity_b
    return Motion(survey.duration, survey.heading, (surge, sway, Profile(0.0, heave)), survey.roll, survey.pitch)


def _hover() -> Motion:
    """Keeps a place, turns now and then."""
    heading = [(30.0, 10.0, TURN), (80.0, 15.0, -2.0 * TURN), (120.0, 10.0, TURN)]
    surge = [(20.0, 3.0, 0.1), (26.0, 3.0, -0.1), (60.0, 3.0, 0.15), (66.0, 3.0, -0.3), (72.0, 3.0, 0.15)]
    return _motion(150.0, heading, surge)


def _brisk() -> Motion:
    """Legs at 0.8 m/s with turns of 180 degrees within 3.5 s, at most 96 degrees a second."""
    heading = [(begin, 3.5, 2.0 * TURN * side) for begin, side in zip(range(25, 170, 16), (1, -1) * 5, strict=True)]
    return _motion(180.0, heading, [(8.0, 4.0, 0.8)])


def _moving_start() -> Motion:
    """Legs at 1.2 m/s for 400 s, under way from the first sample."""
    heading = [(begin, 12.0, 2.0 * TURN * side) for begin, side in ((80, 1), (170, -1), (260, 1), (350, -1))]
    return _motion(400.0, heading, [], speed=1.2)


def _river(turns: bool) -> Motion:
    """300 m at 1 m/s."""
    heading = [(100.0, 10.0, TURN), (200.0, 10.0, TURN)] if turns else []
    return _motion(306.0, heading, [(3.0, 6.0, 1.0)])


def _motion(
    seconds: float,
    heading: list[tuple[float, float, float]],
    surge: list[tuple[float, float, float]],
    heave: list[tuple[float, float, float]] | None = None,
    speed: float = 0.0,
) -> Motion:
    roll = [(begin, duration, 0.03) for begin, duration, _ in heading]
    back = [(begin + duration, duration, -0.03) for begin, duration, _ in heading]
    velocity = (Profile(speed, surge), Profile(0.0), Profile(0.0, heave or []))
    return Motion(seconds, Profile(0.0, heading), velocity, Profile(0.0, [*roll, *back]))


SCENARIOS: dict[str, Builder] = {
    "survey": _survey,
    "survey of 4 minutes": lambda: _survey(240.0),
    "long survey": lambda: _survey(360.0),
    "survey of 20 minutes": lambda: _survey(1200.0),
    "eights": _eights,
    "transit": _transit,
    "long transit": lambda: _transit(360.0),
    "dives": _dives,
    "hover": _hover,
    "brisk turns": _brisk,
    "moving start": _moving_start,
    "river": lambda: _river(False),
    "river with turns": lambda: _river(True),
}


def make_motion(name: str, rng: np.random.Generator) -> Motion:
    """A scenario; "..., waves" has an orbital motion of 0.15 m/s with roll and pitch of 3 degrees on it."""
    base, _, waves = name.partition(", ")
    motion = SCENARIOS[base]()
    height = 1.0 if waves else 0.03  # a vehicle is never entirely still
    phases = rng.uniform(0.0, 2.0 * np.pi, 9)
    heading = Profile(rng.uniform(-np.pi, np.pi), motion.heading.ramps)
    periods = (5.1, 6.7, 8.9)
    amplitudes = (0.15, 0.12, 0.1)
    velocity = [
        v.with_waves((height * a, period, phase))
        for v, a, period, phase in zip(motion.velocity_b, amplitudes, periods, phases[:3], strict=True)
    ]
    return Motion(
        motion.duration,
        heading.with_waves((height * 0.02, 7.3, phases[3])),
        (velocity[0], velocity[1], velocity[2]),
        motion.roll.with_waves((height * 0.05, 5.9, phases[4])),
        motion.pitch.with_waves((height * 0.04, 6.3, phases[5])),
        motion.depth,
    )
