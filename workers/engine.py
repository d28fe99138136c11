"""The contract of an engine, which runs the jobs of a stage, and the ledger of attempts that all engines keep.

What a job computes never depends on the engine, on the number of workers, or on what died meanwhile.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Protocol

from oodil.pipeline.config import RuntimeConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stage import Run, Stage
from oodil.workers.reports import DONE, AttemptFailed, Event, Finished, Progress, Report, Started

POLL_S = 0.2
"""How long an engine waits before it looks again whether it should stop."""
MAX_DELAY_S = 10.0
"""The longest pause before something is started again."""

OnEvent = Callable[[Event], None]
ShouldStop = Callable[[], bool]


@dataclass
class Outcome:
    """What became of the jobs of a stage."""

    done: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """The first traceback, or how it died, by job."""
    not_run: list[str] = field(default_factory=list)
    """Never started, or stopped before they were done."""
    stopped: bool = False
    """Whether a stop was asked for."""
    is_final: bool = False
    """Whether all that failed did so for a reason that another attempt would meet again."""


class Engine(Protocol):
    """Runs the jobs of a stage."""

    @property
    def workers(self) -> int | None:
        """How many processes compute at the same time; 0 for the caller's own alone, None if only the engine knows."""

    def run_jobs(self, stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: ShouldStop) -> Outcome:
        """Run jobs until each is done or has failed; one failure does not end the others.

        Once ``should_stop`` returns true, running jobs write a checkpoint and stop. ``on_event`` is called in this
        thread.
        """


def refuse_main(stage: Stage) -> None:
    """Raise ConfigError for a stage that no other process can import, because the caller's script defines it."""
    if stage.module == "__main__":
        raise ConfigError(
            f"{stage.name} is defined in the script that runs; put it into a module of its own, or use workers=0"
        )


class Attempts:
    """The attempts at one thing: how many there were, and whether there should be another.

    An attempt that got further than all before it is followed by another in any case. ``limit`` is the number of
    attempts in a row that may end at the same point, the one that first got there included.
    """

    def __init__(self, limit: int, delay_s: float) -> None:
        self.number = 0
        self.first_reason = ""
        """Why the first one failed."""
        self._limit = limit
        self._delay_s = delay_s
        self._least_left = inf
        self._got_further = False
        self._without_progress = 0

    def begin(self) -> int:
        """Count another attempt and return its number."""
        self.number += 1
        return self.number

    def reached(self, left: int) -> None:
        """Note how much the current attempt has left to do; what earlier ones have finished may not be part of it."""
        if left < self._least_left:
            self._least_left, self._got_further = left, True

    def failed(self, reason: str) -> float | None:
        """Note that the current attempt failed.

        Returns the pause in seconds before the next one, which doubles until an attempt gets further, or None when
        there should be no other.
        """
        self.first_reason = self.first_reason or reason
        self._without_progress = 1 if self._got_further else self._without_progress + 1
        self._got_further = False
        if self._without_progress >= self._limit:
            return None
        return min(self._delay_s * 2.0 ** min(self._without_progress - 1, 32), MAX_DELAY_S)


class JobLedger:
    """What happened to the jobs of a stage: attempts, reasons, outcomes. It tells ``on_event`` all of it."""

    def __init__(self, jobs: list[str], runtime: RuntimeConfig, on_event: OnEvent) -> None:
        self.stopped = False
        """Whether a stop was asked for; from then on nothing is tried again and nothing counts as failed."""
        self._attempts = {job: Attempts(runtime.max_attempts, runtime.restart_delay_s) for job in jobs}
        self._done: set[str] = set()
        self._failed: dict[str, str] = {}
        self._final: set[str] = set()
        self._on_event = on_event

    def begin(self, job: str) -> int:
        """Note that an attempt begins; return its number, from 1."""
        attempt = self._attempts[job].begin()
        self._on_event(Event(job, Started(attempt)))
        return attempt

    def report(self, job: str, report: Report) -> None:
        """Note a report of the current attempt and pass it on."""
        if isinstance(report, Progress):
            self._attempts[job].reached(report.total - report.done)
        self._on_event(Event(job, report))

    def finished(self, job: str, outcome: str) -> None:
        """Note that a job is DONE or STOPPED."""
        if outcome == DONE:
            self._done.add(job)
        else:
            self.stopped = True
        self._on_event(Event(job, Finished(outcome)))

    def failed(self, job: str, reason: str, is_final: bool = False) -> float | None:
        """Note that the current attempt failed; return the pause before the next one, or None if it was the last."""
        attempts = self._attempts[job]
        delay_s = attempts.failed(reason)
        if is_final:
            delay_s = None
            self._final.add(job)
        if self.stopped:
            delay_s = None
        elif delay_s is None:
            self._failed[job] = reason if is_final else attempts.first_reason
        self._on_event(Event(job, AttemptFailed(attempts.number, reason, delay_s is not None)))
        return delay_s

    def give_up(self, job: str, reason: str) -> None:
        """Note that a job fails for a reason outside of it."""
        attempts = self._attempts[job]
        self._failed[job] = attempts.first_reason or reason
        self._on_event(Event(job, AttemptFailed(attempts.number, reason, False)))

    def outcome(self) -> Outcome:
        """Return what became of the jobs, each list in the order of the jobs."""
        done = [job for job in self._attempts if job in self._done]
        not_run = [job for job in self._attempts if job not in self._done and job not in self._failed]
        is_final = bool(self._failed) and self._final.issuperset(self._failed)
        return Outcome(done, self._failed, not_run, self.stopped, is_final)
