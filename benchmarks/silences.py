"""What a time without any data does to a track. Figures are in benchmarks/README.md.

python benchmarks/silences.py simulated --seeds 5
python benchmarks/silences.py dvl --seeds 100
python benchmarks/silences.py recorded LOG --config CONFIG --reference REFERENCE --after 600
"""

import argparse
from pathlib import Path

import numpy as np

from rovgraph.dive import smooth
from rovgraph.geometry import Array, log_rotation, transpose
from rovgraph.inference.error_state import ErrorStateFilter
from rovgraph.inference.initialise import initialise
from rovgraph.lab.evaluate import evaluate, read_reference
from rovgraph.log import Log, read_log
from rovgraph.model.config import Config, load_config
from rovgraph.simulate import Style, Truth, Waves, scenario, simulate
from rovgraph.simulate.named import falcon

EARLY = [(begin, seconds) for begin in (8.0, 15.0, 25.0) for seconds in (3.0, 5.0, 7.0, 9.0)]
RECORDED = [(900.0, 9.0), (1500.0, 20.0), (2100.0, 6.0)]
LIVELY = Style(waves=Waves(heave=0.05, roll=0.1, pitch=0.08))
SETTLED_S = 10.0  # after the silence
DVL_SILENT_S = (1.0, 600.0)  # its logarithm is uniform
BEFORE_S, AFTER_S, RETURNED_S = 60.0, 40.0, 5.0  # of a silence of the DVL: what is heard around it, and the return


def silenced(log: Log, silences: list[tuple[float, float]], sensors: tuple[str, ...] = ()) -> Log:
    """A log without what was measured in some times: since its beginning, and how long [s]; of all or some sensors."""
    streams, start = {}, float(log["imu"].time[0])
    for name, stream in log.streams.items():
        heard = np.ones(len(stream), bool)
        for begin, seconds in silences if name in sensors or not sensors else ():
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


def dvl(seeds: int) -> None:
    """The filter where its DVL returns after 1 to 600 s, a dive each.

    A jump is what the returning pings change of the position's error, measured by the sd from before them.
    """
    config, lines = falcon(), []
    for seed in range(1, seeds + 1):
        rng = np.random.default_rng([2, seed])
        seconds = float(np.exp(rng.uniform(*np.log(DVL_SILENT_S))))
        path = scenario("falcon", BEFORE_S + seconds + AFTER_S, None, LIVELY)
        dive = simulate(path, Truth(config, dvl_rate=4.0), rng)
        log = silenced(Log.from_frame(dive.log_frame), [(BEFORE_S, seconds)], ("dvl",))
        filtered = smooth(log, config, "filtered").estimates[0]
        track, truth = filtered.trajectory, dive.truth
        at = np.array([np.interp(track.time, truth.time, p) for p in truth.p_n.T]).T
        error, back = (track.p_n - at)[:, :2], track.time[0] + BEFORE_S + seconds
        before = int(np.flatnonzero(track.time < back)[-1])
        after = (track.time >= back) & (track.time < back + RETURNED_S)
        jumps = in_sd(error[after] - error[before], track.cov_p[before, :2, :2])
        settled = track.time >= back + RETURNED_S
        late = in_sd(error[settled], track.cov_p[settled, :2, :2])
        rejected = int(filtered.summary["nis"]["dvl"]["rejected"])
        lines.append((seconds, jumps.max(), late.max(), np.mean(late**2) / 2.0, rejected))
        print(f"seed {seed}: {' '.join(f'{x:.2f}' for x in lines[-1])}", flush=True)
    silent, jump, off, nees, pings = np.array(lines).T
    span = f"{silent.min():.0f} to {silent.max():.0f} s"
    print(f"{len(lines)} dives, DVL silent for {span}, median {np.median(silent):.0f} s")
    print(f"largest jump of the position at its return: median {np.median(jump):.1f} sd, at most {jump.max():.1f} sd")
    print(f"error of the position afterwards: at most {off.max():.1f} sd, NEES {nees.mean():.2f}")
    print(f"pings rejected: {pings.sum():.0f}, at most {pings.max():.0f} in a dive")


def in_sd(error: Array, covariance: Array) -> Array:
    """Mahalanobis distances of errors, shape (n, 2), with one covariance or one each."""
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])))


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
    parser.add_argument("what", choices=["simulated", "dvl", "recorded"])
    parser.add_argument("log", nargs="?", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--after", type=float, default=0.0, help="errors are taken from this long after the start [s]")
    given = parser.parse_args()
    if given.what == "simulated":
        early(given.seeds)
    elif given.what == "dvl":
        dvl(given.seeds)
    else:
        recorded(given.log, load_config(given.config), given.reference, given.after)


if __name__ == "__main__":
    main()
