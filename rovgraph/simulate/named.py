"""A dive by the name of its scenario, with the configuration for an estimator."""

import difflib
from dataclasses import replace
from importlib.resources import files

import numpy as np

from rovgraph.errors import InputError, kind_of
from rovgraph.model.config import Config, config_or_defaults, parse_config
from rovgraph.simulate.acoustic import has_acoustics, ship_path
from rovgraph.simulate.choices import Choices
from rovgraph.simulate.dive import Dive, simulate
from rovgraph.simulate.driven import DRIVEN, World
from rovgraph.simulate.environment import Magnetism, iron_near
from rovgraph.simulate.files import known
from rovgraph.simulate.path import Path
from rovgraph.simulate.scenario import SCENARIOS, scenario
from rovgraph.simulate.truth import Truth

NAMES = tuple(dict.fromkeys([*SCENARIOS, *DRIVEN]))
_KINEMATIC = frozenset({"duration", "speed", "depth", "ship"})
_OWN = Choices()


def require_known(name: str) -> None:
    """Refuse the name of a scenario that does not exist.

    Parameters
    ----------
    name : of a scenario

    Raises
    ------
    InputError : the name is not one of `NAMES`; with the nearest
    """
    if name not in NAMES:
        near = difflib.get_close_matches(name, NAMES, 1)
        hint = f", did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown scenario {name!r}{hint} (known: {', '.join(sorted(NAMES))})")


def simulated(name: str, seed: int, config: Config | None = None, choices: Choices = _OWN) -> tuple[Dive, Config]:
    """A dive of a scenario.

    The scenarios of `DRIVEN` are driven through the thrusters and have the thesis's sensors;
    the others are motions as such, with the noise of the configuration.

    Parameters
    ----------
    name : one of `NAMES`
    seed : the same one gives the same dive
    config : vehicle, sensors and what is believed of them; None = the thesis's Falcon with its
        compasses (`lake`) for a scenario that is driven, all defaults for another
    choices : Choices

    Returns
    -------
    Dive, and the Config for an estimator: with the planned start

    Raises
    ------
    InputError : no such scenario, or a choice that it does not have
    """
    if not isinstance(name, str):
        raise InputError(f"scenario: expected its name, such as lawnmower, found {kind_of(name)}")
    require_known(name)
    if not (isinstance(seed, int) and seed >= 0):
        raise InputError(f"seed {seed!r}: an integer of 0 or more is expected")
    if not isinstance(choices, Choices):
        raise InputError(f"choices: expected Choices(duration=60), for example, found {kind_of(choices)}")
    if name in DRIVEN:
        driven = DRIVEN[name]
        choices.require(name, driven.choices, driven.variants)
        config = lake() if config is None else config_or_defaults(config)
        path, truth = driven.make(World.drawn(config, choices, seed))
    else:
        choices.require(name, _KINEMATIC)
        config = config_or_defaults(config)
        path = scenario(name, choices.duration, choices.speed)
        if choices.depth is not None:
            path = path.shifted([0.0, 0.0, choices.depth - path.motion([0.0]).p_n[0, 2]])
        truth = _kinematic(path, config, choices, seed)
    dive = simulate(path, truth, np.random.default_rng(seed))
    return dive, known(dive, config)


def _kinematic(path: Path, config: Config, choices: Choices, seed: int) -> Truth:
    """What the sensors obey in a dive that nothing drives."""
    truth = Truth(
        config,
        noise=choices.noise,
        outlier_share=choices.outliers,
        dropouts=choices.dropouts,
        profiles=choices.profiles,
        places=choices.places,
        false_places=choices.false_places,
        ship=None if choices.ship is None else ship_path(choices.ship, path, np.random.default_rng([seed, 2])),
    )
    if choices.ship is not None and not has_acoustics(config):
        raise InputError(
            f"ship {choices.ship}: the configuration has no acoustic system; state usbl, beacons or receivers"
        )
    if not choices.disturbances:
        return truth
    return replace(truth, magnetism=Magnetism(iron_near(path, config, np.random.default_rng([seed, 1]))))


def lake() -> Config:
    """`falcon` with its compasses as their data sheets have them, after a calibration in the tank.

    Xsens MTi: static heading within 1 degree, dynamic 2 degrees rms; RDI's compass within 2 degrees,
    and a deviation of 1 degree once per turn is a choice. So no heading is exact.
    """
    config = falcon()
    entries = {
        "mag_offset": {"estimate": True, "sd_deg": 1.0},
        "ahrs_offset": {"estimate": True, "sd_deg": 1.0},
        "dvl_compass_offset": {"estimate": True, "sd_deg": 2.0},
        "dvl_compass_deviation": {"estimate": True, "sd_deg": 1.0},
        "ahrs_deviation": {"estimate": True, "sd_deg": 1.0},
    }
    return config.with_values(calibration=entries, heading={"ahrs_sd_deg": 2.0})


def falcon() -> Config:
    """The configuration of the thesis's vehicle, ``falcon.yaml``."""
    return parse_config((files("rovgraph.model") / "falcon.yaml").read_text(encoding="utf-8"), "falcon.yaml")
