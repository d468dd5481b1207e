"""Noise and bias of an inertial unit that cannot be of one instrument.

A sensor of density d, averaged at rest for a time T, shows its bias to d / sqrt(T). A prior that is sharper than ten
minutes of that is knowledge that hardly anyone has. A prior that is far wider is of a worse instrument: of the
instruments whose data sheets state both (`rovgraph.config.presets`) the widest offset is 250 sqrt(Hz) d.
"""

import numpy as np

from rovgraph.config.sections import Imu
from rovgraph.errors import warn

SHARPEST = 1.0 / np.sqrt(600.0)  # of the prior over the density [sqrt(Hz)]
WIDEST = 1000.0  # a fibre-optic gyro beside the bias of a MEMS gyro has 3000


def warn_of_mixed_grades(imu: Imu, source: str) -> None:
    """Warn where density and bias prior of gyro or accelerometer are not of one instrument.

    Parameters
    ----------
    imu : stated, filled in and default values
    source : of the configuration, for the message
    """
    gyr_sd = float(np.deg2rad(imu.gyr_bias_sd_dps))
    rows = (
        ("imu.noise.gyr", imu.noise.gyr, "imu.gyr_bias_sd_dps", imu.gyr_bias_sd_dps, gyr_sd),
        ("imu.noise.acc", imu.noise.acc, "imu.acc_bias_sd_mps2", imu.acc_bias_sd_mps2, imu.acc_bias_sd_mps2),
    )
    for noise, density, bias, shown, sd in rows:
        if sd > WIDEST * density:
            verdict = "is that of a much coarser instrument"
        elif sd < SHARPEST * density:
            verdict = "is that of a much finer instrument"
        else:
            continue
        text = f"{source}: {bias} = {shown:g} {verdict} than {noise} = {density:.3g}; state both of one data sheet"
        warn(text)
