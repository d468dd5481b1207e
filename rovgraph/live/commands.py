"""What a person says to a dive that goes on. Commands come through the feed, between messages of the sources."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """Something that a person wants done."""


@dataclass(frozen=True)
class DropMark(Command):
    """Keep a place.

    Attributes
    ----------
    name : any text
    north, east : of a way-point [m]; None = a mark where the vehicle is
    """

    name: str
    north: float | None = None
    east: float | None = None


@dataclass(frozen=True)
class RemoveMark(Command):
    """Forget a mark by its number."""

    number: int


@dataclass(frozen=True)
class SetPosition(Command):
    """Where the vehicle is now: becomes a position fix, which is weighed and gated as any other.

    Attributes
    ----------
    north, east : [m]
    sd : of each [m]
    """

    north: float
    east: float
    sd: float
