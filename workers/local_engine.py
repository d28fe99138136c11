"""The engine of one machine: jobs in processes of their own, or one after another in this one."""

import time
import uuid
from collections import deque
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from oodil.pipeline.collecting import InlineRollouts
from oodil.pipeline.config import RuntimeConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stage import Run, Stage
from oodil.workers import job as job_process
from oodil.workers import rollout_worker
from oodil.workers.channels import Access, private_endpoint, refuse_long_path
from oodil.workers.engine import POLL_S, Attempts, JobLedger, OnEvent, Outcome, ShouldStop, refuse_main
from oodil.workers.reports import Event, Failed, Finished, Progress, Replaced, Silent, Started, Warn, failure
from oodil.workers.supervisor import Supervisor

_WORKER = "rollout-worker-"
_PRELOAD = (
    "oodil.workers.job",
    "oodil.workers.zmq_rollouts",
    "oodil.workers.rollout_worker",
    "oodil.pipeline.stages",
    "oodil.pipeline.training",
    "oodil.pipeline.algorithms.gail",
    "oodil.pipeline.algorithms.learner",
    "torch._dynamo",
)
"""What children have loaded from the start: what they compute with, torch above all.

torch imports its `_dynamo` with the first optimizer, in as much time as itself."""


class LocalEngine:
    """Runs jobs on this machine: in ``workers`` processes, or with 0 in this one.

    A distributed stage has one learner process, and ``workers`` rollout workers beside it, unless it has as many jobs
    as there are workers; with ``access`` others may join them from elsewhere (`oodil.workers.remote`). Raises
    ConfigError for a negative number of workers, and EndpointError if TMPDIR is too long for a socket.
    """

    def __init__(self, workers: int, access: Access | None = None) -> None:
        if workers < 0:
            raise ConfigError(f"workers is {workers}; it cannot be negative")
        if workers:
            refuse_long_path(Path())
        self.workers = workers
        self._access = access
        """Where rollout workers of other machines may join, if they may."""

    def __str__(self) -> str:
        return f"local, {self.workers} workers"

    def run_jobs(self, stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: ShouldStop) -> Outcome:
        """Run jobs until each is done or has failed; see `Engine`."""
        ledger = JobLedger(jobs, run.config.runtime, on_event)
        if not self.workers:
            _run_inline(stage, run, jobs, ledger, should_stop)
            return ledger.outcome()
        refuse_main(stage)
        # As many jobs as cores are done soonest side by side: what a job collects itself needs no messages.
        distributed = stage.distributed and (self._access is not None or len(jobs) == 1 or len(jobs) < self.workers)
        with (
            private_endpoint(run.directory.path) if distributed else nullcontext("") as endpoint,
            Supervisor(run.directory.logs(), stage.name, _PRELOAD) as supervisor,
        ):
            path = str(run.directory.path.absolute())
            arguments = {"run_path": path, "stage": stage.name, "module": stage.module}
            workers: dict[str, dict[str, str]] = {}
            if distributed:
                shared = {"endpoint": endpoint, "run_id": uuid.uuid4().hex}
                if self._access is not None:
                    shared["keys"] = str(self._access.keys)
                    arguments["address"] = self._access.address
                arguments |= shared
                workers = {f"{_WORKER}{index}": shared for index in range(self.workers)}
            parallel = 1 if distributed else self.workers
            processes = _Processes(supervisor, run.config.runtime, ledger, arguments, workers, on_event)
            processes.run(jobs, parallel, should_stop)
        return ledger.outcome()


def _run_inline(stage: Stage, run: Run, jobs: list[str], ledger: JobLedger, should_stop: ShouldStop) -> None:
    for job in jobs:
        pause_s: float | None = 0.0
        while pause_s is not None:
            ledger.stopped = ledger.stopped or _is_asked_to_stop(should_stop, pause_s)
            if ledger.stopped:
                return
            pause_s = _attempt_inline(stage, run, job, ledger, should_stop)


def _attempt_inline(stage: Stage, run: Run, job: str, ledger: JobLedger, should_stop: ShouldStop) -> float | None:
    """Try a job once; return the pause before it is to be tried again, or None."""
    ledger.begin(job)
    try:
        outcome = job_process.run_job(stage, run, job, InlineRollouts(), partial(ledger.report, job), should_stop)
    except Exception as error:
        failed = failure(error)
        return ledger.failed(job, failed.reason, failed.is_final)
    ledger.finished(job, outcome)
    return None


def _is_asked_to_stop(should_stop: ShouldStop, pause_s: float) -> bool:
    """Wait, and return whether a stop was asked for before or meanwhile."""
    deadline = time.monotonic() + pause_s
    while not should_stop():
        left_s = deadline - time.monotonic()
        if left_s <= 0:
            return False
        time.sleep(min(POLL_S, left_s))
    return True


class _Processes:
    """The jobs of one stage while they run in processes of their own."""

    def __init__(
        self,
        supervisor: Supervisor,
        runtime: RuntimeConfig,
        ledger: JobLedger,
        arguments: dict[str, str],
        workers: dict[str, dict[str, str]],
        on_event: OnEvent,
    ) -> None:
        self._supervisor = supervisor
        self._runtime = runtime
        self._ledger = ledger
        self._arguments = arguments
        self._workers = workers
        """The arguments of each rollout worker."""
        self._on_event = on_event
        self._worker_attempts = Attempts(runtime.max_worker_restarts + 1, runtime.restart_delay_s)
        """Of all workers together."""
        self._waiting: deque[str] = deque()
        self._running: set[str] = set()
        """Those that run or wait for their next attempt."""
        self._identities: dict[str, str] = {}
        self._last_sign: dict[str, float] = {}
        """When each running job last began or reported progress."""

    def run(self, jobs: list[str], parallel: int, should_stop: ShouldStop) -> None:
        """Run until nothing is left to run, at most ``parallel`` jobs at once."""
        self._waiting.extend(jobs)
        for worker in self._workers:
            self._start_worker(worker, 0.0)
        while self._running or (self._waiting and not self._ledger.stopped):
            if not self._ledger.stopped and should_stop():
                self._ledger.stopped = True
                # One that waits for its next attempt is gone at once and will say nothing.
                self._running = {job for job in self._running if self._supervisor.stop(job)}
            while not self._ledger.stopped and self._waiting and len(self._running) < parallel:
                self._start_job(self._waiting.popleft(), 0.0)
            for event in self._supervisor.poll(POLL_S):
                if event.name in self._workers:
                    self._handle_worker(event)
                else:
                    self._handle_job(event)
            self._kill_hung_jobs()

    def _start_job(self, job: str, delay_s: float) -> None:
        self._supervisor.start(job, job_process.main, self._arguments | {"job": job}, delay_s)
        self._running.add(job)

    def _start_worker(self, worker: str, delay_s: float) -> None:
        self._supervisor.start(worker, rollout_worker.main, self._workers[worker], delay_s)

    def _handle_job(self, event: Event) -> None:
        job, report = event.name, event.report
        match report:
            case Started(attempt):
                self._ledger.begin(job)
                self._identities[job], self._last_sign[job] = f"{job}.{attempt}", time.monotonic()
            case Finished(outcome):
                self._forget(job)
                self._ledger.finished(job, outcome)
            case Failed(reason, is_final):
                self._forget(job)
                delay_s = self._ledger.failed(job, reason, is_final)
                if delay_s is not None:
                    self._start_job(job, delay_s)
            case Silent(worker):
                timeout_s = self._runtime.unit_timeout_s
                text = f"{worker} answered nothing for {timeout_s:g} s (runtime.unit_timeout_s) and is replaced"
                self._ledger.report(job, Warn(text))
                self._supervisor.kill(worker)
            case Progress() | Warn():
                if isinstance(report, Progress):
                    self._last_sign[job] = time.monotonic()
                self._ledger.report(job, report)

    def _forget(self, job: str) -> None:
        self._last_sign.pop(job, None)
        self._running.discard(job)

    def _handle_worker(self, event: Event) -> None:
        if not isinstance(event.report, Failed):
            return
        reason = event.report.reason
        delay_s = self._worker_attempts.failed(reason)
        if delay_s is not None:
            self._on_event(Event(event.name, Replaced(reason)))
            self._start_worker(event.name, delay_s)
            return
        limit = self._runtime.max_worker_restarts
        reason = f"rollout workers died more than {limit} times (runtime.max_worker_restarts), last: {reason}"
        for job in self._running:
            self._ledger.give_up(job, reason)
        self._running.clear()
        self._waiting.clear()

    def _kill_hung_jobs(self) -> None:
        """Kill jobs that have made no progress for too long; they are started again like any that died."""
        timeout_s = self._runtime.job_timeout_s
        for job, since in list(self._last_sign.items()):
            if time.monotonic() - since > timeout_s:
                self._ledger.report(job, Warn(f"no progress for {timeout_s:g} s (runtime.job_timeout_s); killed"))
                self._supervisor.kill(self._identities[job])
                self._last_sign[job] = time.monotonic()
