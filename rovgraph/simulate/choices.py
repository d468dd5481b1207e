"""Options of a simulated dive beside its scenario and seed."""

from dataclasses import dataclass, fields
from math import hypot, isfinite
from numbers import Real
from typing import Any

from rovgraph.errors import InputError

CURRENT_MAX = 1.0  # that may be chosen [m/s]
MOST_CELLS = 255  # of a profile
DEEPEST_M = 11_000.0
DURATION_MAX = 6 * 3600.0  # beyond it the log outgrows the memory [s]
EVERYWHERE = frozenset({"noise", "outliers", "dropouts", "disturbances", "places", "false_places", "profiles"})


@dataclass(frozen=True)
class Choices:
    """Choices for a simulated dive; None = the scenario's.

    Attributes
    ----------
    duration : [s]
    speed : [m/s]
    variant : one of the scenario's variants
    current : north, east [m/s]
    disturbances : iron on the seabed
    depth : at which the dive begins [m]
    ship : what the ship of an acoustic system does, one of `rovgraph.simulate.scenario.MANOEUVRES`
    outliers : share of DVL pings that are wrong, 0 to 1
    dropouts : intervals (from, to) [s] without bottom lock
    places : north, east [m] of places that a camera recognises
    false_places : share of the matches that are false, from 0 to below 1
    profiles : length of a cell [m] and number of cells of an ADCP's profiles; None = without
    noise : with noise, biases and drawn errors of vehicle and sensors
    """

    duration: float | None = None
    speed: float | None = None
    variant: str | None = None
    current: tuple[float, float] | None = None
    disturbances: bool | None = None
    depth: float | None = None
    ship: str | None = None
    outliers: float = 0.0
    dropouts: tuple[tuple[float, float], ...] = ()
    places: tuple[tuple[float, float], ...] = ()
    false_places: float = 0.0
    profiles: tuple[float, float] | None = None
    noise: bool = True

    def __post_init__(self) -> None:
        """Refuse what no scenario can give.

        Raises
        ------
        InputError : an entry that is not a number or a pair; an invalid duration, time without bottom lock or
            place
        """
        self._require_numbers()
        if self.duration is not None and self.duration > DURATION_MAX:
            raise InputError(f"duration of {self.duration} s: at most {DURATION_MAX:.0f} s")
        if self.depth is not None and not 0.0 <= self.depth <= DEEPEST_M:
            raise InputError(f"depth of {self.depth} m: between 0 and {DEEPEST_M:g} m are expected")
        if self.profiles is not None and not (self.profiles[0] > 0.0 and 1 <= self.profiles[1] <= MOST_CELLS):
            raise InputError(f"profiles {self.profiles!r}: length and number (to {MOST_CELLS}) of cells, as (4, 25)")
        for first, last in self.dropouts:
            if not 0.0 <= first < last:
                raise InputError(f"dropout {first:g}:{last:g}: two times in seconds are expected, as 100:130")
        for north, east in self.places:
            if not (isfinite(north) and isfinite(east)):
                raise InputError(f"place {north:g}:{east:g}: north and east in metres are expected, as 10:-5")

    def _require_numbers(self) -> None:
        for name in ("duration", "speed", "depth", "outliers", "false_places"):
            value = getattr(self, name)
            if not (value is None or isinstance(value, Real)):
                raise InputError(f"{name} {value!r}: a number is expected")
        if not (self.current is None or _is_pair(self.current)):
            raise InputError(f"current {self.current!r}: north and east in m/s are expected, as (0.1, -0.05)")
        if not (self.profiles is None or _is_pair(self.profiles)):
            raise InputError(f"profiles {self.profiles!r}: length and number of cells are expected, as (4, 25)")
        for name, example in (("dropouts", "((100, 130),)"), ("places", "((10, -5),)")):
            pairs = getattr(self, name)
            if not (isinstance(pairs, tuple | list) and all(map(_is_pair, pairs))):
                raise InputError(f"{name} {pairs!r}: pairs of numbers are expected, as {example}")

    def summary(self) -> dict[str, Any]:
        """Entries of ``summary.json``: the common ones always, the others where they were chosen."""
        common = {"speed_mps": self.speed, "outlier_share": self.outliers, "noise": self.noise}
        others = {name: getattr(self, name) for name in ("variant", "current", "disturbances", "depth", "ship")}
        others |= {name: getattr(self, name) or None for name in ("dropouts", "places", "false_places", "profiles")}
        return common | {name: value for name, value in others.items() if value is not None}

    def require(self, scenario: str, known: frozenset[str], variants: tuple[str, ...] = ()) -> None:
        """Refuse what a scenario cannot give.

        Parameters
        ----------
        scenario : its name
        known : names of the choices it has, beside those that all have
        variants : that it has

        Raises
        ------
        InputError : a choice or a variant that the scenario does not have, a current out of bounds
        """
        default: Any = Choices()
        for name in (f.name for f in fields(self)):
            if name not in EVERYWHERE | known and getattr(self, name) != getattr(default, name):
                has = f"it has {', '.join(sorted(known))}" if known else "it has none of its own"
                raise InputError(f"scenario {scenario}: no choice of {name}; {has}")
        if self.current is not None and not hypot(*self.current) <= CURRENT_MAX:
            raise InputError(
                f"current of {self.current[0]:g}, {self.current[1]:g} m/s: at most {CURRENT_MAX} is expected"
            )
        if self.variant is not None and self.variant not in variants:
            raise InputError(f"scenario {scenario}: no variant {self.variant!r}; it has {', '.join(variants)}")


def _is_pair(value: object) -> bool:
    return isinstance(value, tuple | list) and len(value) == 2 and all(isinstance(one, Real) for one in value)
