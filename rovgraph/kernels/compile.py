"""Compiles kernels with numba, once per machine, into a cache folder that can be written.

The folder is the first that can be written of ``ROVGRAPH_CACHE_DIR``, ``NUMBA_CACHE_DIR``, this package's
``__pycache__`` and the user's cache directory; where there is none, kernels are compiled in each process.
Below it, one folder stands for each state of a module and of all kernels that it imports, so that a kernel which
calls a helper of a changed module is compiled again, which numba's own cache does not notice.

How kernels are compiled beyond what numba promises (`rovgraph.kernels.compilers`) is tried out on two small functions,
once for each version of numba. Where a numba does not take it, kernels are compiled as numba does by itself, which
takes longer.

Where several modules are missing, as many processes as there are cores compile them, each module after those that it
imports. A process keeps the helpers that it has compiled for its next modules.
"""

import contextlib
import hashlib
import logging
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import IO, Annotated, Any, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from rovgraph._version import __version__
from rovgraph.errors import InputError
from rovgraph.geometry import Array

try:
    import numba
    from numba import njit, types
    from numba.core import caching, dispatcher
    from numba.extending import register_jitable
except ImportError as error:
    raise InputError(f"numba is missing or broken ({error}): pip install 'numba>=0.61,<0.69'") from None

F = TypeVar("F", bound=Callable[..., Any])
config: Any = numba.config
KERNEL: Any = {"error_model": "numpy", "nogil": True}
HELPS = "ROVGRAPH_HELPS_COMPILE"  # in the environment of a process that compiles for another one
logger = logging.getLogger("rovgraph")

# arrays that a kernel takes as they lie in memory: contiguous, and writable
Vector = Annotated[Array, types.float64[::1]]
Matrix = Annotated[Array, types.float64[:, ::1]]
Matrices = Annotated[Array, types.float64[:, :, ::1]]  # one for each of n
Index = Annotated[NDArray[np.int64], types.int64[::1]]
Flags = Annotated[NDArray[np.bool_], types.boolean[::1]]
FlagMatrix = Annotated[NDArray[np.bool_], types.boolean[:, ::1]]
IndexMatrix = Annotated[NDArray[np.int64], types.int64[:, ::1]]
# arrays with any strides, which may be read-only; in no NamedTuple, whose fields numba does not convert
AnyVector = Annotated[Array, types.Array(types.float64, 1, "A", readonly=True)]
AnyMatrix = Annotated[Array, types.Array(types.float64, 2, "A", readonly=True)]
_SCALARS = {float: types.float64, int: types.int64, bool: types.boolean, None: types.void, type(None): types.void}


def numba_type(annotation: Any) -> Any:
    """What numba calls a number, an array of the names above, a tuple, a NamedTuple of such, or a kernel's address."""
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    arguments = get_args(annotation)
    if get_origin(annotation) is Annotated:
        return arguments[1]
    if get_origin(annotation) is Callable:
        return types.FunctionType(numba_type(arguments[1])(*map(numba_type, arguments[0])))
    if get_origin(annotation) is tuple:
        return types.Tuple([numba_type(each) for each in arguments])
    fields = [numba_type(each) for each in get_type_hints(annotation, include_extras=True).values()]
    if len(set(fields)) == 1:
        return types.NamedUniTuple(fields[0], len(fields), annotation)
    return types.NamedTuple(fields, annotation)


def signature_of(function: Callable[..., Any]) -> Any:
    """A kernel's signature for numba, from its annotations."""
    hints = get_type_hints(function, include_extras=True)
    result = numba_type(hints.pop("return"))
    return result(*map(numba_type, hints.values()))


def helper(function: F) -> F:
    """A function that is compiled into the kernels that call it; from Python it is called as it stands, slowly."""
    registered: F = register_jitable(**_compilation().helper)(function)
    return registered


def view_helper(function: F) -> F:
    """A `helper` that takes arrays and views of them, and allocates none: numba need not count its references.

    It saves 5 to 10 ns for each array that is given or viewed, which in a helper of branches and loops adds up.
    """
    registered: F = register_jitable(**_compilation().view_helper)(function)
    return registered


def readonly_array(ndim: int) -> str:
    """Type, for a signature, of an input array with any strides, which may be read-only."""
    return f"Array(f8, {ndim}, 'A', True)"


def kernel(signature: str | None = None, by_address: bool = False) -> Callable[[F], F]:
    """An entry point, compiled for one signature when its module is imported, or loaded from the cache.

    Parameters
    ----------
    signature : numba's, such as ``"void(f8[:, ::1], f8[::1])"``; None = that of the annotations (`numba_type`)
    by_address : can be an argument of other kernels, annotated as a ``Callable``: what calls it so need not be
        optimised with it once more

    Raises
    ------
    InputError : numba cannot compile it
    """

    def decorate(function: F) -> F:
        options = _compilation().called_kernel if by_address else _compilation().kernel
        folder, call_signature = cache_folder(function.__module__), signature or signature_of(function)
        try:
            with _cache_in(folder, _compilation().cache):
                compiled = njit(call_signature, cache=folder is not None, **options)(function)
        except OSError:  # the folder went away, or the disk is full
            compiled = njit(call_signature, **options)(function)
        except numba.core.errors.NumbaError as error:
            raise InputError(
                f"numba {numba.__version__} cannot compile {function.__name__} ({_first_line(error)}): "
                "pip install --upgrade numba"
            ) from None
        return cast(F, compiled)

    return decorate


class _Compilation(NamedTuple):
    """Options of numba for each kind of function; all the same where numba compiles as it does by itself."""

    helper: dict[str, Any] = KERNEL
    view_helper: dict[str, Any] = KERNEL
    kernel: dict[str, Any] = KERNEL
    called_kernel: dict[str, Any] = KERNEL
    cache: Any = caching.FunctionCache


@cache
def _compilation() -> _Compilation:
    """Options by this package's compilers, or numba's own where these were tried and failed."""
    parent = _writable_parent()
    if config.DISABLE_JIT:
        return _Compilation()
    mark = parent and parent / f"rovgraph-compilers-{_state_of('compilers')}"
    try:
        outcome = mark.read_text() if mark else ""
    except OSError:  # not tried yet
        outcome = ""
    if outcome == "failed":
        return _Compilation()
    try:
        special = _special_compilation()
        if not outcome:
            _try_out(special)
    except Exception as error:
        reason = f"{type(error).__name__}: {_first_line(error)}"
        _say_once(f"numba {numba.__version__} compiles rovgraph's kernels in its own way, more slowly ({reason})")
        special, outcome = _Compilation(), "failed"
    if mark:
        with contextlib.suppress(OSError):
            mark.write_text(outcome or "works")
    return special


def _special_compilation() -> _Compilation:
    from rovgraph.kernels.compilers import HelperCompiler, KernelCache, KernelCompiler, UncalledKernelCompiler

    helping = {**KERNEL, "no_cpython_wrapper": False, "pipeline_class": HelperCompiler}  # False: as kernels
    kernel, called = ({**KERNEL, "pipeline_class": each} for each in (UncalledKernelCompiler, KernelCompiler))
    return _Compilation(helping, {**helping, "_nrt": False}, kernel, called, KernelCache)


def _double(x: Array) -> float:
    doubled: float = 2.0 * x[0]
    return doubled


def _double_more(x: Array) -> float:
    return _double(x) + 1.0


def _try_out(options: _Compilation) -> None:
    """Compile a kernel with a helper, keep it, and load it: an error shows that numba does not take the options."""
    register_jitable(**options.view_helper)(_double)
    with tempfile.TemporaryDirectory() as folder, _cache_in(Path(folder), options.cache):
        for each in (options.kernel, options.called_kernel):
            made, loaded = (njit("f8(f8[::1])", cache=True, **each)(_double_more) for _ in range(2))
            if not made(np.ones(1)) == loaded(np.ones(1)) == 3.0:
                raise RuntimeError("another result")


def cache_folder(module: str) -> Path | None:
    """Where a module's compiled kernels are kept, or None where no folder can be written; reports missing ones."""
    parent = _writable_parent()
    if parent is None:
        return None
    folder = _folder_in(parent, module)
    if not _is_compiled(folder):
        if HELPS not in os.environ:
            _say_once("compiling rovgraph's kernels, once: this takes half a minute or more")
            if module.rpartition(".")[0] == __package__:
                with contextlib.suppress(OSError):  # no process can be started
                    _compile_missing(parent)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:  # the disk is full
            return None
    return folder


def _is_compiled(folder: Path) -> bool:
    """Whether a folder holds kernels; what interrupts compiling leaves it empty."""
    return next(folder.rglob("*.nbi"), None) is not None


def _folder_in(parent: Path, module: str) -> Path:
    return parent / f"rovgraph-{module.rpartition('.')[2]}-{_state_of(module)}"


@cache
def _compile_missing(parent: Path) -> None:
    """Have other processes compile what is missing; what they leave, this one compiles when it imports it."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    missing = {module for module in _modules() if not _is_compiled(_folder_in(parent, f"{__package__}.{module}"))}
    if cores < 2 or len(missing) < 2:
        return
    # a module comes after those that it imports: their kernels are then loaded, not compiled once more
    order = TopologicalSorter({module: (_imported_kernels(module) - {module}) & missing for module in missing})
    order.prepare()
    count = min(cores, len(missing))
    with ThreadPoolExecutor(count) as pool, contextlib.ExitStack() as stack:
        idle = [stack.enter_context(_worker(parent)) for _ in range(count)]
        ready: list[str] = []
        running: dict[Future[bool], tuple[str, subprocess.Popen[str]]] = {}
        while order.is_active():
            ready = sorted([*ready, *order.get_ready()], key=lambda module: _awaited(module, missing))
            while ready and idle:
                module, worker = ready.pop(), idle.pop()
                running[pool.submit(_import_in, worker, f"{__package__}.{module}")] = module, worker
            if not running:  # all workers have died
                return
            for each in wait(running, return_when=FIRST_COMPLETED).done:
                module, worker = running.pop(each)
                order.done(module)
                if each.result():
                    idle.append(worker)


def _import_in(worker: subprocess.Popen[str], module: str) -> bool:
    """Have a `_worker` import a module; False = it has died, such as for want of memory."""
    try:
        print(module, file=worker.stdin, flush=True)
        return bool(cast(IO[str], worker.stdout).readline())
    except OSError:
        return False


def _awaited(module: str, among: set[str]) -> int:
    """Size of the largest module that imports this one: the parts of the largest come first."""
    return max(len(_imported_kernels(importer)) for importer in among if module in _imported_kernels(importer))


@contextlib.contextmanager
def _worker(parent: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that imports each module whose name it is given, and answers when it has; an error ends it at once."""
    root = str(Path(__file__).parents[2])
    code = (
        "import contextlib, importlib, sys; sys.path.insert(0, sys.argv[1])\n"
        "for line in sys.stdin:\n"
        "    with contextlib.suppress(Exception): importlib.import_module(line.strip())\n"
        "    print(flush=True)"
    )
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", code, root],  # -P: files of the current folder are not imported
        env={**os.environ, HELPS: "1", "ROVGRAPH_CACHE_DIR": str(parent)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        yield process
    except BaseException:
        process.kill()
        raise
    finally:
        with contextlib.suppress(OSError):
            process.communicate()


def _modules() -> list[str]:
    """All modules of this package that have kernels."""
    sources = {path.stem: path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("*.py")}
    return [name for name, text in sources.items() if re.search(r"^@kernel\(", text, re.MULTILINE)]


@cache
def _writable_parent() -> Path | None:
    """The first folder that can be written, or None."""
    if config.DISABLE_JIT:
        return None
    for parent in _candidates():
        if _writable(parent):
            return parent
    _say_once("compiling rovgraph's kernels, as no cache folder can be written; set ROVGRAPH_CACHE_DIR to one")
    return None


@cache
def _say_once(text: str) -> None:
    logger.warning(text)


def _candidates() -> Iterator[Path]:
    for name in ("ROVGRAPH_CACHE_DIR", "NUMBA_CACHE_DIR"):
        if os.environ.get(name):
            yield Path(os.environ[name])
    yield Path(__file__).parent / "__pycache__"
    if sys.platform == "win32":
        yield Path(os.environ.get("LOCALAPPDATA", Path.home()))
    else:
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _writable(folder: Path) -> bool:
    probe = folder / f"probe-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except (OSError, RuntimeError):
        return False
    return True


@cache
def _state_of(module: str) -> str:
    """A digest of a module, of all kernels that it imports, and of what compiles them."""
    compiler = "" if module == "compilers" or _compilation().helper is not KERNEL else "as numba does"
    digest = hashlib.sha256(f"{__version__} {numba.__version__} {sys.version}{compiler}".encode())
    for name in sorted(_imported_kernels(module.rpartition(".")[2])):
        digest.update((Path(__file__).parent / f"{name}.py").read_bytes())
    return digest.hexdigest()[:16]


@cache
def _imported_kernels(name: str) -> frozenset[str]:
    """A module of this package and those that it imports, and so on."""
    path = Path(__file__).parent / f"{name}.py"
    if not path.exists():  # a kernel of somebody else's
        return frozenset()
    names = set(re.findall(r"^ *from rovgraph\.kernels\.(\w+) import", path.read_text(encoding="utf-8"), re.MULTILINE))
    return frozenset({name}).union(*(_imported_kernels(other) for other in names))


@contextlib.contextmanager
def _cache_in(folder: Path | None, kind: Any) -> Iterator[None]:
    """Have numba cache there, in a cache of this kind, what is decorated meanwhile, and nothing else."""
    numbas: Any = dispatcher
    before = config.CACHE_DIR, numbas.FunctionCache
    if folder is not None:
        config.CACHE_DIR = str(folder)
    numbas.FunctionCache = kind
    try:
        yield
    finally:
        config.CACHE_DIR, numbas.FunctionCache = before


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [""])[0][:200]
