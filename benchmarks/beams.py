"""A DVL's beams against truth, by an independent simulator: lost, biased, refused, off by their angle, over a bottom.

    python benchmarks/beams.py                                     every row, 20 seeds, and what a ping costs
    python benchmarks/beams.py --rows healthy --seeds 3 --online
    python benchmarks/beams.py --figure docs/images/beams.png      what losing two beams costs

prints a table in Markdown: what each row is about, with its target, and the horizontal rms error and NEES of the
smoothed, filtered and online estimates. Dives go through the command line. A row compares dives of the same motion and
noise, such as one with beams lost and one with all.
"""

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from fault_campaign.beams import Beams, Bottom, Fault, Head, bias, lose, refuse, stated
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive, Result, estimate_cells, row_options, run_command, run_dive, tracks, write_dive
from fault_campaign.motion import Profile
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import configuration, make_vehicle

from rovgraph.lab.executors import cores, starting, workers

SCALE_SD = 0.003
FIXES_END, SPEED_FROM = 800.0, 820.0  # of the row with fixes: until when it has them, from when speed is compared [s]


@dataclass(kw_only=True)
class Setting:
    """A dive with a DVL whose beams are in the log.

    Attributes
    ----------
    seconds : [s]
    brisk : legs of 200 m at 1 m/s; else of 7 m at 0.5 m/s
    beams : the head, the bottom and what goes wrong
    fixes : of 1 m each 2 s, until `FIXES_END`
    scale : of velocities and ranges, beside what is drawn
    water : temperature of the water [deg C] and speed of sound that the DVL is set to [m/s], as the log has them
    config : beside what a careful crew states
    """

    seconds: float = 360.0
    brisk: bool = False
    beams: Beams = field(default_factory=Beams)
    fixes: bool = False
    scale: float = 0.0
    water: tuple[float, float] | None = None
    config: dict[str, Any] = field(default_factory=dict)


def make_dive(setting: Setting, seed: int) -> Dive:
    """A dive. A seed gives every setting of the same length the same motion and the same noise."""
    rng = np.random.default_rng([17, seed])
    motion = replace(make_motion("survey of 20 minutes", rng), duration=setting.seconds)
    if setting.brisk:
        turns = tuple((130.0 + k * 210.0, 10.0, np.pi / 2) for k in range(int(setting.seconds / 210.0)))
        surge = Profile(0.0, ((8.0, 4.0, 1.0),), motion.velocity_b[0].waves)
        heading = replace(motion.heading, ramps=turns)
        motion = replace(motion, heading=heading, velocity_b=(surge, *motion.velocity_b[1:]))
    vehicle = make_vehicle("mti", ("ahrs", "depth", "fix") if setting.fixes else ("ahrs", "depth"))
    head, scale_sd = setting.beams.head, SCALE_SD if setting.water is None else WATER_SD
    vehicle.dvl = replace(
        vehicle.dvl, mount_rpy_deg=(0.0, 0.0, -45.0), yaw_sd=0.3, scale_sd=scale_sd, sd=head.velocity_sd
    )
    vehicle.dvl.scale = setting.scale
    vehicle.ahrs = replace(vehicle.ahrs, offset_sd=0.3, curve_sd=0.2)
    known = setting.water is not None  # then the scale's prior is rovgraph's
    scale = {} if known else {"calibration": {"dvl_scale": {"estimate": True, "sd": SCALE_SD}}}
    config = merge(merge(configuration(vehicle), stated(head)), scale)
    config["start"] |= dict(zip(("north_m", "east_m"), rng.normal(0.0, 0.1, 2).tolist(), strict=True))
    streams, hidden = sample(motion, vehicle, rng, setting.beams)
    if setting.fixes:
        streams["fix"] = streams["fix"][streams["fix"]["time"] < FIXES_END]
    if setting.water is not None:
        time = np.arange(0.5, setting.seconds, 10.0)
        told = {"water_temperature": setting.water[0], "dvl_sound_speed": setting.water[1]}
        streams["dvl_sound"] = pd.DataFrame({"time": time, **told})
        hidden = replace(hidden, dvl_scale=(1.0 + hidden.dvl_scale) / (1.0 + setting.scale) - 1.0)  # what is left
    return Dive(streams, merge(config, setting.config), motion, hidden)


def inspect(folder: Path, dive: Dive) -> dict[str, float]:
    """What the rows need beside errors: the end, speed, beams that were used, what was found."""
    found: dict[str, float] = {}
    for kind, track in tracks(folder):
        last = track.iloc[-1]
        off = last[["north", "east"]].to_numpy(float) - dive.motion.local(np.array([last["time"]]))[0, :2]
        found[f"{kind} end"] = float(np.hypot(*off))
        found[f"{kind} end sd"] = float(np.hypot(last["north_sd"], last["east_sd"]))
        late = track[track["time"] > SPEED_FROM]
        if len(late):
            true = dive.motion.v_n(late["time"].to_numpy())[:, :2]
            v = late[["v_north", "v_east"]].to_numpy()
            found[f"{kind} speed"] = float((v * true).sum() / (true * true).sum()) - 1.0
    calibration = pd.read_csv(folder / "out/calibration.csv")
    smoothed = calibration[calibration["estimate"] == "smoothed"].set_index("label")
    found |= {f"{name} {what}": float(smoothed.loc[name, what]) for name in ("dvl_scale",) for what in ("value", "sd")}
    found["dvl_scale true"] = dive.hidden.dvl_scale
    pings = dive.streams["dvl"]
    refused = pings.loc[pings["dvl_valid"] == 0.0, "time"].to_numpy()
    rows = pd.read_csv(folder / "out/residuals.csv", usecols=["time", "sensor", "weight"])
    rows = rows[rows["sensor"].str.startswith("dvl_beam_") & (rows["weight"] > 0.01)]
    readmitted = np.isin(rows["time"].round(4), refused.round(4))
    found["refused"], found["readmitted"] = float(len(refused)), float(rows["time"][readmitted].nunique())
    return found


Runs = Mapping[str, Sequence[Result]]  # of each dive of a row


@dataclass
class Row:
    """A row of the table.

    Attributes
    ----------
    target : in words
    dives : name -> setting; the first is the one whose errors are printed
    outcome : what was found in words, and whether the target is met
    """

    target: str
    dives: dict[str, Setting]
    outcome: Callable[[Runs], tuple[str, bool]]


def rms(results: Sequence[Result], what: str) -> float:
    """Root of the mean square over seeds of something that `inspect` has found."""
    return float(np.sqrt(np.mean([r.found[what] ** 2 for r in results if what in r.found])))


def end_ratios(of: str, to: str, most: float, kinds: Sequence[str] = ("smoothed", "filtered")) -> Any:
    """Outcome: end errors of one dive over those of another."""

    def outcome(runs: Runs) -> tuple[str, bool]:
        ratios = {kind: rms(runs[of], f"{kind} end") / rms(runs[to], f"{kind} end") for kind in kinds}
        text = ", ".join(f"{kind} {ratio:.2f}" for kind, ratio in ratios.items())
        ends = " / ".join(f"{rms(runs[name], 'smoothed end'):.2f}" for name in runs)
        return f"{text} (end {ends} m: {' / '.join(runs)})", max(ratios.values()) <= most

    return outcome


def healthy(runs: Runs) -> tuple[str, bool]:
    """Outcome: end error and its sd, by beams over by velocity."""
    a, b = runs["by beams"], runs["by velocity"]
    ratios = [
        rms(a, f"{kind} {what}") / rms(b, f"{kind} {what}")
        for kind in ("smoothed", "filtered")
        for what in ("end", "end sd")
    ]
    text = "smoothed error {:.3f}, sd {:.3f}; filtered {:.3f}, {:.3f}".format(*ratios)
    return text, max(abs(ratio - 1.0) for ratio in ratios) <= 0.03


def named(runs: Runs) -> tuple[str, bool]:
    """Outcome: the biased beam is named, and does little harm."""
    first, *_ = runs
    count = sum(any(re.search(r"beam[_ ]2\b", line) for line in r.said) for r in runs[first])
    text, met = end_ratios("biased", "without", 1.2)(runs)
    return f"named in {count} of {len(runs[first])}; {text}", met and count == len(runs[first])


def readmitted(runs: Runs) -> tuple[str, bool]:
    """Outcome: refused pings that were used."""
    every = runs["refused"]
    share = sum(r.found["readmitted"] for r in every) / max(sum(r.found["refused"] for r in every), 1.0)
    text, _ = end_ratios("refused", "without", 1.0)(runs)
    return f"{100 * share:.1f} % of refused pings used; {text}", share <= 0.01


def speed_bias(runs: Runs) -> tuple[str, bool]:
    """Outcome: mean error of the speed after the fixes ended."""
    first, *_ = runs
    errors = np.array([r.found["smoothed speed"] for r in runs[first]])
    text = f"speed off by {100 * np.sqrt(np.mean(errors**2)):.2f} % (rms), {100 * errors.mean():+.2f} % (mean)"
    return text, float(np.sqrt(np.mean(errors**2))) <= 0.002


def scale_found(runs: Runs) -> tuple[str, bool]:
    """Outcome: the scale that was found."""
    first, *_ = runs
    errors = [r.found["dvl_scale value"] - r.found["dvl_scale true"] for r in runs[first]]
    off = float(np.sqrt(np.mean(np.square(errors))))
    sd = rms(runs[first], "dvl_scale sd")
    return f"dvl_scale off by {100 * off:.2f} % (sd {100 * sd:.2f})", max(off, sd) <= 0.003


def by_beams(*faults: Fault, **more: Any) -> Setting:
    """A dive whose beams are used."""
    return Setting(beams=Beams(faults=faults), **more)


def by_velocity(*faults: Fault, **more: Any) -> Setting:
    """The same, by the velocity that the instrument makes of them.

    Errors of the angles make a scale error, of half an angle's by the cotangent of the beams' angle.
    """
    shared = 0.5 * np.deg2rad(Head().error_sd) / np.tan(np.deg2rad(Head().angle))
    scale = {"dvl_scale": {"estimate": True, "sd": float(np.hypot(SCALE_SD, shared))}}
    return by_beams(*faults, config={"dvl": {"use": "velocity"}, "calibration": scale}, **more)


def exact(use: str) -> Setting:
    """A dive with a head whose errors that last are none, and known to be: beams and velocity then say the same."""
    none = {
        name: {"estimate": False} for name in (*(f"dvl_beam_{k}_angle" for k in ALL), "dvl_bias", "dvl_altitude_scale")
    }
    head = Beams(Head(error_sd=0.0, bias_sd=0.0))
    return Setting(beams=head, config={"dvl": {"use": use}, "calibration": none})


ALL = (0, 1, 2, 3)
LOSS = "two adjacent beams lost for half of 20 min"
HALF = 300.0, 900.0  # of 20 min
WIDE = Beams(Head(width=4.6), Bottom(2.0 + 22.5, 17.5, 302.0, 0.6), (), (0.0, 0.0, 0.14, 0.0))
CALIBRATED = {
    "calibration": {
        **{f"dvl_beam_{k}_angle": {"estimate": True, "sd_deg": 0.15} for k in ALL},
        "dvl_altitude_scale": {"estimate": True, "sd": 1e-4},
        "dvl_scale": {"estimate": True, "sd": 0.005},
    }
}
WATER_SD = 0.002  # of what temperature and salinity leave of the scale
SET, WATER = 1500.0, 1470.0  # speed of sound that is set, and of the water at 6.03 degrees and a salinity of 31 [m/s]
SOUND = {"dvl": {"sound_speed_set_mps": "logged"}, "sound": {"salinity_psu": 31.0}}
ROWS = {
    "healthy": Row("error and sd within 3 %", {"by beams": exact("auto"), "by velocity": exact("velocity")}, healthy),
    LOSS: Row(
        "end error at most 1.3 times that with all",
        {
            "lost": by_beams(lose((0, 1), *HALF), seconds=1200.0),
            "with all": by_beams(seconds=1200.0),
            "by velocity": by_velocity(lose((0, 1), *HALF), seconds=1200.0),
        },
        end_ratios("lost", "with all", 1.3),
    ),
    "opposite pair lost for 60 s": Row(
        "end error at most 0.5 times that of losing the pings",
        {"lost": by_beams(lose((0, 2), 150.0, 210.0)), "pings lost": by_beams(lose(ALL, 150.0, 210.0))},
        end_ratios("lost", "pings lost", 0.5),
    ),
    "one beam 0.1 m/s off for 60 s": Row(
        "named; end error at most 1.2 times that without",
        {
            "biased": by_beams(bias(2, 0.1, 150.0, 210.0)),
            "without": by_beams(),
            "by velocity": by_velocity(bias(2, 0.1, 150.0, 210.0)),
        },
        named,
    ),
    "valid beams of refused pings": Row(
        "not readmitted (1 %)",
        {"refused": by_beams(refuse(0.1, Head())), "without": by_beams()},
        readmitted,
    ),
    "wide beams, one 0.14 deg off, slope, fixes": Row(
        "speed within 0.2 % after calibration",
        {"wide": Setting(seconds=1200.0, brisk=True, beams=WIDE, fixes=True, config=CALIBRATED)},
        speed_bias,
    ),
    "sound speed 30 m/s off, temperature and salinity in the log": Row(
        "dvl_scale within 0.3 %, its sd at most 0.3 %",
        {"set": Setting(scale=SET / WATER - 1.0, water=(6.03, SET), config=SOUND)},
        scale_found,
    ),
}


def run_dive_of(row: str, name: str, seed: int, online: bool) -> Result:
    """One dive."""
    return run_dive(make_dive(ROWS[row].dives[name], seed), online, inspect)


def figures(name: str, runs: Runs) -> str:
    """A row of the table."""
    text, met = ROWS[name].outcome(runs)
    cells = [name, ROWS[name].target, text, "yes" if met else "**no**"]
    cells += estimate_cells(next(iter(runs.values())))
    return "| " + " | ".join(cells) + " |"


def cost(rounds: int) -> tuple[float, float]:
    """Processor time of a ping by beams and by velocity, the least of some rounds [s]."""
    import tempfile

    import rovgraph

    with tempfile.TemporaryDirectory() as name:
        write_dive(make_dive(by_beams(), 0), Path(name))
        config = rovgraph.load_config(Path(name) / "vehicle.yaml")
        log = rovgraph.read_log(Path(name) / "log.csv", config)
    pings, least = len(log["dvl"]), {"auto": np.inf, "velocity": np.inf}
    for _ in range(rounds):
        for use in least:
            begin = time.process_time()
            rovgraph.smooth(log, config.model_copy(update={"dvl": config.dvl.model_copy(update={"use": use})}))
            least[use] = min(least[use], time.process_time() - begin)
    return least["auto"] / pings, least["velocity"] / pings


def draw(path: Path) -> None:
    """Horizontal error and sd of the filter in the first dive of the row in which two beams are lost."""
    import tempfile

    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(*HALF, color="0.93", label="two beams lost")
    for name, colour in (("by velocity", "tab:red"), ("lost", "tab:blue"), ("with all", "0.3")):
        dive = make_dive(ROWS[LOSS].dives[name], 0)
        with tempfile.TemporaryDirectory() as folder:
            write_dive(dive, Path(folder))
            files = [f"{folder}/{part}" for part in ("log.csv", "vehicle.yaml", "out")]
            run_command(["smooth", files[0], "--config", files[1], "--out", files[2], "--no-figures"])
            track = pd.read_csv(f"{files[2]}/trajectory_filtered.csv").iloc[::10]
        off = track[["north", "east"]].to_numpy() - dive.motion.local(track["time"].to_numpy())[:, :2]
        label = {"by velocity": "velocities only", "lost": "beams", "with all": "beams, none lost"}[name]
        axes.plot(track["time"], np.hypot(*off.T), color=colour, label=label)
        axes.plot(track["time"], np.hypot(track["north_sd"], track["east_sd"]), color=colour, linestyle=":")
    axes.set(yscale="log", xlabel="time [s]", ylabel="horizontal error, dotted: sd [m]", ylim=(0.02, None))
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run and print."""
    parser = row_options(__doc__, [*ROWS, "cost"], cores())
    parser.add_argument("--figure", type=Path, help="draw what losing two beams costs, instead of the table")
    arguments = parser.parse_args()
    if arguments.figure:
        draw(arguments.figure)
        return
    if "cost" in arguments.rows:
        beams, velocity = cost(3)
        met = "yes" if beams <= 1.6 * velocity else "**no**"
        print(f"A ping by beams takes {1e6 * beams:.0f} us, by velocity {1e6 * velocity:.0f} us: ", end="")
        print(f"{beams / velocity:.2f} times (at most 1.6: {met}).\n", flush=True)
        arguments.rows.remove("cost")
    if not arguments.rows:
        return
    heads = [f"{kind} {what}" for kind in ("smoothed", "filtered", "online") for what in ("rms (sd) [m]", "NEES")]
    print("| dive | target | found | met | " + " | ".join(heads) + " | verdicts |")
    print("|---" * (len(heads) + 5) + "|", flush=True)
    with workers(arguments.jobs) as pool:
        for name in arguments.rows:
            with starting():
                futures = {
                    dive: [
                        pool.submit(run_dive_of, name, dive, seed, arguments.online and not place)
                        for seed in range(arguments.seeds)
                    ]
                    for place, dive in enumerate(ROWS[name].dives)
                }
            runs = {dive: [future.result() for future in every] for dive, every in futures.items()}
            print(figures(name, runs), flush=True)
            if arguments.said:
                print("\n".join(next(iter(runs.values()))[0].said), flush=True)
            if arguments.keep:
                for dive, setting in ROWS[name].dives.items():
                    folder = arguments.keep / f"{name}, {dive}".replace(" ", "_").replace("%", "").replace(",", "")
                    folder.mkdir(parents=True, exist_ok=True)
                    write_dive(make_dive(setting, 0), folder)


if __name__ == "__main__":
    main()
