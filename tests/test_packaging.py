"""What is released is whole: the sdist builds the wheel, and the wheel runs outside the repository."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement

import rovgraph

ROOT = Path(__file__).parents[1]
BUILT_FROM = (
    *("pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "LICENSE", "Makefile", "Dockerfile", "mkdocs.yml"),
    *("CITATION.cff", "CONTRIBUTING.md", "SECURITY.md", "constraints.txt", ".pre-commit-config.yaml", ".github"),
    *(".dockerignore", "rovgraph", "tests", "docs", "data", "configs", "benchmarks", "blueos", "examples"),
)
NOT_RELEASED = {".ci", ".gitignore"}
LEFT_BEHIND = ("__pycache__", ".*_cache")
LINUX = {"sys_platform": "linux", "platform_machine": "x86_64"}


def outside() -> dict[str, str]:
    """The environment of a process that must not find this checkout."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkout without what was left in it by earlier work."""
    tree = tmp_path_factory.mktemp("tree")
    left = shutil.ignore_patterns(*LEFT_BEHIND)
    for name in BUILT_FROM:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, ignore=left, symlinks=True)
        else:
            shutil.copy(ROOT / name, tree / name)
    return tree


@pytest.fixture(scope="module")
def built(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and with the wheel that was made of the sdist."""
    pytest.importorskip("build", reason="the package 'build' is not installed")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(tree)]
    done = subprocess.run(command, capture_output=True, text=True, env=outside(), cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (wheel,) = built.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode("utf-8"))


def files(folder: Path) -> set[str]:
    """Names of all files below a folder, but for those that earlier work left behind."""
    found = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    return {path.as_posix() for path in found if not any(fnmatch(part, p) for part in path.parts for p in LEFT_BEHIND)}


def test_the_wheel_holds_the_package_with_its_data_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == {f"rovgraph/{name}" for name in files(ROOT / "rovgraph")}
    assert {"rovgraph/py.typed", "rovgraph/model/falcon.yaml", "rovgraph/model/presets/dvls.yaml"} <= names
    assert wheel.name.endswith("-py3-none-any.whl") and wheel.stat().st_size < 2e6


def test_the_sdist_holds_the_whole_source(tree, built):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {PurePosixPath(*PurePosixPath(m.name).parts[1:]).as_posix() for m in archive if m.isfile()}
    made = {name for name in names if name in ("PKG-INFO", "setup.cfg") or ".egg-info/" in name}
    written = {name for name in files(tree) if ".egg-info/" in name}  # by the build
    assert names - made == files(tree) - written


def test_what_the_repository_holds_is_released():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this is no checkout")
    assert {name.partition("/")[0] for name in listed.stdout.splitlines()} - NOT_RELEASED == set(BUILT_FROM)


def test_nothing_is_a_symbolic_link(tree):
    assert [path for path in tree.rglob("*") if path.is_symlink()] == []


def requirements(metadata: Message) -> list[Requirement]:
    return [Requirement(text) for text in metadata.get_all("Requires-Dist", [])]


def test_gtsam_is_required_only_where_it_has_wheels(metadata):
    (marker,) = (r.marker for r in requirements(metadata) if r.name == "gtsam")
    assert isinstance(marker, Marker)
    assert marker.evaluate(LINUX) and marker.evaluate({**LINUX, "platform_machine": "aarch64"})
    assert marker.evaluate({"sys_platform": "darwin", "platform_machine": "arm64"})
    assert not marker.evaluate({"sys_platform": "win32", "platform_machine": "AMD64"})
    assert not marker.evaluate({**LINUX, "platform_machine": "armv7l"})


def test_every_extra_that_a_message_names_is_there(metadata):
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "rovgraph").rglob("*.py")]
    named = {extra for text in texts for extra in re.findall(r"rovgraph\[([a-z,]+)\]", text)}
    assert {"online", "parquet", "calibrate", "studies"} <= named <= set(metadata.get_all("Provides-Extra", []))


def test_the_metadata_say_what_was_tried(metadata):
    assert metadata["Requires-Python"] == ">=3.11" and metadata["License-Expression"] == "MIT"
    stated = {c.rpartition(" ")[2] for c in metadata.get_all("Classifier", []) if ":: Python :: 3." in c}
    assert stated == {"3.11", "3.12", "3.13"}


@pytest.mark.parametrize("dockerfile", ["Dockerfile", "blueos/Dockerfile"])
def test_the_image_is_built_from_files_that_are_there_and_not_ignored(dockerfile):
    copied = re.findall(r"^COPY (.+) \S+$", (ROOT / dockerfile).read_text(encoding="utf-8"), re.MULTILINE)
    names = [name for line in copied for name in line.split()]
    let_in = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert names and all((ROOT / name).exists() and f"!{name}" in let_in for name in names)


def test_the_extension_of_blueos_says_what_blueos_reads():
    text = (ROOT / "blueos/Dockerfile").read_text(encoding="utf-8").replace("\\\n", "")
    labels = {name: value.strip("'\"") for name, value in re.findall(r"^LABEL (\w+)=(.*)$", text, re.MULTILINE)}
    assert labels["version"] == rovgraph.__version__ and labels["type"] == "device-integration"
    read = {name: json.loads(labels[name]) for name in ("permissions", "authors", "company", "tags", "links")}
    assert read["authors"][0].keys() == {"name", "email"} and read["company"]["name"]
    ports, host = read["permissions"]["ExposedPorts"], read["permissions"]["HostConfig"]
    (exposed,) = re.findall(r"^EXPOSE (.+)$", text, re.MULTILINE)
    assert ports.keys() == host["PortBindings"].keys() == set(exposed.split())
    assert [bind.partition(":")[2] for bind in host["Binds"]] == ["/data"]


NO_GTSAM = "import sys; sys.modules['gtsam'] = None; from rovgraph.cli.app import main; main()"


@pytest.mark.slow
def test_the_wheel_runs_in_a_clean_environment(wheel, tmp_path):
    """Outside the repository, with the newest libraries, and without GTSAM too."""
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = next(path for path in (tmp_path / "venv").glob("*/python*") if path.stem == "python")
    pip = [python, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    if subprocess.run([*pip, "download", "--no-deps", "--dest", tmp_path, "typer"], capture_output=True).returncode:
        pytest.skip("packages cannot be downloaded: no network")
    subprocess.run([*pip, "install", wheel], check=True, env=outside())
    environment = outside() | {"ROVGRAPH_CACHE_DIR": str(tmp_path / "cache")}

    def run(*command: object) -> str:
        done = subprocess.run(
            [*map(str, command)], capture_output=True, text=True, env=environment, cwd=tmp_path, timeout=1200
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    said = run(python.with_name("rovgraph" + python.suffix), "demo")
    assert "verdict: trusted" in said and "0.043 m" in said
    smooth = ("smooth", "demo/log.csv", "--config", "demo/config.yaml", "--no-figures")
    assert "verdict: trusted" in run(python, "-c", NO_GTSAM, *smooth, "--out", "again")
    one, other = (tmp_path / folder / "trajectory_smoothed.csv" for folder in ("demo/results", "again"))
    assert one.read_bytes() == other.read_bytes()
