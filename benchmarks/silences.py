"""What a time without any data does to a track. Figures are in benchmarks/README.md.

python benchmarks/silences.py simulated --seeds 5
python benchmarks/silences.py recorded LOG --config CONFIG --reference REFERENCE --after 600
"""

import argparse
from pathlib import Path

import numpy as np

from rovgraph.config import Config, load_config
from rovgraph.estimators.dive import smooth
from rovgraph.estimators.eskf.error_state import ErrorStateFilter
from rovgraph.estimators.initialise import initialise
from rovgraph.evaluate import evaluate, read_reference
from rovgraph.geometry import log_rotation, transpose
from rovgraph.log import Log, read_log
from rovgraph.simulate import Style, Truth, Waves, scenario, simulate
from rovgraph.simulate.named import falcon

EARLY = [(begin, seconds) for begin in (8.0, 15.0, 25.0) for seconds in (3.0, 5.0, 7.0, 9.0)]
RECORDED = [(900.0, 9.0), (1500.0, 20.0), (2100.0, 6.0)]
LIVELY = Style(waves=Waves(heave=0.05, roll=0.1, pitch=0.08))
SETTLED_S = 10.0  # after the silence


def silenced(log: Log, silences: list[tuple[float, float]]) -> Log:
    """A log without what was measured in some times: since its beginning, and how long [s]."""
    streams, start = {}, float(log["imu"].time[0])
    for name, stream in log.streams.items():
        heard = np.ones(len(stream), bool)
        for begin, seconds in silences:
            heard &= (stream.time - start < begin) | (stream.time - start >= begin + seconds)
        streams[name] = stream.take(heard)
    return Log(log.source, streams, log.origin)


def early(seeds: int) -> None:
    """The filter by itself on dives with one silence in their first half minute."""
    config, lines = falcon(), []
    for seed in range(1, seeds + 1):
        dive = simulate(
            scenario("falcon", 55.0, None, LIVELY), Truth(config, dvl_rate=4.0), np.random.default_rng(seed)
        )
        log = Log.from_frame(dive.log_frame)
        for begin, seconds in EARLY:
            quiet = silenced(log, [(begin, seconds)])
            estimator = ErrorStateFilter(initialise(quiet, config), learn_noise=True)
            for measurement in quiet.measurements():
                estimator.add(measurement)
            estimator.finish()
            estimate = estimator.solve()
            track, truth = estimate.trajectory, dive.truth
            late = track.time > begin + seconds + SETTLED_S
            R_nb = truth.R_nb[np.minimum(np.searchsorted(truth.time, track.time), len(truth) - 1)]
            off = log_rotation(R_nb @ transpose(track.R_nb))[:, 2] / np.sqrt(track.cov_theta[:, 2, 2])
            out = {s: int(row["rejected"]) for s, row in estimate.summary["nis"].items()}
            lines.append((np.abs(off[late]).max(), out.get("dvl", 0), out.get("mag", 0)))
    heading, pings, fields = np.array(lines).T
    print(f"{len(lines)} dives; largest error of heading from {SETTLED_S:g} s after the silence, in its sd:")
    print(f"median {np.median(heading):.1f}, more than 3.5 in {np.sum(heading > 3.5)}")
    print(f"more than 5 pings kept out in {np.sum(pings > 5)}, more than 20 fields in {np.sum(fields > 20)}")


def recorded(path: Path, config: Config, reference: Path, after: float) -> None:
    """A recorded dive with and without silences."""
    log = read_log(path, config)
    for silences in ([], RECORDED):
        print(f"silences of {', '.join(f'{s:g}' for _, s in silences) or 'no'} s:")
        for estimate in smooth(silenced(log, silences), config).estimates[:2]:  # not dead reckoning
            result = evaluate(estimate.trajectory, read_reference(reference), start=after)
            print(f"  {estimate.kind:9} {result.rms_m:.2f} m rms, at most {result.max_m:.1f} m, NEES {result.nees:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["simulated", "recorded"])
    parser.add_argument("log", nargs="?", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--after", type=float, default=0.0, help="errors are taken from this long after the start [s]")
    given = parser.parse_args()
    if given.what == "simulated":
        early(given.seeds)
    else:
        recorded(given.log, load_config(given.config), given.reference, given.after)


if __name__ == "__main__":
    main()
