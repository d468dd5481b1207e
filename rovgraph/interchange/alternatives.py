"""Several sources of one sensor's measurements: which comes first."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rovgraph.errors import InputError


class SourceMissing(InputError):
    """A file has a sensor, and not the source of it that was chosen; another file may.

    Attributes
    ----------
    sensor : name of its stream in a log
    """

    def __init__(self, text: str, sensor: str) -> None:
        super().__init__(text)
        self.sensor = sensor


def preferred_first(path: Path, sensor: str, labels: Sequence[str], choose: Mapping[str, str]) -> list[str]:
    """Sources of a sensor with what a user chose in front.

    Parameters
    ----------
    path : of the file, for messages
    sensor : name of its stream in a log
    labels : a message and, where there are several, its instance, such as "IMU 1"; the best first
    choose : sensor -> a label, or its instance alone

    Raises
    ------
    SourceMissing : none is called so
    """
    wanted = choose.get(sensor)
    if wanted is None or not labels:
        return list(labels)
    if not any(_means(wanted, label) for label in labels):
        text = f"{path}: {sensor} cannot come from {wanted!r}; choose one of: {', '.join(labels)}"
        raise SourceMissing(text, sensor)
    return sorted(labels, key=lambda label: not _means(wanted, label))


def _means(wanted: str, label: str) -> bool:
    return wanted.casefold() in (label.casefold(), label.rpartition(" ")[2].casefold())
