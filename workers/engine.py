"""The one interface to parallelizm: run the jobs of a stage, wherever they run and whoever collects for them.

What a job computes never depends on the engine, on the number of workers, or on what died meanwhile.
"""

import time
import traceback
import uuid
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import count
from typing import Protocol

from oodil.pipeline.collecting import InlineRollouts, RolloutSource
from oodil.pipeline.config import RuntimeConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stage import JobStoppedError, Run, Stage
from oodil.workers import job as job_process
from oodil.workers import rollout_worker as rollout_process
from oodil.workers.channels import Access, private_endpoint
from oodil.workers.reports import Progress, Silent, Warn
from oodil.workers.supervisor import Died, Ended, Restarts, Said, Started, Supervisor
from oodil.workers.supervisor import Event as ChildEvent

_POLL_S = 0.2
_WORKER = "rollout-worker-"


@dataclass(frozen=True)
class JobStarted:
    """An attempt at a job begins."""

    job: str
    attempt: int


@dataclass(frozen=True)
class JobProgress:
    """How far a job is."""

    job: str
    done: int
    total: int
    metrics: dict[str, float]


@dataclass(frozen=True)
class JobWarning:
    """A job has something to say to the user."""

    job: str
    message: str


@dataclass(frozen=True)
class JobFailed:
    """An attempt at a job raised or was killed."""

    job: str
    attempt: int
    will_retry: bool
    reason: str
    """Its traceback if there is one."""


@dataclass(frozen=True)
class JobDone:
    """A job's artifact is written."""

    job: str


@dataclass(frozen=True)
class WorkerRestarted:
    """A rollout worker died and is replaced."""

    worker: str
    reason: str


Event = JobStarted | JobProgress | JobWarning | JobFailed | JobDone | WorkerRestarted
OnEvent = Callable[[Event], None]


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


class Engine(Protocol):
    """Runs the jobs of a stage."""

    def run_jobs(
        self, stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: Callable[[], bool]
    ) -> Outcome:
        """Run jobs until each is done or has failed; one failure does not end the others.

        Once ``should_stop`` returns true, running jobs write a checkpoint and stop. ``on_event`` is called in this
        thread.
        """


class LocalEngine:
    """Runs jobs on this machine: in ``workers`` processes, or with 0 in this one.

    A distributed stage has one learner process, and ``workers`` rollout workers beside it; with ``access`` others may
    join them from elsewhere (`oodil.workers.remote`).
    """

    def __init__(
        self, workers: int, stages: str = "oodil.pipeline.stages:stage_named", access: Access | None = None
    ) -> None:
        if workers < 0:
            raise ConfigError(f"workers is {workers}; it cannot be negative")
        self._workers = workers
        self._access = access
        """Where rollout workers of other machines may join, if they may."""
        self._stages = stages
        """Where a job's process finds ``(config, name) -> Stage``, as module:function."""

    def __str__(self) -> str:
        return f"local, {self._workers} workers"

    def run_jobs(
        self, stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: Callable[[], bool]
    ) -> Outcome:
        """Run jobs until each is done or has failed; see `Engine`."""
        if not self._workers:
            return _run_inline(stage, run, jobs, on_event, should_stop)
        with (
            private_endpoint(run.directory.path) if stage.distributed else nullcontext("") as endpoint,
            Supervisor(run.directory.logs(), stage.name) as supervisor,
        ):
            path = str(run.directory.path.absolute())
            arguments = {"run_path": path, "stages": self._stages, "stage": stage.name}
            parallel = self._workers
            if stage.distributed:
                parallel = 1
                shared = {"endpoint": endpoint, "run_id": uuid.uuid4().hex}
                if self._access is not None:
                    shared["keys"] = str(self._access.keys)
                    arguments["address"] = self._access.address
                arguments |= shared
                restarts = Restarts(run.config.runtime.max_worker_restarts, run.config.runtime.restart_delay_s)
                for index in range(self._workers):
                    supervisor.start(f"{_WORKER}{index}", rollout_process.main, shared, restarts)
            return _Processes(supervisor, run.config.runtime, arguments, jobs, parallel, on_event).run(should_stop)


class _Processes:
    """The jobs of one stage while they run in processes of their own."""

    def __init__(
        self,
        supervisor: Supervisor,
        runtime: RuntimeConfig,
        arguments: dict[str, str],
        jobs: list[str],
        parallel: int,
        on_event: OnEvent,
    ) -> None:
        self._supervisor = supervisor
        self._runtime = runtime
        self._arguments = arguments
        self._jobs = jobs
        self._parallel = parallel
        self._on_event = on_event
        self._waiting = deque(jobs)
        self._running: set[str] = set()
        self._done: set[str] = set()
        self._failed: dict[str, str] = {}
        self._first_reason: dict[str, str] = {}
        self._attempts: dict[str, int] = {}
        self._last_sign: dict[str, float] = {}
        """When each running job last began or reported progress."""
        self._stopped = False

    def run(self, should_stop: Callable[[], bool]) -> Outcome:
        """Run until nothing is left to run."""
        while self._running or (self._waiting and not self._stopped):
            if not self._stopped and should_stop():
                self._stopped = True
                # One that waits for its next attempt is gone at once and will say nothing.
                self._running = {job for job in self._running if self._supervisor.stop(job)}
            while not self._stopped and self._waiting and len(self._running) < self._parallel:
                self._start(self._waiting.popleft())
            for event in self._supervisor.poll(_POLL_S):
                self._handle(event)
            self._kill_hung_jobs()
        done = [job for job in self._jobs if job in self._done]
        not_run = [job for job in self._jobs if job not in self._done and job not in self._failed]
        return Outcome(done, self._failed, not_run, self._stopped)

    def _start(self, job: str) -> None:
        restarts = Restarts(self._runtime.max_attempts - 1, self._runtime.restart_delay_s)
        self._supervisor.start(job, job_process.main, self._arguments | {"job": job}, restarts)
        self._running.add(job)

    def _handle(self, event: ChildEvent) -> None:
        if isinstance(event, Said):
            self._pass_on(event)
        elif event.name.startswith(_WORKER):
            if isinstance(event, Died):
                self._worker_died(event)
        elif isinstance(event, Started):
            self._attempts[event.name], self._last_sign[event.name] = event.attempt, time.monotonic()
            self._on_event(JobStarted(event.name, event.attempt))
        elif isinstance(event, Ended):
            del self._last_sign[event.name]
            self._running.discard(event.name)
            if event.outcome == job_process.DONE:
                self._done.add(event.name)
                self._on_event(JobDone(event.name))
        else:
            self._job_died(event)

    def _pass_on(self, said: Said) -> None:
        report = said.report
        if isinstance(report, Progress):
            self._last_sign[said.name] = time.monotonic()
            self._on_event(JobProgress(said.name, report.done, report.total, report.metrics))
        elif isinstance(report, Warn):
            self._on_event(JobWarning(said.name, report.text))
        elif isinstance(report, Silent):
            timeout_s = self._runtime.unit_timeout_s
            message = f"{report.worker} answered nothing for {timeout_s:g} s (runtime.unit_timeout_s) and is replaced"
            self._on_event(JobWarning(said.name, message))
            self._supervisor.kill(report.worker)

    def _kill_hung_jobs(self) -> None:
        """Kill jobs that have made no progress for too long; they are started again like any that died."""
        timeout_s = self._runtime.job_timeout_s
        for job, since in list(self._last_sign.items()):
            if time.monotonic() - since > timeout_s:
                message = f"no progress for {timeout_s:g} s (runtime.job_timeout_s); killed"
                self._on_event(JobWarning(job, message))
                self._supervisor.kill(f"{job}.{self._attempts[job]}")
                self._last_sign[job] = time.monotonic()

    def _job_died(self, died: Died) -> None:
        self._last_sign.pop(died.name, None)
        self._on_event(JobFailed(died.name, died.attempt, died.restarts, died.reason))
        first = self._first_reason.setdefault(died.name, died.reason)
        if not died.restarts:
            self._running.discard(died.name)
            # After a stop nothing is tried again, so its attempts are not used up and it did not fail.
            if not self._stopped:
                self._failed[died.name] = first

    def _worker_died(self, died: Died) -> None:
        if died.restarts:
            self._on_event(WorkerRestarted(died.name, died.reason))
            return
        limit = self._runtime.max_worker_restarts
        reason = f"rollout workers died more than {limit} times (runtime.max_worker_restarts), last: {died.reason}"
        for job in self._running:
            self._failed[job] = self._first_reason.get(job, reason)
            self._on_event(JobFailed(job, 0, False, reason))
        self._running.clear()
        self._waiting.clear()


class _InlineContext:
    """A job's view of the orchestrator's own process."""

    def __init__(self, run: Run, job: str, on_event: OnEvent, should_stop: Callable[[], bool]) -> None:
        self.rollouts: RolloutSource = InlineRollouts()
        self.checkpoint_interval_s = run.config.runtime.checkpoint_interval_s
        self.should_stop = should_stop
        self._job = job
        self._on_event = on_event

    def progress(self, done: int, total: int, **metrics: float) -> None:
        """Report progress."""
        self._on_event(JobProgress(self._job, done, total, metrics))

    def warn(self, message: str) -> None:
        """Pass a warning on."""
        self._on_event(JobWarning(self._job, message))


def _run_inline(stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: Callable[[], bool]) -> Outcome:
    outcome = Outcome()
    for job in jobs:
        is_done = False
        if not should_stop():
            is_done = _attempt_inline(stage, run, job, on_event, should_stop, outcome.failed)
        if is_done:
            outcome.done.append(job)
        elif job not in outcome.failed:
            outcome.not_run.append(job)
            outcome.stopped = True
    return outcome


def _attempt_inline(
    stage: Stage,
    run: Run,
    job: str,
    on_event: OnEvent,
    should_stop: Callable[[], bool],
    failed: dict[str, str],
) -> bool:
    """Return whether the job is done; one that failed for good is entered in ``failed``."""
    runtime = run.config.runtime
    restarts = Restarts(runtime.max_attempts - 1, runtime.restart_delay_s)
    first_reason = ""
    for attempt in count(1):
        on_event(JobStarted(job, attempt))
        try:
            job_process.execute(stage, run, job, _InlineContext(run, job, on_event, should_stop))
        except JobStoppedError:
            return False
        except Exception:
            reason = traceback.format_exc()
            first_reason = first_reason or reason
            delay_s = restarts.next_delay()
            on_event(JobFailed(job, attempt, delay_s is not None, reason))
            if delay_s is None:
                failed[job] = first_reason
                return False
            deadline = time.monotonic() + delay_s
            while time.monotonic() < deadline:
                if should_stop():
                    return False
                time.sleep(min(_POLL_S, delay_s))
        else:
            on_event(JobDone(job))
            return True
    raise AssertionError("unreachable: the loop has no end")
