"""The engine on a Ray cluster: cluster jobs, the learner and every unit of work are Ray tasks.

Placing tasks, moving bytes and running again what was lost is Ray's. What travels are texts, numbers and the frames of
`workers.messages`. The run's folder has to be on storage that every node sees under the same path, and every node has
the same oodil installed.
"""

import ipaddress
import math
import os
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ray
from ray.util import get_node_ip_address
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from pipeline.config import RuntimeConfig
from pipeline.loading import ConfigError
from pipeline.rollout import InlineRollouts, Unit, UnitResult, collect
from pipeline.stage import JobStoppedError, Run, Stage
from pipeline.versions import collecting_versions
from workers import job as job_process
from workers.engine import JobDone, JobFailed, JobProgress, JobStarted, JobWarning, OnEvent, Outcome
from workers.messages import Header, ResultMessage, UnitMessage, decode, encode
from workers.reports import Failed, Progress, Report, Warn, decode_report, encode_report
from workers.wire import MessageError, shortened

_POLL_S = 0.2
_HEADER = Header("", "", "ray", 0)
"""Ray knows which answer belongs to which question."""
_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def connect(trusted: bool) -> None:
    """Join the Ray cluster at RAY_ADDRESS or on this machine, or start one here if there is none.

    Raises ValueError for a cluster of several machines without token authentication, unless it is ``trusted``: whoever
    reaches its ports can run programs on it.
    """
    authenticated = os.environ.get("RAY_AUTH_MODE") == "token"
    _refuse_unless(trusted or authenticated or _is_here(os.environ.get("RAY_ADDRESS", "")))
    ray.init(runtime_env={"env_vars": _ONE_THREAD}, include_dashboard=False, log_to_driver=False)
    addresses = {node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
    try:
        _refuse_unless(trusted or authenticated or addresses == {get_node_ip_address()})
    except ValueError:
        ray.shutdown()
        raise


def _is_here(address: str) -> bool:
    host = address.removeprefix("ray://").rpartition(":")[0] or address
    if host in ("", "auto", "local", "localhost", get_node_ip_address()):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _refuse_unless(acceptable: bool) -> None:
    if not acceptable:
        raise ValueError(
            "this Ray cluster spans machines and asks nobody for a token: start it with RAY_AUTH_MODE=token and set "
            "that here too, or say --trust-cluster where its network is closed"
        )


class RayEngine:
    """Runs jobs as Ray tasks; a distributed stage's job has its units collected by Ray tasks, too."""

    def __init__(self, stages: str = "pipeline.stages:stage_named") -> None:
        self._stages = stages
        """Where a task finds ``(config, name) -> Stage``, as module:function."""

    def __str__(self) -> str:
        return "ray"

    def run_jobs(
        self, stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: Callable[[], bool]
    ) -> Outcome:
        """Run jobs until each is done or has failed; see `Engine`.

        Raises ConfigError when a node does not see the run's folder or has other libraries.
        """
        path = str(run.directory.path.absolute())
        _check_nodes(path)
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        board: Any = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
        task = ray.remote(_run_job).options(max_retries=0)

        def start(job: str) -> Any:
            return task.remote(board, path, self._stages, stage.name, job)

        try:
            return _Tasks(start, board, run.config.runtime, jobs, on_event).run(should_stop)
        finally:
            ray.kill(board)


class _Tasks:
    """The jobs of one stage while they run as Ray tasks."""

    def __init__(
        self, start: Callable[[str], Any], board: Any, runtime: RuntimeConfig, jobs: list[str], on_event: OnEvent
    ) -> None:
        self._start = start
        self._board = board
        self._runtime = runtime
        self._jobs = jobs
        self._on_event = on_event
        self._running: dict[Any, str] = {}
        self._attempts: Counter[str] = Counter()
        self._last_sign: dict[str, float] = {}
        """When each job that Ray has begun to run began or reported progress."""
        self._words: dict[str, str] = {}
        """Why the present attempt ends, from itself."""
        self._first_reason: dict[str, str] = {}
        self._outcome = Outcome()

    def run(self, should_stop: Callable[[], bool]) -> Outcome:
        """Run until nothing is left to run."""
        for job in self._jobs:
            self._begin(job)
        try:
            while self._running:
                if should_stop() and not self._outcome.stopped:
                    self._outcome.stopped = True
                    ray.get(self._board.stop.remote())
                ended, _ = ray.wait(list(self._running), timeout=_POLL_S)
                for job, content in ray.get(self._board.read.remote()):
                    self._take_in(job, decode_report(content) if content else None)
                for task in ended:
                    self._take_out(task)
                self._give_up_hung_tasks()
        finally:
            for task in self._running:
                ray.cancel(task, force=True)
        self._outcome.done.sort(key=self._jobs.index)
        return self._outcome

    def _begin(self, job: str) -> None:
        self._attempts[job] += 1
        self._running[self._start(job)] = job

    def _take_in(self, job: str, report: Report | None) -> None:
        if isinstance(report, Failed):
            self._words[job] = report.traceback
        elif isinstance(report, Warn):
            self._on_event(JobWarning(job, report.text))
        else:
            self._last_sign[job] = time.monotonic()
            if isinstance(report, Progress):
                self._on_event(JobProgress(job, report.done, report.total, report.metrics))
            else:
                self._on_event(JobStarted(job, self._attempts[job]))

    def _take_out(self, task: Any) -> None:
        job = self._running[task]
        try:
            ended = ray.get(task)
        except ray.exceptions.RayError as error:
            self._failed(task, self._words.pop(job, f"its process or its node is gone: {error}"))
            return
        self._forget(task)
        if ended == job_process.DONE:
            self._outcome.done.append(job)
            self._on_event(JobDone(job))
        else:
            self._outcome.not_run.append(job)

    def _give_up_hung_tasks(self) -> None:
        """Leave tasks that have made no progress for too long; a frozen process may not even follow the cancelling."""
        timeout_s = self._runtime.job_timeout_s
        for task, job in list(self._running.items()):
            if time.monotonic() - self._last_sign.get(job, math.inf) > timeout_s:
                ray.cancel(task, force=True)
                self._failed(task, f"no progress for {timeout_s:g} s (runtime.job_timeout_s)")

    def _failed(self, task: Any, reason: str) -> None:
        job = self._forget(task)
        first = self._first_reason.setdefault(job, reason)
        tries_again = self._attempts[job] < self._runtime.max_attempts and not self._outcome.stopped
        self._on_event(JobFailed(job, self._attempts[job], tries_again, reason))
        if tries_again:
            self._begin(job)
        elif self._outcome.stopped:
            self._outcome.not_run.append(job)
        else:
            self._outcome.failed[job] = first

    def _forget(self, task: Any) -> str:
        job = self._running.pop(task)
        self._last_sign.pop(job, None)
        return job


class _Board:
    """An actor beside the orchestrator: what jobs say until it is read, and whether they should stop."""

    def __init__(self) -> None:
        self._notes: list[tuple[str, bytes]] = []
        self._is_stopping = False

    def write(self, job: str, report: bytes) -> None:
        """Note a job's report; an empty one says that an attempt begins."""
        self._notes.append((job, report))

    def read(self) -> list[tuple[str, bytes]]:
        """Return what was written since the last time."""
        notes, self._notes = self._notes, []
        return notes

    def stop(self) -> None:
        """Ask all jobs to stop."""
        self._is_stopping = True

    def is_stopping(self) -> bool:
        """Return whether jobs should stop."""
        return self._is_stopping


class _Writer:
    """A job's end of the board."""

    def __init__(self, board: Any, job: str) -> None:
        self._board = board
        self._job = job
        self._next_question = 0.0
        self._is_stopping = False

    def begin(self) -> None:
        """Note that an attempt begins."""
        ray.get(self._board.write.remote(self._job, b""))

    def send(self, report: Report) -> None:
        """Put a report on the board."""
        ray.get(self._board.write.remote(self._job, encode_report(report)))

    def should_stop(self) -> bool:
        """Return whether the orchestrator asked for an end; it is asked now and then."""
        if not self._is_stopping and time.monotonic() >= self._next_question:
            self._next_question = time.monotonic() + _POLL_S
            self._is_stopping = ray.get(self._board.is_stopping.remote())
        return self._is_stopping


def _run_job(board: Any, run_path: str, stages: str, stage_name: str, job: str) -> str:
    """The task of a job; returns DONE or STOPPED."""
    stage, run = job_process.find(run_path, stages, stage_name)
    rollouts = RayRollouts(run.config.runtime.unit_timeout_s) if stage.distributed else InlineRollouts()
    writer = _Writer(board, job)
    context = job_process.Context(writer.send, writer.should_stop, rollouts, run.config.runtime.checkpoint_interval_s)
    if writer.should_stop():
        return job_process.STOPPED
    writer.begin()
    try:
        job_process.execute(stage, run, job, context)
    except JobStoppedError:
        return job_process.STOPPED
    except Exception:
        writer.send(Failed(shortened(traceback.format_exc())))
        raise
    return job_process.DONE


class RayRollouts:
    """A rollout source whose units are Ray tasks. Ray runs a unit again wherever it was lost."""

    def __init__(self, unit_timeout_s: float) -> None:
        self._unit_timeout_s = unit_timeout_s
        self._collect = ray.remote(_collect).options(max_retries=-1)
        self._versions = collecting_versions()
        self._units: list[list[bytes]] = []
        self._answers: list[Any] = []

    def submit(self, units: list[Unit]) -> None:
        """Hand over the units of one iteration."""
        self._units = [encode(UnitMessage(_HEADER, unit)) for unit in units]
        self._answers = [self._ask(unit) for unit in self._units]

    def gather(self) -> list[UnitResult]:
        """Wait for the submitted units and return their results in group order; raises what collecting raised.

        A unit that takes longer than the time allowed is given away again.
        """
        while late := ray.wait(self._answers, num_returns=len(self._answers), timeout=self._unit_timeout_s)[1]:
            for answer in late:
                ray.cancel(answer, force=True)
                group = self._answers.index(answer)
                self._answers[group] = self._ask(self._units[group])
        results = []
        for frames in ray.get(self._answers):
            message = decode(frames)
            if not isinstance(message, ResultMessage):
                raise MessageError(f"a unit was answered by {type(message).__name__}")
            results.append(message.result)
        return results

    def _ask(self, unit: list[bytes]) -> Any:
        return self._collect.remote(self._versions, unit)


def _collect(versions: str, frames: list[bytes]) -> list[bytes]:
    """The task of a unit: the frames of a UnitMessage in, those of a ResultMessage out."""
    _refuse_other_versions(versions)
    message = decode(frames)
    if not isinstance(message, UnitMessage):
        raise MessageError(f"asked to collect {type(message).__name__}")
    return encode(ResultMessage(_HEADER, collect(message.unit)))


def _check_nodes(run_path: str) -> None:
    """Look from every node at the run's folder and at its libraries. Raises ConfigError that names the node."""
    looks: list[tuple[str, Any]] = []
    for node in ray.nodes():
        if node["Alive"]:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            look = ray.remote(_look).options(num_cpus=0, scheduling_strategy=there)
            looks.append((node["NodeManagerAddress"], look.remote(run_path, collecting_versions())))
    for address, look in looks:
        try:
            sees_run = ray.get(look)
        except ray.exceptions.RayTaskError as error:
            raise ConfigError(f"Ray node {address}: {error.cause or error}") from error
        except ray.exceptions.RayError:
            # The node has left meanwhile: there is nothing to look at, and nothing will be placed there.
            continue
        if not sees_run:
            raise ConfigError(f"Ray node {address} does not see {run_path}; choose a --run-dir on shared storage")


def _look(run_path: str, versions: str) -> bool:
    _refuse_other_versions(versions)
    return Path(run_path).is_dir()


def _refuse_other_versions(versions: str) -> None:
    if collecting_versions() != versions:
        raise RuntimeError(f"this node has {collecting_versions()}; the learner has {versions}")
