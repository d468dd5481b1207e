"""Simulated dives: a path, a vehicle with its sensors (`Truth`), and `simulate`.

May import `rovgraph.inference`, `problem`, `rules`, `log`, `sensors`, `model`, `kernels` and what is below. Begin with
`dive` (`simulate`: the models' predictions plus noise), `path` and `truth`; `simulated` makes a dive by the name of its
scenario, `driven` one with thrusters.

What the simulator does (`Truth`, `World`) and what an estimator assumes (`rovgraph.model.config.Config`) are two
separate things; in a kinematic dive (`scenario`) they agree unless stated otherwise.
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
