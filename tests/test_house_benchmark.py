"""What benchmarks/house.py counts in the text of a package."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from rooms import Rooms

FILES = {
    "__init__.py": "if True:\n    from house.top import Door\n",
    "low.py": "class Room: ...\nclass _Own: ...\n",
    "middle/__init__.py": "",
    "middle/one.py": "from house import low\nfrom . import two\nclass Room: ...\nclass _Own: ...\n",
    "middle/two.py": "def f(self, a, *, b, **c):\n    import house\n",
    "top.py": "from house.middle import one, two\nclass Door: ...\n",
    "cli.py": "import house\n",
    "__main__.py": "from house import cli\n",
}
LAYERS = 'LAYERS = ({"low"}, {"middle"}, {"top"}, {"cli"})\n'


@pytest.fixture
def rooms(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_architecture.py").write_text(LAYERS)
    return Rooms(tmp_path, "house")


def test_imports_are_of_modules_and_inside_functions_too(rooms):
    assert rooms.imports["house.middle.one"] == {"house.low", "house.middle.two"}
    assert rooms.imports["house.middle.two"] == {"house"}
    assert rooms.imports["house.top"] == {"house.middle.one", "house.middle.two"}


def test_modules_of_one_importer_and_of_cycles_are_counted(rooms):
    assert rooms.with_one_importer == 4  # low, one, top and cli
    assert rooms.in_cycles == 4  # the root, top, one and two


def test_an_import_of_the_root_is_upwards_but_for_the_commands(rooms):
    assert rooms.upwards == 1
    (rooms.root / "tests" / "test_architecture.py").unlink()
    assert rooms.upwards is None


def test_names_of_classes_and_numbers_of_parameters_are_counted(rooms):
    assert rooms.shared_class_names == (2, 1)
    assert rooms.parameters == [3]
    assert (rooms.longest, rooms.lines("middle/*.py")) == (4, 6)
