"""The files of ``rovgraph calibrate``: a piece of configuration, the figures of the calibration, a summary."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.lab.calibrate import MagnetometerCalibration, NoiseReport
from rovgraph.lab.calibrate.piece import Piece, piece_yaml, with_piece
from rovgraph.model.config import Config
from rovgraph.report.figures_lab import draw_allan, draw_magnetometer, draw_spectra
from rovgraph.report.folder import STAMP, SUMMARY
from rovgraph.report.results import to_plain
from rovgraph.report.style import save, style


def write_magnetometer(folder: Path, found: MagnetometerCalibration, config: Config) -> None:
    """Write magnetometer.yaml, config.yaml, summary.json and magnetometer.png into an existing folder."""
    _write_pieces(folder, "magnetometer", found.piece, found.remarks, config)
    _write_summary(folder, magnetometer_summary(found))
    with style():
        save(draw_magnetometer(found), folder / "magnetometer.png")


def write_noise(folder: Path, found: NoiseReport, config: Config) -> None:
    """Write noise.yaml, config.yaml, summary.json, spectra.csv, allan.csv and two figures into an existing folder."""
    _write_pieces(folder, "noise", found.piece, [f"noise read from {found.source}", *found.remarks], config)
    _write_summary(folder, noise_summary(found))
    spectra = [(c.name, c.spectrum) for c in found.channels]
    rows = [
        pd.DataFrame({"channel": n, "frequency_hz": s.frequency, "density": s.density, "background": s.background})
        for n, s in spectra
    ]
    pd.concat(rows).to_csv(folder / "spectra.csv", index=False, float_format="%.6g")
    curves = [
        pd.DataFrame({"channel": c.name, "tau_s": c.allan.tau, "deviation": c.allan.deviation, "sd": c.allan.sd})
        for c in found.channels
    ]
    pd.concat(curves).to_csv(folder / "allan.csv", index=False, float_format="%.6g")
    with style():
        save(draw_allan(found), folder / "allan.png")
        save(draw_spectra(found), folder / "spectra.png")


def magnetometer_summary(found: MagnetometerCalibration) -> dict[str, Any]:
    """Entries of summary.json on a magnetometer; field in the log's unit, lengths' scatter a fraction of it."""
    degrees = [None if x is None else np.rad2deg(x) for x in (found.dip, found.before.dip_rms, found.after.dip_rms)]
    disturbances = None
    if found.disturbances is not None:
        disturbances = [
            {"start_s": d.start, "end_s": d.end, "vector": d.vector, "sd": d.sd} for d in found.disturbances
        ]
    return {
        **STAMP,
        "calibration": "magnetometer",
        "log": found.source,
        "method": found.method,
        "samples": len(found.used),
        "samples_used": found.used.sum(),
        "centre": found.centre,
        "centre_sd": found.centre_sd,
        "matrix": found.matrix,
        "radii": found.radii,
        "field_length": found.length,
        "length_rms_before": found.before.length_rms,
        "length_rms_after": found.after.length_rms,
        "dip_deg": degrees[0],
        "dip_rms_before_deg": degrees[1],
        "dip_rms_after_deg": degrees[2],
        "disturbances": disturbances,
        "turns": [{"axis": t.axis, "start_s": t.start, "end_s": t.end} for t in found.turns],
    }


def noise_summary(found: NoiseReport) -> dict[str, Any]:
    """Entries of summary.json on noise; SI and radians."""
    channels = {
        c.name: {
            "unit": c.unit,
            "rate_hz": c.rate,
            "mean": c.mean,
            "sd": c.sd,
            "sd_without_lines": c.quiet_sd,
            "density": c.allan.density,
            "density_sd": c.allan.density_sd,
            "bias_instability": c.allan.instability,
            "walk": c.allan.walk,
            "walk_limit": c.allan.walk_limit,
        }
        for c in found.channels
    }
    return {
        **STAMP,
        "calibration": "noise",
        "log": found.source,
        "duration_s": found.duration,
        "channels": channels,
        "covariance": {name: {"components": names, "matrix": m} for name, (names, m) in found.covariance.items()},
        "lines": [
            {
                "sensor": p.sensor,
                "frequency_hz": p.frequency,
                "rad_per_sample": p.rad_per_sample,
                "kind": p.kind,
                "rms": p.rms,
            }
            for p in found.peaks
        ],
        "remarks": found.remarks,
    }


def _write_pieces(folder: Path, name: str, piece: Piece, remarks: list[str], config: Config) -> None:
    """The piece by itself, and the whole configuration with it."""
    (folder / f"{name}.yaml").write_text(piece_yaml(piece, remarks), encoding="utf-8")
    (folder / "config.yaml").write_text(with_piece(config, piece).to_yaml(), encoding="utf-8")


def _write_summary(folder: Path, summary: dict[str, Any]) -> None:
    text = json.dumps(to_plain(summary), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
