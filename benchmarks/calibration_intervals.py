"""Where the DVL's yaw or scale is called observable: how often does its 95 % interval hold the truth?

    python benchmarks/calibration_intervals.py --seeds 20
    python benchmarks/calibration_intervals.py --seeds 200 --cells "mti, survey, waves" --keep dives.jsonl

The dives are those of `fault_campaign`, without a fault. Yaw and scale are drawn from wide priors; the DVL's arm and
tilt and the gyro's scale, which are considered, from theirs. Figures are in docs/observability.md.
"""

import argparse
import json
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from fault_campaign.cases import AHRS_DEPTH, WITH_FIXES
from fault_campaign.instruments import log_table, sample
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import GRADES, Vehicle, configuration, make_vehicle
from scipy.stats import binomtest

from rovgraph.dive import smooth
from rovgraph.log import Log
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config

YAW_SD_DEG, SCALE_SD = 10.0, 0.03  # of the priors: wide, so that the dive decides
SHOWN = ("dvl_yaw", "dvl_scale")
MOTIONS = ("survey", "survey, waves", "eights, waves", "dives", "transit")
INSIDE_SD = 1.96  # half of the 95 % interval


@dataclass(frozen=True)
class Cell:
    """Dives of one kind: an inertial unit, a motion, and what else is aboard."""

    grade: str
    motion: str
    aids: tuple[str, ...]

    @property
    def name(self) -> str:
        return f"{self.grade}, {self.motion}" + (", fixes" if "fix" in self.aids else "")


CELLS = {
    cell.name: cell
    for cell in (Cell(*choice) for choice in product(GRADES, MOTIONS, (tuple(AHRS_DEPTH), tuple(WITH_FIXES))))
}


def one_dive(cell: Cell, seed: int) -> list[dict[str, Any]]:
    """A row for each estimate and variable: its error in units of the stated sd, that sd, and the verdict."""
    rng = np.random.default_rng([zlib.crc32(cell.name.encode()), seed])
    motion, vehicle = make_motion(cell.motion, rng), make_vehicle(cell.grade, cell.aids)
    vehicle.dvl.yaw_sd, vehicle.dvl.scale_sd = YAW_SD_DEG, SCALE_SD
    data = configuration(vehicle)
    data["calibration"]["dvl_scale"] = {"estimate": True, "sd": SCALE_SD}
    _draw_considered(vehicle, rng)
    streams, hidden = sample(motion, vehicle, rng)
    dive = smooth(Log.from_frame(log_table(streams)), Config.model_validate(data))
    truth = {"dvl_yaw": np.deg2rad(hidden.dvl_yaw), "dvl_scale": hidden.dvl_scale}
    return [
        {
            "cell": cell.name,
            "seed": seed,
            "estimate": estimate.kind,
            "variable": entry.label,
            "verdict": entry.verdict,
            "error": (entry.value - truth[entry.label]) / entry.sd,
            "sd": entry.sd,
        }
        for estimate in dive.estimates
        for entry in estimate.calibration
        if entry.label in SHOWN
    ]


def _draw_considered(vehicle: Vehicle, rng: np.random.Generator) -> None:
    """What the configuration does not know of an instrument, by the sd that it has of it."""
    tilt = np.rad2deg([TABLE["dvl_roll"].sd, TABLE["dvl_pitch"].sd]) * rng.standard_normal(2)
    vehicle.dvl.mount_rpy_deg = tuple(np.add(vehicle.dvl.mount_rpy_deg, (*tilt, 0.0)))
    vehicle.dvl.arm = tuple(np.add(vehicle.dvl.arm, TABLE["dvl_lever_arm"].sd * rng.standard_normal(3)))
    vehicle.imu.gyr_matrix = np.diag(1.0 + TABLE["gyr_scale"].sd * rng.standard_normal(3))


def table(rows: pd.DataFrame) -> str:
    """A line per cell, variable and estimate that is called observable in any dive, and a line for all cells."""
    lines = ["| cell | variable | estimate | observable | 95 % interval holds | NEES | sd |", "|---" * 7 + "|"]
    seen = rows[rows["verdict"] == "observable"]
    dives = rows.groupby("cell")["seed"].nunique()
    for (cell, variable, estimate), some in seen.groupby(["cell", "variable", "estimate"], sort=False):
        lines.append(_line(cell, variable, estimate, some, int(dives[cell])))
    for (variable, estimate), some in seen.groupby(["variable", "estimate"], sort=False):
        lines.append(_line("all", variable, estimate, some, int(dives.sum())))
    return "\n".join(lines)


def _line(cell: str, variable: str, estimate: str, some: pd.DataFrame, dives: int) -> str:
    """Share of dives with its exact binomial interval, NEES, and the median of the stated sd."""
    inside = int((some["error"].abs() < INSIDE_SD).sum())
    low, high = binomtest(inside, len(some)).proportion_ci()
    sd = float(some["sd"].median())
    shown = f"{np.rad2deg(sd):.2f}°" if variable == "dvl_yaw" else f"{100.0 * sd:.2f} %"
    share = f"{inside / len(some):.1%} ({100 * low:.0f}–{100 * high:.0f})"
    nees = float(np.mean(np.square(some["error"])))
    return f"| {cell} | {variable} | {estimate} | {len(some)} of {dives} | {share} | {nees:.2f} | {shown} |"


def run(cells: Sequence[Cell], seeds: int, kept: Path | None) -> pd.DataFrame:
    """All dives, one after the other; those that ``kept`` has are not run again."""
    lines = kept.read_text(encoding="utf-8").splitlines() if kept is not None and kept.exists() else []
    rows = [json.loads(line) for line in lines]
    done = {(row["cell"], row["seed"]) for row in rows}
    for seed, cell in product(range(seeds), cells):
        if (cell.name, seed) not in done:
            rows += (more := one_dive(cell, seed))
            if kept is not None:
                with kept.open("a", encoding="utf-8") as file:
                    file.writelines(json.dumps(row) + "\n" for row in more)
    found, names = pd.DataFrame(rows), [cell.name for cell in cells]
    return found[found["cell"].isin(names) & (found["seed"] < seeds)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="dives of each cell")
    parser.add_argument("--cells", nargs="+", choices=list(CELLS), default=list(CELLS), metavar="CELL")
    parser.add_argument("--keep", type=Path, help="keep every dive in this file, and run only those that it lacks")
    parser.add_argument("--list", action="store_true", help="list the cells")
    given = parser.parse_args(arguments)
    if given.list:
        print("\n".join(CELLS))
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        print(table(run([CELLS[name] for name in given.cells], given.seeds, given.keep)))


if __name__ == "__main__":
    main()
