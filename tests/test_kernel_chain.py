"""The chain's square root says what dense linear algebra says of the same rows."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from rovgraph.inference.chain_information import MeasurementRows, MotionRows, SquareRoot, UndeterminedError, eliminate

CHAINS = [(6, 15, 0, 0), (6, 15, 0, 4), (5, 15, 2, 5), (4, 15, 2, 0), (1, 15, 0, 3), (7, 3, 1, 20)]


@dataclass
class Sensor:
    """Measurements of one sensor, at random keyframes."""

    keyframe: np.ndarray
    r: np.ndarray
    J: np.ndarray
    C: np.ndarray
    targets: np.ndarray
    weight: np.ndarray


@dataclass
class Chain:
    """Random rows of n keyframes of s components that move and w that walk, and of a border of c."""

    n: int
    s: int
    w: int
    c: int
    motions: MotionRows
    sensors: list[Sensor]
    border_rows: np.ndarray

    @property
    def d(self) -> int:
        return self.s + self.w

    def measurements(self) -> MeasurementRows:
        others = max(s.C.shape[2] for s in self.sensors)
        keyframes, dims = [s.keyframe for s in self.sensors], [s.r.shape[1] for s in self.sensors]
        rows = MeasurementRows(self.n, self.s, keyframes, dims, others)
        for _ in range(2):  # the second takes the place of the first
            for i, s in enumerate(self.sensors):
                rows.put(i, s.r, s.J, s.C, s.targets, s.weight)
        return rows

    def eliminate(self, stops: tuple[int, ...] = ()) -> SquareRoot:
        return eliminate(self.motions, self.measurements(), self.border_rows, stops)

    def dense(self, last: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """All rows up to a keyframe, columns in the order of keyframes, then the border; and right-hand sides."""
        last = self.n - 1 if last is None else last
        rows = [*self._motion_rows(last), *self._measurement_rows(last)]
        rows += [(one[-1], [(self.n * self.d + j, one[j]) for j in range(self.c)]) for one in self.border_rows]
        J = np.zeros((len(rows), self.n * self.d + self.c))
        for own, (_, parts) in zip(J, rows, strict=True):
            for column, value in parts:
                own[column] += value
        return J, np.array([r for r, _ in rows])

    def _others(self, keyframe: int, targets: np.ndarray, values: np.ndarray) -> list[tuple[int, float]]:
        shifts = [keyframe * self.d if t < self.d else (self.n - 1) * self.d for t in targets]
        return [(shift + t, value) for shift, t, value in zip(shifts, targets, values, strict=True) if t >= 0]

    def _motion_rows(self, last: int) -> Iterator[tuple[float, list[tuple[int, float]]]]:
        m, d = self.motions, self.d
        for k in range(last):
            for i in range(self.s):
                parts = self._others(k, m.targets, m.C[k, i])
                parts += [(k * d + j, m.A[k, i, j]) for j in range(self.s)]
                parts += [((k + 1) * d + j, m.A[k, i, self.s + 1 + j]) for j in range(self.s)]
                yield m.A[k, i, self.s], parts
            for i in range(self.w):
                here = k * d + self.s + i
                yield m.walk_r[k, i], [(here, -m.walk[k, i] * m.kept[k, i]), (here + d, m.walk[k, i])]

    def _measurement_rows(self, last: int) -> Iterator[tuple[float, list[tuple[int, float]]]]:
        for sensor in self.sensors:
            for r, J, C, k, root in zip(
                sensor.r, sensor.J, sensor.C, sensor.keyframe, np.sqrt(sensor.weight), strict=True
            ):
                for i in range(len(r) if k <= last else 0):
                    parts = self._others(k, sensor.targets, root * C[i])
                    yield root * r[i], parts + [(k * self.d + j, root * J[i, j]) for j in range(self.s)]

    def covariance(self) -> np.ndarray:
        J, _ = self.dense()
        return np.linalg.inv(J.T @ J)


def random_sensor(
    rng: np.random.Generator, n: int, s: int, m: int, dim: int, targets: list[int], every: bool = False
) -> Sensor:
    keyframe = np.zeros(m, dtype=np.int64) if every else rng.integers(0, n, m)
    shape = (m, dim)
    return Sensor(
        keyframe,
        rng.standard_normal(shape),
        rng.standard_normal((*shape, s)),
        rng.standard_normal((*shape, len(targets))),
        np.array(targets, dtype=np.int64),
        rng.uniform(0.5, 2.0, m),
    )


def random_chain(n: int, s: int, w: int, c: int, seed: int = 0) -> Chain:
    rng, d = np.random.default_rng(seed), s + w
    e = min(c, 2)
    motion_targets = [d + c - 1 - j for j in range(e)] + [s + j for j in range(w)] + [-1, 0]
    motions = MotionRows(
        rng.standard_normal((n - 1, s, 2 * (s + 1))),
        rng.standard_normal((n - 1, s, len(motion_targets))),
        np.array(motion_targets, dtype=np.int64),
        rng.uniform(0.5, 2.0, (n - 1, w)),
        rng.uniform(0.5, 1.0, (n - 1, w)),
        rng.standard_normal((n - 1, w)),
    )
    for i in range(2 * s // 3, s):  # every other motion has rows that begin at the diagonal, as a bias's do
        motions.A[::2, i, :i] = 0.0
    of_border, walking = [d + j for j in range(min(c, 3))], [s + j for j in range(w)]
    sensors = [
        random_sensor(rng, n, s, 1, d + 2, walking, every=True),  # the first keyframe's prior
        random_sensor(rng, n, s, 2 * n, 3, of_border),
        random_sensor(rng, n, s, n, 1, [*of_border[::-1], -1, *walking]),
        random_sensor(rng, n, s, 0, 2, []),
    ]
    return Chain(n, s, w, c, motions, sensors, rng.standard_normal((3 * c, c + 1)))


@pytest.fixture(params=CHAINS, ids=str)
def chain(request: pytest.FixtureRequest) -> Chain:
    return random_chain(*request.param)


def assert_close(actual: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max(initial=0.0))


def test_the_optimum_is_that_of_dense_least_squares(chain):
    J, r = chain.dense()
    expected, *_ = np.linalg.lstsq(J, r)
    root = chain.eliminate()
    x, y = root.solve()
    assert_close(np.concatenate([x.ravel(), y]), expected)
    assert root.left == pytest.approx(np.sum((r - J @ expected) ** 2), rel=1e-9)


def test_covariances_are_blocks_of_the_inverse_information(chain):
    P, n, d = chain.covariance(), chain.n, chain.d
    root = chain.eliminate()
    P_y = root.border_covariance()
    own, cross, following = root.joint_covariances(P_y)
    assert_close(P_y, P[n * d :, n * d :])
    for k in range(n):
        here = slice(k * d, (k + 1) * d)
        assert_close(own[k], P[here, here])
        assert_close(cross[k], P[here, n * d :])
        if k + 1 < n:
            assert_close(following[k], P[here, (k + 1) * d : (k + 2) * d])
    assert_close(root.covariances(P_y), own)
    expected = root.covariances(P_y)
    np.testing.assert_array_equal(root.turn_into_covariances(P_y), expected)


def test_the_derivative_by_the_border_is_that_of_the_optimum(chain):
    J, _ = chain.dense()
    of_states, of_border = J[:, : chain.n * chain.d], J[:, chain.n * chain.d :]
    expected, *_ = np.linalg.lstsq(of_states, -of_border)
    assert_close(chain.eliminate().x_by_y.reshape(expected.shape), expected)


def test_the_border_held_leaves_the_covariance_of_the_states_alone(chain):
    of_states = chain.dense()[0][:, : chain.n * chain.d]
    expected = np.linalg.inv(of_states.T @ of_states)
    own = chain.eliminate().covariances(np.zeros((chain.c, chain.c)))
    for k in range(chain.n):
        here = slice(k * chain.d, (k + 1) * chain.d)
        assert_close(own[k], expected[here, here])


@pytest.mark.parametrize("held", [1, 3])
def test_considered_variables_add_their_own_covariance_and_move_nothing(held):
    chain = random_chain(5, 15, 2, 5)
    J, r = chain.dense()
    free = J.shape[1] - held
    expected, *_ = np.linalg.lstsq(J[:, :free], r)
    gain, *_ = np.linalg.lstsq(J[:, :free], -J[:, free:])
    half = np.random.default_rng(1).standard_normal((held, held))
    believed = half @ half.T
    P = np.linalg.inv(J[:, :free].T @ J[:, :free]) + gain @ believed @ gain.T
    root = chain.eliminate()
    x, y = root.solve(held)
    P_y = root.border_covariance(believed)
    own, cross, _ = root.joint_covariances(P_y)
    n, d = chain.n, chain.d
    assert_close(np.concatenate([x.ravel(), y[: chain.c - held]]), expected)
    np.testing.assert_array_equal(y[chain.c - held :], 0.0)
    assert_close(P_y[:-held, :-held], P[n * d :, n * d :])
    assert_close(P_y[-held:, -held:], believed)
    assert_close(P_y[:-held, -held:], (gain @ believed)[n * d :])
    for k in range(n):
        here = slice(k * d, (k + 1) * d)
        assert_close(own[k], P[here, here])
        assert_close(cross[k], np.hstack([P[here, n * d :], (gain @ believed)[here]]))


@pytest.mark.parametrize("free", [[], [0, 1, 2], [4, 0, 2], [0, 1, 2, 3, 4]], ids=str)
def test_any_components_of_the_border_can_be_held_anywhere_and_scored(free):
    """As by dense least squares whose gradient has the score in it, from one elimination."""
    chain, rng = random_chain(5, 15, 2, 5), np.random.default_rng(3)
    J, r = chain.dense()
    n, d = chain.n, chain.d
    held, score = rng.standard_normal(5), rng.standard_normal(5)
    used = np.r_[: n * d, n * d + np.array(free, dtype=int)]
    fixed = held * ~np.isin(np.arange(5), free)
    gradient = J[:, used].T @ (r - J[:, n * d :] @ fixed) + np.concatenate([np.zeros(n * d), score[free]])
    expected = np.linalg.solve(J[:, used].T @ J[:, used], gradient)
    root = chain.eliminate()
    y = root.border_with(np.array(free, dtype=np.int64), held, score)
    assert_close(np.concatenate([root.followed(y).ravel(), y[free]]), expected)
    np.testing.assert_array_equal(np.delete(y, free), np.delete(held, free))


@pytest.mark.parametrize("held", [0, 2])
def test_errors_counted_from_the_optimum_are_at_rest_there_and_as_well_known(held):
    chain = random_chain(5, 15, 2, 5)
    before, after = chain.eliminate(), chain.eliminate()
    x, y = before.solve(held)
    after.move_to(y)
    for at_rest in after.solve(held):
        np.testing.assert_allclose(at_rest, 0.0, atol=1e-9)
    assert after.explained(held) < 1e-18 < before.explained(held)
    assert after.least(held) == pytest.approx(before.least(held), rel=1e-12)
    every = np.arange(5)
    again = before.border_with(every, np.zeros(5))  # from elsewhere, to the same place
    moved = after.border_with(every, np.zeros(5))
    assert_close(y + moved, again)
    assert_close(x + after.followed(moved), before.followed(again))


def test_draws_have_the_covariance_of_the_states_with_the_border_held(chain):
    """A draw is linear in white noise, so that unit vectors give the whole root of the covariance."""
    root, n, d = chain.eliminate(), chain.n, chain.d
    columns = [root.draw(unit.reshape(n, d)).ravel() for unit in np.eye(n * d)]
    of_states = chain.dense()[0][:, : n * d]
    assert_close(np.transpose(columns) @ columns, np.linalg.inv(of_states.T @ of_states))


def test_filtered_covariances_are_those_of_the_data_up_to_a_keyframe(chain):
    stops = (0, chain.n - 1) if chain.n < 3 else (0, 2, chain.n - 1)
    stops, d = tuple(dict.fromkeys(stops)), chain.d
    filtered = chain.eliminate(stops)
    P = filtered.filtered_covariances()
    for i, stop in enumerate(stops):
        J, r = chain.dense(stop)
        used = np.r_[: (stop + 1) * d, chain.n * d : chain.n * d + chain.c]
        last = np.r_[stop * d : (stop + 1) * d, (stop + 1) * d : (stop + 1) * d + chain.c]
        assert_close(P[i], np.linalg.inv(J[:, used].T @ J[:, used])[np.ix_(last, last)])
        z = np.linalg.solve(filtered.filtered[i, :, :-1], filtered.filtered[i, :, -1])
        assert_close(z, np.linalg.lstsq(J[:, used], r)[0][last])


def test_keeping_filtered_information_changes_nothing(chain):
    plain, kept = chain.eliminate(), chain.eliminate(tuple(range(chain.n)))
    for a, b in zip(plain.solve(), kept.solve(), strict=True):
        assert_close(a, b)
    assert kept.left == pytest.approx(plain.left)


def test_the_log_determinant_is_that_of_the_information(chain):
    J, _ = chain.dense()
    assert chain.eliminate().log_determinant() == pytest.approx(np.linalg.slogdet(J.T @ J)[1], rel=1e-12)


def test_a_measurement_of_weight_zero_says_nothing():
    chain = random_chain(6, 15, 0, 4)
    without = random_chain(6, 15, 0, 4)
    gated = chain.sensors[1]
    gated.weight[::2] = 0.0
    gated.r[::2] = 1e6
    kept = without.sensors[1]
    for name in ("keyframe", "r", "J", "C", "weight"):
        setattr(kept, name, getattr(gated, name)[1::2])
    a, b = chain.eliminate(), without.eliminate()
    assert_close(a.solve()[0], b.solve()[0])
    assert a.left == pytest.approx(b.left)


def test_what_a_border_tied_to_the_first_keyframe_says_is_said_of_that_keyframe():
    """So that an attitude at the start is known beside every later keyframe."""
    free, tie_sd = random_chain(6, 15, 0, 4), 1e-6
    P = free.covariance()
    one = np.eye(3)[None] / tie_sd
    J = np.zeros((1, 3, 15))
    J[0, :, :3] = one[0]
    tied = random_chain(6, 15, 0, 4)
    tied.c += 3
    tied.border_rows = np.insert(tied.border_rows, [4, 4, 4], 0.0, axis=1)
    tied.sensors.append(Sensor(np.zeros(1, dtype=np.int64), np.zeros((1, 3)), J, -one, np.arange(19, 22), np.ones(1)))
    root = tied.eliminate((5,))
    known, cross = root.filtered_covariances()[0], root.joint_covariances(root.border_covariance())[1]
    assert_close(known[19:, 19:], P[:3, :3])
    assert_close(known[:15, 19:], P[75:90, :3])
    assert_close(cross[3, :, 4:], P[45:60, :3])


def random_walk(n: int, s: int, prior_sd: float, step_sd: float) -> Chain:
    """A walk from a prior, and nothing that is measured on the way; a border of 0 to be added by the caller."""
    one = np.tile(np.eye(s) / step_sd, (n - 1, 1, 1))
    motions = MotionRows.of_states(-one, one, np.zeros((n - 1, s)))
    J = np.eye(s)[None] / prior_sd
    none, start = np.zeros((1, s, 0)), np.zeros(1, dtype=np.int64)
    prior = Sensor(start, np.zeros((1, s)), J, none, start[:0], np.ones(1))
    return Chain(n, s, 0, 0, motions, [prior], np.zeros((0, 1)))


def test_a_vague_prior_survives_precise_motions():
    """Normal equations would be wrong by 1e-4 here, and indefinite over a longer dive."""
    n, prior_sd, step_sd = 3000, 1e3, 4e-4
    chain = random_walk(n, 2, prior_sd, step_sd)
    mixed = np.array([[0.8, -0.6], [0.6, 0.8]])
    for part in (chain.motions.A[:, :, :2], chain.motions.A[:, :, 3:5], chain.sensors[0].J):
        part[:] = part @ mixed  # or all would be powers of one number
    P = chain.eliminate().covariances(np.zeros((0, 0)))
    expected = prior_sd**2 + step_sd**2 * np.arange(n)
    np.testing.assert_allclose(np.sqrt(P[:, 0, 0]), np.sqrt(expected), rtol=1e-8)
    np.testing.assert_allclose(np.sqrt(P[:, 1, 1]), np.sqrt(expected), rtol=1e-8)


def test_a_component_that_rounding_alone_determines_is_named():
    """Two components that only their sum is known of."""
    rng = np.random.default_rng(2)
    chain = random_walk(200, 3, 1.0, 1e-3)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    chain.sensors[0].J[0] = turn @ np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    with pytest.raises(UndeterminedError) as raised:
        chain.eliminate()
    assert (raised.value.keyframe, raised.value.component) == (199, 1)


def test_a_component_of_the_border_that_nothing_determines_is_named():
    chain = random_chain(6, 15, 0, 4)
    chain.border_rows[:, 1:] = 0.0
    chain.motions.C[:] = 0.0
    chain.sensors[1].C[:, :, 1] = chain.sensors[1].C[:, :, 0]  # columns of components 0 and 1
    chain.sensors[2].C[:] = 0.0
    chain.border_rows[:, 1] = chain.border_rows[:, 0]
    with pytest.raises(UndeterminedError) as raised:
        chain.eliminate()
    assert (raised.value.keyframe, raised.value.component) == (None, 1)


@pytest.mark.parametrize(("stops", "keyframe"), [((), 39), ((20, 30), 20)])
def test_a_component_that_nothing_determines_is_named_at_the_first_stop_or_the_end(stops, keyframe):
    chain = random_walk(40, 3, 1.0, 1e-3)
    chain.sensors[0].J[0, 1, 1] = 0.0
    with pytest.raises(UndeterminedError) as raised:
        chain.eliminate(stops)
    assert (raised.value.keyframe, raised.value.component) == (keyframe, 1)


@pytest.mark.parametrize("where", ["motion", "measurement"])
def test_a_row_that_is_no_number_is_found_where_it_is(where):
    chain = random_chain(6, 15, 0, 4)
    if where == "motion":
        chain.motions.A[3, 2, 5] = np.nan
        expected = 3
    else:
        chain.sensors[1].J[4, 0, 5] = np.nan
        expected = int(chain.sensors[1].keyframe[4])
    with pytest.raises(UndeterminedError) as raised:
        chain.eliminate()
    assert raised.value.keyframe == expected


def test_more_border_priors_than_are_folded_at_a_time_count_all():
    chain = random_chain(3, 3, 0, 4)
    chain.border_rows = np.random.default_rng(3).standard_normal((200, 5))
    assert_close(chain.eliminate().border_covariance(), chain.covariance()[9:, 9:])


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    """``benchmarks/chain.py``, which is a script and no part of the package."""
    path = Path(__file__).parents[1] / "benchmarks" / "chain.py"
    spec = importlib.util.spec_from_file_location("chain_benchmark", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_a_dive_has_the_solution_and_the_sds_of_gtsams_qr(benchmark):
    errors = benchmark.accuracy(200, 0.1)["chain"]
    assert max(errors.solution, errors.sd) < 1e-9


def test_the_benchmark_times_every_solver(benchmark):
    """Banded Cholesky has no place for a border."""
    for border, solvers in ((False, {"chain", "solveh_banded", "GTSAM"}), (True, {"chain", "GTSAM"})):
        assert {name.split(",")[0] for name in benchmark.speed(40, border, repeats=1) if "'" not in name} == solvers


WITHOUT_COMPILER = """
from test_kernel_chain import random_chain
root = random_chain(4, 15, 2, 5).eliminate((1, 3))
P, cross, _ = root.joint_covariances(root.border_covariance())
x, y = root.solve()
print(*map(float.hex, [*x.ravel(), *y, *P.ravel(), *root.filtered_covariances().ravel()]))
"""


def test_kernels_say_the_same_without_the_compiler():
    printed = [
        subprocess.run(
            [sys.executable, "-c", WITHOUT_COMPILER],
            env={**os.environ, "NUMBA_DISABLE_JIT": disabled},
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split()
        for disabled in ("0", "1")
    ]
    compiled, plain = (np.array([float.fromhex(number) for number in numbers]) for numbers in printed)
    assert_close(compiled, plain)
