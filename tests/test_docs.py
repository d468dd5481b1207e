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
import pytest
from ruamel.yaml import YAML
from typer.main import get_command

import rovgraph as rg
from rovgraph import extend
from rovgraph.cli.app import app, main
from rovgraph.sensors import SENSORS, unregister

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
HOW_TO = ("own-log", "mounting", "compass", "noise", "windows", "on-board", "estimators", "uncertainty")
RUN = tuple(DOCS / f"{name}.md" for name in (*HOW_TO, "troubleshooting"))
ELSEWHERE = ("waterlinked://", "turns.csv", "still.csv", "dive.BIN")  # instruments, and files that other tests have
PROCESSES = ("plan", "compare")  # what starts some, which takes long
EXAMPLES = {  # what each of them has to say
    "smooth": r"verdict: trusted\n143 m in 480 s",
    "residuals": r"dvl x +\d+ +-?0\.0\d +(0\.9\d|1\.0\d) +2\d",
    "mountings": r"stated 45 .*: trusted\nstated -45 .* found 4\d.*: wrong",
    "monte_carlo": r"NEES (1\.\d|2\.\d|3\.[0-4]) over 10 dives",
    "simulate_plan_observe": r"square@0\.5: dvl_yaw known to 1\.\d°(.*\n)*after the square@0\.5: dvl_yaw is weak",
    "own_sensor": r"without ranges: 0\.97 m rms.*\nwith ranges: 0\.17 m rms",
    "live": r"start: heading from mag, dvl_heading\n(.*\n)*6\d solutions, the last at \[6\.",
    "export": r"xarray.Dataset",
    "native_files": r"dvl.csv: .* by acceleration .*\ntrusted, .* m rms\nmaps",
}


def commands(page: Path) -> Iterator[str]:
    """The commands of a page that stand on lines of their own, without what the shell does with them."""
    for line in page.read_text(encoding="utf-8").replace("\\\n", " ").splitlines():
        if found := re.match(r" {4,}(?:[a-z]+ \| )?(rovgraph [a-z][^|>#]*)", line):
            yield found[1].strip()


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
    assert "rg.Online" in (tmp_path / "site" / "api-reference.html").read_text(encoding="utf-8")


# commands


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
    """A dive as the manuals name its files: log.csv, vehicle.yaml, reference.csv, and the README's dive1.yaml."""
    folder = tmp_path_factory.mktemp("manual")
    config = rg.parse_config(
        "calibration: {dvl_yaw: {estimate: true, sd_deg: 5}}\nenvironment: {origin_lat_deg: 58.3, origin_lon_deg: 11.4}"
    )
    rg.simulate("square", config, seed=1, choices=rg.Choices(duration=40)).save(folder / "dive")
    for name, here in (("log.csv", "log.csv"), ("config.yaml", "vehicle.yaml"), ("truth.csv", "reference.csv")):
        shutil.move(folder / "dive" / name, folder / here)
    shutil.copy(folder / "vehicle.yaml", folder / "dive1.yaml")
    return folder


def run(text: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", shlex.split(text))
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
    with warnings.catch_warnings():
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def run_all(
    chosen: Callable[[str], bool], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> int:
    """Run each different command of the how-to pages that is chosen, in the order of the pages; gives their number."""
    monkeypatch.chdir(folder)
    texts = dict.fromkeys(text for page in RUN for text in commands(page))
    texts = [text for text in texts if chosen(text) and not any(word in text for word in ELSEWHERE)]
    for text in texts:
        assert run(text, monkeypatch) == 0, f"{text}\n{capsys.readouterr().err}"
    return len(texts)


@pytest.mark.slow
def test_the_commands_of_the_how_to_pages_do_their_work(folder, monkeypatch, capsys):
    assert run_all(lambda text: text.split()[1] not in PROCESSES, folder, monkeypatch, capsys) >= 10


@pytest.mark.slow
def test_the_commands_of_the_how_to_pages_that_start_processes_do_theirs(folder, monkeypatch, capsys):
    assert run_all(lambda text: text.split()[1] in PROCESSES, folder, monkeypatch, capsys) == 2


# code


def test_the_example_of_the_readme_runs(folder, monkeypatch):
    monkeypatch.chdir(folder)
    failed, tried = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert tried == 5 and failed == 0


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
        key = (log.source, len(log["imu"]), config.to_yaml(), *options.items())
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


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_an_example_says_what_it_promises_and_draws_its_figure(path, remembered, drawing, monkeypatch, capsys):
    known = set(SENSORS)
    monkeypatch.setattr(rg, "smooth", remembered)
    monkeypatch.setattr("rovgraph.studies.plan.cores", lambda: 1)  # each process imports everything anew
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
    assert "units: {gyr: deg/s}" in said and "sign is reversed" in said and "mount_rpy_deg: [180.0, 0.0, 0.0]" in said
    assert "its noise is" in said  # of the ping that was stated too precise
    assert told["metrics"].rms_m < 1.0
    assert rg.evaluate(told["straight"].smoothed.trajectory, told["dive"].truth).rms_m > 5.0
