"""Calibrations from a log of their own: what ``rovgraph calibrate`` does."""

from dataclasses import dataclass
from pathlib import Path

from rovgraph import calibrate as library
from rovgraph.api.logs import given
from rovgraph.calibrate import MagnetometerCalibration, NoiseReport
from rovgraph.config import Config, completed, config_or_defaults
from rovgraph.errors import InputError, as_path
from rovgraph.log import Log


@dataclass(frozen=True)
class MagnetometerResult:
    """Hard and soft iron of a magnetometer.

    Attributes
    ----------
    found : centre, matrix, disturbances, and how well the samples fit
    config : the configuration to which the calibration is added
    """

    found: MagnetometerCalibration
    config: Config

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of ``rovgraph calibrate magnetometer`` (docs/calibration.md), complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.pages.reporting import write_page
        from rovgraph.report.calibrations import write_magnetometer
        from rovgraph.report.folder import results_folder

        with results_folder(as_path(path, "path"), force, [Path(self.found.source)]) as folder:
            write_magnetometer(folder, self.found, self.config)
            write_page(folder)


@dataclass(frozen=True)
class NoiseResult:
    """Noise of the sensors at rest.

    Attributes
    ----------
    found : channels with densities and bias instability, lines in the spectra, remarks
    config : the configuration to which the noise is added
    """

    found: NoiseReport
    config: Config

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of ``rovgraph calibrate noise`` (docs/calibration.md), complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.pages.reporting import write_page
        from rovgraph.report.calibrations import write_noise
        from rovgraph.report.folder import results_folder

        with results_folder(as_path(path, "path"), force, [Path(self.found.source)]) as folder:
            write_noise(folder, self.found, self.config)
            write_page(folder)


def calibrate_magnetometer(
    log: Log, config: Config | None = None, method: library.Method = "ellipsoid"
) -> MagnetometerResult:
    """Determine hard and soft iron from a log in which the vehicle turns about all its axes.

    Parameters
    ----------
    log : read with the configuration's ``with_raw_magnetometer()``, so that its samples are uncorrected
    config : of vehicle and sensors; None = all defaults
    method : "ellipsoid", or "turns" for a turn about z and one about x

    Raises
    ------
    InputError : no magnetometer, too few samples, samples that are calibrated already, or too little turning
    """
    config = config_or_defaults(config)
    raw = config.with_raw_magnetometer()
    if isinstance(log, Log) and log.config is not None and log.config.imu.mag != raw.imu.mag:
        raise InputError(
            f"{log.source}: its magnetometer was calibrated as it was read; read it with config.with_raw_magnetometer()"
        )
    found = library.calibrate_magnetometer(log, given(log, raw), method)
    return MagnetometerResult(found, _completed(config, log))


def calibrate_noise(log: Log, config: Config | None = None) -> NoiseResult:
    """Determine the noise of IMU, DVL and compasses from a log at rest.

    Parameters
    ----------
    log : as read with the configuration; the vehicle is at rest in it, waves are tolerated
    config : of vehicle and sensors; None = all defaults

    Raises
    ------
    InputError : the vehicle moves, the log is too short, or ``rovgraph[calibrate]`` is not installed
    """
    config = given(log, config)
    return NoiseResult(library.calibrate_noise(log, config), config)


def _completed(config: Config, log: Log) -> Config:
    return completed(config, log.settings, f"settings in {log.source}")[0]
