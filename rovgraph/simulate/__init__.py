"""Simulated dives: a path (`scenario`), a vehicle (`Truth`), and `simulate`.

What the simulator does (`Truth`) and what an estimator believes (`rovgraph.config.Config`)
are two separate things; they agree where nothing else is said.
"""

from rovgraph.simulate.dive import Dive, simulate
from rovgraph.simulate.path import CALM, Motion, Path, Style, Waves
from rovgraph.simulate.scenario import SCENARIOS, scenario
from rovgraph.simulate.truth import Truth

__all__ = ["CALM", "SCENARIOS", "Dive", "Motion", "Path", "Style", "Truth", "Waves", "scenario", "simulate"]
