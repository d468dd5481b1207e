"""What the noise of the measured rate does to the DVL's arm and scale: spurious information, and scores that draw them.

A ping measures R_bs' (v + w x l) with the arm l, and the rate w is a gyro's, with an error e: errors in variables. The
derivative by the arm has e in it, and so has the innovation, as e x l. Least squares then counts

    F = sum over pings of rate_sd^2 (tr(M) 1 - M),   M = R_bs (diag(sd^2) + G G' rate_sd^2)^-1 R_bs'

as information of the arm, which is E [e]x' M [e]x, and draws it to zero by the score - F l. Without both, the
information of the vehicle's own rates remains: the corrected score (Nakamura 1990). For a vehicle that hardly rolls,
with an IMU for autopilots, no information about the arm's z remains, however long the dive is. Noise that the estimate
follows is not in the innovation, so M is reduced by the part of a ping's information that goes into its own prediction.

The derivative by the DVL's scale, v + w x l, has e in it too: least squares draws the scale down by the score -l' F l.
What the filter's prediction adds to that is in `rovgraph.kernels.correction.draw_no_scale`.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.optimum import NEWEST, Optimum, estimated_parts
from rovgraph.kernels import measurement_row as at
from rovgraph.model.calibration import BEAM_SENSORS
from rovgraph.problem.measurements import Measurements
from rovgraph.sensors.dvl import DvlVelocity, dvl_mounting
from rovgraph.sensors.dvl_beam import DvlBeam

ARM, SCALE = "dvl_lever_arm", "dvl_scale"
WORTHLESS = 0.5  # share of spurious information beyond which what is left is worth little
MOST = 0.25  # the same, up to which the arm may be estimated
MOST_DRAWN = 5.0  # sds, up to which it may be estimated: what is taken off is right to a tenth
MOST_DRAWN_UNCORRECTED = 1.0  # the same where nothing is taken off
LEAST_DRAWN = 0.05  # sds, from which on the scale is worth a step
ROUNDS = 3  # each leaves of the score's error the share of spurious information
MOST_FOLLOWED = 0.2  # part of a ping's information that goes into its own prediction
BRIDGED = 3.0  # times the usual noise of the rate, in gaps of the IMU: not the noise of a gyro


@dataclass(frozen=True)
class RateNoiseScore:
    """What the rate's noise adds to least squares of the arm's three components along b, each by itself, and the scale.

    Attributes
    ----------
    information : ndarray, shape (3,), of the arm, spurious [1/m^2]
    score : ndarray, shape (3,), that it takes from the arm's components [1/m]
    scale_score : that it takes from the DVL's scale
    """

    information: Array
    score: Array
    scale_score: float

    def share(self, sd: Array) -> Array:
        """Spurious share of the information of least squares with an sd [m]."""
        return self.information * sd**2

    def drawn(self, sd: Array) -> Array:
        """By how much least squares with an sd falls short of the arm [m]."""
        return np.asarray(np.abs(self.score) * sd**2)

    def sd(self, sd: Array) -> Array:
        """The true sd for an sd of least squares [m]; infinite where little information remains."""
        share = self.share(sd)
        return np.asarray(np.where(share < WORTHLESS, sd / (1.0 - np.minimum(share, WORTHLESS)), np.inf))

    def step(self, step: Array, sd: Array) -> Array:
        """The corrected step for a step of least squares with its sd [m]; only where `sd` is finite."""
        return np.asarray((step + self.score * sd**2) / (1.0 - np.minimum(self.share(sd), WORTHLESS)))


def score_of_rate_noise(best: Optimum) -> RateNoiseScore:
    """F and F l of above in a dive, of the admitted measurements with their weights."""
    information, score, scale_score, followed = np.zeros(3), np.zeros(3), 0.0, _followed(best)
    dvl = {s: block for s, block in best.blocks.items() if isinstance(block.instrument.model, DvlVelocity | DvlBeam)}
    found = {sensor: _of_velocity(best, block) for sensor, block in dvl.items()}
    beams = sum((M.mean(axis=0) for sensor, M in found.items() if sensor in BEAM_SENSORS), np.zeros((3, 3)))
    for sensor, block in dvl.items():
        M = found[sensor]
        part = np.minimum(followed * np.diag(beams if sensor in BEAM_SENSORS else M.mean(axis=0)), MOST_FOLLOWED)
        M *= np.sqrt(np.outer(1.0 - part, 1.0 - part))
        of_one = np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3) - M
        used = best.weights[sensor] * (block.rate_sd < BRIDGED * np.median(block.rate_sd))
        F = np.einsum("n,nij->ij", used * block.rate_sd**2, of_one)
        arm = np.mean(_arm_b(block) + np.atleast_2d(best.state.calibration[ARM]), axis=0)
        information += np.diag(F)
        score += F @ arm
        scale_score += float(arm @ F @ arm)
    return RateNoiseScore(information, score, scale_score)


def _of_velocity(best: Optimum, block: Measurements) -> Array:
    """M of above for each measurement, of a velocity or along a beam, shape (n, 3, 3)."""
    model, R_sb = block.model, np.swapaxes(dvl_mounting(best.state.at(block.keyframe)), 1, 2)
    seen = model.context[:, None, at.BEAM : at.BEAM + 3] @ R_sb if isinstance(model, DvlBeam) else R_sb
    WR = block.W @ seen
    return np.asarray(np.swapaxes(WR, 1, 2) @ WR)


def _arm_b(block: Measurements) -> Array:
    """Of the DVL, from the state's origin, shape (3,) [m]."""
    model = block.at(slice(0, 1)).model
    if isinstance(model, DvlBeam):
        return model.context[0, at.BEAM_ARM : at.BEAM_ARM + 3]
    assert isinstance(model, DvlVelocity)
    return np.asarray(model.lever_arm_b)


def _followed(best: Optimum) -> Array:
    """Variance of the velocity along axes of b with which the estimate follows a ping, shape (3,).

    A smoother has a quarter of a filter's variance of what is integrated twice from white noise, as velocity is from
    the gyro's by tilt. Constants follow no single ping.
    """
    if not isinstance(best, ChainOptimum):
        return np.zeros(3)
    R_nb = best.state.R_nb[-1]
    return np.asarray(0.25 * np.diag(R_nb.T @ best.newest_of_known_constants[6:9, 6:9] @ R_nb))


def rate_noise_moves_arm(best: Optimum, sd: Array) -> bool:
    """Whether too much of least squares' information about the arm is spurious, of an sd of shape (3,) [m]."""
    spurious = score_of_rate_noise(best)
    most = MOST_DRAWN if isinstance(best, ChainOptimum) else MOST_DRAWN_UNCORRECTED
    return bool(((spurious.share(sd) > MOST) | (spurious.drawn(sd) > most * sd)).any())


def without_rate_noise(best: Optimum) -> Optimum:
    """The optimum without what the gyro's noise takes from an estimated arm and scale of the DVL.

    The arm is as the vehicle's own rates show it, and considered where these show too little.

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    best = _with_scale(best)
    if best.unknowns.walks.get(ARM) != 0.0:
        return best
    sd = np.sqrt(np.diag(best.newest_covariance())[NEWEST:])
    if rate_noise_moves_arm(best, sd[estimated_parts(best)[ARM]]):
        return best.considering([ARM])
    if isinstance(best, ChainOptimum):
        for _ in range(ROUNDS):
            best = best.with_score(ARM, score_of_rate_noise(best).score)
    return best


def _with_scale(best: Optimum) -> Optimum:
    """The optimum with the score of the DVL's scale, where it is worth a step."""
    if best.unknowns.walks.get(SCALE) != 0.0 or not isinstance(best, ChainOptimum):
        return best
    sd = np.sqrt(np.diag(best.newest_covariance())[NEWEST:])[estimated_parts(best)[SCALE]]
    score = np.array([score_of_rate_noise(best).scale_score])
    return best.with_score(SCALE, score) if (score * sd > LEAST_DRAWN).all() else best
