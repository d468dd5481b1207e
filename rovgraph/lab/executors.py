"""Executors of a study's runs: a pool of processes on this machine, or a Dask cluster.

On one machine a pool of processes suffices; it needs no other library, starts in a second and uses no ports. When one
of its processes is killed, a pool breaks as a whole: `Local` makes it again. A cluster's scheduler does that by itself,
so for more than one machine there is Dask. `in_workers` spreads work over the machine's cores, in processes that end
with it.
"""

import contextlib
import logging
import multiprocessing
import multiprocessing.process
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from typing import Any, Protocol, TypeVar

from rovgraph._version import __version__
from rovgraph.errors import InputError, warn
from rovgraph.process import ONE_THREAD, limit_threads_and_gc

Task = TypeVar("Task")
Result = TypeVar("Result")

UNGUARDED = (
    "worker processes ended while they started; they import your script again, so that it has to be a file with its "
    "work under if __name__ == '__main__'"
)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that an error or an interrupt within the block ends at once.

    They are started afresh (spawned) with the first tasks, which `submit` has to be given
    within `starting`; what they call has to be importable.

    Raises
    ------
    InputError : a process was killed from outside, or none could start
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker, which imports the caller's script
        sys.exit(1)  # quietly: the caller reports why
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    started = context.Event()
    pool = ProcessPoolExecutor(count, context, _prepare, (started,))
    try:
        yield pool
    except BaseException as error:
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        pool.shutdown(cancel_futures=True)  # waits for the pool's own thread, which would complain at exit
        if isinstance(error, BrokenProcessPool):
            killed = "a worker process was killed (out of memory?); try again with fewer of them"
            raise InputError(killed if started.is_set() else UNGUARDED) from None
        raise
    pool.shutdown()
    if not started.is_set():
        raise InputError(UNGUARDED)


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Around what starts processes: they inherit one thread for each library, and no interrupts."""
    with _environment(ONE_THREAD), _interrupts_held_back():
        yield


def in_workers(
    function: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, progress: Callable[[float], None]
) -> list[Result]:
    """``function`` of every task, in the order of the tasks: in processes of their own, or in this one if one does.

    Parameters
    ----------
    function, tasks : what to do, picklable
    jobs : number of processes
    progress : called with the share of tasks that are done

    Raises
    ------
    InputError : a process was killed from outside, or none could start
    """
    if min(jobs, len(tasks)) == 1:  # a process more would only import everything once more
        results = []
        for done, task in enumerate(tasks, 1):
            results.append(function(task))
            progress(done / len(tasks))
        return results
    with workers(min(jobs, len(tasks))) as pool:
        with starting():
            futures = [pool.submit(function, task) for task in tasks]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            progress(done / len(tasks))
        return [future.result() for future in futures]


def _prepare(started: Event) -> None:
    """In a worker: leave interrupts to the parent, and end when the parent has ended, however it did."""
    started.set()
    limit_threads_and_gc()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """An interrupt waits for the end of the block; processes started within never see one."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _interrupts_kept():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _interrupts_kept() -> Iterator[None]:
    """One that another thread takes, a progress bar's, Python handles in the main thread even where that blocks it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)
        if came:
            signal.raise_signal(signal.SIGINT)


Finished = Callable[[Any, Any], None]  # a task; its result, or the error

RETRIES = 2  # of a task that raised, or whose process was killed
CONNECT_S = 5.0  # to a scheduler
WORKERS_S = 30.0  # for the first worker to join it


class Executor(Protocol):
    """Calls a function with every task, elsewhere, and ``finished`` here with the result of each.

    A task that raises, or whose process dies, is tried again; after `RETRIES` of that
    ``finished`` is given the error.
    """

    def each(self, function: Callable[[Task], Result], tasks: Sequence[Task], finished: Finished) -> None: ...


@dataclass(frozen=True)
class Local:
    """Processes on this machine.

    Attributes
    ----------
    jobs : how many, None = one per core
    """

    jobs: int | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise InputError(f"{self.jobs} jobs: at least 1 is expected")

    def each(self, function: Callable[[Task], Result], tasks: Sequence[Task], finished: Finished) -> None:
        """As `Executor`: after a process was killed, the tasks that it may have had come first, each by itself."""
        jobs, failures = self.jobs or cores(), dict.fromkeys(range(len(tasks)), 0)  # of what is not finished yet
        work = _Work(function, tasks, finished, failures)
        while failures:
            for suspect in work.in_pool(list(failures), jobs):
                while suspect in failures:
                    work.in_pool([suspect], 1)


@dataclass(frozen=True)
class _Work:
    """Remaining tasks, and how often each has failed; finished ones are removed from ``failures``."""

    function: Callable[[Any], Any]
    tasks: Sequence[Any]
    finished: Finished
    failures: dict[int, int]

    def in_pool(self, chosen: Sequence[int], jobs: int) -> list[int]:
        """Try each of some tasks once; those that may have killed a process are returned."""
        lost = []
        with workers(min(jobs, len(chosen))) as pool:
            with starting():
                futures = {pool.submit(self.function, self.tasks[i]): i for i in chosen}
            for future in as_completed(futures):
                try:
                    result = future.result()
                except BrokenProcessPool:
                    lost.append(futures[future])
                except Exception as error:
                    self._failed(futures[future], error)
                else:
                    self._end(futures[future], result)
        return self._killed(sorted(lost)[:jobs]) if lost else []

    def _killed(self, at_hand: list[int]) -> list[int]:
        """A pool takes tasks in their order, so the first of the lost ones were running."""
        message = "a worker process was killed (out of memory?); its task is done again"
        warn(message)
        if len(at_hand) == 1:
            self._failed(at_hand[0], RuntimeError("its process was killed repeatedly (out of memory?)"))
        return at_hand

    def _failed(self, task: int, error: BaseException) -> None:
        self.failures[task] += 1
        if self.failures[task] > RETRIES:
            self._end(task, error)

    def _end(self, task: int, result: Any) -> None:
        del self.failures[task]
        self.finished(self.tasks[task], result)


@dataclass(frozen=True)
class Cluster:
    """A Dask cluster that is running already; its workers need this version of rovgraph.

    Attributes
    ----------
    address : of the scheduler, such as ``tcp://host:8786``
    """

    address: str

    def each(self, function: Callable[[Task], Result], tasks: Sequence[Task], finished: Finished) -> None:
        """As `Executor`.

        Raises
        ------
        InputError : Dask is not installed; no scheduler, no workers, another version; the scheduler was lost
        """
        with self._client() as client:
            from distributed import as_completed as as_they_come

            waiting = {client.submit(function, task, retries=RETRIES, pure=False): (task, 0) for task in tasks}
            coming = as_they_come(list(waiting), loop=client.loop)
            for future in coming:
                task, lost = waiting.pop(future)
                if future.status != "cancelled":
                    finished(task, future.exception() if future.status == "error" else future.result())
                    continue
                self._check_alive(client)
                if lost == RETRIES:
                    finished(task, RuntimeError(f"the cluster lost it {RETRIES + 1} times"))
                    continue
                again = client.submit(function, task, retries=RETRIES, pure=False)
                waiting[again] = (task, lost + 1)
                coming.add(again)

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            from distributed import Client
        except ImportError:
            raise InputError(
                "--scheduler needs Dask, which is not installed; pip install 'rovgraph[studies]'"
            ) from None
        _hush("distributed", "tornado", "asyncio")
        try:
            client = Client(self.address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{self.address}: no Dask scheduler answers there ({reason})") from None
        with client:
            self._check_workers(client)
            yield client

    def _check_workers(self, client: Any) -> None:
        try:
            client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError:
            raise InputError(f"{self.address}: no worker joined this scheduler in {WORKERS_S:.0f} s") from None
        try:
            versions = set(client.run(own_version).values())
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{self.address}: its workers cannot load rovgraph ({reason})") from None
        if strange := versions - {own_version()}:
            raise InputError(f"{self.address}: a worker has rovgraph {min(strange)}, here it is {own_version()}")

    def _check_alive(self, client: Any) -> None:
        if client.status != "running":
            raise InputError(f"{self.address}: the scheduler was lost; give --resume when it is back")


def _hush(*libraries: str) -> None:
    """Keep libraries from logging errors, with tracebacks, that are reported in one line here."""
    for name in [*libraries, *logging.root.manager.loggerDict]:
        if name.split(".")[0] in libraries:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def own_version() -> str:
    """Of rovgraph where this is called."""
    return __version__
