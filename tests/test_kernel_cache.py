"""Compiled kernels: where they are kept, and what is said where they cannot be."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

MODULE = """
from rovgraph.kernels.compile import cache_folder, kernel

@kernel("f8(f8)")
def twice(x: float) -> float:
    return 2.0 * x

print(twice(1.5), cache_folder(__name__))
"""


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    given = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_DISABLE_JIT": "0", **environment}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=given, timeout=120)


def own_kernel(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    (folder / "own_kernel.py").write_text(MODULE)
    return run(f"import sys; sys.path.insert(0, {str(folder)!r}); import own_kernel", **environment)


@pytest.mark.slow
def test_a_kernel_is_compiled_once_and_said_to_be_once(tmp_path):
    kept = tmp_path / "kept"
    first, second = (own_kernel(tmp_path, ROVGRAPH_CACHE_DIR=str(kept)) for _ in range(2))
    assert first.returncode == second.returncode == 0, first.stderr + second.stderr
    assert first.stdout == second.stdout
    assert first.stdout.startswith(f"3.0 {kept}")
    assert first.stderr.count("compiling rovgraph's kernels, once") == 1
    assert second.stderr == ""
    assert list(kept.rglob("*.nbc"))


def test_a_folder_that_cannot_be_written_is_passed_over(tmp_path):
    (tmp_path / "file").write_text("no folder")
    done = own_kernel(tmp_path, ROVGRAPH_CACHE_DIR=str(tmp_path / "file" / "below"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("3.0 ")
    assert "below" not in done.stdout


def test_where_no_folder_can_be_written_kernels_are_compiled_all_the_same(tmp_path):
    code = (
        "from rovgraph.kernels import compile as c; c._candidates = lambda: iter(()); "
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import own_kernel"
    )
    (tmp_path / "own_kernel.py").write_text(MODULE)
    done = run(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "3.0 None\n"
    assert "set ROVGRAPH_CACHE_DIR" in done.stderr


@pytest.mark.slow
def test_processes_that_compile_at_once_do_not_disturb_each_other(tmp_path):
    (tmp_path / "own_kernel.py").write_text(MODULE)
    given = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "NUMBA_DISABLE_JIT": "0",
        "ROVGRAPH_CACHE_DIR": str(tmp_path / "kept"),
    }
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import own_kernel"
    children = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=given) for _ in range(3)
    ]
    assert all(child.communicate(timeout=120)[0].startswith("3.0 ") for child in children)
    assert all(child.returncode == 0 for child in children)


def test_the_folder_changes_with_the_version_and_with_what_a_kernel_imports(monkeypatch):
    from rovgraph.kernels import compile as compiling

    before = compiling._state_of("rovgraph.kernels.correction")
    assert {"rotations", "compile", "compilers"} < compiling._imported_kernels("correction")
    compiling._state_of.cache_clear()
    monkeypatch.setattr(compiling, "__version__", "another")
    assert compiling._state_of("rovgraph.kernels.correction") != before
    compiling._state_of.cache_clear()


@pytest.mark.parametrize("command", [["smooth", "log.csv"], ["online", "file:log.csv"]])
def test_without_numba_one_line_says_what_to_install(command, tmp_path):
    (tmp_path / "log.csv").write_text("time,acc_x\n0,1\n")
    code = (
        f"import sys, os; os.chdir({str(tmp_path)!r}); sys.modules['numba'] = None; "
        f"from rovgraph.cli import app; sys.argv = ['rovgraph', *{command!r}]; app.main()"
    )
    done = run(code)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "pip install 'numba" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_missing_modules_are_compiled_by_processes_of_their_own_and_nothing_else(tmp_path):
    few = ["chain", "chain_posterior"]
    code = (
        "from rovgraph.kernels import compile as c; c.__dict__['_modules'] = lambda: " + repr(few) + "; "
        "c.os.sched_getaffinity = lambda pid: {0, 1}; c.cache_folder('rovgraph.kernels.chain')"
    )
    done = run(code, ROVGRAPH_CACHE_DIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    kept = sorted(folder.name.split("-")[1] for folder in tmp_path.iterdir())
    assert kept == ["chain", "chain_posterior"]
    assert all(any(folder.rglob("*.nbc")) for folder in tmp_path.iterdir())


RECORDING = "import sys; [(print(x, end='', file=open(sys.argv[1], 'a')), print(flush=True)) for x in sys.stdin]"


@pytest.mark.parametrize("alive", [0, 1])
def test_where_a_worker_has_died_the_others_compile_the_rest(alive, tmp_path, monkeypatch):
    from rovgraph.kernels import compile as compiling

    given, codes = tmp_path / "given", iter(["", *[RECORDING] * alive, ""])

    @contextlib.contextmanager
    def worker(parent: Path) -> Iterator[subprocess.Popen[str]]:
        command = [sys.executable, "-c", next(codes), str(given)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        yield process
        with contextlib.suppress(OSError):
            process.communicate(timeout=60)

    given.touch()
    monkeypatch.setattr(compiling, "_worker", worker)
    monkeypatch.setattr(compiling.os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    compiling._compile_missing(tmp_path / "kept")
    assert len(given.read_text().split()) >= alive * (len(compiling._modules()) - 1)


def test_an_error_ends_a_worker_at_once(tmp_path):
    from rovgraph.kernels.compile import _worker

    with pytest.raises(KeyboardInterrupt), _worker(tmp_path) as worker:
        raise KeyboardInterrupt
    assert worker.returncode not in (0, None)


def test_a_worker_imports_no_file_of_the_current_folder(tmp_path, monkeypatch):
    from rovgraph.kernels.compile import _import_in, _worker

    (tmp_path / "random.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    with _worker(tmp_path) as worker:
        assert _import_in(worker, "random")
    assert not (tmp_path / "imported").exists()


def test_where_the_disk_is_full_there_is_no_cache(tmp_path, monkeypatch):
    from rovgraph.kernels import compile as compiling

    (tmp_path / "file").touch()
    monkeypatch.setenv(compiling.HELPS, "1")
    monkeypatch.setattr(compiling, "_writable_parent", lambda: tmp_path)
    monkeypatch.setattr(compiling, "_folder_in", lambda parent, module: parent / "file" / "below")
    assert compiling.cache_folder("rovgraph.kernels.chain") is None


def test_kernels_are_loaded_without_what_numba_compiles_with():
    code = (
        "import sys, importlib; from rovgraph.kernels.compile import _modules; "
        "[importlib.import_module(f'rovgraph.kernels.{name}') for name in _modules()]; "
        "print({'numba.cpython.unicode', 'numba.np.arrayobj', 'scipy.linalg'} & set(sys.modules))"
    )
    run(code)  # compiles what is missing
    assert run(code).stdout == "set()\n"


def test_modules_with_kernels_are_those_that_decorate_one():
    from rovgraph.kernels.compile import _modules

    names = set(_modules())
    assert {"chain", "weighting", "filtering"} < names and not {"compile", "rotations"} & names


@pytest.mark.slow
def test_a_folder_that_an_interrupt_left_empty_is_compiled_again_and_said_to_be(tmp_path):
    kept = tmp_path / "kept"
    first = own_kernel(tmp_path, ROVGRAPH_CACHE_DIR=str(kept))
    for file in [*kept.rglob("*.nbi"), *kept.rglob("*.nbc")]:
        file.unlink()
    again = own_kernel(tmp_path, ROVGRAPH_CACHE_DIR=str(kept))
    assert again.stdout == first.stdout
    assert again.stderr.count("compiling rovgraph's kernels, once") == 1
    assert list(kept.rglob("*.nbi"))


RENAMED = {  # what another numba might have changed
    "a class": "from numba.core import codegen; codegen.Library = codegen.JITCodeLibrary; del codegen.JITCodeLibrary; ",
    "an argument": "from numba.core.codegen import JITCodeLibrary as L; old = L.serialize_using_object_code; "
    "L.serialize_using_object_code = lambda self: (*old(self), 'more'); "
    "new = L._unserialize.__func__; L._unserialize = classmethod(lambda c, g, state: new(c, g, state[:3])); ",
}

IN_NUMBAS_WAY = """
import numpy as np
from collections.abc import Callable
from typing import NamedTuple
from rovgraph.kernels.compile import Vector, helper, kernel, view_helper

class Pair(NamedTuple):
    a: Vector
    b: Vector

@view_helper
def dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total

@helper
def ones(n):
    return np.ones(n)

@kernel(by_address=True)
def product(pair: Pair) -> float:
    return dot(pair.a, pair.b) + dot(ones(2), ones(2))

@kernel()
def twice(pair: Pair, product: Callable[[Pair], float]) -> float:
    return 2.0 * product(pair)

print(twice(Pair(np.ones(3), np.full(3, 2.0)), product))
"""


@pytest.mark.slow
@pytest.mark.parametrize("changed", RENAMED)
def test_a_numba_that_does_not_take_our_compilers_compiles_in_its_own_way_and_says_so_once(changed, tmp_path):
    (tmp_path / "own_kernel.py").write_text(IN_NUMBAS_WAY)
    code = RENAMED[changed] + f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import own_kernel"
    first, second = (run(code, ROVGRAPH_CACHE_DIR=str(tmp_path / "kept")) for _ in range(2))
    assert first.returncode == second.returncode == 0, first.stderr + second.stderr
    assert first.stdout == second.stdout == "16.0\n"
    assert first.stderr.count("in its own way, more slowly") == 1
    assert second.stderr == ""
    assert list((tmp_path / "kept").rglob("*.nbc"))


@pytest.mark.slow
def test_a_numba_that_takes_our_compilers_is_tried_once(tmp_path):
    (tmp_path / "own_kernel.py").write_text(IN_NUMBAS_WAY)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import own_kernel"
    done = run(code, ROVGRAPH_CACHE_DIR=str(tmp_path / "kept"))
    assert done.stdout == "16.0\n" and "in its own way" not in done.stderr
    [mark] = (tmp_path / "kept").glob("rovgraph-compilers-*")
    assert mark.read_text() == "works"
    untried = "from rovgraph.kernels import compile as c; c._try_out = None; " + code
    assert run(untried, ROVGRAPH_CACHE_DIR=str(tmp_path / "kept")).stdout == "16.0\n"


@pytest.mark.slow
def test_a_command_runs_with_a_numba_that_does_not_take_our_compilers(tmp_path):
    code = (
        RENAMED["a class"] + "import sys; from rovgraph.cli import app; "
        f"sys.argv = ['rovgraph', 'demo', '--out', {str(tmp_path / 'demo')!r}]; app.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=280,
        env={**os.environ, "PYTHONPATH": str(ROOT), "ROVGRAPH_CACHE_DIR": str(tmp_path / "kept")},
    )
    assert done.returncode == 0, done.stderr
    assert "trusted" in done.stdout
