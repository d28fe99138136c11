"""What is shown while a run goes on: bars on a terminal that can move its cursor, lines with times elsewhere.

One thread draws, and no signal handler does: two that draw at once lose lines.
"""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

from rich.console import Console
from rich.live import Live
from rich.text import Text

from oodil.estimate import RunCost
from oodil.orchestrator import Observer
from oodil.terminal.progress import Clock, JobProgress, RunProgress
from oodil.terminal.words import duration, eta, figure
from oodil.workers.reports import DONE, AttemptFailed, Event, Finished, Progress, Replaced, Started, Warn

DRAW_INTERVAL_S = 0.1
"""The shortest time between two drawings."""
PLAIN_INTERVAL_S = 30.0
"""Seconds between lines about what is running where there is no such terminal."""
SHOWN_METRICS = ("return", "length", "loss", "value_loss")
"""Figures of a job that are shown beside its rate, as far as there is room."""
MARGIN = 4
"""Columns at the right that stay free: a terminal writes ``^C`` where the cursor is, and a line must not wrap."""
BAR = 24
"""The longest bar."""


@contextmanager
def stop_flag(announce: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a polite stop; a second one ends the run at once.

    It is announced when the function that is yielded is next asked: a handler may come in the middle of any line.
    """
    received: list[int] = []
    announced: list[int] = []

    def handle(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt

    def is_asked_to_stop() -> bool:
        if received and not announced:
            announced.extend(received)
            announce()
        return bool(received)

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield is_asked_to_stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class Display(Observer):
    """What a user sees of a run. All of it is drawn by the thread that calls."""

    def __init__(self, cost: RunCost, clock: Clock = time.monotonic) -> None:
        self._run = RunProgress(cost.stages, clock)
        self._clock = clock
        self._console = Console(highlight=False)
        # FORCE_COLOR makes a terminal of a file for Rich; colors are fine there, moving the cursor is not.
        self._is_live = self._console.is_interactive and self._console.file.isatty()
        self._live = Live(console=self._console, auto_refresh=False, transient=True, get_renderable=self._bars)
        self._drawn = clock()
        self._cost = cost

    def __enter__(self) -> "Display":
        if any(stage.seconds for stage in self._cost.stages.values()):
            self.say(str(self._cost))
        if self._is_live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._live.stop()

    def say(self, message: str, style: str = "") -> None:
        """Print a message above the bars."""
        text = Text(message, style)
        if not self._is_live:
            text = Text.assemble(time.strftime("%H:%M:%S  "), text)
        self._console.print(text, soft_wrap=True)

    def tick(self) -> None:
        """Draw what has changed, if it is time to; whoever waits for a run calls this now and then."""
        if self._clock() - self._drawn < (DRAW_INTERVAL_S if self._is_live else PLAIN_INTERVAL_S):
            return
        self._drawn = self._clock()
        if self._is_live:
            self._live.refresh()
        else:
            for line in self._lines(self._console.width, has_bars=False):
                self.say(line.plain.rstrip())

    def stopping(self) -> None:
        """Say that a stop was heard."""
        self.say("stopping after a checkpoint; press Ctrl-C again to stop at once")

    def stage_reused(self, stage: str) -> None:
        """Say that a finished stage is taken as it is."""
        self._run.stage_reused(stage)
        self.say(f"✓ {stage}: reused", "green")

    def stage_started(self, stage: str, reason: str, jobs: int) -> None:
        """Say that a stage begins, and why if it is not its first time."""
        self._run.stage_started(stage, jobs)
        self.say(f"▶ {stage}" + (f" ({jobs} jobs)" if jobs > 1 else "") + (f": {reason}" if reason else ""), "bold")
        self._draw()

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Say that a stage is done, and take its bars away."""
        self._run.stage_finished()
        self._draw()
        self.say(f"✓ {stage}: {duration(seconds)}", "green")

    def event(self, event: Event) -> None:
        """Show what an engine reports."""
        match event:
            case Event(job, Started()):
                self._run.job_started(job)
            case Event(job, Progress(done, total, metrics)):
                self._run.job_advanced(job, done, total, metrics)
            case Event(job, Finished(outcome)):
                self._run.job_ended(job, outcome == DONE)
            case Event(job, Warn(message)):
                self.say(f"! {job}: {message}", "yellow")
            case Event(job, AttemptFailed(attempt, reason, will_retry)):
                self._run.job_ended(job, is_done=False)
                then = "trying again" if will_retry else "giving up"
                self.say(f"✗ {job}: attempt {attempt} failed, {then}: {_last_line(reason)}", "red")
            case Event(worker, Replaced(reason)):
                self.say(f"! {worker}: {_last_line(reason)}; started again", "yellow")
        self.tick()

    def _draw(self) -> None:
        if self._is_live:
            self._live.refresh()

    def _bars(self) -> Text:
        return Text("\n").join(self._lines(self._console.width - MARGIN, has_bars=True))

    def _lines(self, width: int, has_bars: bool) -> Iterator[Text]:
        """Yield a line for each job that runs, as far as they fit on the screen, and one for the whole run."""
        run = self._run
        shown = list(run.jobs.items())[: max(1, self._console.height - 4)]
        names = min(max([len("whole run"), *(len(name) for name, _ in shown)]), max(9, width // 3 - 4))
        for name, job in shown:
            yield _line(name, names, width, job.share, job.left_s, _figures(job), has_bars)
        if run.stage:
            place = [f"stage {run.stage} of {run.num_stages}"] if run.num_stages else []
            if run.num_jobs > 1:
                place.append(f"{run.num_finished} of {run.num_jobs} jobs done")
            yield _line("whole run", names, width, run.share, run.left_s, place, has_bars)


def _figures(job: JobProgress) -> list[str]:
    """Return what is worth knowing of a job, most important first, in columns that stay where they are."""
    if not job.total:
        return ["starting"]
    metrics = [f"{name} {figure(job.metrics[name]):<7}" for name in SHOWN_METRICS if name in job.metrics]
    rate = f"{job.rate:,.0f}/s" if job.rate else ""
    return [*metrics[:1], f"{rate:<9}", *metrics[1:]]


def _line(
    name: str, names: int, width: int, share: float, left_s: float | None, figures: list[str], has_bars: bool
) -> Text:
    """Return name, bar, per cent and time left, and as many of the figures as there is room for."""
    bar = max(3, min(BAR, width // 4, width - names - 24)) if has_bars else 0
    full = int(share * bar)
    name = name if len(name) <= names else name[: names - 1] + "…"
    told = f"{eta(left_s):<8}"
    line = Text.assemble(
        f"  {name:<{names}} ",
        ("━" * full, "cyan"),
        ("─" * (bar - full), "dim"),
        f" {int(100 * share):>3}%  eta {told}",
    )
    for each in figures:
        if line.cell_len + 2 + len(each.rstrip()) > width:
            break
        line.append(f"  {each}")
    line.truncate(width)
    return line


def _last_line(reason: str) -> str:
    """Return what a traceback ends with."""
    return (reason.strip().splitlines() or ["no reason given"])[-1]
