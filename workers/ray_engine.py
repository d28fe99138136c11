"""The engine on a Ray cluster: cluster jobs, the learner and every unit of work are Ray tasks.

Placing tasks, moving bytes and running again what was lost is Ray's. Ray does not see that a task hangs, so a task
whose time is up ends its own process, and with that it is lost like any other. What travels are texts, numbers and the
frames of `oodil.workers.messages`. The run's folder has to be on storage that every node sees under the same path, and
every node has the same oodil installed.
"""

import faulthandler
import ipaddress
import os
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray.util import get_node_ip_address
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from oodil.pipeline.collecting import Follow, InlineRollouts, collect, nothing_follows
from oodil.pipeline.data import Unit, UnitResult
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.stage import JobStoppedError, Run, Stage
from oodil.pipeline.versions import collecting_versions
from oodil.workers import job as job_process
from oodil.workers.engine import Event, JobDone, JobFailed, JobProgress, JobStarted, JobWarning, OnEvent, Outcome
from oodil.workers.messages import Header, ResultMessage, UnitMessage, decode, encode
from oodil.workers.reports import Failed, Progress, Report, Warn, decode_report, encode_report
from oodil.workers.wire import MessageError, shortened

_POLL_S = 0.2
_LOST = "its process or its node is gone; Ray runs it again"
_HEADER = Header("", "", "ray", 0)
"""Ray knows which answer belongs to which question."""
_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def connect(trusted: bool) -> None:
    """Join the Ray cluster at RAY_ADDRESS or on this machine, or start one here if there is none.

    Raises ConfigError for a cluster of several machines without token authentication, unless it is ``trusted``: whoever
    reaches its ports can run programs on it.
    """
    authenticated = os.environ.get("RAY_AUTH_MODE") == "token"
    _refuse_unless(trusted or authenticated or _is_here(os.environ.get("RAY_ADDRESS", "")))
    ray.init(runtime_env={"env_vars": _ONE_THREAD}, include_dashboard=False, log_to_driver=False)
    addresses = {node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
    try:
        _refuse_unless(trusted or authenticated or addresses == {get_node_ip_address()})
    except ConfigError:
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
        raise ConfigError(
            "this Ray cluster spans machines and asks nobody for a token: start it with RAY_AUTH_MODE=token and set "
            "that here too, or say --trust-cluster where its network is closed"
        )


class RayEngine:
    """Runs jobs as Ray tasks; a distributed stage's job has its units collected by Ray tasks, too."""

    def __init__(self, stages: str = "oodil.pipeline.stages:stage_named") -> None:
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
        runtime = run.config.runtime
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        board: Any = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
        task = ray.remote(_run_job).options(max_retries=runtime.max_attempts - 1, retry_exceptions=True)
        running = {task.remote(board, path, self._stages, stage.name, job): job for job in jobs}
        reader = _Reader(runtime.max_attempts, on_event)
        outcome = Outcome()
        try:
            while running:
                if should_stop() and not outcome.stopped:
                    outcome.stopped = True
                    ray.get(board.stop.remote())
                ended, _ = ray.wait(list(running), timeout=_POLL_S)
                reader.take_in(ray.get(board.read.remote()))
                for reference in ended:
                    self._take_out(running.pop(reference), reference, reader, outcome)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)
            ray.kill(board)
        outcome.done.sort(key=jobs.index)
        return outcome

    def _take_out(self, job: str, reference: Any, reader: "_Reader", outcome: Outcome) -> None:
        try:
            ended = ray.get(reference)
        except ray.exceptions.RayError as error:
            outcome.failed[job] = reader.first_reason(job) or str(error)
            reader.lost_for_good(job)
        else:
            if ended == job_process.DONE:
                outcome.done.append(job)
                reader.done(job)
            else:
                outcome.not_run.append(job)


class _Reader:
    """Turns what jobs wrote on the board into the engine's events."""

    def __init__(self, max_attempts: int, on_event: OnEvent) -> None:
        self._max_attempts = max_attempts
        self._on_event = on_event
        self._attempts: Counter[str] = Counter()
        self._failures: Counter[str] = Counter()
        self._first_reason: dict[str, str] = {}

    def take_in(self, notes: list[tuple[str, bytes]]) -> None:
        for job, content in notes:
            for event in self._events(job, decode_report(content) if content else None):
                self._on_event(event)

    def first_reason(self, job: str) -> str:
        return self._first_reason.get(job, "")

    def lost_for_good(self, job: str) -> None:
        """The last attempt is over; say so unless it did itself."""
        if self._failures[job] < self._attempts[job]:
            self._on_event(self._failed(job, _LOST))

    def done(self, job: str) -> None:
        self._on_event(JobDone(job))

    def _events(self, job: str, report: Report | None) -> list[Event]:
        if report is None:
            gone = [self._failed(job, _LOST)] if self._failures[job] < self._attempts[job] else []
            self._attempts[job] += 1
            return [*gone, JobStarted(job, self._attempts[job])]
        if isinstance(report, Progress):
            return [JobProgress(job, report.done, report.total, report.metrics)]
        if isinstance(report, Warn):
            return [JobWarning(job, report.text)]
        if isinstance(report, Failed):
            return [self._failed(job, report.traceback)]
        raise MessageError(f"a job says nothing like {type(report).__name__}")

    def _failed(self, job: str, reason: str) -> JobFailed:
        self._failures[job] = self._attempts[job]
        self._first_reason.setdefault(job, reason)
        return JobFailed(job, self._attempts[job], self._attempts[job] < self._max_attempts, reason)


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

    def __init__(self, board: Any, job: str, set_back: Callable[[], None]) -> None:
        self._board = board
        self._job = job
        self._set_back = set_back
        self._next_question = 0.0
        self._is_stopping = False

    def begin(self) -> None:
        """Note that an attempt begins."""
        ray.get(self._board.write.remote(self._job, b""))

    def send(self, report: Report) -> None:
        """Put a report on the board; the clock that ends a hanging task begins again."""
        self._set_back()
        ray.get(self._board.write.remote(self._job, encode_report(report)))

    def should_stop(self) -> bool:
        """Return whether the orchestrator asked for an end; it is asked now and then."""
        if not self._is_stopping and time.monotonic() >= self._next_question:
            self._next_question = time.monotonic() + _POLL_S
            self._is_stopping = ray.get(self._board.is_stopping.remote())
        return self._is_stopping


@contextmanager
def _ended_after(timeout_s: float) -> Iterator[Callable[[], None]]:
    """End this process after a time, by a thread that no simulator can hold up; what is yielded sets the clock back."""

    def set_back() -> None:
        faulthandler.dump_traceback_later(timeout_s, exit=True)

    set_back()
    try:
        yield set_back
    finally:
        faulthandler.cancel_dump_traceback_later()


def _run_job(board: Any, run_path: str, stages: str, stage_name: str, job: str) -> str:
    """The task of a job; returns DONE or STOPPED."""
    stage, run = job_process.find(run_path, stages, stage_name)
    runtime = run.config.runtime
    rollouts = RayRollouts(runtime.unit_timeout_s) if stage.distributed else InlineRollouts()
    with _ended_after(runtime.job_timeout_s) as set_back:
        writer = _Writer(board, job, set_back)
        context = job_process.Context(writer.send, writer.should_stop, rollouts, runtime.checkpoint_interval_s)
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
        self._answers: dict[Any, int] = {}
        """Tasks and the iterations of their units, as they were submitted."""

    def submit(self, units: list[Unit]) -> None:
        """Hand over units, each as a task."""
        for unit in units:
            frames = encode(UnitMessage(_HEADER, unit))
            self._answers[self._collect.remote(self._versions, frames, self._unit_timeout_s)] = unit.iteration

    def gather(self, follow: Follow = nothing_follows) -> list[UnitResult]:
        """Wait for the iteration that was submitted first, see `RolloutSource`; raises what collecting raised."""
        first = min(self._answers.values())
        waiting = [answer for answer, iteration in self._answers.items() if iteration == first]
        results = []
        while waiting:
            (answer,), waiting = ray.wait(waiting, num_returns=1)
            del self._answers[answer]
            message = decode(ray.get(answer))
            if not isinstance(message, ResultMessage):
                raise MessageError(f"a unit was answered by {type(message).__name__}")
            results.append(message.result)
            self.submit(follow(message.result))
        return sorted(results, key=lambda result: result.group)


def _collect(versions: str, frames: list[bytes], timeout_s: float) -> list[bytes]:
    """The task of a unit: the frames of a UnitMessage in, those of a ResultMessage out."""
    _refuse_other_versions(versions)
    message = decode(frames)
    if not isinstance(message, UnitMessage):
        raise MessageError(f"asked to collect {type(message).__name__}")
    with _ended_after(timeout_s):
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
