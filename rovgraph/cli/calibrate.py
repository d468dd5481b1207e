"""``rovgraph calibrate``: calibrations from a log of their own."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from rovgraph.calibrate import MagnetometerCalibration, NoiseReport

calibrate = typer.Typer(
    help="Calibrate the magnetometer, or determine the noise of sensors at rest.", no_args_is_help=True
)

LogPath = Annotated[Path, typer.Argument(help="CSV, CSV.gz or Parquet, see docs/log-format.md", metavar="LOG")]
ConfigPath = Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")]
OutPath = Annotated[Path, typer.Option("--out", "-o", help="results folder to create", show_default=False)]
Force = Annotated[bool, typer.Option("--force", help="replace an older results folder")]


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
