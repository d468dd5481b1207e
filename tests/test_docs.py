"""Manuals and examples: commands and code that stand there work, and every page is on the site."""

import doctest
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from browsers import printing_browser
from ruamel.yaml import YAML
from test_microstrain_files import as_export as microstrain_export
from test_vectornav_files import as_csv as vectornav_csv
from test_vectornav_files import as_sentences as vectornav_sentences
from typer.main import get_command
from wire import report

import rovgraph as rg
from rovgraph import extend
from rovgraph.cli.app import app, main
from rovgraph.sensors import SENSORS, unregister

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
ELSEWHERE = (  # what is not run here: instruments, a browser, recordings that do not come with rovgraph, hours of work
    *("waterlinked://", "SOURCE...", "--http", "dive.BIN", "dive.mtb", "remus600", "ictineu", "misalignment.yaml"),
    "rovgraph demo",  # test_api and test_packaging run it
)
PATHS = ("bluerov2", "survey", "auv", "bag")  # pages whose commands test_paths runs, as they stand
INSTRUMENTS = ("waterlinked://",)  # in what it does not run
SHORTER = {  # the same work on fewer and shorter dives
    "--scenario vattern --seeds 30": "--scenario circle --seeds 1 --duration 40 --estimators dead-reckoning --jobs 1",
    "--from 600": "--from 10",
    "dvl.jsonl --out log.csv": "dvl.jsonl --out log.csv --force",  # each page's folder has a log
    "plan --config configs/": "plan --manoeuvres ship-spin --duration 60 --imu-rate 25 --config configs/",
    "plan --config dive1.yaml": "plan --manoeuvres straight --config dive1.yaml",
    "plan --config vehicle.yaml --known": "plan --manoeuvres straight --config vehicle.yaml --known",
    "compare log.csv": "compare log.csv --estimators dead-reckoning --jobs 1",
    "simulate lawnmower": "simulate lawnmower --duration 60",
    "data/falcon/log.csv.gz": "log.csv",
    "data/falcon/truth.csv.gz": "reference.csv",
    "data/falcon/config.yaml": "vehicle.yaml",
    "study misalignment --config configs/studies/quick.yaml": "study misalignment --config quick.yaml",
}
RESULTS = ("results", "results/dive1", "results/dive2")  # folders of `smooth` that a page may presuppose
EXAMPLES = {  # what each of them has to say
    "smooth": r"verdict: trusted\n143 m in 480 s",
    "residuals": r"dvl x +\d+ +-?0\.0\d +(0\.9\d|1\.0\d) +2\d",
    "mountings": r"stated 45 .*: trusted\nstated -45 .* found 4\d.*: wrong",
    "monte_carlo": r"NEES (1\.\d|2\.\d|3\.[0-4]) over 10 dives",
    "simulate_plan_observe": r"square@0\.5: dvl_yaw known to 1\.\d°(.*\n)*after the square@0\.5: dvl_yaw is weak",
    "own_sensor": r"without ranges: 0\.98 m rms.*\nwith ranges: 0\.17 m rms",
    "live": r"start: heading from mag, dvl_heading\n(.*\n)*6\d solutions, the last at \[6\.",
    "export": r"xarray.Dataset",
    "bottom": r"19\d\d soundings(.*\n)*altitude 6\.\d to 9\.\d m",
    "native_files": r"dvl.csv: .* by acceleration .*\ntrusted, .* m rms\nmaps",
}


def commands(page: Path) -> Iterator[str]:
    """The commands of a page that stand on lines of their own, without what the shell does with them."""
    for line in page.read_text(encoding="utf-8").replace("\\\n", " ").splitlines():
        if found := command_on(line):
            yield found


def command_on(line: str) -> str:
    """The command on a line of a page; empty where there is none."""
    found = re.match(r" {4,}(?:[a-z]+ \| )?(rovgraph [a-z][^|>#]*)", line)
    return found[1].strip() if found else ""


def needs_an_instrument(text: str) -> bool:
    return any(word in text for word in INSTRUMENTS)


def refuse_unless_parsed(text: str) -> None:
    """Raises what the command line raises for a command, an option or a choice that it does not have."""
    name, words = "rovgraph", shlex.split(text)[1:]
    command = get_command(app)
    while hasattr(command, "commands"):
        name, words = words[0], words[1:]
        command = command.commands[name]
    command.make_context(name, words)


# the site


def test_every_page_stands_in_the_navigation():
    """A page that does not cannot be found; add it to `nav` in mkdocs.yml."""
    nav = YAML(typ="safe").load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    listed = re.findall(r"'([\w-]+\.(?:md|py))'", str(nav))
    assert len(listed) == len(set(listed))
    assert {page.name for page in PAGES[1:]} | {"tutorial.py"} <= set(listed)


def test_every_picture_of_the_manuals_is_there_and_small():
    pictures = [
        page.parent / src
        for page in PAGES
        for src in re.findall(r"(?:!\[[^\]]*\]\(|<img [^>]*src=\")([^)\"\s]+)", page.read_text(encoding="utf-8"))
        if "://" not in src
    ]
    assert len(pictures) > 10
    assert [path.name for path in pictures if not path.is_file()] == []
    assert [path.name for path in (DOCS / "images").iterdir() if path not in set(pictures)] == []
    assert [path.name for path in pictures if path.stat().st_size > 150_000] == []


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_its_search_needs_no_network(tmp_path):
    """Links, anchors, public names without a docstring, and the notebook, which is run."""
    pytest.importorskip("mkdocs_jupyter", reason="needs pip install '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "search/search_index.js" in page or (tmp_path / "site" / "search" / "search_index.js").is_file()
    assert 'src="site/iframe-worker.js"' in page
    for html in (tmp_path / "site").rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img)[^>]+(?:src|href)=\"(https?:[^\"]+)", html.read_text(encoding="utf-8")
        )
        assert not loaded, html.name
        if html.name != "404.html":  # its addresses begin at the root of a server
            own = re.findall(r"<(?:img|script)[^>]+src=\"(?!data:)([^\"]+)", html.read_text(encoding="utf-8"))
            assert [src for src in own if not (html.parent / src).is_file()] == [], html.name
    assert "rg.Online" in (tmp_path / "site" / "api-reference.html").read_text(encoding="utf-8")


# commands


@pytest.mark.slow
def test_the_command_line_knows_every_command_of_the_manuals():
    found = [(page.name, text) for page in PAGES for text in commands(page)]
    wrong = []
    for page, text in found:
        try:
            refuse_unless_parsed(text)
        except Exception as error:
            wrong.append(f"{page}: {text}: {error}")
    assert not wrong
    assert len(found) > 60
    with pytest.raises(Exception, match="--nonsense"):
        refuse_unless_parsed("rovgraph smooth log.csv --nonsense")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files as the manuals name them: a dive, logs for calibrations, a table of photos, and a results folder."""
    folder = tmp_path_factory.mktemp("manual")
    config = rg.parse_config(
        "calibration: {dvl_yaw: {estimate: true, sd_deg: 5}}\nenvironment: {origin_lat_deg: 58.3, origin_lon_deg: 11.4}"
    )
    rg.simulate("square", config, seed=1, choices=rg.Choices(duration=40)).save(folder / "made")
    for name, copies in (
        ("log.csv", ("log.csv", "dive.csv")),
        ("config.yaml", ("vehicle.yaml", "dive1.yaml", "rov.yaml")),
        ("truth.csv", ("reference.csv", "truth.csv")),
    ):
        for copy in copies:
            shutil.copy(folder / "made" / name, folder / copy)
    write_recordings(folder)
    table = pd.read_csv(folder / "log.csv").rename(columns={"time": "timestamp", "gyr_x": "gyro x", "gyr_y": "gyro y"})
    table.rename(columns={"gyr_z": "gyro z"}).to_csv(folder / "table.csv", index=False)
    pd.DataFrame({"time": [5.0, 20.0], "taken": [5.0, 20.0], "photo": ["a.jpg", "b.jpg"]}).to_csv(folder / "photos.csv")
    rg.simulate("stationary", choices=rg.Choices(variant="water")).save(folder / "still")
    for calibration in ("still.csv", "standing.csv"):
        shutil.copy(folder / "still" / "log.csv", folder / calibration)
    for calibration in ("turns.csv", "turned.csv"):
        write_turns(folder / calibration)
    shutil.copytree(ROOT / "configs", folder / "configs")
    quick = (ROOT / "configs" / "studies" / "quick.yaml").read_text(encoding="utf-8")
    (folder / "quick.yaml").write_text(re.sub(r"(?m)^runs: \d+", "runs: 2", quick), encoding="utf-8")
    result = rg.smooth(rg.read_log(folder / "log.csv", config), config)
    result.save(folder / "smoothed", figures=False)
    return folder


def write_recordings(folder: Path) -> None:
    """A dive as instruments record it, long enough to join their clocks: the IMU in three forms, the DVL in one."""
    log = rg.simulate("lawnmower", seed=1, choices=rg.Choices(duration=120)).log
    (folder / "microstrain.csv").write_bytes(microstrain_export(log))
    (folder / "vectornav.csv").write_bytes(vectornav_csv(log))
    (folder / "vn100.txt").write_bytes(vectornav_sentences(log))
    pings = log["dvl"]
    (folder / "dvl.jsonl").write_bytes(
        b"".join(
            report(vx=vx, vy=vy, vz=vz, time_of_validity=round(1e6 * time), covariance=[], fom=0.01)
            for time, (vx, vy, vz) in zip(pings.time, pings.data[:, :3].tolist(), strict=True)
        )
    )


def write_turns(path: Path) -> None:
    """Samples of a magnetometer that is turned all ways, with hard iron, a field of 50."""
    field = np.random.default_rng(1).normal(size=(2000, 3))
    field *= 50.0 / np.linalg.norm(field, axis=1, keepdims=True)
    table = pd.DataFrame(field + np.array([12.0, -25.0, 7.0]), columns=["mag_x", "mag_y", "mag_z"])
    table.assign(time=np.arange(len(table)) / 25.0).to_csv(path, index=False)


def run(text: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", shlex.split(text))
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
    with warnings.catch_warnings():
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def shortened(text: str) -> str:
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    return text


RUN = {
    page: [] if page.stem in PATHS else [c for c in commands(page) if not any(word in c for word in ELSEWHERE)]
    for page in PAGES
}


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page, texts in RUN.items() if texts], ids=lambda page: page.stem)
def test_the_commands_of_a_page_do_their_work_one_after_another(page, folder, tmp_path, monkeypatch, capsys):
    """As a reader would type them: each in the folder that those before it left."""
    here = tmp_path / "here"
    shutil.copytree(folder, here)
    monkeypatch.chdir(here)
    monkeypatch.setattr("rovgraph.lab.plan.cores", lambda: 1)  # each process imports everything again
    monkeypatch.setenv("ROVGRAPH_BROWSER", str(printing_browser(tmp_path / "chromium")))
    for text in map(shortened, RUN[page]):
        words = shlex.split(text)
        for k, word in enumerate(words):
            needed = "results/dive1" if word.startswith("results/dive1/") else word
            if needed in RESULTS and not Path(needed, "summary.json").exists() and words[k - 1] != "--out":
                shutil.copytree(here / "smoothed", needed, dirs_exist_ok=True)
        assert run(text, monkeypatch) == 0, f"{text}\n{capsys.readouterr().err}"


def test_few_commands_of_the_manuals_are_not_run():
    every = {text for page in PAGES for text in commands(page)}
    ran = {text for texts in RUN.values() for text in texts}
    ran |= {text for name in PATHS for text in commands(DOCS / f"{name}.md") if not needs_an_instrument(text)}
    assert len(every - ran) <= 16


# code


def test_the_example_of_the_readme_runs(folder, monkeypatch):
    monkeypatch.chdir(folder)
    failed, tried = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert tried == 5 and failed == 0


def test_the_table_of_the_api_has_every_function_and_every_result():
    table = (DOCS / "api.md").read_text(encoding="utf-8")
    assert [name for name in rg.__all__ if not re.search(rf"\b{name}\b", table)] == []


def test_extensions_and_examples_import_public_modules_only():
    """What the manuals promise to keep: `rovgraph`, `rovgraph.extend`, and the command line's `main`."""
    texts = [(DOCS / f"{name}.md").read_text(encoding="utf-8") for name in ("own-sensor", "formats", "export", "api")]
    texts += [path.read_text(encoding="utf-8") for path in (*(ROOT / "examples").glob("*.py"), DOCS / "tutorial.py")]
    modules = {module for text in texts for module in re.findall(r"^(?:from|import) (rovgraph[\w.]*)", text, re.M)}
    assert modules == {"rovgraph", "rovgraph.extend", "rovgraph.cli.app"}
    assert all(hasattr(extend, name) for name in extend.__all__)


@pytest.fixture(scope="module")
def remembered() -> Callable[..., rg.Result]:
    """`rg.smooth`, which does not do the same work twice: three examples smooth the same dive."""
    results: dict[tuple[object, ...], rg.Result] = {}
    smooth = rg.smooth

    def again(log: rg.Log, config: rg.Config, **options: object) -> rg.Result:
        key = (log.source, len(log.streams.get("imu", ())), config.to_yaml(), *options.items())
        if key not in results or log.source == "log" or " " in log.source:  # what has no file is not told by its name
            results[key] = smooth(log, config, **options)
        return results[key]

    return again


@pytest.fixture
def drawing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An empty folder, and figures that nobody has to close."""
    import matplotlib.pyplot as plt

    monkeypatch.chdir(tmp_path)
    backend = mpl.get_backend()
    plt.switch_backend("Agg")
    yield
    plt.close("all")
    plt.switch_backend(backend)


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_an_example_says_what_it_promises_and_draws_its_figure(path, remembered, drawing, monkeypatch, capsys):
    known = set(SENSORS)
    monkeypatch.setattr(rg, "smooth", remembered)
    monkeypatch.setattr("rovgraph.lab.plan.cores", lambda: 1)  # each process imports everything again
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        try:
            runpy.run_path(str(path), run_name="__main__")
        finally:
            for name in set(SENSORS) - known:
                unregister(name)
    said = capsys.readouterr().out
    assert re.search(EXAMPLES[path.stem], said), said
    assert Path(f"{path.stem}.png").stat().st_size > 5000
    if path.stem == "export":
        assert len(json.loads(Path("track.geojson").read_text())["features"]) > 2000


@pytest.mark.slow
def test_the_tutorial_goes_from_a_wrong_track_to_one_that_is_right(drawing, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        told = runpy.run_path(str(DOCS / "tutorial.py"))
    said = capsys.readouterr().out
    assert [told[name].verdict for name in ("straight", "mounted")] == ["wrong", "trusted"]
    assert "units: {gyr: deg/s}" in said and "sign is reversed" in said and "mount_rpy_deg: [180.0, 0.0, -90.0]" in said
    assert "its noise is" in said  # of the ping that was stated too precise
    assert told["metrics"].rms_m < 1.0
    assert rg.evaluate(told["straight"].smoothed.trajectory, told["dive"].truth).rms_m > 5.0
