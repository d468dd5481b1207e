"""An estimate while data arrive: what ``rovgraph online`` does."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rovgraph.api.live_folder import prepare, settings_of, summarise
from rovgraph.api.live_page import live_page
from rovgraph.api.logs import given, warn_of_unused
from rovgraph.config import Config, Mag, config_or_defaults, with_priors_stated
from rovgraph.errors import InputError, as_path, as_texts
from rovgraph.live.clocks import Clocks
from rovgraph.live.feed import Feed
from rovgraph.live.files import Files, Known
from rovgraph.live.marks import Marks
from rovgraph.live.navigator import Navigator
from rovgraph.live.outputs import Output, open_output
from rovgraph.live.session import PAGE_RATE_HZ, RATE_HZ, Session
from rovgraph.live.solution import Solution
from rovgraph.live.sources import open_sources
from rovgraph.live.sources.replay import LogReplay
from rovgraph.live.warnings import Complain, Warnings
from rovgraph.log import Log

if TYPE_CHECKING:
    from rovgraph.web.page import LivePage

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
        except GeneratorExit:  # whoever iterates has had enough
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
        warnings = Warnings(on_warning)
        opened = open_sources(sources, warnings, config, speed, Known(folder, resume, warnings))
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
                files = Files(folder, config, warnings, resume, replayed=self.engine == "isam2")
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
        config = given(log, self.config)
        if config.imu.mag != Mag():  # its prior is that of a calibrated one, which the log's samples are
            config = with_priors_stated(config, names=("hard_iron",))
        delays = {} if log.config is None else log.config.delay_s
        config = config.with_raw_magnetometer().model_copy(update={"delay_s": delays})  # the log holds the field
        feed = Feed([LogReplay(log.source, _as_it_arrived(log, delays), AS_FAST_AS_POSSIBLE)])
        session = Session(self._navigator(config, patient=True, trust=True), [], Warnings(), self.rate_hz or RATE_HZ)
        yield from LiveRun((log.source,), session, feed, ())

    def _navigator(self, config: Config, patient: bool, trust: bool) -> Navigator:
        return Navigator(config, patient, smooth=self.engine == "isam2", clocks=Clocks(trust=trust))


def _as_it_arrived(log: Log, delays: Mapping[Any, float]) -> Log:
    """A log with the stamps that its measurements came with: later than their times by what is known of it."""
    late = {name: replace(log[name], time=log[name].time + delays[name]) for name in delays if name in log}
    return replace(log, streams={**log.streams, **late})
