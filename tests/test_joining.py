"""What those need who join: constraints, workflow, citation and hooks say what pyproject.toml says."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

import rovgraph

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NOT_TRIED = {"benchmarks", "docs"}  # extras that are in no environment of the tests


def yaml(name: str) -> Any:
    return YAML(typ="safe").load((ROOT / name).read_text(encoding="utf-8"))


def requirements(extras: set[str]) -> list[Requirement]:
    texts = [text for extra in sorted(extras) for text in PROJECT["optional-dependencies"][extra]]
    found = [Requirement(text) for text in (*PROJECT["dependencies"], *texts)]
    return [requirement for requirement in found if requirement.name != "rovgraph"]


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = [line.split("==") for line in lines]
    return {canonicalize_name(name): version for name, version in pinned}


def test_constraints_satisfy_the_bounds_of_the_project():
    pinned = constraints()
    of_tools = {"setuptools"}  # which pip freeze leaves out
    for requirement in requirements(PROJECT["optional-dependencies"].keys() - NOT_TRIED):
        name = canonicalize_name(requirement.name)
        if name not in of_tools:
            assert requirement.specifier.contains(pinned[name]), f"{requirement} and {pinned[name]}"
    assert "rovgraph" not in pinned


def test_every_dependency_of_the_package_has_a_lower_and_an_upper_bound():
    for requirement in requirements(set()):
        assert {one.operator for one in requirement.specifier} == {">=", "<"}, requirement


def test_the_hooks_and_the_linters_are_of_one_version():
    (ruff,) = (r for r in requirements({"dev"}) if r.name == "ruff")
    (hooks,) = yaml(".pre-commit-config.yaml")["repos"]
    assert str(ruff.specifier) == hooks["rev"].replace("v", "==")
    assert {hook["id"] for hook in hooks["hooks"]} == {"ruff-check", "ruff-format"}


def commands(job: dict[str, Any]) -> list[str]:
    return [step["run"] for step in job["steps"] if "run" in step]


def test_the_workflow_runs_what_make_runs_here():
    jobs = yaml(".github/workflows/ci.yml")["jobs"]
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    run = {text.removeprefix("make ") for job in jobs.values() for text in commands(job) if text.startswith("make ")}
    assert {"test", "matrix"} <= run <= set(targets)
    (tests,) = (job for job in jobs.values() if "make test" in commands(job))
    supported = {text.rpartition(" ")[2] for text in PROJECT["classifiers"] if ":: Python :: 3." in text}
    assert set(tests["strategy"]["matrix"]["python"]) == supported


def test_the_citation_is_valid_and_of_this_version():
    citation = yaml("CITATION.cff")
    required = {"cff-version", "message", "title", "authors"}
    assert required <= citation.keys() and citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == rovgraph.__version__ and citation["license"] == PROJECT["license"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in PROJECT["authors"]]
    assert [one["type"] for one in citation["references"]] == ["thesis", "article"]
    for reference in citation["references"]:
        assert {"type", "title", "authors", "year"} <= reference.keys()
        assert all(author.keys() == {"family-names", "given-names"} for author in reference["authors"])


def test_the_changelog_begins_with_this_version_and_is_one_page():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (version, *_) = re.findall(r"^## \[([\d.]+)\]", text, re.MULTILINE)
    assert version == rovgraph.__version__
    assert len(text.splitlines()) <= 70


@pytest.mark.parametrize("name", ["CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"])
def test_files_that_are_named_exist(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    linked = {link.partition("#")[0] for link in re.findall(r"\]\((?!\w+:)([^)]+)\)", text)}
    named = set(re.findall(r"`((?:rovgraph|tests|\.github)/[\w./]+)`", text))
    assert linked | named and all((ROOT / path).exists() for path in linked | named), linked | named
