"""The place of a DVL that is elsewhere than the configuration has it, by the vehicle's own rates.

Where the gyro's noise would move the DVL's arm if it were estimated, it is considered, and stays at its mean however
far off that is (`rovgraph.engine.rate_noise`). The score test without that noise says where the DVL is instead.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.calibration import MOUNT, TABLE
from rovgraph.diagnosis.constants import FEIGNED, RELEASED
from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.engine.rate_noise import ARM
from rovgraph.engine.released import release
from rovgraph.geometry import Array
from rovgraph.rules import RULES


@dataclass(frozen=True)
class DvlPlace:
    """Where the DVL is.

    Attributes
    ----------
    offset : ndarray, shape (3,), from where the configuration has it, along b; 0 where nothing shows [m]
    mean : ndarray, shape (3,), of `ARM`, that puts it there [m]
    sd : of each component, at least the prior's [m]
    size : of the largest offset, in sds of the prior
    """

    offset: Array
    mean: Array
    sd: float
    size: float

    @property
    def cause(self) -> str:
        """What is so, in words."""
        named = zip(TABLE[ARM].labels, self.offset.tolist(), strict=True)
        where = ", ".join(f"{label[-1]} {off:+.2g} m" for label, off in named if off)
        return (
            f"the vehicle's rates show it elsewhere, {where} from where dvl.lever_arm_m, imu.lever_arm_m and "
            f"calibration.{ARM}.mean have it"
        )


def other_place(best: ChainOptimum) -> DvlPlace | None:
    """The place of a DVL that is considered, where it is another and no constant that is held is further off."""
    if ARM not in best.unknowns.considered or _is_turned(best):
        return None
    belief, released = best.beliefs[ARM], release(best, RELEASED)
    spread = {r.label: float(np.hypot(r.sd, FEIGNED.get(r.name, 0.0))) for r in released}
    arm = [r for r in released if r.name == ARM and abs(r.step) > RULES["held"].doubtful * spread[r.label]]
    # a place that is off makes stamps seem late: the arm is compared without what errors in variables allow for
    others = [abs(r.step) / spread[r.label] for r in released if r.name != ARM]
    if not arm or max(r.significance for r in arm) < max(others, default=0.0):
        return None
    steps = {r.label: r.step for r in arm}
    offset = np.array([steps.get(label, 0.0) for label in belief.variable.labels])
    sd = max(belief.sd, *(spread[r.label] for r in arm))
    return DvlPlace(offset, belief.mean + offset, sd, float(np.abs(offset).max() / belief.sd))


def _is_turned(best: ChainOptimum) -> bool:
    """Whether the DVL's mounting is estimated far from its prior, as it is where axes are named wrongly."""
    own = [best.beliefs[name] for name in MOUNT if best.unknowns.walks.get(name) == 0.0]
    return any(
        abs(float(best.state.calibration[b.variable.name][0] - b.mean[0])) > RULES["moved"].doubtful * b.sd for b in own
    )
