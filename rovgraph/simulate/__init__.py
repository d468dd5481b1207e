"""Simulated dives: a path, a vehicle with its sensors (`Truth`), and `simulate`.

`simulated` makes one by the name of its scenario. What the simulator does (`Truth`, `World`)
and what an estimator believes (`rovgraph.model.config.Config`) are two separate things; in a motion
as such (`scenario`) they agree where nothing else is said.
"""

from rovgraph.simulate.choices import Choices
from rovgraph.simulate.dive import Dive, simulate
from rovgraph.simulate.driven import DRIVEN
from rovgraph.simulate.named import NAMES, falcon, lake, simulated
from rovgraph.simulate.path import CALM, Motion, Path, Style, Waves
from rovgraph.simulate.scenario import SCENARIOS, scenario
from rovgraph.simulate.truth import Truth

__all__ = [
    "CALM",
    "DRIVEN",
    "NAMES",
    "SCENARIOS",
    "Choices",
    "Dive",
    "Motion",
    "Path",
    "Style",
    "Truth",
    "Waves",
    "falcon",
    "lake",
    "scenario",
    "simulate",
    "simulated",
]
