"""An estimate while data arrive: the work of ``rovgraph online``, its folder, and its live page (``--http``)."""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rovgraph.api.logs import config_of, warn_of_unused
from rovgraph.errors import InputError, as_path, as_texts
from rovgraph.live.clocks import Clocks
from rovgraph.live.files import SETTINGS, Files
from rovgraph.live.marks import Command, Marks
from rovgraph.live.navigator import Navigator
from rovgraph.live.outputs import Output, open_output
from rovgraph.live.session import PAGE_RATE_HZ, RATE_HZ, Feed, Session
from rovgraph.live.solution import Solution
from rovgraph.live.sources import open_sources, with_depth_options
from rovgraph.live.sources.replay import LogReplay
from rovgraph.live.warnings import Complain, Warnings
from rovgraph.log import Log
from rovgraph.model.config import Config, Mag, config_or_defaults, load_config, with_priors_stated
from rovgraph.report.folder import STAMP, SUMMARY, check_writable
from rovgraph.report.results import to_plain

if TYPE_CHECKING:
    from rovgraph.web.page import LivePage


def settings_of(folder: Path) -> Config:
    """The configuration of an earlier run; all defaults where it left none."""
    return load_config(folder / SETTINGS if (folder / SETTINGS).is_file() else None)


def prepare(folder: Path, force: bool, sources: Sequence[str]) -> None:
    """Make the folder of a run.

    Raises
    ------
    InputError : it holds something that must not be replaced, or cannot be made
    """
    for url in sources:
        if _file(url).is_relative_to(folder.resolve()):
            raise InputError(f"{url}: lies in {folder}, which would be replaced; choose another --out")
    check_writable(folder, force)
    try:
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another --out") from None
    _write_summary(folder, {"state": "running"})


def summarise(folder: Path, session: Session) -> None:
    """Write what came of a run.

    Raises
    ------
    InputError : it cannot be written
    """
    solution, navigator = session.solution, session.navigator
    if solution is None:
        with contextlib.suppress(InputError):  # that there is no estimate is the worse news
            _write_summary(folder, {"state": "no estimate"})
        return
    _write_summary(
        folder,
        {
            "state": "finished",
            "verdict": solution.verdict,
            "alarms": [vars(alarm) for alarm in navigator.alarms.history.values()],
            "advice": [vars(advice) for advice in navigator.alarms.advice.values()],
            "time": solution.time,
            "position_m": solution.position.tolist(),
            "position_sd_m": solution.position_sd.tolist(),
            "distance_m": solution.distance,
            "calibration": {name: list(pair) for name, pair in solution.calibration.items()},
            "marks": [asdict(mark) for mark in session.marks.all],
            "solutions": session.solutions,
            "left_out": [[*key, count] for key, count in sorted(navigator.left_out.items())],
            "warnings": [[*key, count] for key, count in sorted(session.warnings.counts.items())],
            "updates": session.updates(),
        },
    )


def _file(url: str) -> Path:
    """The file of a URL, if it is one of a file."""
    return Path(url.partition(":")[2].partition("?")[0]).resolve()


def _write_summary(folder: Path, content: dict[str, Any]) -> None:
    partial = folder / f".{SUMMARY}.partial"
    try:
        plain = to_plain({**STAMP, "kind": "online", **content})
        partial.write_text(json.dumps(plain, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(folder / SUMMARY)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise InputError(f"{folder / SUMMARY}: cannot be written ({error.strerror}); free some space") from None


NEEDED = {"starlette", "uvicorn", "websockets", "prometheus_client"}


def live_page(
    address: str = "127.0.0.1:8080",
    offer: Callable[[Command], bool] | None = None,
    marks: Marks | None = None,
    charts: Sequence[Path | str] = (),
    origins: Sequence[str] = (),
    token: Path | str | None = None,
    position_sd_limit_m: float = 5.0,
    warnings: Warnings | None = None,
) -> "LivePage":
    """Serve the live page (docs/live-page.md). Pass each solution to its `send`, and `close` it at the end.

    Parameters
    ----------
    address : ``host:port``; a host other than the loopback requires a token, which is in the page's `url`
    offer : called with commands of pages; None = pages are read-only
    marks : to show on the map
    charts : GeoTIFF or GeoJSON files, or folders of tiles, to show under the track
    origins : of other pages, such as Cockpit's, that may frame the page and read values without a token
    token : file that holds the token; None = a new token each time
    position_sd_limit_m : position sd beyond which the page raises an alarm
    warnings : receives failures of the server

    Raises
    ------
    InputError : a missing library, an address that cannot be used, a chart that cannot be read
    """
    try:
        from rovgraph.web.page import LivePage
        from rovgraph.web.view import PageLimits
    except ImportError as error:
        if error.name is None or error.name.partition(".")[0] not in NEEDED:
            raise
        raise InputError(f"--http needs {error.name}; install it with: pip install 'rovgraph[web]'") from None
    if not 0.0 < position_sd_limit_m < float("inf"):
        raise InputError(f"--position-sd-limit {position_sd_limit_m:g}: expected metres, more than 0")
    limits = PageLimits(position_sd_m=position_sd_limit_m)
    return LivePage(address, offer, marks, charts, origins, token, limits, warnings)


AS_FAST_AS_POSSIBLE = float("inf")
ENGINES = ("fixed-lag", "isam2")


@dataclass(frozen=True)
class LiveRun:
    """A run of the online estimator. Iterate over it once; it yields each solution as soon as it is due.

    The run ends when its sources end, when you call `close`, or when you leave the loop.

    Attributes
    ----------
    sources : their addresses
    session : the estimate, the newest solution, and counts of warnings
    feed : messages of the sources
    outputs : where solutions are sent
    page : the live page; open its ``url`` in a browser; None = none
    folder : of recording, track and checkpoint; None = none
    resume : continue with the files in the folder
    """

    sources: tuple[str, ...]
    session: Session
    feed: Feed
    outputs: tuple[Output, ...]
    page: "LivePage | None" = None
    folder: Path | None = None
    resume: bool = False

    def __iter__(self) -> Iterator[Solution]:
        """Yield solutions as they are due.

        Raises
        ------
        InputError : the sources ended before an estimate could be made; the summary cannot be written
        """
        try:
            yield from self._solve()
        except GeneratorExit:  # the caller stops iterating
            self._summarise()
            raise
        self._summarise()
        if self.session.solution is None:
            raise InputError(f"no estimate was made: {self.waiting()}")

    def close(self) -> None:
        """End the run once received data are processed. Call it from any thread or signal handler, also repeatedly."""
        self.feed.close()

    def waiting(self) -> str:
        """What the first solution waits for; empty once there is one."""
        return self.session.navigator.waiting(self.sources)

    def write_smoothed(self) -> None:
        """Request the smoothed track so far in the folder (iSAM2 only). Call it from any thread or signal handler."""
        self.session.want_smoothed()

    def require_whole_recording(self) -> None:
        """Check that the folder holds everything received.

        Raises
        ------
        InputError : the disk was full for a while, and rows were lost
        """
        files = self.session.files
        if files is not None and files.recorder.lost:
            raise InputError(f"{self.folder}: {files.recorder.lost} rows of the recording were lost, the disk was full")

    def _solve(self) -> Iterator[Solution]:
        try:
            if self.resume:
                self.session.resume()
            yield from self.session.solve(self.feed)
        finally:
            self.feed.close()
            self.session.navigator.close()
            for output in self.outputs:
                output.close()
            if self.page is not None:
                self.page.close()
            if self.session.files is not None:
                self.session.files.close()

    def _summarise(self) -> None:
        if self.folder is not None:
            summarise(self.folder, self.session)


@dataclass(frozen=True)
class Online:
    """The online estimator of a vehicle.

    Attributes
    ----------
    config : of vehicle and sensors; None = all defaults, or the configuration of the resumed run
    rate_hz : of solutions, by the log's time; None = 5, or 10 with a live page
    engine : "fixed-lag", or "isam2", which smooths the whole dive during the run
    """

    config: Config | None = None
    rate_hz: float | None = None
    engine: str = "fixed-lag"

    def __post_init__(self) -> None:
        config_or_defaults(self.config)
        if not (self.rate_hz is None or (isinstance(self.rate_hz, Real) and 0.01 <= self.rate_hz <= 200.0)):
            raise InputError(f"rate_hz {self.rate_hz}: between 0.01 and 200 solutions per second are expected")
        if self.engine not in ENGINES:
            raise InputError(f"engine {self.engine!r}: expected {', '.join(ENGINES)}")

    def run(
        self,
        *sources: str,
        outputs: str | Sequence[str] = (),
        speed: str = "1",
        out: Path | str | None = None,
        resume: bool = False,
        force: bool = False,
        on_warning: Complain | None = None,
        http: str | None = None,
        page: Mapping[str, Any] | None = None,
    ) -> LiveRun:
        """Open sources and outputs; iterate over the returned run for its solutions.

        Parameters
        ----------
        sources : addresses as for ``rovgraph online`` (docs/online-sources.md), such as "tcp://192.168.2.2:5700"
        outputs : where to send solutions as well (docs/online-output.md), one or several, such as
            "udp://127.0.0.1:5600"
        speed : of replayed files, a number or "max"
        out : folder for recording, track and checkpoint; None = none
        resume : continue after a crash with the files in ``out``
        force : replace an older folder
        on_warning : called with source, kind and text of a warning about sources, outputs or disk, also from other
            threads; None = warnings are only counted
        http : ``host:port`` of a live page for a browser (docs/live-page.md); None = none
        page : its ``charts``, ``origins``, ``token`` and ``position_sd_limit_m``, as for `rovgraph.live_page`

        Raises
        ------
        InputError : an address that cannot be used, a folder that exists or cannot be written, no run to resume

        Warns
        -----
        DataWarning : a configuration lies beside a log and was not given
        """
        folder = None if out is None else as_path(out, "out")
        if resume and folder is None:
            raise InputError("--resume needs the folder of the run, --out")
        if self.config is None and not resume:
            warn_of_unused(
                *(url.removeprefix("file:").partition("?")[0] for url in map(str, sources) if url.startswith("file:"))
            )
        config = self.config or (settings_of(folder) if resume and folder is not None else Config())
        config = with_depth_options([url for url in sources if isinstance(url, str)], config)
        warnings = Warnings(on_warning)
        opened = open_sources(sources, warnings, config, speed)
        if resume and any(source.pace == 1.0 for source in opened):
            raise InputError("--resume cannot continue a replay at speed 1; add --speed max")
        feed = Feed(opened, warnings)
        navigator = self._navigator(
            config, patient=feed.recorded, trust=feed.replayed
        )  # may refuse, before anything is written
        with ExitStack() as opened_outputs:  # they have threads, which a refused folder must not leave behind
            receivers: list[Output] = []
            for url in as_texts(outputs, "outputs"):
                receivers.append(open_output(url, warnings, patient=feed.recorded))
                opened_outputs.callback(receivers[-1].close)
            marks, watched = Marks(folder, warnings, resume), None
            if http is not None:
                watched = live_page(http, feed.offer, marks, warnings=warnings, **(page or {}))
                opened_outputs.callback(watched.close)
            files = None
            if folder is not None:
                if not resume:
                    prepare(folder, force, sources)
                whole = self.engine == "isam2" or config.matches_bottom
                files = Files(folder, config, warnings, resume, replayed=whole)
            opened_outputs.pop_all()
        told: list[Callable[[Solution], None]] = [each.send for each in receivers]
        if watched is not None:
            told.append(watched.send)
        usual = RATE_HZ if http is None else PAGE_RATE_HZ
        session = Session(navigator, told, warnings, self.rate_hz or usual, files, marks)
        return LiveRun(sources, session, feed, tuple(receivers), watched, folder, resume)

    def replay(self, log: Log) -> Iterator[Solution]:
        """Yield the solutions of a log as if its measurements arrived now; each call starts again.

        The log is not checked beforehand: failures of sensors are detected as they happen and come as events.

        Parameters
        ----------
        log : as read with the configuration

        Raises
        ------
        InputError : the log was read with other columns, or allows no estimate
        """
        config = config_of(log, self.config)
        if config.imu.mag != Mag():  # its prior is that of a calibrated one, which the log's samples are
            config = with_priors_stated(config, names=("hard_iron",))
        if config.knows_sound_speed:  # so do the log's velocities
            config = with_priors_stated(config, names=("dvl_scale",))
        delays = {} if log.config is None else log.config.delay_s
        config = config.as_recorded().model_copy(update={"delay_s": delays})  # the log holds the field
        feed = Feed([LogReplay(log.source, _as_it_arrived(log, delays), AS_FAST_AS_POSSIBLE)])
        session = Session(self._navigator(config, patient=True, trust=True), [], Warnings(), self.rate_hz or RATE_HZ)
        yield from LiveRun((log.source,), session, feed, ())

    def _navigator(self, config: Config, patient: bool, trust: bool) -> Navigator:
        return Navigator(config, patient, smooth=self.engine == "isam2", clocks=Clocks(trust=trust))


def _as_it_arrived(log: Log, delays: Mapping[Any, float]) -> Log:
    """A log with the stamps that its measurements came with: later than their times by what is known of it."""
    late = {name: replace(log[name], time=log[name].time + delays[name]) for name in delays if name in log}
    return replace(log, streams={**log.streams, **late})
