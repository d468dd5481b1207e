"""Pages of results folders: whole, offline, safe with any text, and honest about what is missing."""

import base64
import json
import re
import shutil
import sys

import numpy as np
import pandas as pd
import pytest
from browsers import PRINTS, printing_browser

import rovgraph as rg
from rovgraph.api.reporting import report
from rovgraph.cli.app import main
from rovgraph.log.companions import usable_beams
from rovgraph.model.config import Config
from rovgraph.report.pages import printing
from rovgraph.report.pages.page import Panel, Section, broken, extremes, line, packed, render
from rovgraph.report.pages.reporting import page_of
from rovgraph.report.pages.sensors import autocorrelation, valid_share
from rovgraph.report.pages.source import PageTrack
from rovgraph.report.pages.uncertainty import falls, separation
from rovgraph.sensors.dvl_beam import beams_of

NASTY = "</script><script>alert(1)</script> \"quotes' & <b>δύτης 潜水</b>"
LIMIT = 4_000_000  # bytes of a page
SECTIONS = [
    "dive",
    "verdict",
    "separation",
    "dvl",
    "residuals",
    "compasses",
    "clocks",
    "calibration",
    "about",
]


@pytest.fixture(scope="session")
def dive():
    """A short dive with faults: without bottom lock for a while, wrong pings, places seen twice, a weak beam."""
    choices = rg.Choices(duration=90, dropouts=((30.0, 50.0),), outliers=0.02)
    simulated = rg.simulate("lawnmower", seed=4, choices=choices)
    return rg.smooth(with_beams(simulated.log), simulated.config)


def with_beams(log):
    """The log with four beams of its DVL: all valid with bottom lock, the fourth in every second ping."""
    pings = log["dvl"]
    valid = np.tile(pings["dvl_valid"][:, None], 4)
    valid[::2, 3] = 0.0
    columns = {f"valid_{k + 1}": valid[:, k] for k in range(4)} | {
        f"range_{k + 1}": 2.0 + k + valid[:, k] for k in range(4)
    }
    return log.with_beams(usable_beams({"time": pings.time, **columns}, Config(), "beams"))


@pytest.fixture(scope="session")
def folder(dive, tmp_path_factory):
    """Its results folder; not to be changed."""
    out = tmp_path_factory.mktemp("dive") / "results"
    dive.save(out, figures=False)
    return out


@pytest.fixture
def own(folder, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(folder, tmp_path / "results")


def summary_with(path, **entries):
    file = path / "summary.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **entries}))


def with_track(path, change):
    table = pd.read_csv(path / "trajectory_smoothed.csv")
    change(table)
    table.to_csv(path / "trajectory_smoothed.csv", index=False)


def cut(path):
    """The second half of the dive is missing."""
    rows = (path / "trajectory_smoothed.csv").read_text().splitlines(keepends=True)
    (path / "trajectory_smoothed.csv").write_text("".join(rows[: len(rows) // 2]))


@pytest.fixture
def browser(tmp_path, monkeypatch):
    """Puts a program that prints as Chromium does on PATH, alone."""

    def install(does=PRINTS, name="chromium"):
        return printing_browser(tmp_path / "bin" / name, does)

    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("ROVGRAPH_BROWSER", raising=False)
    return install


def report_command(monkeypatch, capsys, *arguments):
    """Exit code, what was printed, and the error, of ``rovgraph report``."""
    monkeypatch.setattr(sys, "argv", ["rovgraph", "report", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr()
    return end.value.code or 0, said.out, said.err


def test_the_page_is_printed_by_the_browser_that_is_found(own, browser, monkeypatch, capsys):
    program = browser()
    before = {path.name for path in own.iterdir()}
    assert report_command(monkeypatch, capsys, own, "--pdf") == (0, f"printed to {own / 'report.pdf'}\n", "")
    assert (own / "report.pdf").read_bytes() == b"%PDF-1.4 of " + (own / "report.html").as_uri().encode()
    assert {path.name for path in own.iterdir()} == before | {"report.pdf"}
    assert "--headless" in program.with_name("chromium.called").read_text()
    report(own, pdf=True)  # those of its own names are replaced
    out = own.parent / "dive.pdf"
    assert report(own, out=out, pdf=True) == out and out.with_suffix(".html").exists()
    with pytest.raises(rg.InputError, match=r"dive\.html exists"):
        report(own, out=out, pdf=True)


def test_a_browser_may_be_named(own, browser, monkeypatch):
    program = browser(name="mine")
    with pytest.raises(rg.InputError, match="no browser found"):
        report(own, pdf=True)
    monkeypatch.setenv("ROVGRAPH_BROWSER", str(program))
    assert report(own, pdf=True).read_bytes()[:5] == b"%PDF-"
    monkeypatch.setenv("ROVGRAPH_BROWSER", "another")
    with pytest.raises(rg.InputError, match="ROVGRAPH_BROWSER=another: no such program"):
        report(own, pdf=True)


def test_without_a_browser_nothing_is_written_and_one_line_says_what_to_do(own, browser, monkeypatch, capsys):
    (own / "report.html").unlink()
    before = {path.name for path in own.iterdir()}
    code, out, error = report_command(monkeypatch, capsys, own, "--pdf")
    assert (code, out) == (2, "") and error.count("\n") == 1
    assert "no browser found to print with" in error and "ROVGRAPH_BROWSER" in error
    assert {path.name for path in own.iterdir()} == before


@pytest.mark.parametrize(
    ("does", "said"),
    [
        ("sys.exit('no display')", "printed no PDF of .*: no display"),
        ("pathlib.Path(out).write_bytes(b'')", "printed no PDF of .*: exit code 0"),
        ("import time; time.sleep(60)", "printed no PDF of .* within 1 s"),
    ],
)
def test_a_browser_that_prints_nothing_leaves_the_older_pdf(own, browser, monkeypatch, does, said):
    browser(does)
    monkeypatch.setattr(printing, "SECONDS", 1.0)
    (own / "report.pdf").write_bytes(b"older")
    before = {path.name for path in own.iterdir()}
    with pytest.raises(rg.InputError, match=said):
        report(own, pdf=True)
    assert (own / "report.pdf").read_bytes() == b"older" and {path.name for path in own.iterdir()} == before


def test_smooth_and_report_make_the_same_page(own):
    made = (own / "report.html").read_text()
    assert report(own) == own / "report.html"
    assert (own / "report.html").read_text() == made


def test_the_page_has_its_sections_in_order_and_is_small(folder):
    html = (folder / "report.html").read_text()
    assert re.findall(r'<section id="(\w+)"', html) == SECTIONS
    assert len(html.encode()) < LIMIT


def test_the_first_screen_says_the_verdict_in_its_colour_and_five_numbers(folder, own):
    html = (folder / "report.html").read_text()
    opening = html[html.index('<div class="opening">') : html.index("<section")]
    assert '<div class="verdict trusted"><strong>Trusted</strong>' in opening
    numbers = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", opening)
    assert [name for name, _ in numbers] == [
        "duration",
        "distance",
        "depth",
        "position sd at the end",
        "heading sd at the end",
    ]
    assert numbers[0][1] == "1 min 30 s" and all(value[0].isdigit() for _, value in numbers)
    summary_with(own, verdict="wrong", origin={"lat_deg": -33.5, "lon_deg": 151.25})
    html = page_of(own)
    assert '<div class="verdict wrong">' in html and html.count("not valid</dd>") == 2
    assert "33.5000° S, 151.2500° E" in html


def test_the_track_has_the_colours_of_its_sd_and_one_without_an_sd_is_a_line(own):
    chart = panels_of(page_of(own))["Track, coloured by its sd"]
    coloured = [trace for trace in chart["traces"] if "value" in trace]
    assert len({trace["line"]["color"] for trace in coloured}) == len(coloured) > 3
    sd = np.concatenate([unpacked(trace["value"]) for trace in coloured])
    table = pd.read_csv(own / "trajectory_smoothed.csv")
    assert np.nanmax(sd) == pytest.approx(np.hypot(table["north_sd"], table["east_sd"]).max(), rel=0.3)

    def forget(table):
        table[["north_sd", "east_sd"]] = np.nan

    with_track(own, forget)
    assert [trace["name"] for trace in panels_of(page_of(own))["Track"]["traces"]].count("smoothed") == 1


def test_the_dive_is_shown_with_its_sds_and_with_the_bottom_where_it_was_measured(own):
    panels = panels_of(page_of(own))
    assert "Altitude over the bottom" not in panels
    depth, attitude = panels["Depth"], panels["Roll and pitch"]
    assert depth["down"] and [t["name"] for t in depth["traces"]] == ["depth"]
    assert all(t["band"] == 1 and (unpacked(t["sd"]) > 0).all() for t in [*depth["traces"], *attitude["traces"]])
    pings = pd.read_csv(own / "dvl.csv")
    pings["altitude"] = np.where(pings["lock"] == 1, 3.0, np.nan)
    pings.to_csv(own / "dvl.csv", index=False)
    panels = panels_of(page_of(own))
    assert "Altitude over the bottom" in panels
    low, high = panels["Depth"]["limits"]
    assert high - low > 3.0
    line_, bottom = panels["Depth"]["traces"]
    assert np.nanmedian(unpacked(bottom["y"])) == pytest.approx(np.nanmedian(unpacked(line_["y"])) + 3.0, abs=0.2)


def test_a_start_that_is_hardly_known_does_not_set_the_scale(own):
    before = panels_of(page_of(own))["Speed over ground"]["limits"]

    def spoil(table):
        table.loc[:1, ["v_north", "v_north_sd"]] = 40.0

    with_track(own, spoil)
    assert panels_of(page_of(own))["Speed over ground"]["limits"] == pytest.approx(before, rel=0.02)


def test_folded_parts_say_whether_they_are_well(own):
    def finding(html, key):
        part = html[html.index(f'<section id="{key}"') :]
        return re.search(r'<span class="finding (\w*)">(.*?)</span>', part, re.DOTALL).groups()

    summary_with(own, alarms=[], advice=[])
    html = page_of(own)
    assert finding(html, "residuals") == ("well", "Every sensor&#39;s are as large as stated.")
    assert finding(html, "dvl")[1].startswith("77.5 % of 503 pings saw the bottom")
    alarm = {"kind": "lasting", "sensor": "dvl", "severity": "doubtful", "text": "dvl: x; y"}
    summary_with(own, alarms=[alarm], advice=[{"kind": "too small", "sensor": "depth", "text": "z"}])
    state, sentence = finding(page_of(own), "residuals")
    assert state == "care" and "1 of 4 sensors errs more than stated, or for longer (DVL)" in sentence
    assert "1 of 4 sensors errs less than stated (depth)" in sentence


def test_terms_of_the_field_are_explained_once_in_each_text(folder):
    html = (folder / "report.html").read_text()
    assert re.search(r'<abbr title="filtered minus smoothed[^"]*">Separation</abbr>', html)
    section = Section("a", "A", ["NEES is NEES <b>", "considered"])
    assert render("x", [section]).count("<abbr") == 2


def test_the_page_loads_nothing(folder):
    html = (folder / "report.html").read_text()
    assert "default-src 'none'" in html
    own = html.replace(re.search(r"<script>/\*\*\n\* plotly.*?</script>", html, re.DOTALL)[0], "")
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", own)


def test_figures_and_page_can_each_be_left_out(dive, tmp_path):
    dive.save(tmp_path / "bare", figures=False, page=False)
    assert not (tmp_path / "bare" / "report.html").exists()
    assert not list((tmp_path / "bare").glob("*.png"))


def test_what_did_not_count_is_written_with_its_reason(folder):
    table = pd.read_csv(folder / "left_out.csv")
    assert "no bottom lock" in set(table["reason"])
    silent = table[table["reason"] == "no bottom lock"]["time"] - pd.read_csv(folder / "dvl.csv")["time"].iloc[0]
    assert silent.between(29.0, 51.0).all()
    residuals = pd.read_csv(folder / "residuals.csv")
    rejected = residuals[residuals["weight"] <= 0].drop_duplicates(["sensor", "time", "row"])
    assert (table["reason"] == "beyond its gate").sum() == len(rejected)


def test_a_frozen_ping_saw_nothing_and_is_written_with_what_did_not_count(tmp_path):
    simulated = rg.simulate("lawnmower", seed=4, choices=rg.Choices(duration=60))
    frame = simulated.dive.log_frame
    pinged = frame["dvl_vx"].notna() & frame["time"].between(20.0, 30.0)
    names = ["dvl_vx", "dvl_vy", "dvl_vz"]
    frame.loc[pinged, names] = frame.loc[pinged, names].iloc[0].to_numpy()
    result = rg.smooth(rg.Log.from_frame(frame, simulated.config), simulated.config, "smoothed")
    result.save(tmp_path / "out", figures=False, page=False)
    left_out, pings = (pd.read_csv(tmp_path / "out" / name) for name in ("left_out.csv", "dvl.csv"))
    frozen = left_out.loc[left_out["reason"] == "frozen"]
    assert set(frozen["sensor"]) == {"dvl"} and len(frozen) == pinged.sum()
    np.testing.assert_allclose(pings.loc[pings["lock"] == 0, "time"], frozen["time"])


def test_the_noise_of_the_configuration_is_shown_and_one_that_cannot_be_read_said(own):
    assert "Allan deviation of the gyro, as configured" in page_of(own)
    (own / "config.yaml").write_text("imu: {noise: {gyr: -1}}\n")
    html = page_of(own)
    assert "Allan deviation of the gyro, as configured" not in html and "imu.noise.gyr" in html


def test_text_of_any_kind_is_shown_and_not_run(own):
    config = (own / "config.yaml").read_text()
    (own / "config.yaml").write_text(config + f"\n# {NASTY}\n")
    summary_with(
        own, name=NASTY, log=NASTY, assumptions=[NASTY], warnings=[NASTY], verdict=NASTY, versions={NASTY: NASTY}
    )
    residuals = pd.read_csv(own / "residuals.csv")
    residuals["sensor"] = residuals["sensor"].replace({"dvl": NASTY})
    residuals.to_csv(own / "residuals.csv", index=False)
    (own / "näme <i>.csv").write_text("x")
    html = page_of(own)
    assert "alert(1)</script>" not in html
    assert "<b>δύτης" not in html
    assert "<i>.csv" not in html
    assert "δύτης 潜水" in html
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.DOTALL)[1]
    assert any("δύτης" in panel["title"] for panel in json.loads(data)["panels"].values())


MISSING = {
    "trajectory_filtered.csv": "The folder has no filtered track",
    "trajectory_dead_reckoning.csv": "The folder has no dead reckoning track",
    "residuals.csv": "residuals.csv is missing, so fixes cannot be shown",
    "history.csv": "the folder has no history.csv",
    "calibration.csv": "calibration.csv is missing",
    "dvl.csv": "the folder has no dvl.csv",
    "dvl_beams.csv": "the folder has no dvl_beams.csv",
    "left_out.csv": "the folder has no left_out.csv",
    "config.yaml": "config.yaml is missing",
}


@pytest.mark.parametrize(("name", "said"), MISSING.items())
def test_a_missing_file_leaves_a_page_that_says_so(own, name, said):
    assert said not in page_of(own)
    (own / name).unlink()
    html = page_of(own)
    assert re.findall(r'<section id="(\w+)"', html) == SECTIONS
    assert said in html


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda f: [p.unlink() for p in f.glob("trajectory_*.csv")], "no trajectory_smoothed.csv"),
        (lambda f: (f / "summary.json").unlink(), "has no summary.json"),
        (lambda f: (f / "summary.json").write_text("{"), "cannot be read"),
        (lambda f: (f / "summary.json").write_text("[1]"), "is not a summary of rovgraph"),
        (lambda f: (f / "summary.json").write_text('{"program": "rovgraph"}'), "no results that have a page"),
        (lambda f: (f / "residuals.csv").write_text(""), "is empty"),
        (lambda f: (f / "residuals.csv").write_text("time,sensor\n1,dvl\n"), "column component is missing"),
        (lambda f: (f / "trajectory_smoothed.csv").write_text("time,north,east\n"), "no rows with a time"),
        (cut, "s of the dive are missing; make the results again"),
        (shutil.rmtree, "no such folder"),
        (lambda f: summary_with(f, alarms="x"), "incomplete or of another version"),
        (lambda f: summary_with(f, end={"north_m": "x"}), "incomplete or of another version"),
        (lambda f: summary_with(f, sensors={"dvl": None}), "incomplete or of another version"),
        (lambda f: (f / "dvl.csv").write_text("time,lock,altitude,figure_of_merit,row\nx,1,1,1,1\n"), "incomplete or"),
        (lambda f: (f / "dvl_beams.csv").write_text("time,valid_1\n1,x\n"), "line 2, column valid_1: 'x' is not a num"),
        (
            lambda f: (f / "dvl_beams.csv").write_text("time,valid_1\n1,7\n"),
            "line 2, column dvl_beam_valid_1: 7, expected 0 or 1",
        ),
    ],
)
def test_what_is_no_results_folder_is_refused_in_a_line_and_an_old_page_stays(own, spoil, said):
    spoil(own)
    before = (own / "report.html").read_text() if own.exists() else None
    with pytest.raises(rg.InputError, match=said) as refusal:
        report(own)
    assert "\n" not in str(refusal.value)
    assert not own.exists() or (own / "report.html").read_text() == before


def panels_of(html):
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.DOTALL)[1]
    return {panel["title"]: panel for panel in json.loads(data)["panels"].values()}


def unpacked(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_each_beam_shows_its_valid_pings_and_its_range(own, folder):
    panels = panels_of((folder / "report.html").read_text())
    validity, far = panels["Valid pings of each beam"], panels["Range of each beam"]
    assert validity["names"] == ["1", "2", "3", "4"]
    shares = {t["name"]: unpacked(t["value"]) for t in validity["traces"] if "not valid" not in t["name"]}
    assert [*shares] == [line["name"] for line in far["traces"]] == ["beam 1", "beam 2", "beam 3", "beam 4"]
    locked = shares["beam 1"] == 100.0
    assert 0.7 < locked.mean() < 0.8  # without lock from 30 to 50 s of 90
    np.testing.assert_allclose(shares["beam 4"][locked], 50.0, atol=20.0)  # of four to six pings
    (own / "dvl_beams.csv").unlink()
    assert not panels_of(page_of(own)).keys() & {"Valid pings of each beam", "Range of each beam"}


def test_beams_without_a_range_or_outside_of_the_track_leave_no_empty_panel(own):
    table = pd.read_csv(own / "dvl_beams.csv")
    table[["time", "valid_2", "valid_4"]].to_csv(own / "dvl_beams.csv", index=False)
    panels = panels_of(page_of(own))
    assert panels["Valid pings of each beam"]["names"] == ["2", "4"]
    assert "Range of each beam" not in panels
    table.assign(time=table["time"] + 1e6).to_csv(own / "dvl_beams.csv", index=False)
    assert "no ping of the beams lies within the track" in page_of(own)


def test_shares_of_valid_pings_stay_few_over_a_long_dive_and_know_where_there_is_no_ping():
    time = np.arange(0.0, 36_000.0, 0.2)
    time = time[(time < 9000.0) | (time > 18_000.0)]
    valid = (time > 26_999.9).astype(float)
    stream = usable_beams({"time": time, "valid_0": valid, "valid_7": 1.0 - valid}, Config(), "beams")
    edges, share = valid_share(stream.time, beams_of(stream.data), 0.0, 36_000.0)
    assert share.shape == (len(edges) - 1, 2) == (240, 2)
    np.testing.assert_array_equal(np.isnan(share).all(axis=1), (edges[:-1] >= 9000.0) & (edges[:-1] < 18_000.0))
    np.testing.assert_array_equal(share[180:], [[100.0, 0.0]] * 60)
    stream = usable_beams({"time": [5.0], "valid_1": [1.0]}, Config(), "beams")
    edges, share = valid_share(stream.time, beams_of(stream.data), 5.0, 5.0)
    np.testing.assert_array_equal(share, [[100.0]])


def test_every_compass_is_shown_with_the_curve_that_was_estimated(own):
    """The vehicle's own heading, too."""
    assert "DVL heading: deviation" in page_of(own)
    for name in ("residuals.csv", "calibration.csv"):
        text = (own / name).read_text()
        (own / name).write_text(
            text.replace("dvl_heading", "vehicle_heading").replace("dvl_compass", "vehicle_compass")
        )
    html = page_of(own)
    assert "vehicle heading: deviation" in html
    assert "No deviation curve was estimated" not in html


def widen(table):
    """The start is known to 30 m."""
    for name in ("north_sd", "east_sd"):
        table[name] = np.hypot(table[name], 30.0)


def without_sources(path):
    """As results of a dive with places have none."""
    summary = json.loads((path / "summary.json").read_text())
    for estimate in summary["estimates"].values():
        estimate.pop("variance_sources", None)
    (path / "summary.json").write_text(json.dumps(summary))


def test_without_a_split_a_start_that_is_hardly_known_is_what_limits_a_track(own):
    without_sources(own)
    assert "the position at the start, known" not in page_of(own)
    with_track(own, widen)
    assert "<strong>What limits it:</strong> the position at the start, known to 30 m" in page_of(own)


def test_without_a_split_a_dive_without_a_dvl_is_not_limited_by_its_dvl(own):
    without_sources(own)
    residuals = pd.read_csv(own / "residuals.csv")
    residuals[residuals["sensor"] != "dvl"].to_csv(own / "residuals.csv", index=False)
    (own / "dvl.csv").unlink()
    html = page_of(own)
    assert "no DVL was used" in html
    assert "errors of the DVL" not in html
    residuals["sensor"] = residuals["sensor"].replace("dvl", "dvl_beam_0")
    residuals.to_csv(own / "residuals.csv", index=False)
    assert "no DVL was used" not in page_of(own)


def test_a_filter_that_is_surer_than_the_smoother_is_explained(own):
    said = "believe the smoothed"
    assert said not in page_of(own)
    with_track(own, widen)
    assert said in page_of(own)


def test_a_wrong_track_is_not_said_to_be_right_within_metres(own):
    assert "99 times in 100" in page_of(own)
    summary_with(own, verdict="wrong")
    assert "99 times in 100" not in page_of(own)


def test_results_of_another_version_are_shown_with_a_note(own):
    summary = json.loads((own / "summary.json").read_text())
    kept = {k: summary[k] for k in ("program", "verdict", "main_estimate")}
    (own / "summary.json").write_text(json.dumps({**kept, "version": "0.0.1"}))
    html = page_of(own)
    assert "written by rovgraph 0.0.1" in html
    assert "unknown" in html


def test_a_dive_of_two_keyframes_without_any_sd_has_a_page(own):
    for path in own.glob("trajectory_*.csv"):
        table = pd.read_csv(path).head(2)
        table[[c for c in table if c.endswith("_sd") or c.startswith("cov")]] = np.nan
        table.to_csv(path, index=False)
    for name in ("residuals.csv", "history.csv", "dvl.csv", "left_out.csv"):
        pd.read_csv(own / name).head(2).to_csv(own / name, index=False)
    summary_with(own, duration_s=0.2)
    html = page_of(own)
    assert "How far it may be off is not known" in html
    assert "no estimate of the folder states a standard deviation" in html
    assert "NaN" not in re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1]


def test_dives_side_by_side_show_each_and_name_what_is_no_dive(folder, tmp_path):
    second = shutil.copytree(folder, tmp_path / NASTY.replace("/", "∕"))
    out = report(folder, second, out=tmp_path / "campaign.html")
    html = out.read_text()
    assert "2 dives side by side" in html
    assert "<b>δύτης" not in html
    with pytest.raises(rg.InputError, match=r"campaign\.html exists"):
        report(folder, second, out=out)
    (second / "summary.json").write_text('{"program": "rovgraph", "study": "x"}')
    with pytest.raises(rg.InputError, match="only dives are set side by side"):
        report(folder, second, out=out, force=True)
    assert out.read_text() == html
    summary_with(second, main_estimate="smoothed", sensors="x")
    with pytest.raises(rg.InputError, match="incomplete or of another version"):
        report(folder, second, out=out, force=True)


def test_dives_about_known_origins_stand_where_they_were(own, tmp_path):
    first = shutil.copytree(own, tmp_path / "first")
    summary_with(first, origin={"lat_deg": 58.0, "lon_deg": 14.0})
    summary_with(own, origin={"lat_deg": 58.001, "lon_deg": 14.0})
    html = report(first, own, out=tmp_path / "both.html").read_text()
    traces = json.loads(re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1])["panels"]["map-0"]["traces"]
    north = [np.frombuffer(base64.b64decode(t["y"]), "<f4") for t in traces if t["mode"] == "lines"]
    assert np.median(north[1] - north[0]) == pytest.approx(111.4, abs=0.5)


def test_thinning_keeps_extremes_ends_and_gaps():
    rng = np.random.default_rng(1)
    values = rng.normal(size=100_000)
    values[12_345], values[77_777], values[50_000:50_400] = 40.0, -40.0, np.nan
    some = extremes(values)
    assert len(some) < 4500
    assert {0, 12_345, 77_777, 99_999} <= set(some.tolist())
    assert np.isnan(values[some]).any()
    assert (np.diff(some) > 0).all()


def test_a_line_breaks_at_both_ends_of_a_gap():
    time = np.array([0.0, 1.0, 2.0, 9.0, 10.0])
    broken_time, values = broken(time, np.arange(5.0))
    np.testing.assert_array_equal(broken_time, [0.0, 1.0, 2.0, 3.0, 8.0, 9.0, 10.0])
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0, np.nan, np.nan, 3.0, 4.0])
    for few in (time[:1], time[:3]):
        np.testing.assert_array_equal(broken(few, few)[0], few)


def test_numbers_far_from_zero_keep_their_digits():
    north = 6.47e6 + np.linspace(0.0, 50.0, 200)
    for values in (north, north[3:4]):
        text = packed(values)
        assert text[0] == ":"
        np.testing.assert_array_equal(np.frombuffer(base64.b64decode(text[1:]), "<f8"), values)
    for values in (north - north[0], [3.0, 3.0], [np.nan], [], np.linspace(0.0, 1e6)):
        np.testing.assert_array_equal(np.frombuffer(base64.b64decode(packed(values)), "<f4"), np.float32(values))


def test_separation_of_two_estimates_that_share_their_data_has_unit_variance():
    """Of a random walk with measurements: its Kalman filter against its smoother, many times."""
    rng = np.random.default_rng(2)
    n, q, r, runs = 400, 0.1, 1.0, 20
    seen = []
    for _ in range(runs):
        x = np.cumsum(rng.normal(0, np.sqrt(q), n))
        z = x + rng.normal(0, np.sqrt(r), n)
        mean, P, means, Ps = 0.0, 10.0, [], []
        for value in z:
            P += q
            gain = P / (P + r)
            mean, P = mean + gain * (value - mean), (1 - gain) * P
            means.append(mean)
            Ps.append(P)
        later, V = [means[-1]], [Ps[-1]]
        for k in range(n - 2, -1, -1):
            G = Ps[k] / (Ps[k] + q)
            later.insert(0, means[k] + G * (later[0] - means[k]))
            V.insert(0, Ps[k] + G**2 * (V[0] - Ps[k] - q))
        time = np.arange(n, dtype=float)
        tracks = [
            PageTrack(kind, {"time": time, "down": np.array(m), "down_sd": np.sqrt(v)})
            for kind, m, v in (("filtered", means, Ps), ("smoothed", later, V))
        ]
        seen.append(separation(*tracks, "down")[1])
    assert np.nanmean(np.square(seen)) == pytest.approx(1.0, abs=0.1)


def test_a_fall_of_the_sd_is_found_once_and_slow_ones_are_not():
    time = np.arange(0.0, 600.0)
    assert falls(time, np.where(time < 300, 2.0, 1.0)) == [299]
    assert falls(time, 2.0 - time / 1000) == []


def test_autocorrelation_is_that_of_an_autoregression():
    rng = np.random.default_rng(3)
    z = np.zeros(20_000)
    for k in range(1, len(z)):
        z[k] = 0.8 * z[k - 1] + rng.normal()
    assert autocorrelation(z, 3) == pytest.approx([0.8, 0.64, 0.512], abs=0.03)
    assert autocorrelation(np.ones(5), 10).tolist() == [0.0] * 4


def test_a_page_of_anything_escapes_its_title():
    html = render(
        NASTY, [Section("a", NASTY, [NASTY], [Panel(NASTY, "x", "y", [line(NASTY, [0], [1], "#000")], kind="xy")])]
    )
    assert "<script>alert" not in html


def test_what_check_finds_is_a_page_and_an_older_one_stays(dive, tmp_path):
    out = rg.report_check(rg.check(dive.log, dive.config), tmp_path / "check.html")
    html = out.read_text()
    assert "bottom lock" in html
    assert html.count("<table>") == 2
    with pytest.raises(rg.InputError, match="exists; choose another --page"):
        rg.report_check(rg.check(dive.log, dive.config), out)


def test_a_comparison_says_which_estimator_errs_least_and_whose_sd_is_wrong(tmp_path):
    summary = {"program": "rovgraph", "estimators": ["dead-reckoning", "ekf-a", NASTY], "failures": []}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    table = {
        "estimator": ["dead-reckoning", "ekf-a", NASTY],
        "rms_m": [9.0, 2.5, np.nan],
        "end_mean_m": [11.0, 3.0, np.nan],
    }
    band = {"nees_end_band": ["", "above", ""]}
    pd.DataFrame({**table, **band}).to_csv(tmp_path / "table.csv", index=False)
    runs = {"run": ["a", "b"] * 2, "estimator": ["dead-reckoning"] * 2 + ["ekf-a"] * 2, "rms_m": [8.0, 10.0, 2.0, 3.0]}
    pd.DataFrame(runs).to_csv(tmp_path / "runs.csv", index=False)
    html = page_of(tmp_path)
    assert "ekf-a errs least: 2.5 m rms along the track; dead reckoning errs by 9 m." in html
    assert "The stated sd is too small at the end of the track of ekf-a." in html
    assert "alert(1)</script>" not in html
    (tmp_path / "table.csv").unlink()
    assert "table.csv is missing" in page_of(tmp_path)


def test_a_plan_says_how_far_the_best_manoeuvre_is_from_the_goal_in_degrees(tmp_path):
    sd = {"mag_offset": 0.05, "dvl_yaw": np.deg2rad(2.0)}
    ranking = [{"manoeuvre": "circle", "speed_mps": 0.5, "score": 2.0, "bits": 7.0, "sd": sd}]
    ranking.append({"manoeuvre": "straight", "speed_mps": 0.5, "score": None, "bits": 0.0, "sd": None})
    summary = {"program": "rovgraph", "goals": {"dvl_yaw": np.deg2rad(1.0)}, "sd_before": sd, "ranking": ranking}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    html = page_of(tmp_path)
    assert "dvl_yaw: sd 2 deg, wanted 1 deg; 2 times the goal." in html
    assert html.index("dvl_yaw °, sd") < html.index("mag_offset °, sd")


def test_noise_of_a_log_at_rest_is_a_page_and_one_that_is_incomplete_says_so(tmp_path):
    channel = {"unit": "m/s2", "rate_hz": 50.0, "sd": 0.02, "sd_without_lines": 0.02, "density": 0.003}
    summary = {"program": "rovgraph", "calibration": "noise", "channels": {"acc_x": channel}, "remarks": [NASTY]}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    table = pd.DataFrame({"channel": "acc_x", "tau_s": [0.02, 0.2, 2.0], "deviation": [0.02, 0.006, 0.002]})
    table.to_csv(tmp_path / "allan.csv", index=False)
    html = page_of(tmp_path)
    assert "acc: Allan deviation" in html
    assert "spectra.csv is missing" in html
    assert "alert(1)</script>" not in html
    (tmp_path / "summary.json").write_text(json.dumps({"program": "rovgraph", "ranking": [{}]}))
    with pytest.raises(rg.InputError, match="incomplete or of another version"):
        page_of(tmp_path)
