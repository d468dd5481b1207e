"""Commands for researchers: ``simulate``, ``demo``, ``compare``, ``observe``, ``plan``, ``study`` and ``calibrate``."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rovgraph.cli.files import Choose, ConfigPath, Files, Force, Shift, Times, name_of, read_files

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rovgraph import SimulatedDive
    from rovgraph.lab.calibrate import MagnetometerCalibration, NoiseReport
    from rovgraph.lab.crosslines import CrosslinePlan


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            help="driven by thrusters: vattern, docking, excited, tank, stationary; "
            "prescribed motions: falcon, lawnmower, square, circle, figure8, straight, accelerate-and-stop, spiral; "
            "around a beacon: hold, spin, cardinal, box, round",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder to create", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="seed: the same one gives the same dive")] = 1,
    duration: Annotated[float | None, typer.Option(help="duration in seconds; default: the scenario's")] = None,
    speed: Annotated[float | None, typer.Option(help="speed in m/s; default: the scenario's")] = None,
    variant: Annotated[
        str | None,
        typer.Option(
            help="vattern: run 1, 2 or 3, default by the seed; tank: raw or calibrated; stationary: land or water"
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="configuration (YAML); default: the thesis's Falcon if driven by thrusters, else defaults"),
    ] = None,
    current: Annotated[
        tuple[float, float] | None,
        typer.Option(help="current, north and east in m/s; default: drawn", metavar="NORTH EAST", show_default=False),
    ] = None,
    disturbances: Annotated[
        bool | None,
        typer.Option(
            "--disturbances/--no-disturbances", help="iron on the seabed; default: in a lake", show_default=False
        ),
    ] = None,
    depth: Annotated[float | None, typer.Option(help="depth at the start in m; default: the scenario's")] = None,
    ship: Annotated[
        str | None,
        typer.Option(
            help="what the ship does of an acoustic system: spin, cardinal, box or round; default: it stays above",
            show_default=False,
        ),
    ] = None,
    outliers: Annotated[float, typer.Option(help="share of DVL pings that are wrong, 0 to 1")] = 0.0,
    dropout: Annotated[
        list[str] | None,
        typer.Option(help="seconds without bottom lock, such as 100:130; may be repeated", metavar="FROM:TO"),
    ] = None,
    place: Annotated[
        list[str] | None,
        typer.Option(
            help="a place that a camera recognises, in m, such as 10:-5; may be repeated", metavar="NORTH:EAST"
        ),
    ] = None,
    profiles: Annotated[
        str | None, typer.Option(help="an ADCP's cells, length in m and number, such as 4:25", metavar="LENGTH:NUMBER")
    ] = None,
    false_places: Annotated[float, typer.Option(help="share of the camera's matches that are false, below 1")] = 0.0,
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="noise, biases and drawn calibration")] = True,
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
) -> None:
    """Simulate a dive: log.csv, the truth, and the configuration for an estimator.

    For a prescribed motion, the truth of what the configuration estimates is drawn from its priors.
    A driven scenario has a world of its own (docs/simulation.md).

    Example: rovgraph simulate vattern --seed 7 --out dive
    """
    import rovgraph as rg
    from rovgraph.report.folder import check_writable

    check_writable(out, force)
    given = None if config is None else rg.load_config(config)
    choices = rg.Choices(
        duration=duration,
        speed=speed,
        variant=variant,
        current=current,
        disturbances=disturbances,
        depth=depth,
        ship=ship,
        outliers=outliers,
        dropouts=tuple(_pair(text) for text in dropout or ()),
        places=tuple(_pair(text) for text in place or ()),
        false_places=false_places,
        profiles=None if profiles is None else _pair(profiles),
        noise=noise,
    )
    dive = rg.simulate(scenario, given, seed, choices)
    dive.save(out, force)
    _show(out, dive)


def _pair(text: str) -> tuple[float, float]:
    """Two numbers with a colon between them; not a number where they are none."""
    first, _, second = text.partition(":")
    try:
        return float(first), float(second)
    except ValueError:
        return float("nan"), float("nan")


def _show(out: Path, dive: "SimulatedDive") -> None:
    """The table that the command prints."""
    from rich.table import Table

    from rovgraph.cli.console import console

    figures = dive.figures
    table = Table("", "", title=f"Simulated dive in {out}", show_header=False)
    table.add_row("scenario, seed", f"{dive.scenario}, {dive.seed}")
    table.add_row("duration, distance", f"{figures['duration_s']:.1f} s, {figures['distance_m']:.1f} m")
    table.add_row("extent", "{:.1f} m north, {:.1f} m east, {:.1f} m depth".format(*figures["extent_m"]))
    for sensor, count in figures["measurements"].items():
        table.add_row(sensor, f"{count} measurements")
    table.add_row("log", f"{len(dive.dive.log_frame)} rows in log.csv")
    console().print(table)


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder to create")] = Path("demo"),
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
) -> None:
    """Write a demonstration dive, estimate its track and compare it with the truth.

    Example: rovgraph demo
    """
    import rovgraph as rg
    from rovgraph.cli.console import progress_bar
    from rovgraph.cli.report import show_metrics
    from rovgraph.cli.smooth import show_result

    with progress_bar() as progress:
        done = rg.demo(out, force, progress)
    track = done.results / "trajectory_smoothed.csv"
    typer.echo(f"$ rovgraph smooth {out / 'log.csv'} --config {out / 'config.yaml'} --out {done.results}")
    show_result(done.result, done.summary, done.results, verbose=False)
    typer.echo(f"\n$ rovgraph evaluate {track} {out / 'truth.csv'}")
    show_metrics(done.metrics, "smoothed track against the truth")
    typer.echo(f"""
Look next at
  {done.results / "report.html"}: the dive as a page, in any browser
  {done.results / "residuals.png"}: every measurement against its prediction
  {out / "config.yaml"}: the vehicle's configuration
For your own log: rovgraph check LOG, then rovgraph smooth LOG --config CONFIG""")


COMPARISON_WIDTH = 120  # columns of a file or a pipe, which has no width of its own


def compare(
    out: Annotated[Path, typer.Option("--out", "-o", help="results folder", show_default=False)],
    files: Annotated[
        list[Path] | None, typer.Argument(help="a log, or native files of one dive", metavar="[FILE...]")
    ] = None,
    config: ConfigPath = None,
    reference: Annotated[
        Path | None, typer.Option(help="CSV with time, north, east, and optionally attitude and velocity")
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="simulate dives of this scenario instead of a LOG")] = None,
    seeds: Annotated[int, typer.Option(help="number of simulated dives")] = 30,
    first_seed: Annotated[int, typer.Option(min=0, help="seed of the first simulated dive")] = 1,
    duration: Annotated[
        float | None, typer.Option(help="duration of a simulated dive in seconds; default: the scenario's")
    ] = None,
    estimators: Annotated[
        str | None,
        typer.Option(help="names or patterns (graph-*), separated by commas; default: all without thrusters"),
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="processes; default: one per core")] = None,
    force: Force = False,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
) -> None:
    """Compare estimators: errors, consistency and cost of each, in a table and figures.

    Example: rovgraph compare --scenario vattern --seeds 30 --out comparison
    """
    import rovgraph as rg
    from rovgraph.api.lab import require_one
    from rovgraph.cli.console import console, progress_bar, say
    from rovgraph.lab.choices import listed
    from rovgraph.lab.estimators import select
    from rovgraph.report.folder import check_writable
    from rovgraph.report.lab import comparison_table
    from rovgraph.report.tables import fitting

    chosen = range(first_seed, first_seed + seeds)
    select(None if estimators is None else listed(estimators))
    require_one(files[0] if files else None, reference, scenario, chosen, duration)
    check_writable(out, force, [*(files or []), config, reference])
    settings = None if config is None else rg.load_config(config)
    dive_log = read_files(files, settings, choose, shift, times) if files else None
    with progress_bar() as progress:
        result = rg.compare(dive_log, settings, reference, scenario, chosen, duration, estimators, jobs, progress)
    result.save(out, force)
    shown = console(COMPARISON_WIDTH)
    for part in fitting(comparison_table(result.comparison, result.title, result.thesis), shown):
        shown.print(part)
    for row in result.comparison.runs.dropna(subset="error").drop_duplicates("estimator").itertuples():
        say(shown, f"{row.estimator} failed on {row.run}: {row.error}")
    say(shown, f"results in {out}")


OBSERVATION_WIDTH = 150  # columns of a file or a pipe, which has no width of its own

Relief = Annotated[
    tuple[float, float] | None,
    typer.Option(
        help="crosslines: sd and correlation length of the bottom's relief in m, where no log shows it; "
        "default: 0.35 4.5",
        metavar="SD LENGTH",
        show_default=False,
    ),
]


def observe(
    files: Files,
    config: ConfigPath = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="results folder; default: observed-LOG")] = None,
    estimate: Annotated[
        str | None, typer.Option(help="further calibration variables to estimate, separated by commas")
    ] = None,
    crosslines: Annotated[
        bool, typer.Option("--crosslines", help="predict what crosslines would show of the track's drift")
    ] = False,
    relief: Relief = None,
    force: Force = False,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
) -> None:
    """Show how well a dive determines each calibration variable, when it did, and what is missing.

    Example: rovgraph observe log.csv --config vehicle.yaml --estimate dvl_yaw,dvl_scale
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, progress_bar, say
    from rovgraph.report.folder import check_writable
    from rovgraph.report.lab import observability_table, words

    out = Path("observed-" + name_of(files)) if out is None else out
    settings = None if config is None else rg.load_config(config)
    check_writable(out, force, [*files, config])
    dive_log = read_files(files, settings, choose, shift, times)
    with progress_bar() as progress:
        result = rg.observe(dive_log, settings, estimate or (), progress, crosslines, relief)
    result.save(out, force)
    seen = result.observability
    shown = console(OBSERVATION_WIDTH)
    shown.print(observability_table(seen, f"what {files[0].name} shows"))
    for sentence in words(seen):
        say(shown, sentence)
    _print_crosslines(shown, result.crosslines)
    say(shown, f"results in {out}")


def _print_crosslines(shown: "Console", crosslines: "CrosslinePlan | None") -> None:
    from rovgraph.cli.console import say
    from rovgraph.report.lab import crosslines_in_words, crosslines_table

    if crosslines is None:
        return
    if len(crosslines.ranked) > 1:
        shown.print(crosslines_table(crosslines))
    for sentence in crosslines_in_words(crosslines):
        say(shown, sentence)


def plan(
    out: Annotated[Path, typer.Option("--out", "-o", help="results folder", show_default=False)],
    config: ConfigPath = None,
    known: Annotated[Path | None, typer.Option(help="observability.json of an earlier dive; default: none")] = None,
    goal: Annotated[
        list[str] | None,
        typer.Option(help="wanted sd, such as dvl_yaw=1deg or beacon=1m; may be repeated", metavar="NAME=SD"),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="duration of each manoeuvre in seconds; default: 120, or 900 for goals of acoustics or heading"
        ),
    ] = None,
    manoeuvres: Annotated[
        str | None,
        typer.Option(
            help="scenarios, such as circle or circle@0.3 (m/s), separated by commas; default: all that serve the goals"
        ),
    ] = None,
    estimate: Annotated[
        str | None, typer.Option(help="further calibration variables to estimate, separated by commas")
    ] = None,
    survey: Annotated[
        str | None,
        typer.Option(
            help="predict what crosslines would leave of a survey's drift: lines x length x distance apart @ speed, "
            "such as 8x250x25@1; manoeuvres are then ranked only with --goal, --manoeuvres, --duration or --known",
            show_default=False,
        ),
    ] = None,
    relief: Relief = None,
    fix_interval: Annotated[float | None, typer.Option(help="seconds between position fixes; default: none")] = None,
    imu_rate: Annotated[float, typer.Option(help="rate of the IMU, 5 to 1000 Hz")] = 100.0,
    dvl_rate: Annotated[float, typer.Option(help="rate of the DVL's pings, 0.1 to 50 Hz")] = 5.6,
    force: Force = False,
) -> None:
    """Rank manoeuvres for the calibration, and predict whether crosslines would help a survey, before the dive.

    Example: rovgraph plan --config vehicle.yaml --goal dvl_yaw=1deg --out plan
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, progress_bar, say
    from rovgraph.lab.choices import goals
    from rovgraph.lab.plan import SensorRates
    from rovgraph.report.folder import check_writable
    from rovgraph.report.lab import plan_table
    from rovgraph.report.tables import fitting

    check_writable(out, force)
    sensors, wanted = SensorRates(imu_rate, dvl_rate, fix_interval), goals(goal or [])
    settings = rg.load_config(config)
    with progress_bar() as progress:
        asked = settings, wanted, known, duration, manoeuvres, estimate or (), sensors, progress, survey, relief
        result = rg.plan(*asked)
    result.save(out, force)
    shown = console()
    if result.plan is not None:
        for part in fitting(plan_table(result.plan, f"manoeuvres of {result.plan.duration:g} s"), shown):
            shown.print(part)
    _print_crosslines(shown, result.crosslines)
    say(shown, f"results in {out}")


study = typer.Typer(help="Study by many simulated dives what is observable.", no_args_is_help=True)

STUDY_WIDTH = 170  # columns of a file or a pipe, which has no width of its own


@study.callback()
def _study() -> None:
    """Keep ``misalignment`` a command of its own, though it is the only one."""


@study.command()
def misalignment(
    config: Annotated[Path, typer.Option("--config", "-c", help="the study (YAML), see docs/studies.md")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="results folder", show_default=False)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="continue with the files in the results folder")] = False,
    only: Annotated[str | None, typer.Option(help="one cell, by the first characters of its id")] = None,
    jobs: Annotated[int | None, typer.Option(help="processes; default: one per core")] = None,
    scheduler: Annotated[str | None, typer.Option(help="address of a Dask cluster, such as tcp://host:8786")] = None,
    show: Annotated[bool, typer.Option("--list", help="list the cells and their ids without running them")] = False,
) -> None:
    """Study how well the DVL's misalignment can be estimated, and whether the stated sd is right.

    Example: rovgraph study misalignment --config configs/studies/quick.yaml --out quick
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, progress_bar, say
    from rovgraph.errors import InputError
    from rovgraph.lab.misalignment import read_study
    from rovgraph.report.lab import study_plan_table, study_table
    from rovgraph.report.tables import fitting

    shown = console(STUDY_WIDTH)
    if show:
        for part in fitting(study_plan_table(read_study(config)), shown):
            shown.print(part)
        return
    if out is None:
        raise InputError("--out is needed: a folder for the results")
    try:
        with progress_bar() as progress:
            tables = rg.study_misalignment(config, out, resume, only, jobs, scheduler, progress)
    except KeyboardInterrupt:
        say(shown, f"interrupted; {out} keeps every finished run, --resume continues")
        raise typer.Exit(130) from None
    for part in fitting(study_table(tables), shown):
        shown.print(part)
    for row in tables.runs.dropna(subset="failure").drop_duplicates("cell").itertuples():
        say(shown, f"{row.cell} failed in run {row.run}: {row.failure}")
    say(shown, f"results in {out}")


calibrate = typer.Typer(
    help="Calibrate the magnetometer, determine the noise of sensors at rest, or where the beams of a DVL point.",
    no_args_is_help=True,
)

LogPath = Annotated[Path, typer.Argument(help="CSV, CSV.gz or Parquet, see docs/log-format.md", metavar="LOG")]
OutPath = Annotated[Path, typer.Option("--out", "-o", help="results folder to create", show_default=False)]


class Method(StrEnum):
    """How a magnetometer is calibrated."""

    ellipsoid = "ellipsoid"
    turns = "turns"


@calibrate.command()
def magnetometer(
    log: LogPath,
    out: OutPath,
    config: ConfigPath = None,
    method: Annotated[
        Method, typer.Option(help="ellipsoid, or turns for one turn about z and one about x")
    ] = Method.ellipsoid,
    force: Force = False,
) -> None:
    """Determine hard and soft iron from a log in which the vehicle turns about all its axes.

    Example: rovgraph calibrate magnetometer turned.csv --out magnetometer
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.report.folder import check_writable

    check_writable(out, force, [log, config])
    settings = rg.load_config(config)
    recorded = rg.read_log(log, settings.with_raw_magnetometer())
    result = rg.calibrate_magnetometer(recorded, settings, method.value)
    result.save(out, force)
    shown = console()
    shown.print(_magnetometer_table(result.found))
    say(shown, f"for the configuration: {out / 'magnetometer.yaml'}")


@calibrate.command()
def noise(log: LogPath, out: OutPath, config: ConfigPath = None, force: Force = False) -> None:
    """Determine the noise of IMU, DVL and compasses from a log at rest; waves are tolerated.

    Example: rovgraph calibrate noise standing.csv --out noise
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.report.folder import check_writable

    check_writable(out, force, [log, config])
    settings = rg.load_config(config)
    result = rg.calibrate_noise(rg.read_log(log, settings), settings)
    result.save(out, force)
    shown = console()
    for table in _noise_tables(result.found):
        shown.print(table)
    for line in result.found.remarks:
        say(shown, f"note: {line}")
    say(shown, f"for the configuration: {out / 'noise.yaml'}")


@calibrate.command()
def dvl_beams(log: LogPath, config: ConfigPath = None) -> None:
    """Determine where the beams of a DVL point, and print it for the configuration.

    Example: rovgraph calibrate dvl-beams log.csv >> vehicle.yaml
    """
    import rovgraph as rg

    settings = rg.load_config(config)
    typer.echo(rg.calibrate_dvl_beams(rg.read_log(log, settings), settings).to_yaml(), nl=False)


def _magnetometer_table(found: "MagnetometerCalibration") -> "Table":
    import numpy as np
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table("", "", title=Text(found.source), title_justify="left", box=box.SIMPLE, show_header=False)
    table.add_row("method, samples used", f"{found.method}, {found.used.sum()} of {len(found.used)}")
    table.add_row("centre (hard iron)", _vector(found.centre))
    if np.isfinite(found.centre_sd).all():
        table.add_row("its sd", _vector(found.centre_sd))
    table.add_row("radii", _vector(found.radii))
    table.add_row("field's length", f"{found.length:.4g}")
    lengths = [f"{100 * fit.length_rms:.2f} %" for fit in (found.before, found.after)]
    table.add_row("its scatter, before and after", ", ".join(lengths))
    if found.dip is not None:
        dips = [f"{np.rad2deg(fit.dip_rms or 0.0):.2f}°" for fit in (found.before, found.after)]
        table.add_row("dip, its scatter before and after", f"{np.rad2deg(found.dip):.1f}°, " + ", ".join(dips))
    if found.disturbances is None:
        table.add_row("disturbances", "not looked for: no gyro in the log")
    for d in found.disturbances or []:
        when = f"{d.start - found.time[0]:.1f} s to {d.end - found.time[0]:.1f} s"
        table.add_row("disturbance", f"{when}: {_vector(d.vector)}")
    if found.disturbances == []:
        table.add_row("disturbances", "none")
    return table


def _vector(values: object) -> str:
    import numpy as np

    return "(" + ", ".join(f"{x:.3g}" for x in np.asarray(values)) + ")"


def _noise_tables(found: "NoiseReport") -> "list[Table]":
    from rich import box
    from rich.table import Table
    from rich.text import Text

    title = f"{found.source}, {found.duration:.0f} s"
    noise = Table(title=Text(title), title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("channel", "sd", "no lines", "/rtHz", "bias", "/rts", "unit"):
        noise.add_column(Text(heading), justify="left" if heading in ("channel", "unit") else "right", no_wrap=True)
    for c in found.channels:
        readings = [f"{x:.2g}" if x is not None else "–" for x in (c.allan.instability, c.allan.walk)]
        noise.add_row(c.name, f"{c.sd:.2g}", f"{c.quiet_sd:.2g}", f"{c.allan.density:.2g}", *readings, c.unit)
    noise.caption = (
        "sd of the samples, and without the spectra's lines; noise density; bias instability; random walk\n"
        "–: does not show in a log of this length"
    )
    lines = Table(title="lines in the spectra", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("sensor", "Hz", "rad/sample", "looks like", "rms, strongest channel"):
        lines.add_column(heading, justify="left" if heading in ("sensor", "looks like") else "right", no_wrap=True)
    for p in found.peaks:
        name = max(p.rms, key=lambda n: p.rms[n] / found.channel(n).quiet_sd)
        strongest = f"{p.rms[name]:.2g} {found.channel(name).unit} {name}"
        lines.add_row(p.sensor, f"{p.frequency:.3f}", f"{p.rad_per_sample:.3f}", p.kind, strongest)
    return [noise, lines] if found.peaks else [noise]
