"""Every measurement model: its derivatives are those of its own prediction, its signs are right."""

from dataclasses import replace

import numpy as np
import pint
import pytest

from rovgraph.geometry import exp_rotation, matrix_from_rpy, rotate, transpose, wrap_angle
from rovgraph.log.units import UNITS
from rovgraph.model.calibration import ACOUSTICS, BEAM_SENSORS, TABLE, WATER_LAYER
from rovgraph.model.config import Config, parse_config
from rovgraph.model.state import BIAS, DIMENSION, PLACE, PLACE_DIM, POSE, State
from rovgraph.sensors import field_direction, innovation
from rovgraph.sensors.instruments import instruments

CONFIG = parse_config(
    """
imu: {mount_rpy_deg: [176.6, 1.2, 30], lever_arm_m: [-0.11, 0.22, -0.10]}
dvl: {mount_rpy_deg: [180, 3, 45], lever_arm_m: [0.24, 0.05, 0.33]}
depth: {lever_arm_m: [0.3, 0.1, -0.2]}
fix: {lever_arm_m: [0.3, 0.1, -0.5]}
place: {lever_arm_m: [0.2, -0.1, 0.3]}
environment: {declination_deg: 4.5, dip_deg: 72, field_norm: 0.5}
"""
)
ALL = instruments(CONFIG, CONFIG.imu.lever_arm_m)
# those need a ship, where their beam points, or a layer: test_acoustics, test_dvl_beam_model, test_water_layers
SENSORS = {name: one for name, one in ALL.items() if name not in {*ACOUSTICS, *BEAM_SENSORS, WATER_LAYER}}
N, STEP = 6, 1e-6


def random_state(seed=0, n=N, per_epoch=False):
    """Any attitude, every calibration variable well away from zero."""
    rng = np.random.default_rng(seed)
    rpy = np.column_stack([rng.uniform(-0.9, 0.9, n), rng.uniform(-0.9, 0.9, n), rng.uniform(-np.pi, np.pi, n)])
    shape = (n,) if per_epoch else ()
    calibration = {name: 0.3 * rng.standard_normal((*shape, v.dim)) for name, v in TABLE.items()}
    calibration["dvl_roll"] = calibration["dvl_roll"] + np.pi
    bias = rng.standard_normal((n, 6))
    calibration[PLACE] = rng.standard_normal((*shape, PLACE_DIM))
    return State(matrix_from_rpy(rpy), rng.standard_normal((n, 3)), rng.standard_normal((n, 3)), bias, calibration)


def at_rest(n=1, rpy=(0.0, 0.0, 0.0), **calibration):
    zero = np.zeros((n, 3))
    values = {name: np.zeros(v.dim) for name, v in TABLE.items()} | {k: np.array(v) for k, v in calibration.items()}
    return State(np.tile(matrix_from_rpy(rpy), (n, 1, 1)), zero, zero, np.zeros((n, 6)), values)


def variables(model):
    seen = {PLACE: PLACE_DIM} if PLACE in model.state else {}
    return {**DIMENSION, **seen, **{name: TABLE[name].dim for name in model.calibration}}


CASES = [(s, v) for s in (*SENSORS, WATER_LAYER) for v in variables(ALL[s].model)]


@pytest.mark.parametrize(("sensor", "variable"), CASES, ids=lambda x: x)
def test_derivative_is_the_finite_difference_of_the_prediction(sensor, variable):
    model, state = ALL[sensor].model, random_state()
    rate = np.random.default_rng(1).standard_normal((N, 3))
    _, H = model.predict(state, rate)
    dim = variables(model)[variable]
    numeric = np.empty((N, model.dim, dim))
    for k in range(dim):
        d = STEP * np.eye(dim)[k]
        ahead, behind = (model.predict(state.retract(variable, s * d), rate)[0] for s in (1, -1))
        numeric[..., k] = (wrap_angle(ahead - behind) if model.angular else ahead - behind) / (2 * STEP)
    given = H.get(variable, np.zeros_like(numeric))  # what is not given is said to have no influence
    np.testing.assert_allclose(given, numeric, atol=2e-8)


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_calibration_variable_that_is_named_has_an_influence(sensor):
    model, state = SENSORS[sensor].model, random_state()
    _, H = model.predict(state, np.ones((N, 3)))
    about_its_own_axis = {"dvl_roll"} if sensor == "dvl_heading" else set()  # a roll leaves the x axis where it is
    for name in set(model.calibration) - about_its_own_axis:
        assert np.abs(H[name]).max() > 1e-3
    assert set(H) <= {*model.state, *model.calibration}


@pytest.mark.parametrize("sensor", SENSORS)
def test_many_epochs_are_predicted_as_one_by_one(sensor):
    model, state = SENSORS[sensor].model, random_state(per_epoch=True)
    rate = np.random.default_rng(1).standard_normal((N, 3))
    z, H = model.predict(state, rate)
    assert z.shape == (N, model.dim) and len(SENSORS[sensor].components) == model.dim
    for k in range(N):
        alone, J = model.predict(state.at([k]), rate[[k]])
        np.testing.assert_allclose(z[k], alone[0], atol=1e-12)
        for variable, value in J.items():
            np.testing.assert_allclose(H[variable][k], value[0], atol=1e-12)


@pytest.mark.parametrize("sensor", SENSORS)
def test_models_do_not_change_the_state_they_are_given(sensor):
    state, again = random_state(), random_state()
    SENSORS[sensor].model.predict(state, np.ones((N, 3)))
    np.testing.assert_array_equal(state.R_nb, again.R_nb)
    np.testing.assert_array_equal(state.v_n, again.v_n)
    for name in TABLE:
        np.testing.assert_array_equal(state.calibration[name], again.calibration[name])


def test_dvl_that_is_turned_and_upside_down_sees_the_velocity_in_its_own_axes():
    model = instruments(Config())["dvl"].model
    state = at_rest(dvl_roll=[np.pi], dvl_yaw=[np.pi / 2])
    state.v_n[:] = [0.3, 0.1, 0.02]
    # x to starboard, z up, so y is forward
    np.testing.assert_allclose(model.predict(state, np.zeros((1, 3)))[0][0], [0.1, 0.3, -0.02], atol=1e-12)


def test_water_track_is_the_velocity_less_the_current_in_the_dvls_axes():
    sensors = instruments(parse_config("dvl: {lever_arm_m: [0.5, 0, 0]}"))
    state, rate = at_rest(dvl_roll=[np.pi], current=[0.2, -0.1]), np.array([[0.0, 0.0, 0.2]])
    state.v_n[:] = [0.3, 0.1, 0.02]
    ground, water = (sensors[s].model.predict(state, rate)[0][0] for s in ("dvl", "dvl_water"))
    np.testing.assert_allclose(ground, [0.3, -0.2, -0.02], atol=1e-12)
    np.testing.assert_allclose(water, [0.1, -0.3, -0.02], atol=1e-12)


def test_an_error_of_the_lever_arm_moves_the_dvl_in_a_turn():
    model = instruments(Config())["dvl"].model
    z = model.predict(at_rest(dvl_lever_arm=[0.1, 0.2, 0.0]), np.array([[0.0, 0.0, 0.5]]))[0]
    np.testing.assert_allclose(z[0], [-0.1, 0.05, 0.0], atol=1e-12)


def test_soft_iron_is_a_symmetric_matrix_in_the_imus_axes():
    model = instruments(parse_config("environment: {field_norm: 50, dip_deg: 90}"))["mag"].model
    soft = [0.0, 0.0, 0.1, 0.0, 0.02, -0.04]  # xx, yy, zz, xy, xz, yz
    np.testing.assert_allclose(model.predict(at_rest(soft_iron=soft), np.zeros((1, 3)))[0][0], [1, -2, 55], atol=1e-9)
    level = instruments(parse_config("environment: {field_norm: 50, dip_deg: 0}"))["mag"].model
    soft = [0.1, 0.0, 0.0, 0.02, -0.04, 0.0]
    np.testing.assert_allclose(level.predict(at_rest(soft_iron=soft), np.zeros((1, 3)))[0][0], [55, 1, -2], atol=1e-9)


def test_dvl_ahead_of_the_centre_moves_to_starboard_in_a_turn_to_starboard():
    model = instruments(parse_config("dvl: {lever_arm_m: [0.5, 0, 0]}"))["dvl"].model
    z = model.predict(at_rest(), np.array([[0.0, 0.0, 0.2]]))[0]
    np.testing.assert_allclose(z[0], [0.0, 0.1, 0.0], atol=1e-12)


def test_the_gyros_bias_is_taken_off_the_rate_before_the_lever_arm():
    model = instruments(parse_config("dvl: {lever_arm_m: [0.5, 0, 0]}"))["dvl"].model
    state = at_rest()
    state.bias[:, 5] = 0.2
    np.testing.assert_allclose(model.predict(state, np.array([[0.0, 0.0, 0.2]]))[0][0], 0.0, atol=1e-12)


@pytest.mark.parametrize("sensor", ["dvl_heading", "ahrs"])
def test_magnetic_heading_is_the_true_one_less_the_declination(sensor):
    model = instruments(parse_config("environment: {declination_deg: 10}"))[sensor].model
    z = model.predict(at_rest(rpy=(0.1, 0.2, np.deg2rad(70))), np.zeros((1, 3)))[0]
    np.testing.assert_allclose(np.rad2deg(z[0, 0]), 60.0)


def test_heading_of_the_dvl_is_that_of_its_own_x_axis():
    z = instruments(Config())["dvl_heading"].model.predict(at_rest(dvl_yaw=[np.deg2rad(45)]), np.zeros((1, 3)))[0]
    np.testing.assert_allclose(np.rad2deg(z[0, 0]), 45.0)


def test_the_heading_of_a_mounted_imu_is_that_of_its_own_x_axis():
    model = instruments(parse_config("imu: {mount_rpy_deg: [0, 0, 30]}"))["ahrs"].model
    z = model.predict(at_rest(rpy=(0.0, 0.0, np.deg2rad(20))), np.zeros((1, 3)))[0]
    np.testing.assert_allclose(np.rad2deg(z[0, 0]), 50.0)


@pytest.mark.parametrize(
    ("sensor", "offset", "curve"),
    [("ahrs", "ahrs_offset", "ahrs_deviation"), ("dvl_heading", "dvl_compass_offset", "dvl_compass_deviation")],
)
def test_deviation_is_offset_plus_sine_and_cosine_of_the_magnetic_heading(sensor, offset, curve):
    model = instruments(Config())[sensor].model
    for heading in np.deg2rad([0, 90, 200]):
        state = at_rest(rpy=(0, 0, heading), **{offset: [0.1], curve: [0.02, 0.03]})
        expected = heading + 0.1 + 0.02 * np.sin(heading) + 0.03 * np.cos(heading)
        np.testing.assert_allclose(
            wrap_angle(model.predict(state, np.zeros((1, 3)))[0][0, 0] - expected), 0, atol=1e-12
        )


def test_magnetometers_deviation_means_the_same_as_that_of_a_compass():
    # the horizontal field that a levelled magnetometer sees turns as the heading of a compass does
    field = instruments(CONFIG.model_copy(update={"imu": Config().imu}))["mag"].model
    compass = instruments(CONFIG.model_copy(update={"imu": Config().imu}))["ahrs"].model
    rpy = (0.0, 0.0, 1.1)
    same = {"mag_offset": [0.1], "mag_deviation": [0.04, -0.03], "ahrs_offset": [0.1], "ahrs_deviation": [0.04, -0.03]}
    state, zero = at_rest(rpy=rpy, **same), np.zeros((1, 3))
    x, y, _ = field.predict(state, zero)[0][0]
    np.testing.assert_allclose(np.arctan2(-y, x), compass.predict(state, zero)[0][0, 0], atol=1e-12)


def test_field_points_to_magnetic_north_and_down_and_iron_is_added_to_it():
    np.testing.assert_allclose(field_direction(0.0, np.pi / 2), [0, 0, 1], atol=1e-12)
    east = field_direction(np.deg2rad(5), np.deg2rad(70))
    assert east[0] > 0 and east[1] > 0 and east[2] > 0
    model = instruments(parse_config("environment: {field_norm: 50, dip_deg: 0}"))["mag"].model
    z = model.predict(at_rest(hard_iron=[0.1, 0.2, 0.3]), np.zeros((1, 3)))[0]
    np.testing.assert_allclose(z[0], [55, 10, 15], atol=1e-9)


def test_depth_and_fix_are_those_of_their_own_place():
    sensors, state = instruments(CONFIG), random_state()
    for sensor, rows in (("depth", [2]), ("fix", [0, 1])):
        arm = getattr(CONFIG, sensor).lever_arm_m
        c = state.calibration
        depth = c["depth_offset"] + c["depth_error"], c["depth_scale"]
        offset, scale = depth if sensor == "depth" else (c["fix_error"], 0.0)
        expected = (1.0 + scale) * (state.p_n + rotate(state.R_nb, np.array(arm)))[:, rows] + offset
        np.testing.assert_allclose(sensors[sensor].model.predict(state, np.zeros((N, 3)))[0], expected)


def test_lever_arms_are_taken_relative_to_the_states_origin():
    origin = np.array([0.1, -0.2, 0.3])
    here, there = instruments(CONFIG), instruments(CONFIG, origin)
    state, rate = random_state(), np.random.default_rng(2).standard_normal((N, 3))
    at_origin = State(
        state.R_nb,
        state.p_n + rotate(state.R_nb, origin),
        state.v_n + rotate(state.R_nb, np.cross(rate - state.bias[:, 3:], origin)),
        state.bias,
        state.calibration,
    )
    w = rate - state.bias[:, 3:]
    for sensor in here:
        expected = here[sensor].model.predict(state, rate)[0]
        if sensor == "thruster":  # what is felt is felt at the origin
            expected = expected + np.cross(w, np.cross(w, origin))
        np.testing.assert_allclose(there[sensor].model.predict(at_origin, rate)[0], expected, atol=1e-12)


def test_innovations_of_angles_wrap():
    heading, depth = SENSORS["ahrs"].model, SENSORS["depth"].model
    np.testing.assert_allclose(innovation(heading, np.array([[3.1]]), np.array([[-3.1]])), [[6.2 - 2 * np.pi]])
    np.testing.assert_allclose(innovation(depth, np.array([[3.1]]), np.array([[-3.1]])), [[6.2]])


def test_gain_of_the_rate_is_the_derivative_through_the_nominal_mounting():
    gain, model = SENSORS["dvl"].rate_gain, SENSORS["dvl"].model
    mount = np.deg2rad(CONFIG.dvl.mount_rpy_deg)
    state = at_rest(dvl_roll=[mount[0]], dvl_pitch=[mount[1]], dvl_yaw=[mount[2]])
    for k in range(3):
        np.testing.assert_allclose(model.predict(state, np.eye(3)[[k]])[0][0], gain[:, k], atol=1e-12)
    assert not SENSORS["depth"].rate_gain.any()


def test_noise_of_the_rate_has_no_direction_where_the_yaw_of_the_dvl_is_unknown():
    vague = CONFIG.calibration.dvl_yaw.model_copy(update={"estimate": True, "sd_deg": 45.0})
    config = CONFIG.model_copy(update={"calibration": CONFIG.calibration.model_copy(update={"dvl_yaw": vague})})
    known, unknown = (instruments(c, c.imu.lever_arm_m)["dvl"].rate_gain for c in (CONFIG, config))
    variance, spread = known @ known.T, unknown @ unknown.T
    assert abs(variance[0, 1]) > 0.01 * variance[0, 0]
    np.testing.assert_allclose(spread, np.diag([np.mean(np.diag(variance)[:2])] * 2 + [variance[2, 2]]), atol=1e-12)


def test_a_rotated_world_rotates_the_dvl_not():
    """What a DVL measures over a bottom at rest does not depend on where north is."""
    state, rate = random_state(), np.zeros((N, 3))
    state = replace(state, calibration={**state.calibration, "bottom_velocity": np.zeros(2)})
    turn = exp_rotation(np.array([0.0, 0.0, 1.0]))
    turned = State(turn @ state.R_nb, state.p_n, rotate(turn, state.v_n), state.bias, state.calibration)
    model = SENSORS["dvl"].model
    np.testing.assert_allclose(model.predict(turned, rate)[0], model.predict(state, rate)[0], atol=1e-12)
    _, H = model.predict(state, rate)
    up = rotate(transpose(state.R_nb), np.array([0.0, 0.0, 1.0]))
    by_turn = rotate(H[POSE][..., :3], up) + rotate(H["velocity"], np.cross([0, 0, 1.0], state.v_n))
    np.testing.assert_allclose(by_turn, 0.0, atol=1e-12)
    assert BIAS in H


def test_every_unit_has_the_factor_that_pint_has():
    """Milligauss was free to be wrong."""
    registry = pint.UnitRegistry()
    inside = {
        "time": "second", "duration": "second",
        "acceleration": "meter / second ** 2", "rate": "radian / second", "field": "microtesla",
        "angle": "radian", "speed": "meter / second", "length": "meter", "latitude": "degree", "pressure": "pascal",
        "area": "meter ** 2",
    }  # fmt: skip
    named = {
        "g": "standard_gravity", "mg": "millistandard_gravity", "m/s2": "meter / second ** 2",
        "m/s^2": "meter / second ** 2", "mrad/s": "milliradian / second", "deg/s": "degree / second",
        "uT": "microtesla", "nT": "nanotesla", "mG": "milligauss", "gauss": "gauss", "us": "microsecond",
        "degE7": "1e-7 degree", "m2": "meter ** 2",
        "ft2": "foot ** 2", "cm2": "centimeter ** 2", "mm2": "millimeter ** 2",
    }  # fmt: skip
    for kind, factors in UNITS.items():
        for unit, factor in factors.items():
            quantity = registry.parse_expression(named.get(unit, unit))
            assert factor == pytest.approx(quantity.to(inside[kind], "Gaussian").magnitude, rel=1e-9), (kind, unit)
