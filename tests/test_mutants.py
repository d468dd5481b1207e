"""The list of planted faults is well formed, and `benchmarks/mutants.py` says what became of one."""

from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def mutants(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import mutants

    return mutants


def test_every_fault_has_a_name_of_its_own_and_tests_that_are_there(mutants):
    faults = mutants.faults()
    assert len(faults) > 40 and max(Counter(fault.name for fault in faults).values()) == 1
    for fault in faults:
        assert fault.old != fault.new and fault.breaks
        for test in fault.tests:
            file, _, name = test.partition("::")
            assert not name or f"def {name}(" in (ROOT / "tests" / file).read_text(encoding="utf-8"), test


def test_every_fault_applies_to_the_code(mutants):
    """One that does not is a fault that nobody plants any more: renew its text in benchmarks/mutants.toml."""
    counts = {f.name: (ROOT / "rovgraph" / f.file).read_text(encoding="utf-8").count(f.old) for f in mutants.faults()}
    assert {name: count for name, count in counts.items() if count != 1} == {}


@pytest.fixture
def plant(mutants, tmp_path, capsys):
    """What is printed of a fault in a package of one line, whose test asks for 2."""
    for folder in ("rovgraph", "tests"):
        (tmp_path / folder).mkdir()
    (tmp_path / "rovgraph" / "__init__.py").write_text("TWO = 2\n")
    (tmp_path / "tests" / "test_two.py").write_text("from rovgraph import TWO\n\ndef test_two():\n    assert TWO > 1\n")

    def planted(old: str, new: str, test: str = "test_two.py") -> tuple[bool, str]:
        caught = mutants.report(mutants.Fault("one", "__init__.py", old, new, "what it breaks", [test]), tmp_path)
        assert (tmp_path / "rovgraph" / "__init__.py").read_text() == "TWO = 2\n"
        return caught, capsys.readouterr().out

    return planted


@pytest.mark.parametrize(
    ("old", "new", "test", "caught", "said"),
    [
        ("2", "1", "test_two.py", True, "caught"),
        ("2", "3", "test_two.py", False, "SURVIVED: what it breaks (test_two.py)"),
        ("4", "1", "test_two.py", False, "OUT OF DATE: its old text is there 0 times"),
        ("2", "1", "test_gone.py", False, "its tests cannot be run"),
        ("2", "(", "test_two.py", False, "its tests cannot be run"),
    ],
    ids=["caught", "survived", "out of date", "no tests", "no Python"],
)
def test_a_fault_is_caught_or_survives_or_is_said_to_be_useless(plant, old, new, test, caught, said):
    found, text = plant(old, new, test)
    assert found == caught and said in text
