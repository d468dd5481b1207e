"""Depth by pressure: the surface, the water, units, and what is told apart by its numbers."""

from collections import Counter
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

import rovgraph as rg
from rovgraph.geometry import Array
from rovgraph.kernels.earth import GRAVITY_PER_DEPTH, normal_gravity
from rovgraph.live.intake import Intake
from rovgraph.live.message import Reading
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.sensors import SENSORS
from rovgraph.sensors.instruments import instruments
from rovgraph.sensors.pressure import OceanProfile, SurfacePressure, density, depths, waves_at_surface
from rovgraph.sensors.sound import sound_speed
from rovgraph.simulate import Path, Truth, simulate

AIR = 100_300.0
TIME = np.arange(0.0, 600.0, 0.5)


def dive(
    deepest: float = 30.0, begin: float = 60.0, end: float = 540.0, air: Array | float = AIR
) -> tuple[Array, Array]:
    """Depth and pressure in sea water at latitude 60, at the surface before ``begin`` and after ``end`` [s]."""
    depth = deepest * np.clip(np.minimum(TIME - begin, end - TIME) / 100.0, 0.0, 1.0)
    gravity = normal_gravity(np.deg2rad(60.0)) + GRAVITY_PER_DEPTH * 0.5 * depth
    return depth, air + 1025.0 * gravity * depth


def log_of(pressure: Array, config: Config | None = None, **more: Array) -> Log:
    return Log.from_arrays({"time": TIME, "pressure": pressure, **more}, config=config)


NORTH = Config().changed(environment={"latitude_deg": 60.0})


def test_depth_is_by_surface_density_and_gravity() -> None:
    depth, pressure = dive(deepest=500.0)
    log = log_of(pressure, NORTH)
    np.testing.assert_allclose(log["depth"]["depth"], depth, atol=2e-3)
    assert log.notes == ("depth by pressure: at the surface 1003.0 to 1003.0 hPa, found where the vehicle was there; "
                         "water of 1025 kg/m3",)  # fmt: skip


@pytest.mark.parametrize(("begin", "end"), [(60.0, 600.0), (-100.0, 540.0)])
def test_the_surface_is_found_before_or_after_the_dive(begin: float, end: float) -> None:
    depth, pressure = dive(begin=begin, end=end)
    np.testing.assert_allclose(depths(TIME, pressure, NORTH, None)[0], depth, atol=5e-3)


def test_a_new_stay_at_the_surface_brings_the_air_of_then_and_a_shallow_stop_does_not() -> None:
    for change, expected in ((600.0, 600.0), (1500.0, 0.0)):
        depth, pressure = dive(air=AIR + np.where(TIME > 300.0, change, 0.0))
        found = depths(TIME, pressure, NORTH, None)[0]
        late = TIME > 570.0
        np.testing.assert_allclose(found[late], depth[late] + (change - expected) / (1025.0 * 9.8192), atol=5e-3)


def test_waves_do_not_move_the_surface() -> None:
    surface, rng = SurfacePressure(None), np.random.default_rng(1)
    swell = 500.0 * np.sin(2.0 * np.pi * TIME / 6.0) + rng.normal(0.0, 30.0, len(TIME))
    found = [surface.take(t, p) for t, p in zip(TIME, AIR + swell, strict=True)]
    assert abs(found[-1] - AIR) < 100.0  # 1 cm


def test_a_sea_at_the_start_is_no_air_pressure_and_a_stop_under_water_no_sea() -> None:
    """Waves of 0.1 m, 30 hPa from the lowest to the highest; and a vehicle that stops at 0.3 m at once."""
    rng = np.random.default_rng(5)
    for period in (3.0, 5.3, 7.0):
        surface = SurfacePressure(None)
        swell = 1400.0 * np.sin(2.0 * np.pi * TIME / period + 1.0) + rng.normal(0.0, 100.0, len(TIME))
        found = [surface.take(t, p) for t, p in zip(TIME[:120], AIR + swell, strict=False)]
        assert abs(found[-1] - AIR) < 350.0  # 3.5 cm
    surface = SurfacePressure(None)
    stopped = AIR + 3000.0 * np.clip(TIME / 5.0, 0.0, 1.0)
    found = [surface.take(t, p) for t, p in zip(TIME, stopped, strict=True)]
    assert abs(found[-1] - AIR) < 350.0


def test_the_online_mode_has_the_depths_of_the_log() -> None:
    rng = np.random.default_rng(2)
    _, pressure = dive(air=AIR + np.where(TIME > 300.0, 400.0, 0.0))
    pressure = pressure + rng.normal(0.0, 50.0, len(TIME))
    intake = Intake(NORTH, Counter())
    live = [intake.measurement(t, Reading("pressure", np.array([p]))) for t, p in zip(TIME, pressure, strict=True)]
    np.testing.assert_array_equal(
        [m.values[0] for m in live if m is not None], log_of(pressure, NORTH)["depth"]["depth"]
    )
    assert {m.sensor for m in live if m is not None} == {"depth"}
    ((_, said),) = intake.news
    assert said.startswith("depth by pressure: at the surface 1003.")


def test_the_surface_is_kept_over_a_restart() -> None:
    _, pressure = dive(begin=60.0)
    first, second, whole = SurfacePressure(None), SurfacePressure(None), SurfacePressure(None)
    for t, p in zip(TIME[:300], pressure[:300], strict=True):
        first.take(t, p)
    second.restore(first.state())
    expected = [whole.take(t, p) for t, p in zip(TIME, pressure, strict=True)][300:]
    np.testing.assert_array_equal(
        [second.take(t, p) for t, p in zip(TIME[300:], pressure[300:], strict=True)], expected
    )


@pytest.mark.parametrize(
    ("unit", "pascal"), [("kPa", 1e3), ("bar", 1e5), ("dbar", 1e4), ("psi", 6894.757), ("hPa", 1e2)]
)
def test_units_and_the_unit_that_numbers_are_in(unit: str, pascal: float) -> None:
    depth, pressure = dive()
    right = NORTH.changed(units={"pressure": unit})
    np.testing.assert_allclose(log_of(pressure / pascal, right)["depth"]["depth"], depth, atol=2e-3)
    with pytest.raises(rg.InputError, match=rf"no air has so little; state units: {{pressure: {unit}}}"):
        log_of(pressure / pascal, NORTH)


@pytest.mark.parametrize(("unit", "pascal"), [("kPa", 1e3), ("bar", 1e5), ("hPa", 1e2)])
def test_the_unit_is_named_live_and_where_the_surface_is_stated(unit: str, pascal: float) -> None:
    _, pressure = dive()
    stated = NORTH.changed(depth={"surface_hpa": 1003.0})
    with pytest.raises(rg.InputError, match=rf"no air has so little; state units: {{pressure: {unit}}}"):
        log_of(pressure / pascal, stated)
    for config in (NORTH, stated):
        intake = Intake(config, Counter())
        found = [
            intake.measurement(t, Reading("pressure", np.array([p / pascal])))
            for t, p in zip(TIME, pressure, strict=True)
        ]
        assert not any(found)
        ((sensor, said),) = intake.news
        assert sensor == "pressure" and f"left out: state units: {{pressure: {unit}}}" in said


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (14.1, r"state units: \{pressure: psi\}, or if it was never at the surface, state units: \{pressure: dbar\}"),
        (1411.0, r"if these are metres, .*; if it was never at the surface, state units: \{pressure: hPa\}"),
        (1.41, r"if it was never at the surface, state units: \{pressure: bar\}"),
    ],
)
def test_pressures_of_a_log_that_begins_under_water_may_be_in_another_unit(number: float, said: str) -> None:
    with pytest.raises(rg.InputError, match=said):
        log_of(number * np.linspace(1.0, 1.01, len(TIME)), NORTH)


def test_psi_taken_for_bar_is_told() -> None:
    _, pressure = dive()
    with pytest.warns(rg.DataWarning, match=r"never at the surface.*the unit is psi: state units: \{pressure: psi\}"):
        log_of(pressure / 6894.757, NORTH.changed(units={"pressure": "bar"}))
    with pytest.raises(rg.InputError, match=r"state units: \{pressure: bar\}"):
        log_of(pressure / 1e5, NORTH.changed(units={"pressure": "psi"}))


def test_depths_and_gauge_pressures_in_the_column_are_told() -> None:
    depth, pressure = dive()
    with pytest.raises(rg.InputError, match="if these are metres, name the column depth"):
        log_of(depth)
    with pytest.raises(rg.InputError, match=r"if the air's is taken off, state depth\.surface_hpa: 0"):
        log_of(pressure - AIR)
    gauge = NORTH.changed(depth={"surface_hpa": 0})
    np.testing.assert_allclose(log_of(pressure - AIR, gauge)["depth"]["depth"], depth, atol=2e-3)


def test_a_surface_that_is_never_reached_is_the_standard_atmospheres() -> None:
    depth, pressure = dive(begin=-200.0, end=900.0, air=101_325.0)
    with pytest.warns(rg.DataWarning, match=r"never at the surface, .* 1013 hPa are taken; state depth\.surface_hpa"):
        log = log_of(pressure, NORTH)
    np.testing.assert_allclose(log["depth"]["depth"], depth, atol=2e-3)
    assert "the standard atmosphere, as the vehicle was never there" in log.notes[0]


def test_beside_depth_one_is_chosen_and_the_other_named() -> None:
    depth, pressure = dive()
    with pytest.warns(rg.DataWarning, match="pressure is ignored beside depth"):
        log = log_of(pressure, NORTH, depth=depth + 1.0)
    np.testing.assert_allclose(log["depth"]["depth"], depth + 1.0)
    chosen = NORTH.changed(depth={"source": "pressure"})
    with pytest.warns(rg.DataWarning, match="depth is ignored beside pressure"):
        log = log_of(pressure, chosen, depth=depth + 1.0)
    np.testing.assert_allclose(log["depth"]["depth"], depth, atol=2e-3)
    intake, left_out = Intake(NORTH, left := Counter()), left
    for column, value in (("pressure", AIR), ("depth", 3.0), ("pressure", AIR)):
        intake.measurement(TIME[sum(left_out.values())], Reading(column, np.array([value])))
    assert left_out["pressure", "ignored beside depth"] == 1


def test_the_density_is_stated_or_by_salinity_or_of_the_sea() -> None:
    assert density(Config()) == 1025.0
    assert density(Config().changed(sound={"salinity_psu": 0})) == pytest.approx(999.7)
    assert density(Config().changed(sound={"salinity_psu": 35})) == pytest.approx(1026.95, abs=0.1)
    assert density(Config().changed(sound={"salinity_psu": 35}, depth={"density_kgm3": 1010})) == 1010.0


def test_waves_are_what_depths_scatter_at_the_surface() -> None:
    rng = np.random.default_rng(3)
    depth, _ = dive(begin=200.0, end=400.0)
    waves = 0.3 * np.sqrt(2.0) * np.sin(2.0 * np.pi * TIME / 5.3) * np.exp(-depth / 5.0)
    noise = rng.normal(0.0, 0.02, len(TIME))
    assert waves_at_surface(TIME, depth + waves + noise) == pytest.approx(0.3, rel=0.1)
    assert waves_at_surface(TIME, depth + noise) == pytest.approx(0.02, rel=0.2)
    assert waves_at_surface(TIME, depth + 5.0 + waves) == 0.0  # never there


def test_waves_add_noise_near_the_surface_alone() -> None:
    config = Config().changed(depth={"sd_m": 0.04, "waves_m": 0.3})
    believed = instruments(config, np.zeros(3))["depth"]
    sd = [float(SENSORS["depth"].standard_deviation(np.array([z]), believed, config)[0]) for z in (-0.1, 5.0, 40.0)]
    np.testing.assert_allclose(sd, [np.hypot(0.04, 0.3), np.hypot(0.04, 0.3 / np.e), 0.04], rtol=1e-3)


def test_depths_of_the_standard_ocean_are_those_that_gsw_publishes() -> None:
    gsw = pytest.importorskip("gsw")
    dbar = np.array([10.0, 50.0, 125.0, 250.0, 600.0, 1000.0])
    published = [9.944583, 49.718090, 124.272622, 248.470058, 595.825348, 992.091906]  # check values of z_from_p
    in_situ = gsw.t_from_CT(35.16504, 0.0, np.arange(0.0, 1300.0, 1.0))
    depth = -gsw.z_from_p(np.arange(0.0, 1300.0, 1.0), 4.0)
    standard = OceanProfile(depth, in_situ, np.full(len(depth), 35.0), 4.0)
    np.testing.assert_allclose(standard.depth(1e4 * dbar), published, atol=1e-4)  # temperatures are linear between
    assert float(gsw.sound_speed(34.7118, 28.7856, 10.0)) == pytest.approx(1542.426412, abs=1e-6)
    assert float(gsw.p_from_z(-1000.0, 45.0)) == pytest.approx(1010.6370, abs=5e-5)


def test_a_profile_of_the_water_gives_depths_by_teos_10(tmp_path: FilePath) -> None:
    gsw = pytest.importorskip("gsw")
    profile = tmp_path / "ctd.csv"
    profile.write_text("depth,temperature,salinity\n0,15,30\n20,8,34\n500,4,35\n")
    config = NORTH.changed(sound={"profile": str(profile)})
    pressure = AIR + np.concatenate([np.zeros(60), np.linspace(0.0, 4e6, len(TIME) - 60)])
    log = log_of(pressure, config)
    assert log.notes[0].endswith("water of sound.profile, by TEOS-10")
    # independently: hydrostatics with the density of each half metre
    z = np.arange(0.0, 420.0, 0.5)
    salt = 35.16504 / 35.0 * np.interp(z, [0.0, 20.0, 500.0], [30.0, 34.0, 35.0])
    dbar = gsw.p_from_z(-z, 60.0)
    rho = gsw.rho_t_exact(salt, np.interp(z, [0.0, 20.0, 500.0], [15.0, 8.0, 4.0]), dbar)
    weight = np.concatenate([[0.0], np.cumsum(0.25 * (rho[1:] + rho[:-1]) * gsw.grav(60.0, dbar)[1:])])
    np.testing.assert_allclose(log["depth"]["depth"], np.interp(pressure - AIR, weight, z), atol=0.01)
    stated = log_of(pressure, config.changed(depth={"density_kgm3": 1025}))
    assert "water of 1025" in stated.notes[0] and abs(stated["depth"]["depth"][-1] - log["depth"]["depth"][-1]) > 0.5


def test_the_speed_of_sound_agrees_with_teos_10() -> None:
    gsw = pytest.importorskip("gsw")
    for salinity, temperature, depth in ((35.0, 10.0, 0.0), (35.0, 4.0, 1000.0), (5.0, 15.0, 50.0)):
        p = gsw.p_from_z(-depth, 45.0)
        absolute = 35.16504 / 35.0 * salinity
        speed = gsw.sound_speed(absolute, gsw.CT_from_t(absolute, temperature, p), p)
        assert float(sound_speed(salinity, temperature, depth)) == pytest.approx(float(speed), abs=0.5)


def test_a_unit_of_the_header_is_judged_as_a_stated_one() -> None:
    _, pressure = dive()
    with pytest.warns(rg.DataWarning, match=r"the unit is psi: state units: \{pressure: psi\}"):
        Log.from_arrays({"time": TIME, "pressure [bar]": pressure / 6894.757})


@pytest.mark.slow
def test_the_depth_follows_the_surface_through_a_tide() -> None:
    """Three hours with 1 m of tide and stays at the surface at begin, middle and end, where the air has changed."""
    t = np.arange(0.0, 10_801.0, 10.0)
    legs = np.where((t // 150.0).astype(int) % 2 == 0, 0.3, 0.3 + np.pi)
    yaw = gaussian_filter1d(legs, 1.0, mode="nearest")
    place = np.cumsum(4.0 * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    under = np.ones(len(t))
    for begin, end in ((-600.0, 120.0), (5340.0, 5460.0), (10_680.0, 11_400.0)):
        under *= np.clip(np.maximum(begin - t, t - end) / 120.0, 0.0, 1.0)
    below = gaussian_filter1d(under * (15.0 + 3.0 * np.sin(2.0 * np.pi * t / 900.0)), 2.0, mode="nearest")
    path = Path.through(t, np.column_stack([place, below - tide(t)]), np.column_stack([0 * t, 0 * t, yaw]), rest=False)
    config = NORTH.changed(heading={"sources": ["ahrs"]}, calibration={"ahrs_offset": {"estimate": False}})
    right = {"depth_offset": np.zeros(1), "depth_scale": np.zeros(1)}
    truth = Truth(config, calibration=right, imu_rate=10.0, dvl_rate=1.0, depth_rate=1.0, ahrs_rate=5.0)
    dived = simulate(path, truth, np.random.default_rng(1))
    frame = dived.log_frame.copy()
    gravity = normal_gravity(np.deg2rad(60.0))
    frame["pressure"] = AIR + 0.05 * frame["time"] + 1025.0 * gravity * (frame.pop("depth") + tide(frame["time"]))
    track = rg.smooth(Log.from_frame(frame, config), config, "smoothed").smoothed.trajectory
    truly = np.interp(track.time, dived.truth.time, dived.truth.p_n[:, 2]) + tide(track.time)
    error = track.p_n[:, 2] - truly
    assert float(np.sqrt(np.mean(error**2))) < 0.1
    assert np.mean((error / track.p_sd[:, 2]) ** 2) < 1.5


def tide(time: Any) -> Any:
    """1 m in three hours [m]."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * time / 21_600.0)
