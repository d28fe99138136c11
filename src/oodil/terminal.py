"""How a run looks in a terminal: live progress, plain lines elsewhere, tables at the end."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from oodil.orchestrator import Observer
from oodil.pipeline.runs import RunResults, shown_return
from oodil.pipeline.verdicts import MEANING, VerdictTable
from oodil.workers.reports import DONE, AttemptFailed, Event, Finished, Replaced, Started, Warn
from oodil.workers.reports import Progress as JobProgress

if TYPE_CHECKING:
    from oodil.pipeline.data import Demonstrations
    from oodil.pipeline.results import Transferability
    from oodil.pipeline.scoring import Scored

PLAIN_INTERVAL_S = 10.0
"""Seconds between lines about one job where there is no terminal."""
SHOWN_METRICS = ("return", "length", "loss", "value_loss")
"""Figures of a job that are shown beside its bar."""
MOST_ROWS = 50
"""Demonstrations in a table; a file takes the others."""


@contextmanager
def stop_flag(announce: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a polite stop; a second one ends the run at once."""
    received: list[int] = []

    def handle(number: int, _frame: Any) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        announce()

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class Display(Observer):
    """What a user sees of a run: live progress on a terminal, plain lines elsewhere."""

    def __init__(self) -> None:
        self._console = Console()
        self._progress = Progress(
            TextColumn("  {task.description:<18}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[rate]:>12}"),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            TextColumn("eta"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._bars: dict[str, Any] = {}
        self._started: dict[str, tuple[float, int]] = {}
        self._spoken: dict[str, float] = {}

    def __enter__(self) -> "Display":
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take the live part away; what was said stays."""
        self._progress.stop()

    def say(self, message: str) -> None:
        """Print one line above the live part."""
        self._console.print(message, highlight=False, soft_wrap=True)

    def stopping(self) -> None:
        """Say that a stop was heard."""
        self.say("stopping after a checkpoint; press Ctrl-C again to stop at once")

    def stage_reused(self, stage: str) -> None:
        """Say that a finished stage is taken as it is."""
        self.say(f"[green]✓[/] {stage}: reused")

    def stage_started(self, stage: str, reason: str, jobs: int) -> None:
        """Say that a stage begins, and why if it is not its first time."""
        self.say(f"[bold]▶ {stage}[/]" + (f" ({jobs} jobs)" if jobs > 1 else "") + (f": {reason}" if reason else ""))

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Say that a stage is done and clear its bars."""
        for bar in self._bars.values():
            self._progress.remove_task(bar)
        self._bars.clear()
        self._started.clear()
        self.say(f"[green]✓[/] {stage}: {_duration(seconds)}")

    def event(self, event: Event) -> None:
        """Show what an engine reports."""
        match event:
            case Event(job, Started()):
                self._bar(job)
            case Event(job, JobProgress(done, total, metrics)):
                self._advance(job, done, total, metrics)
            case Event(job, Warn(message)):
                self.say(f"[yellow]! {job}: {message}[/]")
            case Event(job, AttemptFailed(attempt, reason, will_retry)):
                then = "trying again" if will_retry else "giving up"
                self.say(f"[red]✗ {job}: attempt {attempt} failed, {then}: {reason.strip().splitlines()[-1]}[/]")
            case Event(job, Finished(outcome)):
                if job in self._bars and outcome == DONE:
                    self._progress.update(self._bars[job], completed=1, total=1, figures="done")
            case Event(worker, Replaced(reason)):
                self.say(f"[yellow]! {worker}: {reason}; started again[/]")

    def job_done(self, job: str) -> None:
        """Say that a job is done, and take its bar away: there are more jobs than lines on a screen."""
        if job in self._bars:
            self._progress.remove_task(self._bars.pop(job))
        self.say(f"[green]✓[/] {escape(job)}")

    def _bar(self, job: str) -> Any:
        if job not in self._bars:
            self._bars[job] = self._progress.add_task(job, total=None, rate="", figures="")
        return self._bars[job]

    def _advance(self, job: str, done: int, total: int, metrics: dict[str, float]) -> None:
        now = time.monotonic()
        since, first = self._started.setdefault(job, (now, done))
        rate = f"{(done - first) / (now - since):,.0f}/s" if now - since > 1 and done > first else ""
        figures = "  ".join(f"{name} {metrics[name]:,.4g}" for name in SHOWN_METRICS if name in metrics)
        self._progress.update(self._bar(job), completed=done, total=total, rate=rate, figures=figures)
        if not self._console.is_terminal and now - self._spoken.get(job, now - PLAIN_INTERVAL_S) >= PLAIN_INTERVAL_S:
            self._spoken[job] = now
            left = (total - done) * (now - since) / (done - first) if done > first else float("nan")
            eta = f"  eta {_duration(left)}" if np.isfinite(left) else ""
            self.say(f"  {job}: {done:,}/{total:,}  {rate}  {figures}{eta}")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def print_summary(results: RunResults, report: Path) -> None:
    """Print the results known so far and where the report is."""
    console = Console()
    table = Table(show_header=False, box=None, padding=(0, 2))
    for label, figure in _summary_rows(results):
        table.add_row(label, figure)
    console.print()
    console.print(table)
    _print_verdicts(console, results)
    console.print(f"\nreport: {report}", highlight=False, soft_wrap=True)


def _summary_rows(results: RunResults) -> Iterator[tuple[str, str]]:
    """Yield what is known of each policy, of each weighting, and of the whole run."""
    found = results.summary()
    for policy in results.policies:
        value = found.get("policies", {}).get(policy.name, {}).get("mean_return")
        if value is not None:
            yield f"final return, {policy.title}", shown_return(value)
    if "purity" in found:
        yield "cluster purity", f"{found['purity']:.3f}"
    for weighting in results.weightings:
        figures = found.get("weightings", {}).get(weighting.name)
        if figures:
            yield f"AUROC, {weighting.title}", f"{figures['auroc']:.3f}"
            shares = f"{figures['share_before']:.3f} -> {figures['share']:.3f}"
            yield f"transferable share of the sampling mass, {weighting.title}", shares
    if "reproducibility" in found:
        sources = found["reproducibility"]["reproducible"]
        everything = "everything" if found["reproducibility"]["everything"] else ", ".join(sources) or "nothing"
        yield "the imitator's simulator can follow", everything
    if "env_steps" in found:
        yield "environment steps", f"{found['env_steps']:,}"
    if "seconds" in found:
        yield "time", _duration(found["seconds"])


def print_status(results: RunResults) -> None:
    """Print where the stages of a run stand, and its results."""
    console = Console()
    table = Table("stage", "state", "seconds", "sha256 or reason", box=None, padding=(0, 2))
    seconds = results.seconds()
    for name, state in results.states.items():
        took = f"{seconds[name]:,.1f}" if name in seconds else ""
        table.add_row(name, state.state, took, escape(state.artifact.sha256[:12] if state.artifact else state.reason))
    console.print(f"{results.config.name}, seed {results.config.seed}  ({results.path})", highlight=False)
    console.print(table)
    for label, figure in _summary_rows(results):
        console.print(f"  {label}: {figure}", highlight=False)
    _print_verdicts(console, results)


def _print_verdicts(console: Console, results: RunResults) -> None:
    """Print what every weighting that trains imitators says of each source and each cluster."""
    for weighting in results.weightings:
        usable = results.is_done(weighting.name) and results.is_done("demonstrations")
        if not usable or not results.weighting(weighting.name).history:
            continue
        found = results.verdicts(weighting.name)
        console.print(f"\nTransferability ({escape(weighting.title)}). {MEANING}.", highlight=False)
        console.print(_verdict_table(found))
        told = (
            f"Kept: the whole interval reaches {found.threshold:.3f}; open: a part of it does. Drawn: share of the "
            "transitions that are drawn, before and after weighting; it is as even as that of "
            f"{found.effective_number:.0f} equal demonstrations."
        )
        console.print(told, highlight=False)
        if found.warning:
            console.print(f"[yellow]{escape(found.warning)}[/]", highlight=False)
    if results.is_done("clustering") and results.suggestion:
        used = results.cluster_diagnostics.non_empty_clusters
        console.print(f"Clusters in use: {used}. {results.suggestion.text}", highlight=False)


def _verdict_table(found: VerdictTable) -> Table:
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    table.add_column("source", max_width=20, overflow="ellipsis", no_wrap=True)
    unlike = any(row.unlike for row in found.by_source)
    for name in ("n", "kept", "open", *(["unlike"] if unlike else []), "score and interval", "drawn"):
        table.add_column(name, justify="right", no_wrap=True)
    for title, rows in (("", found.by_source), ("[bold]cluster[/]", found.by_cluster)):
        if title:
            table.add_row(title)
        for row in rows:
            counts = (str(each) for each in (row.demonstrations, row.kept, row.open, *([row.unlike] if unlike else [])))
            score = escape(_score(row.score, row.low, row.high))
            table.add_row(escape(row.name), *counts, score, f"{row.share_before:.1%} -> {row.share:.1%}")
    return table


def _score(score: float, low: float, high: float) -> str:
    """Return a score with its interval; a dash where there is none."""
    return f"{score:.3f} [{low:.3f}, {high:.3f}]" if np.isfinite(score) else "-"


def print_scores(results: RunResults, scored: "Scored") -> None:
    """Print what each weighting says of demonstrations that came later, by source and one by one."""
    console, titles = Console(), {each.name: each.title for each in results.weightings}
    for name, found in scored.found.items():
        console.print(f"\n{escape(titles[name])}: kept from a score of {found.threshold:.3f}", highlight=False)
        console.print(_verdict_table(VerdictTable.of(found, scored.demonstrations)))
        console.print(_demonstration_table(found, scored.demonstrations))
        if len(scored.demonstrations) > MOST_ROWS:
            console.print(f"... and {len(scored.demonstrations) - MOST_ROWS} more; --output FILE.csv has all")
    for name, reason in scored.refused.items():
        console.print(f"{escape(titles[name])}: {escape(reason)}", highlight=False, soft_wrap=True)


def _demonstration_table(found: "Transferability", demonstrations: "Demonstrations") -> Table:
    table = Table(box=None, padding=(0, 1), pad_edge=False)
    table.add_column("demonstration", justify="right")
    table.add_column("source", max_width=20, overflow="ellipsis", no_wrap=True)
    for name in ("cluster", "score and interval", "verdict"):
        table.add_column(name, justify="right", no_wrap=True)
    verdicts = found.verdicts
    for n in range(min(len(demonstrations), MOST_ROWS)):
        source = escape(demonstrations.source_labels[demonstrations.sources[n]])
        cluster = str(found.clusters[n]) if found.clusters[n] >= 0 else ""
        score = escape(_score(float(found.scores[n]), *found.intervals[n]))
        table.add_row(str(n), source, cluster, score, str(verdicts[n]))
    return table


def print_demonstrations(path: Path, demonstrations: "Demonstrations", environment: str) -> None:
    """Print what a set of demonstrations contains, by source."""
    console = Console()
    lengths, counts = demonstrations.lengths, np.bincount(demonstrations.sources)
    console.print(
        f"{path}: {len(demonstrations)} demonstrations, {lengths.sum():,} states of {demonstrations.observation_dim} "
        f"dimensions, environment {environment or 'not stated'}",
        highlight=False,
        soft_wrap=True,
    )
    table = Table("source", "count", "states (min - max)", "return in its own dynamics", box=None, padding=(0, 2))
    for i, label in enumerate(demonstrations.source_labels):
        mine = demonstrations.sources == i
        if mine.any():
            returns = demonstrations.returns[mine]
            shown = f"{returns.mean():,.0f} ± {returns.std():,.0f}" if np.isfinite(returns).all() else "not recorded"
            table.add_row(label, str(counts[i]), f"{lengths[mine].min()} - {lengths[mine].max()}", shown)
    console.print(table)


def print_bench(environment: str, results: dict[int, dict[str, float]]) -> None:
    """Print environment steps per second by number of workers, and which is best."""
    best = max(results, key=lambda workers: results[workers]["steps_per_s"])
    slowest = min(figures["steps_per_s"] for figures in results.values())
    table = Table("workers", "steps per second", "times the slowest", "", box=None, padding=(0, 2))
    for workers, figures in results.items():
        rate = figures["steps_per_s"]
        name = f"{workers} (inline)" if workers == 0 else str(workers)
        table.add_row(name, f"{rate:,.0f}", f"{rate / slowest:.2f}", "◀ --workers" if workers == best else "")
    console = Console()
    console.print(f"{environment}: one learner and its rollout workers, {os.cpu_count()} cores", highlight=False)
    console.print(table)
