"""A place on Earth in plain numbers, against pymap3d's arrays."""

import numpy as np
import pymap3d
import pytest

from rovgraph.live.geodesy import geodetic


@pytest.mark.parametrize("origin", [(42.16, 3.12), (-33.9, 151.2), (0.0, 179.9999), (88.5, -60.0)])
def test_latitude_and_longitude_are_those_of_pymap3d(origin):
    for north, east in np.random.default_rng(1).uniform(-2e4, 2e4, (50, 2)).tolist():
        latitude, longitude, _ = pymap3d.ned2geodetic(north, east, 0.0, *origin, 0.0)
        assert geodetic(north, east, origin) == pytest.approx((float(latitude), float(longitude)), abs=1e-12)
