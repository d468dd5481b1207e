"""Several channels of one sensor: which comes first."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rovgraph.errors import InputError
from rovgraph.interchange.recording import Channel


def preferred_first(
    path: Path, channels: Sequence[tuple[str, Channel]], choose: Mapping[str, str]
) -> tuple[Channel, ...]:
    """Channels with what a user chose in front of its alternatives.

    Parameters
    ----------
    path : of the file, for messages
    channels : label and channel, the preferred one of each sensor first; a label is a message and, where there are
        several, its instance, such as "IMU 1"
    choose : sensor -> a label, or its last word where that is an instance

    Raises
    ------
    InputError : none of a sensor's channels is called so
    """
    for sensor, wanted in choose.items():
        labels = [label for label, channel in channels if channel.sensor == sensor]
        if labels and not any(_means(wanted, label) for label in labels):
            raise InputError(f"{path}: {sensor} cannot come from {wanted!r}; choose one of: {', '.join(labels)}")
    return tuple(c for label, c in sorted(channels, key=lambda each: not _chosen(*each, choose)))


def _chosen(label: str, channel: Channel, choose: Mapping[str, str]) -> bool:
    return channel.sensor in choose and _means(choose[channel.sensor], label)


def _means(wanted: str, label: str) -> bool:
    name, _, instance = label.partition(" ")
    return wanted.casefold() in (label.casefold(), instance or name.casefold())
