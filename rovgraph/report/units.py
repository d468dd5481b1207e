"""Numbers and names with units, for people."""

import numpy as np

from rovgraph.log.units import behind, shown


def plus_minus(value: float, sd: float, unit: str = "") -> str:
    """``value ± sd unit`` with two significant digits of the sd.

    >>> plus_minus(-21.5312, 1.912, "deg")
    '-21.5 ± 1.9 deg'
    """
    tail = behind(unit)
    if not np.isfinite(value):
        return "unknown"
    if not np.isfinite(sd) or sd <= 0.0:
        return f"{value:.4g}{tail}"
    digits = int(np.clip(1 - np.floor(np.log10(float(f"{sd:.1e}"))), 0, 9))
    return f"{value:.{digits}f} ± {sd:.{digits}f}{tail}"


def label_with_unit(label: str, unit: str) -> str:
    """A name with the unit that its numbers are shown in, as short as can be.

    >>> label_with_unit("gyr_bias_x", "rad/s"), label_with_unit("dvl_scale", "1")
    ('gyr_bias_x °/s', 'dvl_scale')
    """
    name = shown(unit)[1].replace("deg", "°")
    return label if unit == "1" else f"{label} {name}"


def percent(ratio: float) -> str:
    """A ratio in percent with two digits, never in powers of ten.

    >>> percent(0.00551), percent(1.04)
    ('0.55 %', '104 %')
    """
    return f"{100 * ratio:.0f} %" if ratio >= 0.0995 else f"{100 * ratio:.2g} %"


def key_suffix(unit: str) -> str:
    """The ending of a JSON key or name for a shown unit: ``_deg``, ``_mps2``; "" for a ratio."""
    plain = (
        unit.replace("^", "")
        .replace("m/s2", "mps2")
        .replace("m/s", "mps")
        .replace("deg/s", "dps")
        .replace("/", "_per_")
    )
    return "" if unit in ("", "1") else "_" + plain


def nice_step(seconds: float) -> float:
    """The round time step at or above ``seconds``, such as 15 s, 2 min, 1 h."""
    steps = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600)
    return next((float(s) for s in steps if s >= seconds), float(3600 * np.ceil(seconds / 3600)))


def duration(seconds: float | None) -> str:
    """Time in words, such as ``55 min 43 s``."""
    if seconds is None:
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


WORDS = {"acc": "accelerometer", "gyr": "gyro", "mag": "magnetometer", "ahrs": "AHRS", "dvl": "DVL", "imu": "IMU",
         "usbl": "USBL",          "sin": "sine part", "cos": "cosine part"}  # fmt: skip
PARTS = {"x", "y", "z", "sin", "cos", "xx", "yy", "zz", "xy", "xz", "yz"}


def words(key: str) -> str:
    """The key of a sensor or a calibration variable in words.

    >>> words("dvl_compass_deviation_sin"), words("acc_bias_x")
    ('DVL compass deviation, sine part', 'accelerometer bias, x')
    """
    *most, last = key.split("_")
    parts = [*most, last] if not most or last not in PARTS else most
    text = " ".join(WORDS.get(part, part) for part in parts)
    return text if len(parts) > len(most) else f"{text}, {WORDS.get(last, last)}"
