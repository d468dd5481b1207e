"""One of several kinds of message that say the same."""

from collections.abc import Sequence

from rovgraph.live.sources.source import Notify

PATIENCE_S = 5.0  # silence after which a lesser kind takes over


class Preferred:
    """Takes one kind of message: the best one that is heard, so that nothing is counted twice.

    Parameters
    ----------
    kinds : best first
    notify : takes warnings
    """

    def __init__(self, kinds: Sequence[str], notify: Notify) -> None:
        self._kinds = tuple(kinds)
        self._notify = notify
        self._current: str | None = None
        self._heard = 0.0

    def takes(self, kind: str, arrival: float) -> bool:
        """Whether a message of this kind is taken.

        Parameters
        ----------
        kind : of the message
        arrival : seconds since 1970
        """
        if kind not in self._kinds:
            return False
        if kind != self._current and self._takes_over(kind, arrival):
            if self._current is not None:
                self._notify("switched", f"{kind} is read from now on, in the place of {self._current}")
            self._current = kind
        if kind == self._current:
            self._heard = arrival
        return kind == self._current

    def _takes_over(self, kind: str, arrival: float) -> bool:
        if self._current is None or arrival - self._heard > PATIENCE_S:
            return True
        return self._kinds.index(kind) < self._kinds.index(self._current)
