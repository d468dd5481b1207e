"""What the gyro's noise feigns of the DVL's place.

A ping measures R_bs' (v + w x l) with the arm l, and the rate w is a gyro's, with an error e: errors in variables. The
derivative by the arm has e in it, and so has the innovation, as e x l. Least squares then counts

    F = sum over pings of rate_sd^2 (tr(M) 1 - M),   M = R_bs (diag(sd^2) + G G' rate_sd^2)^-1 R_bs'

as information of the arm, which is E [e]x' M [e]x, and draws it to zero by the score - F l. Without both, what is left
is what the vehicle's own rates show: the corrected score (Nakamura 1990). Of a vehicle that hardly rolls, with an IMU
for autopilots, nothing is left of the arm's z, however long the dive is. Noise that the estimate follows is in no
innovation: M is less M P M, with P the covariance with which it follows.
"""

from dataclasses import dataclass, replace

import numpy as np

from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.stretches import resume
from rovgraph.geometry import Array
from rovgraph.sensors.dvl import DvlVelocity, dvl_mounting

ARM = "dvl_lever_arm"
MOST = 0.5  # of the arm's information, that may be feigned: beyond it what is left is worth little
MOST_DRAWN = 5.0  # sds: what is taken off is right to a tenth
ROUNDS = 3  # each leaves of the error of the score as much as is feigned of the information


@dataclass(frozen=True)
class Feigned:
    """What the rate's noise feigns of the arm's three components, each by itself.

    Attributes
    ----------
    information : ndarray, shape (3,) [1/m^2]
    score : ndarray, shape (3,), as if the arm were longer by score / information [1/m]
    """

    information: Array
    score: Array

    def sd(self, sd: Array) -> Array:
        """What an sd of least squares [m] is in truth; infinite where most of its information is feigned."""
        share = self.share(sd)
        return np.asarray(np.where(share < MOST, sd / (1.0 - np.minimum(share, MOST)), np.inf))

    def share(self, sd: Array) -> Array:
        """Of the information of least squares with an sd [m], what is feigned."""
        return self.information * sd**2

    def drawn(self, sd: Array) -> Array:
        """By how much least squares with an sd falls short of the arm [m]."""
        return np.asarray(np.abs(self.score) * sd**2)

    def step(self, step: Array, sd: Array) -> Array:
        """A step of least squares with its sd, without what is feigned [m]; only where `sd` is finite."""
        return np.asarray((step + self.score * sd**2) / (1.0 - np.minimum(self.share(sd), MOST)))


def feigned(best: Optimum) -> Feigned:
    """What the rate's noise feigns of the arm in a dive."""
    information, score, followed = np.zeros(3), np.zeros(3), _followed(best)
    for sensor, block in best.blocks.items():
        model = block.instrument.model
        if not isinstance(model, DvlVelocity):
            continue
        R_bs = dvl_mounting(best.state.at(block.keyframe))
        WR = block.W @ np.swapaxes(R_bs, 1, 2)
        M = np.swapaxes(WR, 1, 2) @ WR
        M -= M @ followed @ M
        of_one = np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3) - M
        F = np.einsum("n,nij->ij", best.weights[sensor] * block.rate_sd**2, of_one)
        arm = np.mean(model.lever_arm_b + np.atleast_2d(best.state.calibration[ARM]), axis=0)
        information += np.diag(F)
        score += F @ arm
    return Feigned(information, score)


def _followed(best: Optimum) -> Array:
    """Covariance of the velocity with which the estimate follows the noise of a ping, in b, shape (3, 3).

    A smoother has a quarter of a filter's variance of what is integrated twice from white noise, as velocity is from
    the gyro's by tilt. Constants follow no single ping.
    """
    if not isinstance(best, ChainOptimum):
        return np.zeros((3, 3))
    R_nb = best.state.R_nb[-1]
    return np.asarray(0.25 * R_nb.T @ best.newest_of_known_constants[6:9, 6:9] @ R_nb)


def noise_moves_arm(best: Optimum, sd: Array) -> bool:
    """Whether noise makes too much of what least squares knows of the arm, of an sd of shape (3,) [m]."""
    noise = feigned(best)
    return bool(((noise.share(sd) > MOST) | (noise.drawn(sd) > MOST_DRAWN * sd)).any())


def with_arm_undrawn(best: ChainOptimum) -> ChainOptimum:
    """The optimum with the score of an estimated arm that the rate's noise has taken."""
    if best.unknowns.walks.get(ARM) != 0.0:
        return best
    for _ in range(ROUNDS):
        belief = replace(best.beliefs[ARM], score=feigned(best).score)
        chain = replace(best.chain, beliefs={**best.beliefs, ARM: belief})
        best = ChainOptimum(chain, resume(chain, best.state, best.solution))
    return best
