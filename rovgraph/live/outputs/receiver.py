"""What a GPS receiver would say, for those who only listen to one."""

SATELLITES = 10  # autopilots refuse fewer than six
RANGE_ERROR = 5.0  # per unit of dilution of precision [m]


def dilution(sd: float) -> float:
    """Dilution of precision with which a receiver would be as uncertain as ``sd`` [m]."""
    return sd / RANGE_ERROR
