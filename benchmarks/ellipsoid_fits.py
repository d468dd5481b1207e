"""Our ellipsoid fit beside navlib's, on magnetometer samples in a CSV with columns mx, my, mz.

    pip install 'rovgraph[benchmarks]'
    python benchmarks/ellipsoid_fits.py samples.csv

Prints for each fit its centre, the scatter of the field's length and the time it took.
Nothing is asserted.
"""

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from rovgraph.geometry import Array
from rovgraph.lab.calibrate.magnetometer import fit_ellipsoid

Fit = Callable[[Array], tuple[Array, Array]]


def fits() -> Iterator[tuple[str, Fit]]:
    """Name, and a function from samples to centre and calibrated field."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of navlib's optional parts
        from navlib import cal

    def ours(samples: Array) -> tuple[Array, Array]:
        found = fit_ellipsoid(samples, "samples")
        return found.centre, (samples - found.centre) @ found.matrix

    def twostep(samples: Array) -> tuple[Array, Array]:
        length = np.linalg.norm(cal.cal_mag_sphere_fit(samples)[1], axis=1).mean()
        centre, _, field = cal.cal_mag_twostep_hsi(samples, np.array([length, 0.0, 0.0]))[:3]
        return centre, field

    yield "rovgraph", ours
    yield "navlib ellipsoid_fit_fang", lambda samples: cal.cal_mag_ellipsoid_fit_fang(samples)[::2]
    yield "navlib twostep_hsi", twostep
    yield "navlib ellipsoid_fit", lambda samples: cal.cal_mag_ellipsoid_fit(samples)[::2]
    yield "navlib sphere_fit", lambda samples: cal.cal_mag_sphere_fit(samples)[:2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("samples", type=Path)
    samples = pd.read_csv(parser.parse_args().samples)[["mx", "my", "mz"]].to_numpy(float)
    magnets = np.where(np.arange(len(samples))[:, None] % 20 == 0, samples + 0.3 * np.ptp(samples), samples)
    for title, given in (("as given", samples), ("with 5 % outliers", magnets)):
        print(title)
        for name, fit in fits():
            began = time.perf_counter()
            centre, field = fit(given)
            spent = time.perf_counter() - began
            good = np.linalg.norm(field, axis=1)[np.arange(len(given)) % 20 != 0]
            scatter = 100.0 * good.std() / good.mean()
            print(f"  {name:28} centre {np.round(centre, 4)}  length {scatter:5.2f} %  {spent:.3f} s")


if __name__ == "__main__":
    main()
