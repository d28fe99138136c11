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
from oodil.pipeline.loading import find_modules_in
from oodil.pipeline.stage import Run, Stage
from oodil.pipeline.versions import collecting_versions
from oodil.workers import job as job_process
from oodil.workers.engine import POLL_S, JobLedger, OnEvent, Outcome, ShouldStop, refuse_main
from oodil.workers.messages import Header, ResultMessage, UnitMessage, decode, encode
from oodil.workers.reports import STOPPED, Failed, Finished, Report, decode_report, encode_report, failure
from oodil.workers.threads import limit_this_process
from oodil.workers.wire import MessageError

_LOST = "its process or its node is gone"
_HEADER = Header("", "", "ray", 0)
"""Ray knows which answer belongs to which question."""


def connect(trusted: bool) -> None:
    """Join the Ray cluster at RAY_ADDRESS or on this machine, or start one here if there is none.

    Raises ConfigError for a cluster of several machines without token authentication, unless it is ``trusted``: whoever
    reaches its ports can run programs on it.
    """
    authenticated = os.environ.get("RAY_AUTH_MODE") == "token"
    _refuse_unless(trusted or authenticated or _is_here(os.environ.get("RAY_ADDRESS", "")))
    ray.init(include_dashboard=False, log_to_driver=False)
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

    def __str__(self) -> str:
        return "ray"

    def run_jobs(self, stage: Stage, run: Run, jobs: list[str], on_event: OnEvent, should_stop: ShouldStop) -> Outcome:
        """Run jobs until each is done or has failed; see `Engine`.

        Raises ConfigError when a node does not see the run's folder or has other libraries.
        """
        refuse_main(stage)
        path = str(run.directory.path.absolute())
        _check_nodes(path)
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        board: Any = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
        # Ray tries nothing again by itself: the ledger knows which attempts got further.
        task = ray.remote(_run_job).options(max_retries=0)
        ledger = JobLedger(jobs, run.config.runtime, on_event)
        due = dict.fromkeys(jobs, 0.0)
        running: dict[Any, str] = {}
        try:
            while running or (due and not ledger.stopped):
                if not ledger.stopped and should_stop():
                    ledger.stopped = True
                    ray.get(board.stop.remote())
                for job in [job for job, at in due.items() if at <= time.monotonic() and not ledger.stopped]:
                    del due[job]
                    ledger.begin(job)
                    running[task.remote(board, path, stage.name, stage.module, job)] = job
                ended = _wait(list(running))
                for job, content in ray.get(board.read.remote()):
                    ledger.report(job, decode_report(content))
                for reference in ended:
                    job, words = running.pop(reference), _last_words(reference)
                    if isinstance(words, Finished):
                        ledger.finished(job, words.outcome)
                        continue
                    delay_s = ledger.failed(job, words.reason, words.is_final)
                    if delay_s is not None:
                        due[job] = time.monotonic() + delay_s
        finally:
            for reference in running:
                ray.cancel(reference, force=True)
            ray.kill(board)
        return ledger.outcome()


def _wait(running: list[Any]) -> list[Any]:
    """Wait for a while; return the tasks that have ended."""
    if not running:
        time.sleep(POLL_S)
        return []
    return list(ray.wait(running, timeout=POLL_S)[0])


def _last_words(reference: Any) -> Finished | Failed:
    """Return what a task that has ended returned, or how it was lost."""
    try:
        words = decode_report(ray.get(reference))
    except ray.exceptions.RayError as error:
        return Failed(f"{error}\n{_LOST}")
    assert isinstance(words, Finished | Failed)
    return words


class _Board:
    """An actor beside the orchestrator: what jobs say until it is read, and whether they should stop."""

    def __init__(self) -> None:
        self._reports: list[tuple[str, bytes]] = []
        self._is_stopping = False

    def write(self, job: str, report: bytes) -> None:
        """Keep a job's report."""
        self._reports.append((job, report))

    def read(self) -> list[tuple[str, bytes]]:
        """Return what was written since the last time."""
        reports, self._reports = self._reports, []
        return reports

    def stop(self) -> None:
        """Ask all jobs to stop."""
        self._is_stopping = True

    def is_stopping(self) -> bool:
        """Return whether jobs should stop."""
        return self._is_stopping


class _Writer:
    """A job's end of the board."""

    def __init__(self, board: Any, job: str, reset_timer: Callable[[], None]) -> None:
        self._board = board
        self._job = job
        self._reset_timer = reset_timer
        self._next_question = 0.0
        self._is_stopping = False

    def send(self, report: Report) -> None:
        """Put a report on the board; the time allowed without any begins again."""
        self._reset_timer()
        ray.get(self._board.write.remote(self._job, encode_report(report)))

    def should_stop(self) -> bool:
        """Return whether the orchestrator asked for an end; it is asked now and then."""
        if not self._is_stopping and time.monotonic() >= self._next_question:
            self._next_question = time.monotonic() + POLL_S
            self._is_stopping = ray.get(self._board.is_stopping.remote())
        return self._is_stopping


@contextmanager
def _ended_after(timeout_s: float) -> Iterator[Callable[[], None]]:
    """End this process after a time, by a thread that no simulator can hold up; what is yielded starts it anew."""

    def reset_timer() -> None:
        faulthandler.dump_traceback_later(timeout_s, exit=True)

    reset_timer()
    try:
        yield reset_timer
    finally:
        faulthandler.cancel_dump_traceback_later()


def _run_job(board: Any, run_path: str, stage_name: str, module: str, job: str) -> bytes:
    """The task of a job; returns its last report."""
    stage, run = job_process.open_stage(run_path, stage_name, module)
    runtime = run.config.runtime
    rollouts = (
        RayRollouts(runtime.unit_timeout_s, str(runtime.modules or "")) if stage.distributed else InlineRollouts()
    )
    with _ended_after(runtime.job_timeout_s) as reset_timer:
        writer = _Writer(board, job, reset_timer)
        if writer.should_stop():
            return encode_report(Finished(STOPPED))
        try:
            outcome = job_process.run_job(stage, run, job, rollouts, writer.send, writer.should_stop)
        except Exception as error:
            return encode_report(failure(error))
        return encode_report(Finished(outcome))


class RayRollouts:
    """A rollout source whose units are Ray tasks. Ray runs a unit again wherever it was lost."""

    def __init__(self, unit_timeout_s: float, modules: str = "") -> None:
        self._unit_timeout_s = unit_timeout_s
        self._modules = modules
        """Folder of modules that a unit's environment may be in."""
        self._collect = ray.remote(_collect).options(max_retries=-1)
        self._versions = collecting_versions()
        self._answers: dict[Any, int] = {}
        """Tasks and the iterations of their units, as they were submitted."""

    def submit(self, units: list[Unit]) -> None:
        """Hand over units, each as a task."""
        for unit in units:
            frames = encode(UnitMessage(_HEADER, unit))
            self._answers[self._collect.remote(self._versions, frames, self._unit_timeout_s, self._modules)] = (
                unit.iteration
            )

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


def _collect(versions: str, frames: list[bytes], timeout_s: float, modules: str) -> list[bytes]:
    """The task of a unit: the frames of a UnitMessage in, those of a ResultMessage out."""
    limit_this_process()
    _refuse_other_versions(versions)
    if modules:
        find_modules_in(modules)
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
