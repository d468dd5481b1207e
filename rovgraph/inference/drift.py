"""The drift of a track, and what loop closures say of it and of all that is correlated with it.

A loop closure is information about e(a) - e(b), the errors of a track, north and east, at two times.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.geometry import Array

BEAMS_M = 0.1  # sd of where soundings are, beside the track's error, where it is not known: 0.5 degrees at 10 m


@dataclass(frozen=True)
class LoopClosure:
    """What soundings say of the errors of a track at two times, in information form.

    Attributes
    ----------
    times : a, b [s]
    information : ndarray, shape (2, 2), of e(a) - e(b) [1/m^2]
    pull : ndarray, shape (2,), information times shift [1/m]
    """

    times: tuple[float, float]
    information: Array
    pull: Array


def condition(mean: Array, P: Array, H: Array, information: Array, pull: Array) -> tuple[Array, Array]:
    """Mean and covariance of x, given what is known of H x in information form."""
    column = P @ H.T
    gain = column @ np.linalg.inv(np.eye(len(H)) + information @ H @ column)
    P = P - gain @ information @ column.T
    return mean + gain @ (pull - information @ H @ mean), 0.5 * (P + P.T)


@dataclass(frozen=True)
class Drift:
    """Errors of a track at m knots, north and east, and between them, where it is straight, in proportion.

    Attributes
    ----------
    time : ndarray, shape (m,) [s]
    mean : ndarray, shape (2 m,) [m]
    P : ndarray, shape (2 m, 2 m) [m^2]
    beams_sd : of where soundings are beside these errors, by attitude and mounting of the beams, along any axis [m]
    """

    time: Array
    mean: Array
    P: Array
    beams_sd: float = BEAMS_M

    def beside(self, mean: Array, sd: float) -> "Drift":
        """With one more knot, at no time: the error of a chart's place, north and east."""
        P = np.pad(self.P, (0, 2))
        P[-2:, -2:] = sd**2 * np.eye(2)
        return replace(self, time=np.append(self.time, np.inf), mean=np.append(self.mean, mean), P=P)

    def at(self, time: Array) -> Array:
        """The mean at some times, shape (n, 2) [m]."""
        return np.stack([np.interp(time, self.time, axis) for axis in self.mean.reshape(-1, 2).T], axis=-1)

    def between(self, ends: Sequence[tuple[float, float]]) -> Array:
        """Derivative of k shifts, each between two times, by the drift, shape (2 k, 2 m)."""
        later, earlier = np.array(ends).T
        H = [np.interp(later, self.time, knot) - np.interp(earlier, self.time, knot) for knot in np.eye(len(self.time))]
        return np.asarray(np.kron(np.transpose(H), np.eye(2)), float)

    def beams(self, ends: Sequence[tuple[float, float]]) -> Array:
        """Variance that beams bring to k shifts of one line or two, north and east, shape (2 k,) [m^2]."""
        return np.repeat(self.beams_sd**2 * np.isfinite(ends).sum(axis=1), 2)

    def given(self, closures: Sequence[LoopClosure]) -> "Drift":
        """What is left of it."""
        pull, root = self.shows(closures)
        V = self.P @ root
        return replace(self, mean=self.mean + self.P @ pull, P=self.P - V @ V.T)

    def shows(self, closures: Sequence[LoopClosure]) -> tuple[Array, Array]:
        """What k closures say of every variable x: it moves by cov(x, e) pull, its covariance loses V V'.

        With H the shifts by these errors e, and the closures' information W,

            root root' = H' (W^-1 + H P H')^-1 H,   V = cov(x, e) root

        Returns
        -------
        pull, root : ndarrays, shapes (2 m,) and (2 m, 2 k)
        """
        ends, information = [c.times for c in closures], np.zeros((2 * len(closures),) * 2)
        for k, closure in enumerate(closures):
            information[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = closure.information
        seen, H = np.linalg.inv(np.eye(len(information)) + information * self.beams(ends)), self.between(ends)
        information, pull = seen @ information, seen @ np.array([c.pull for c in closures]).ravel()
        value, axes = np.linalg.eigh(0.5 * (information + information.T))
        known, S = axes * np.sqrt(value.clip(min=0.0)), H @ self.P @ H.T
        root = np.linalg.inv(np.linalg.cholesky(np.eye(len(S)) + known.T @ S @ known)).T
        off = np.linalg.solve(np.eye(len(S)) + information @ S, pull - information @ H @ self.mean)
        return H.T @ off, H.T @ known @ root
