"""How far jobs and the whole run are, and how long they will still take; nothing here knows of a screen."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from oodil.estimate import StageCost

Clock = Callable[[], float]
"""Seconds since some moment."""
TRUST = 0.1
"""Share of a run's expected time after which what was seen of its pace counts as much as what was expected."""


@dataclass
class JobProgress:
    """How far a job is."""

    clock: Clock = time.monotonic
    done: int = 0
    total: int = 0
    metrics: Mapping[str, float] = field(default_factory=dict)
    _since: float = 0.0
    _first: int = 0
    """What was done when its first report came: a job that goes on does not begin at 0."""

    def advance(self, done: int, total: int, metrics: Mapping[str, float]) -> None:
        """Note a report."""
        if not self.total:
            self._since, self._first = self.clock(), done
        self.done, self.total, self.metrics = done, total, metrics

    @property
    def share(self) -> float:
        """Of the job that is done."""
        return self.done / self.total if self.total else 0.0

    @property
    def first_share(self) -> float:
        """Of the job that was done when its first report came."""
        return self._first / self.total if self.total else 0.0

    @property
    def rate(self) -> float | None:
        """What is done in a second; None until a second has passed."""
        seconds = self.clock() - self._since
        return (self.done - self._first) / seconds if self.total and seconds >= 1 and self.done > self._first else None

    @property
    def left_s(self) -> float | None:
        """Seconds until it is done; None until they can be told."""
        return (self.total - self.done) / self.rate if self.rate else None


class RunProgress:
    """How far the whole run is, by what each of its stages was expected to cost.

    How long it still takes follows from the expectation and from the pace so far, the more of the latter the more is
    done. What is reused, or was done before an interruption, counts as done and says nothing of the pace.
    """

    def __init__(self, costs: Mapping[str, StageCost], clock: Clock = time.monotonic) -> None:
        self.num_stages = len(costs)
        self.stage = 0
        """The number of the current stage, from 1."""
        self.jobs: dict[str, JobProgress] = {}
        """Of the current stage, those that run."""
        self.num_jobs = 0
        self._costs = dict(costs)
        self._seconds = {name: cost.seconds for name, cost in costs.items()}
        self._clock = clock
        self._current = ""
        self._finished_s = 0.0
        """Expected seconds of the stages that are done."""
        self._given = 0.0
        """Expected seconds of what was done before."""
        self._given_by_job: dict[str, float] = {}
        """Shares of the current stage's jobs that were done before."""
        self._done_jobs: set[str] = set()
        """Of the current stage."""
        self._began: float | None = None

    def stage_reused(self, stage: str) -> None:
        """A stage takes no time."""
        self.stage += 1
        self._seconds[stage] = 0.0

    def stage_started(self, stage: str, jobs: int) -> None:
        """A stage begins with some of its jobs, or all."""
        if self._began is None:
            self._began = self._clock()
        self.stage += 1
        self._current, self.num_jobs = stage, jobs
        self._forget_jobs()
        if stage in self._costs:
            self._seconds[stage] *= min(1.0, jobs / self._costs[stage].jobs)

    def stage_finished(self) -> None:
        """The current stage is done."""
        self._finished_s += self._seconds.get(self._current, 0.0)
        self._given += self._given_s
        self._current, self.num_jobs = "", 0
        self._forget_jobs()

    def job_started(self, job: str) -> None:
        """A job begins, or begins again."""
        self.jobs[job] = JobProgress(self._clock)

    def job_advanced(self, job: str, done: int, total: int, metrics: Mapping[str, float]) -> None:
        """A job reports."""
        known = self.jobs.setdefault(job, JobProgress(self._clock))
        known.advance(done, total, metrics)
        self._given_by_job.setdefault(job, known.first_share)

    def job_ended(self, job: str, is_done: bool) -> None:
        """A job is done, or has to be begun again."""
        self.jobs.pop(job, None)
        if is_done:
            self._done_jobs.add(job)

    @property
    def num_finished(self) -> int:
        """Jobs of the current stage that are done."""
        return len(self._done_jobs)

    @property
    def share(self) -> float:
        """Of the run that is done."""
        total = sum(self._seconds.values())
        return min(1.0, self._done_s / total) if total else 0.0

    @property
    def left_s(self) -> float | None:
        """Seconds until the run is done; None if nothing is known of its costs."""
        total = sum(self._seconds.values())
        if not total or self._began is None:
            return None
        given = self._given + self._given_s
        trust = TRUST * total
        pace = (self._clock() - self._began + trust) / (max(self._done_s - given, 0.0) + trust)
        return max(total - self._done_s, 0.0) * pace

    def _job_s(self, job: str) -> float:
        """Return the expected seconds of a job of the current stage."""
        cost, alike = self._costs.get(self._current), 1 / max(self.num_jobs, 1)
        return self._seconds.get(self._current, 0.0) * (cost.shares.get(job, alike) if cost else alike)

    @property
    def _given_s(self) -> float:
        return sum(share * self._job_s(job) for job, share in self._given_by_job.items())

    @property
    def _done_s(self) -> float:
        done = sum(self._job_s(job) for job in self._done_jobs)
        done += sum(progress.share * self._job_s(job) for job, progress in self.jobs.items())
        return self._finished_s + min(done, self._seconds.get(self._current, 0.0))

    def _forget_jobs(self) -> None:
        self.jobs.clear()
        self._given_by_job.clear()
        self._done_jobs.clear()
