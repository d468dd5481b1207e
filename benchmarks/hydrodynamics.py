"""What thrusters and drag are worth, on simulated dives: the figures of docs/hydrodynamics.md.

python benchmarks/hydrodynamics.py drag --seeds 20
python benchmarks/hydrodynamics.py gap vattern --seeds 10
python benchmarks/hydrodynamics.py gap vattern --seeds 10 --known-drag 0.05
"""

import argparse

import numpy as np

from rovgraph.geometry import Array
from rovgraph.inference.estimate import Estimate
from rovgraph.lab.estimators import ESTIMATORS, EstimatorSpec, outcomes, select
from rovgraph.lab.evaluate import normalised_error
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.simulate import Choices, Dive, simulated

GAP = {"vattern": (120.0, 180.0), "excited": (150.0, 210.0)}  # without bottom lock [s]
DRAG = ("drag_linear", "drag_quadratic")


def estimates(estimators: list[EstimatorSpec], log: Log, config: Config) -> list[Estimate]:
    """One estimate of each; a failure is raised."""
    found = []
    for outcome in outcomes(estimators, log, config):
        if outcome.error is not None:
            raise outcome.error
        assert outcome.estimate is not None
        found.append(outcome.estimate)
    return found


def drag(seeds: int) -> None:
    """Errors of the six coefficients after an excited dive."""
    chosen = select(["*-hydrodynamics"])
    rows = []
    for seed in range(seeds):
        dive, config = simulated("excited", seed)
        truth = np.concatenate([dive.hidden["calibration"][name] for name in DRAG])
        for estimate in estimates(chosen, Log.from_frame(dive.log_frame), config):
            found = [c for c in estimate.calibration if c.label.startswith("drag")]
            rows.append([[c.value for c in found], [c.sd for c in found], truth])
    values, sd, truth = np.moveaxis(np.array(rows).reshape(seeds, len(chosen), 3, 6), 2, 0)
    for k, named in enumerate(chosen):
        error = values[:, k] - truth[:, k]
        print(named.name, "linear x y z, quadratic x y z")
        print("  rms error      ", np.sqrt((error**2).mean(axis=0)).round(3))
        print("  stated sd      ", sd[:, k].mean(axis=0).round(3))
        print("  within 10 %    ", (np.abs(error) < 0.1 * (1.0 + truth[:, k])).mean(axis=0).round(2))
        print("  in 95 % of own ", (np.abs(error) < 1.96 * sd[:, k]).mean(axis=0).round(2))


def gap(scenario: str, seeds: int, known: float | None) -> None:
    """Horizontal error at the end of a minute without bottom lock, its growth, and its NEES (2 is honest)."""
    names = ["graph-smoothed-a", "ekf-a", "graph-smoothed-hydrodynamics", "ekf-hydrodynamics"]
    begin, end = GAP[scenario]
    rows = []
    for seed in range(seeds):
        dive, config = simulated(scenario, seed, choices=Choices(dropouts=((begin, end),)))
        if known is not None:
            config = with_drag(config, dive, known, seed)
        found = estimates([ESTIMATORS[name] for name in names], Log.from_frame(dive.log_frame), config)
        rows.append([_at(dive, estimate, np.array([begin, end])) for estimate in found])
    for name, (error, growth, nees) in zip(names, np.array(rows).mean(axis=0), strict=True):
        print(f"{name:30s} error {error:6.2f} m, growth {growth:6.2f} m, NEES {nees:5.1f}")


def _at(dive: Dive, estimate: Estimate, time: Array) -> tuple[float, float, float]:
    track = estimate.trajectory.clamped(time)
    e = (track.p_n - dive.path.motion(time).p_n)[:, :2]
    nees = normalised_error(e, track.cov_p[:, :2, :2])[1]
    return float(np.linalg.norm(e[1])), float(np.linalg.norm(e[1] - e[0])), float(nees)


def with_drag(config: Config, dive: Dive, sd: float, seed: int) -> Config:
    """Drag known beforehand to a relative sd, and held."""
    rng, entries = np.random.default_rng(seed), {}
    for name in DRAG:
        mean = dive.hidden["calibration"][name] + sd * rng.standard_normal(3)
        update = {"mean": tuple(mean.tolist()), "estimate": False}
        entries[name] = getattr(config.calibration, name).model_copy(update=update)
    return config.model_copy(update={"calibration": config.calibration.model_copy(update=entries)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tasks = parser.add_subparsers(dest="task", required=True)
    one = tasks.add_parser("drag", help="coefficients after an excited dive")
    two = tasks.add_parser("gap", help="a minute without bottom lock")
    two.add_argument("scenario", choices=sorted(GAP))
    two.add_argument("--known-drag", type=float, help="hold drag at the truth plus an error of this relative sd")
    for task in (one, two):
        task.add_argument("--seeds", type=int, default=10)
    args = parser.parse_args()
    if args.task == "drag":
        drag(args.seeds)
    else:
        gap(args.scenario, args.seeds, args.known_drag)


if __name__ == "__main__":
    main()
