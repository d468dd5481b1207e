"""The study of the thesis's questions: each table comes out, and a field that walks does no harm."""

import importlib.util
import sys
from functools import cache, partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from rovgraph.simulate import CALM, Choices, simulated


@cache
def study() -> ModuleType:
    """``benchmarks/thesis.py``, which is a script and no part of the package."""
    path = Path(__file__).parents[1] / "benchmarks" / "thesis.py"
    spec = importlib.util.spec_from_file_location("thesis_study", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def short_dive():
    return simulated("docking", 1, choices=Choices(speed=0.8, dropouts=((14.0, 15.0),)))


def short_driven(name, seed, seconds, **choices):
    """A dive that is quick to make, whatever was asked for."""
    return study().case_of(*short_dive(), seconds)


@pytest.fixture
def quick(monkeypatch):
    """Fewer rows, and one short dive in place of all that are driven."""
    monkeypatch.setattr(study(), "driven", short_driven)
    monkeypatch.setattr(study(), "WATERS", {"all pings": (study().STILL, ()), "gap": (study().STILL, ((0.7, 0.8),))})
    monkeypatch.setattr(study(), "DRAG_ERRORS", (0.0,))
    monkeypatch.setattr(study(), "MOTIONS", {"turning, calm": ("square", CALM)})
    changes = {name: study().CHANGES[name] for name in ("as printed", "Jacobians at the truth")}
    monkeypatch.setattr(study(), "CHANGES", changes)
    monkeypatch.setattr(study(), "ON_ARMLESS", ())
    monkeypatch.setattr(study(), "OF_4_5", changes)
    monkeypatch.setattr(study(), "SOUGHT", {"docking": partial(short_driven, "docking")})
    monkeypatch.setattr(study(), "BELIEVED", {"fixed": study().BELIEVED["fixed"]})


SECONDS = {"model": 18, "online": 18, "frames": 32, "misalignment": 18, "invariant": 1, "field": 18}


LONG = ("model", "frames")


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in SECONDS])
def test_each_study_prints_its_table(name, quick, capsys):
    text = study().main([name, "--seeds", "1", "--first", "2", "--seconds", str(SECONDS[name]), "--jobs", "1"])
    assert capsys.readouterr().out.strip() == text
    header, rule, *rows = text.splitlines()
    assert set(rule) <= set("|-") and rows
    assert all(row.count("|") == header.count("|") for row in rows)
    shown = study().STUDIES[name]
    assert all(label in header for label in (*shown.labels, *shown.numbers))
    assert "nan" not in text
    for column, numbers in enumerate(shown.numbers, start=-len(shown.numbers)):
        cells = [row.split("|")[1:-1][column].strip() for row in rows]
        assert any(cell != "-" for cell in cells), f"{numbers} is known somewhere"


def test_every_study_is_tested():
    assert set(SECONDS) == set(study().STUDIES)


def test_a_field_that_walks_takes_a_change_of_the_field_without_harm(monkeypatch):
    """Track's error over seeds within 1.2 of that without the change; the same field all the way is worse."""
    believed = {name: study().BELIEVED[name] for name in ("constant", "walking")}
    monkeypatch.setattr(study(), "BELIEVED", believed)
    squared = {}
    for seed in (1, 2):
        case = study().moved("square", CALM, seed, 60.0)
        for row in study().field(seed, 60.0, case, "c", False):
            squared.setdefault((row["field"], row["believed"]), []).append(row["rms_m"] ** 2)
    error = {key: np.sqrt(np.mean(values)) for key, values in squared.items()}
    assert error["another", "walking"] < 1.2 * error["the same", "constant"]
    assert error["another", "constant"] > 1.2 * error["another", "walking"]
