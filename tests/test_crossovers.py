"""Crossovers: lines are matched by their soundings as a whole, or not at all."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rovgraph.inference.crossovers import Drift, Line, Tie, fit_relief, lines_of, match


def terrain(seed: int, sd: float):
    """Depths of a bottom of 120 m by 120 m, in cells of a metre, and of the places of soundings there."""
    rng = np.random.default_rng(seed)
    grid = gaussian_filter(rng.standard_normal((161, 161)), 3.0)
    grid = 20.0 + sd * grid / grid.std()

    def depth(place):
        x = np.clip(place + 20.0, 0.0, 159.0)
        i = np.floor(x).astype(int)
        u, v = (x - i).T
        a, b = i.T
        top = (1 - u) * grid[a, b] + u * grid[a + 1, b]
        return (1 - v) * top + v * ((1 - u) * grid[a, b + 1] + u * grid[a + 1, b + 1])

    return depth


def survey(seed: int, sd: float = 0.5, shift=(2.0, -1.5)):
    """Five lines of 120 m, 20 m apart, and a crossline whose track is off by a shift."""
    rng, depth, lines = np.random.default_rng([seed, 1]), terrain(seed, sd), []
    for k in range(6):
        along = np.arange(1.0, 120.0, 2.0)
        cells = np.repeat(np.arange(len(along)), 3)
        across = np.tile([-1, 0, 1], len(along))
        s = along[cells]
        place = np.column_stack([s, 20.0 + 20.0 * k + 2.5 * across] if k < 5 else [60.0 + 2.5 * across, s])
        z = depth(place) + rng.normal(0.0, 0.05, len(place))
        lines.append(Line(200.0 * k + s, cells, across, place - (shift if k == 5 else (0.0, 0.0)), z))
    knots = np.arange(0.0, 1200.0, 10.0)
    late = (knots >= 1000.0).astype(float)
    P = np.kron(16.0 * np.outer(late, late), np.eye(2)) + 1e-4 * np.eye(2 * len(knots))
    return lines, Drift(knots, np.zeros(2 * len(knots)), P)


def test_a_crossline_finds_its_shift():
    lines, drift = survey(1)
    found = match(lines, drift)
    after = drift.tied(found.ties)
    k = after.knot(1060.0)
    off = after.mean[2 * k : 2 * k + 2] - (2.0, -1.5)
    assert len(found.ties) >= 3
    assert np.abs(off).max() < 0.6
    assert off @ np.linalg.solve(after.P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], off) < 12.0
    assert "of 5 crossings of the survey's lines matched" in found.text


def test_a_flat_bottom_is_not_used():
    lines, drift = survey(2, sd=1e-3)
    found = match(lines, drift)
    assert not found.ties and not found.relief.shows
    assert "nothing is used: the bottom shows no relief" in found.text


def test_soundings_of_another_bottom_are_not_used():
    lines, drift = survey(3)
    other, _ = survey(4)
    found = match([*lines[:5], other[5]], drift)
    assert not found.ties
    assert "nothing is used" in found.text


def test_relief_is_found():
    relief = fit_relief(survey(5)[0])
    assert relief.shows
    assert relief.sd == pytest.approx(0.5, rel=0.4)


def test_two_crossings_are_too_few():
    lines, drift = survey(1)
    found = match([lines[0], lines[1], lines[5]], drift)
    assert not found.ties and "fewer than 3 times" in found.text


def test_a_tie_corrects_both_ends_by_what_they_are_unsure_of():
    P = np.diag([1.0, 1.0, 3.0, 3.0])
    after = Drift(np.array([0.0, 1.0]), np.zeros(4), P).tied([Tie((1, 0), 1e8 * np.eye(2), np.array([2e8, 0.0]))])
    assert after.mean == pytest.approx([-0.5, 0.0, 1.5, 0.0], abs=1e-6)
    assert np.diag(after.P) == pytest.approx([0.75] * 4, abs=1e-6)


def test_lines_end_at_turns():
    t = np.arange(0.0, 130.0)
    heading = np.where(t < 65.0, 0.0, np.pi / 2.0)
    position = np.column_stack([np.minimum(t, 65.0), np.maximum(t - 65.0, 0.0)])
    lines = lines_of(t, heading, position, t, position, np.full(len(t), 20.0))
    assert len(lines) == 2
    assert lines[0].time[-1] < 65.0 < lines[1].time[0]
