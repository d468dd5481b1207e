"""The compiled arithmetic of the thesis's filters, against NumPy and differences, compiled and as plain Python."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rovgraph.geometry import Array
from rovgraph.lab.thesis.core import Polynomials, iterated_update, propagate_covariance

FILTERS, STATES, MEASURED, MOVING = 3, 7, 4, 5
ALL = np.ones((FILTERS, MEASURED), bool)


def covariances(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(size=(FILTERS, n, n))
    return root @ root.mT + np.eye(n)


def a_problem(seed: int = 0) -> tuple[Array, Array, Array, Array, Array]:
    """x, P, residual, H with zeros, and R."""
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(FILTERS, MEASURED, STATES)) * (rng.uniform(size=(FILTERS, MEASURED, STATES)) < 0.5)
    x, residual = rng.normal(size=(FILTERS, STATES)), rng.normal(size=(FILTERS, MEASURED))
    return x, covariances(rng, STATES), residual, H, covariances(rng, MEASURED)


def some_polynomials(rng: np.random.Generator) -> Polynomials:
    out = Polynomials(MEASURED, STATES)
    first, last = slice(0, 3), slice(4, 7)
    out.add(slice(0, 4), rng.normal(size=4))
    out.add(slice(1, 4), rng.normal(size=(3, 3)), first)
    out.add(slice(0, 2), rng.normal(size=(2, 3, 3)), first, first)
    out.add(slice(2, 4), rng.normal(size=(2, 3, 3, 3)), last, first, first)
    return out


def test_polynomials_are_sums_of_products_and_their_jacobian_is_a_difference():
    rng = np.random.default_rng(1)
    c, A = rng.normal(size=2), rng.normal(size=(2, 3, 3, 3))
    own = Polynomials(2, STATES)
    own.add(slice(0, 2), c)
    own.add(slice(0, 2), A, slice(0, 3), slice(3, 6), slice(3, 6))
    x = rng.normal(size=STATES)
    assert_allclose(own(x)[0], c + np.einsum("ijkl,j,k,l->i", A, x[:3], x[3:6], x[3:6]), atol=1e-12)
    members = [some_polynomials(np.random.default_rng(seed)) for seed in range(FILTERS)]
    y, J = Polynomials.together(members)(states := rng.normal(size=(FILTERS, STATES)))
    for f, member in enumerate(members):
        assert_allclose(y[f], member(states[f])[0], rtol=1e-13)
        steps = 1e-6 * np.eye(STATES)
        numeric = [(member(states[f] + d)[0] - member(states[f] - d)[0]) / 2e-6 for d in steps]
        assert_allclose(J[f], np.transpose(numeric), atol=1e-8)


def test_a_step_is_forward_euler_over_the_time_of_each_filter():
    rng = np.random.default_rng(2)
    rate = Polynomials(STATES, STATES)
    rate.add(slice(0, 3), rng.normal(size=(3, 3, 3)), slice(2, 5), slice(4, 7))
    x, dt = rng.normal(size=(FILTERS, STATES)), np.array([0.01, 0.0, 0.3])
    y, J = rate(x)
    new, F = rate.step(x, dt)
    assert_allclose(new, x + dt[:, None] * y, atol=1e-15)
    assert_allclose(F, np.eye(STATES) + dt[:, None, None] * J, atol=1e-15)
    assert (new[1] == x[1]).all() and (F[1] == np.eye(STATES)).all()


@pytest.mark.parametrize("whole", [False, True])
def test_covariances_are_propagated(whole):
    rng = np.random.default_rng(3)
    P, Q = covariances(rng, STATES), rng.uniform(size=(FILTERS, STATES))
    F = np.tile(np.eye(STATES), (FILTERS, 1, 1))
    F[:, :MOVING, :MOVING] += rng.normal(size=(FILTERS, MOVING, MOVING)) * (rng.uniform(size=(MOVING, MOVING)) < 0.4)
    matrices = Q[..., None] * np.eye(STATES)
    new = propagate_covariance(P, F, matrices if whole else Q, MOVING)
    assert_allclose(new, F @ P @ F.mT + matrices, rtol=1e-13, atol=1e-13)
    assert (new == new.mT).all()


def updated(x: Array, P: Array, residual: Array, H: Array, R: Array) -> tuple[Array, Array, Array, Array]:
    """One filter by itself, in NumPy."""
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    whitened = np.linalg.solve(np.linalg.cholesky(S), residual)
    return x + K @ residual, P - K @ S @ K.T, whitened, np.sqrt(np.diag(S))


def test_an_update_is_kalman_s():
    x, P, residual, H, R = a_problem()
    _, *done = iterated_update(x, P, lambda _: (residual, H), R, ALL)
    for f in range(FILTERS):
        for ours, expected in zip(done, updated(x[f], P[f], residual[f], H[f], R[f]), strict=True):
            assert_allclose(ours[f], expected, rtol=1e-10, atol=1e-12)
    assert (done[1] == done[1].mT).all()


def test_what_is_not_measured_changes_nothing():
    x, P, residual, H, R = a_problem(4)
    measured = np.array([[True, False, True, True], [False] * 4, [True, True, False, False]])
    residual[~measured] = np.nan
    _, new, P_new, normalised, sd = iterated_update(x, P, lambda _: (residual, H), R, measured)
    assert (new[1] == x[1]).all() and (P_new[1] == P[1]).all()
    for f in (0, 2):
        k = np.flatnonzero(measured[f])
        alone = updated(x[f], P[f], residual[f, k], H[f, k], R[f][np.ix_(k, k)])
        for ours, expected in zip((new[f], P_new[f], normalised[f, k], sd[f, k]), alone, strict=True):
            assert_allclose(ours, expected, rtol=1e-10, atol=1e-12)


def test_a_covariance_that_is_none_ends_that_filter_alone():
    x, P, residual, H, R = a_problem(5)
    alone = iterated_update(x, P, lambda _: (residual, H), R, ALL)
    R[1] -= 1e3 * np.eye(MEASURED)
    done = iterated_update(x, P, lambda _: (residual, H), R, ALL)
    assert np.isnan(done[1][1]).all() and np.isnan(done[2][1]).all()
    for ours, expected in zip(done, alone, strict=True):
        assert (ours[[0, 2]] == expected[[0, 2]]).all()


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="this is that run")
def test_as_plain_python_too():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(command, env=environment, cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
