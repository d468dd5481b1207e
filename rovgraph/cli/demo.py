"""``rovgraph demo``: a first dive, without a log of your own."""

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder to create")] = Path("demo"),
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
) -> None:
    """Write a demonstration dive, estimate its track and compare it with the truth.

    Example: rovgraph demo
    """
    import rovgraph as rg
    from rovgraph.cli.evaluate import show_metrics
    from rovgraph.cli.progress import progress_bar
    from rovgraph.cli.smooth import show_result

    with progress_bar() as progress:
        done = rg.demo(out, force, progress)
    track = done.results / "trajectory_smoothed.csv"
    typer.echo(f"$ rovgraph smooth {out / 'log.csv'} --config {out / 'config.yaml'} --out {done.results}")
    show_result(done.result, done.summary, done.results)
    typer.echo(f"\n$ rovgraph evaluate {track} {out / 'truth.csv'}")
    show_metrics(done.metrics, "smoothed track against the truth")
    typer.echo(f"""
Look next at
  {done.results / "report.html"}: the dive as a page, in any browser
  {done.results / "residuals.png"}: every measurement against its prediction
  {out / "config.yaml"}: the vehicle's configuration
For your own log: rovgraph check LOG, then rovgraph smooth LOG --config CONFIG""")
