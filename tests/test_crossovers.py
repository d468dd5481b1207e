"""Crossovers: lines are matched by their soundings as a whole, or not at all."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rovgraph.dive import _Solver
from rovgraph.errors import InputError
from rovgraph.inference.chart import DepthChart, read_chart
from rovgraph.inference.crossovers import crossings_of, field_at, match
from rovgraph.inference.drift import Drift, LoopClosure
from rovgraph.inference.relief import Line, fit_relief, lines_of
from rovgraph.model.config_sections import ChartSettings
from rovgraph.report.assumptions import leading
from rovgraph.report.pages.track import _crossings

ORIGIN = 58.3, 11.4


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
        lines.append(Line(200.0 * k + s, cells, across, place - (shift if k == 5 else (0.0, 0.0)), z, 0.0, s < 0.0))
    knots = np.arange(0.0, 1200.0, 10.0)
    late = (knots >= 1000.0).astype(float)
    P = np.kron(16.0 * np.outer(late, late), np.eye(2)) + 1e-4 * np.eye(2 * len(knots))
    return lines, Drift(knots, np.zeros(2 * len(knots)), P)


def test_a_crossline_finds_its_shift():
    lines, drift = survey(1)
    found = match(lines, drift)
    after = drift.given(found.closures)
    k = int(np.searchsorted(after.time, 1060.0))
    off = after.mean[2 * k : 2 * k + 2] - (2.0, -1.5)
    assert len(found.closures) >= 3
    assert np.abs(off).max() < 0.6
    assert off @ np.linalg.solve(after.P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], off) < 12.0
    assert "of 5 crossings of the survey's lines matched" in found.text


def test_a_flat_bottom_is_not_used():
    lines, drift = survey(2, sd=1e-3)
    found = match(lines, drift)
    assert not found.closures and not found.relief.shows
    assert "nothing is used: the bottom shows no relief" in found.text


def test_soundings_of_another_bottom_are_not_used():
    lines, drift = survey(3)
    other, _ = survey(4)
    found = match([*lines[:5], other[5]], drift)
    assert not found.closures
    assert "nothing is used" in found.text


def test_relief_is_found():
    relief = fit_relief(survey(5)[0])
    assert relief.shows
    assert relief.sd == pytest.approx(0.5, rel=0.4)


def test_relief_is_found_by_slanted_beams_that_land_further_out_where_it_is_deeper():
    lines = survey(5)[0]
    slanted = [
        replace(line, place=line.place + np.outer(0.41 * (line.depth - 20.0), (0.0, 1.0) if k < 5 else (1.0, 0.0)))
        for k, line in enumerate(lines)
    ]
    assert fit_relief(slanted).sd == pytest.approx(fit_relief(lines).sd, rel=0.15)


def test_a_crossing_whose_soundings_are_not_the_bottoms_is_left_out_of_the_match():
    lines, drift = survey(1)
    other = survey(4)[0][5]
    near = np.abs(lines[5].place[:, 1] - 60.0) < 9.0
    found = match([*lines[:5], replace(lines[5], depth=np.where(near, other.depth, lines[5].depth))], drift)
    after = drift.given(found.closures)
    assert len(found.closures) == 4
    assert np.abs(after.at(np.array([1060.0])) - (2.0, -1.5)).max() < 0.8


@pytest.mark.parametrize("verdict", ["doubtful", "wrong"])
def test_a_dive_that_is_not_trusted_gets_no_crossovers(verdict):
    smoothed = SimpleNamespace(kind="smoothed", posterior=object())
    solver = SimpleNamespace(
        estimates=[smoothed], rivals=(), mirrors=[], dive=lambda more: SimpleNamespace(verdict=verdict)
    )
    text, found = _Solver._cross(solver)
    assert found is None and f"nothing is used: the verdict is {verdict}" in text
    assert solver.estimates == [smoothed]
    assert leading(["heading from ahrs", text])[0][0] == text


def test_two_crossings_are_too_few():
    lines, drift = survey(1)
    found = match([lines[0], lines[1], lines[5]], drift)
    assert not found.closures and "fewer than 3 times" in found.text


def test_a_loop_closure_corrects_both_ends_by_what_they_are_unsure_of():
    P = np.diag([1.0, 1.0, 3.0, 3.0])
    closure = LoopClosure((1.0, 0.0), 1e8 * np.eye(2), np.array([2e8, 0.0]))
    after = Drift(np.array([0.0, 1.0]), np.zeros(4), P, beams_sd=0.0).given([closure])
    assert after.mean == pytest.approx([-0.5, 0.0, 1.5, 0.0], abs=1e-6)
    assert np.diag(after.P) == pytest.approx([0.75] * 4, abs=1e-6)


def test_a_loop_closure_counts_between_knots_and_no_more_than_beams_can_tell():
    closure = LoopClosure((9.5, 0.5), 1e8 * np.eye(2), np.array([2e8, 0.0]))
    after = Drift(np.array([0.0, 1.0, 9.0, 10.0]), np.zeros(8), np.eye(8), beams_sd=0.3).given([closure])
    variance = 2 * 0.5 + 2 * 0.3**2  # of the mean of two knots, twice, and of the beams of two lines
    assert after.mean == pytest.approx(np.repeat([-0.5, 0.5], 4) * np.tile([2.0, 0.0], 4) / variance, abs=1e-6)
    assert np.diag(after.P) == pytest.approx([1.0 - 0.25 / variance] * 8, abs=1e-6)


def test_fish_are_left_out_where_beams_land_astride_two_cells():
    t = np.repeat(np.arange(0.0, 100.0, 1.0), 2)
    rng, fish = np.random.default_rng(2), (t > 40.0) & (t < 55.0)
    depth = 20.0 + 0.05 * rng.standard_normal(len(t)) - np.where(fish, rng.uniform(0.0, 4.0, len(t)), 0.0)
    place = np.column_stack([t, 3.0 + 0.1 * rng.standard_normal(len(t))])  # cells end at 3 m
    (line,) = lines_of(t, 0.0 * t, np.column_stack([t, 0.0 * t]), t, place, depth)
    assert np.abs(line.depth - 20.0).max() < 0.2


def test_lines_end_where_soundings_do():
    t = np.concatenate([np.arange(0.0, 60.0), np.arange(4000.0, 4060.0)])
    place = np.column_stack([t - 3900.0 * (t > 100.0), 50.0 * (t > 100.0)])
    lines = lines_of(t, 0.0 * t, place, t, place, np.full(len(t), 20.0))
    assert [(line.time[0] < 5.0, line.time[-1] < 70.0) for line in lines] == [(True, True), (False, False)]


def test_lines_end_at_turns():
    t = np.arange(0.0, 130.0)
    heading = np.where(t < 65.0, 0.0, np.pi / 2.0)
    position = np.column_stack([np.minimum(t, 65.0), np.maximum(t - 65.0, 0.0)])
    lines = lines_of(t, heading, position, t, position, np.full(len(t), 20.0))
    assert len(lines) == 2
    assert lines[0].time[-1] < 65.0 < lines[1].time[0]


def test_a_bottom_that_repeats_itself_is_not_used():
    lines, drift = survey(1)
    z = [20.0 + 0.5 * np.sin(2.0 * np.pi * (line.place @ (0.8, 0.6)) / 10.0) for line in lines]
    found = match([replace(line, depth=depth) for line, depth in zip(lines, z, strict=True)], drift)
    assert not found.closures and "repeats itself" in found.text


def test_fish_are_left_out():
    t = np.arange(0.0, 100.0, 0.25)
    rng, fish = np.random.default_rng(1), (t > 40.0) & (t < 55.0)
    depth = 20.0 + 0.05 * rng.standard_normal(len(t)) - np.where(fish, rng.uniform(0.0, 4.0, len(t)), 0.0)
    place = np.column_stack([t, 0.0 * t])
    (line,) = lines_of(t, 0.0 * t, place, t, place, depth)
    assert np.abs(line.depth - 20.0).max() < 0.2
    assert line.noise == pytest.approx(0.05 / np.sqrt(8.0), rel=0.2)


def test_a_line_over_fish_is_judged_by_the_other_lines():
    t = np.arange(0.0, 300.0, 0.25)
    rng, third = np.random.default_rng(3), (t // 100.0).astype(int)
    fish = (third == 2) & (t % 100.0 > 30.0)
    depth = 20.0 + 0.05 * rng.standard_normal(len(t)) - np.where(fish, rng.uniform(0.0, 4.0, len(t)), 0.0)
    place = np.column_stack([t % 100.0, 30.0 * third])
    lines = lines_of(t, np.pi * (third % 2), place, t, place, depth)
    assert max(np.abs(line.depth - 20.0).max() for line in lines) < 0.2


def test_a_dense_school_of_fish_ends_what_a_crossing_uses():
    t = np.arange(0.0, 100.0)
    rng, fish = np.random.default_rng(1), (t > 40.5) & (t < 55.5)
    place, depth = np.column_stack([t, 0.0 * t]), 20.0 + 0.05 * rng.standard_normal(len(t)) - 1.0 * fish
    (line,) = lines_of(t, 0.0 * t, place, t, place, depth)
    at = line.time[line.jumps]
    assert np.minimum(np.abs(at - 40.5), np.abs(at - 55.5)).max() < 4.5 and (at < 45.0).any() and (at > 50.0).any()

    lines, drift = survey(2)
    crossing = next(c for c in crossings_of(lines, 5, drift) if c.earlier == 2)
    from_fish = lines[5].place[:, 1] - 1.5 - crossing.centre[1] - 4.0
    depth, ends = lines[5].depth - 2.0 * (from_fish > 0.0), np.abs(from_fish) < 2.0
    relief, shift = fit_relief(lines), np.array([[2.0, -1.5]])

    def field(seen: Line) -> float:
        return float(field_at([*lines[:5], seen], crossing, shift[0], 15.0, relief, None).at(shift)[0])

    clean, used = field(lines[5]), field(replace(lines[5], depth=depth, jumps=ends))
    assert clean > used > 1.0 and field(replace(lines[5], depth=depth)) < -5.0


def charted(seed: int, sd: float = 0.3):
    """The chart of a bottom in cells of a metre, with an offset of 1.5 m."""
    depth, rng = terrain(seed, 0.5), np.random.default_rng([seed, 2])
    axis = np.arange(-20.0, 140.0)
    place = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    z = depth(place.reshape(-1, 2)).reshape(160, 160)
    return DepthChart(z + 1.5 + rng.normal(0.0, sd, z.shape), np.array([-20.0, -20.0]), 1.0, sd)


def lost(shift=(6.0, -4.0)):
    """Three lines of a survey whose whole track is off by a shift, which has an sd of 8 m."""
    lines, drift = survey(6, shift=(0.0, 0.0))
    P = 64.0 * np.kron(np.ones((120, 120)), np.eye(2)) + 1e-4 * np.eye(240)
    return [replace(line, place=line.place - shift) for line in lines[:3]], Drift(drift.time, drift.mean, P).beside(
        np.zeros(2), 0.1
    )


def test_a_chart_shows_where_a_track_is():
    lines, drift = lost()
    found = match(lines, drift, charted(6))
    after = drift.given(found.closures)
    assert np.abs(after.mean[:2] - (6.0, -4.0)).max() < 0.5
    assert after.P[0, 0] < 0.3
    assert "6 of 6 pieces on the chart" in found.text


def test_a_chart_with_holes_shows_it_too():
    lines, drift = lost()
    chart = charted(6)
    chart.depth[60:75, 30:60] = np.nan
    after = drift.given(match(lines, drift, chart).closures)
    assert np.abs(after.mean[:2] - (6.0, -4.0)).max() < 0.7


@pytest.mark.parametrize("seed", range(7, 10))
def test_a_chart_of_another_place_is_not_used(seed):
    found = match(*lost(), charted(seed))
    assert not found.closures and "nothing is used" in found.text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda z: z / 0.3048, "look like feet"),
        (lambda z: z + 25.0, "another place or datum"),
        (lambda z: z * np.nan, "no depths where the track is"),
    ],
)
def test_a_chart_that_cannot_be_of_the_bottom_is_named(change, said):
    chart = charted(6)
    found = match(*lost(), replace(chart, depth=change(chart.depth)))
    assert not found.closures and said in found.text


def geotiff(path, values, crs="EPSG:32632", flipped=False):
    """A file with its upper left corner at ``ORIGIN``, in cells of 2 m."""
    rasterio, pyproj = pytest.importorskip("rasterio"), pytest.importorskip("pyproj")
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(*ORIGIN[::-1])
    down = 2.0 if flipped else -2.0
    place = rasterio.Affine(2.0, 0.0, x, 0.0, down, y - (2.0 * len(values) if flipped else 0.0))
    rows = values[::-1] if flipped else values
    with rasterio.open(
        path, "w", driver="GTiff", height=len(values), width=values.shape[1], count=1, dtype=values.dtype, crs=crs,
        transform=place, nodata=-9999.0 if values.dtype.kind == "f" else None,
    ) as file:  # fmt: skip
        file.write(rows, 1)


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_chart_is_read_where_it_lies(tmp_path, flipped, sense):
    pytest.importorskip("rasterio")
    rows, columns = np.meshgrid(np.arange(50.0), np.arange(60.0), indexing="ij")
    depth = 20.0 + 0.1 * rows + 0.03 * columns
    values = (sense * depth).astype("float32")
    values[40:] = -9999.0
    geotiff(tmp_path / "chart.tif", values, flipped=flipped)
    file = read_chart(ChartSettings(file=str(tmp_path / "chart.tif"), sd_m=0.2), ORIGIN)
    chart = file.around(np.array([-90.0, 0.0]), np.array([0.0, 110.0]), ORIGIN)
    # grid north is within 2 degrees of true north here, and 30 m are off by less than a cell
    assert chart.at(np.array([[-21.0, 31.0]])) == pytest.approx(20.0 + 0.1 * 10.0 + 0.03 * 15.0, abs=0.08)
    assert np.isnan(chart.at(np.array([[-86.0, 31.0]]))) and chart.step == pytest.approx(2.0, rel=0.01)


def test_a_chart_that_cannot_be_used_is_refused_in_a_line(tmp_path):
    pytest.importorskip("rasterio")
    path = tmp_path / "chart.tif"
    settings = ChartSettings(file=str(path))
    with pytest.raises(InputError, match="there is no such file"):
        read_chart(settings, ORIGIN)
    path.write_text("no image")
    with pytest.raises(InputError, match="is no GeoTIFF"):
        read_chart(settings, ORIGIN)
    with pytest.raises(InputError, match=r"environment\.origin_lat_deg"):
        read_chart(settings, None)
    geotiff(path, np.full((4, 4), 20.0, "float32"), crs=None)
    with pytest.raises(InputError, match="coordinate system"):
        read_chart(settings, ORIGIN)
    geotiff(path, np.full((4, 4), 20, "uint8"))
    with pytest.raises(InputError, match="expected depths"):
        read_chart(settings, ORIGIN)
    assert read_chart(ChartSettings(), None) is None


def test_the_map_of_a_page_shows_crossings():
    class Main(dict):
        kind = "smoothed"

    t = np.arange(0.0, 100.0)
    found = {"time_s": [10.0, 20.0, 30.0], "matched": [True, False, True]}
    source = SimpleNamespace(
        summary={"estimates": {"smoothed": {"crossovers": found}}},
        main=Main(time=t, north=t, east=2.0 * t),
        clock=lambda time: time,
    )
    traces = _crossings(source)
    assert [trace["name"] for trace in traces] == ["crossings, matched (2)", "crossings, not matched (1)"]
    source.summary = {}
    assert _crossings(source) == []
