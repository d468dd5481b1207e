"""A configuration that lies beside a log and was not given."""

import warnings
from pathlib import Path

from rovgraph.errors import DataWarning


def warn_of_unused(config: Path | None, *logs: Path | str) -> None:
    """Say that there is one: forgetting it makes a wrong track, which looks certain.

    Parameters
    ----------
    config : that was given, or None
    logs : files, or sources of the form ``file:log.csv``
    """
    for log in logs:
        beside = Path(str(log).removeprefix("file:").partition("?")[0]).parent / "config.yaml"
        if config is None and beside.is_file():
            text = f"{beside} lies beside the log and is not used; give --config {beside} if it is the vehicle's"
            warnings.warn(text, DataWarning, stacklevel=2)
