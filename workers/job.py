"""The process of a job, a learner's included: find the stage, run the job, write its artifact."""

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from oodil.workers.channels import Access
from oodil.workers.reports import Progress, Report, Silent, Warn
from oodil.workers.supervisor import Link
from oodil.workers.wire import shortened

if TYPE_CHECKING:
    # A job's process says that it runs before it loads what it computes with.
    from oodil.pipeline.stage import JobContext, Run, Stage
from oodil.pipeline.collecting import RolloutSource

DONE, STOPPED = "done", "stopped"
_REPORT_INTERVAL_S = 0.2


class Context:
    """A job's view of where it runs: ``send`` takes its reports to the orchestrator."""

    def __init__(
        self,
        send: Callable[[Report], None],
        should_stop: Callable[[], bool],
        rollouts: "RolloutSource",
        checkpoint_interval_s: float,
    ) -> None:
        self.should_stop = should_stop
        self.rollouts = rollouts
        self.checkpoint_interval_s = checkpoint_interval_s
        self._send = send
        self._next_report = 0.0

    def progress(self, done: int, total: int, **metrics: float) -> None:
        """Report progress, but not more often than anybody can read."""
        now = time.monotonic()
        if now >= self._next_report or done >= total:
            self._next_report = now + _REPORT_INTERVAL_S
            figures = {name: float(value) for name, value in metrics.items()}
            self._send(Progress(int(done), int(total), figures))

    def warn(self, message: str) -> None:
        """Pass a warning on."""
        self._send(Warn(shortened(message)))


def main(
    link: Link,
    run_path: str,
    stages: str,
    stage: str,
    job: str,
    endpoint: str = "",
    run_id: str = "",
    address: str = "",
    keys: str = "",
) -> str:
    """Run one job; rollout workers collect for it if there is an endpoint, those of other machines at the address.

    Returns DONE or STOPPED.
    """
    from oodil.pipeline.stage import JobStoppedError

    found, run = find(run_path, stages, stage)
    runtime = run.config.runtime
    access = Access(address, Path(keys)) if address else None
    with _rollouts(link, endpoint, run_id, runtime.unit_timeout_s, access) as rollouts:
        context = Context(link.send, link.should_stop, rollouts, runtime.checkpoint_interval_s)
        try:
            execute(found, run, job, context)
        except JobStoppedError:
            return STOPPED
    return DONE


def find(run_path: str, stages: str, name: str) -> "tuple[Stage, Run]":
    """Return a stage of the run in a folder; ``stages`` is module:function for ``(config, name) -> Stage``."""
    from oodil.pipeline.artifacts import RunDirectory
    from oodil.pipeline.config import RunConfig
    from oodil.pipeline.stage import Run

    directory = RunDirectory(Path(run_path))
    config = RunConfig.model_validate_json(directory.config.read_text())
    module, _, function = stages.partition(":")
    return getattr(importlib.import_module(module), function)(config, name), Run(config, directory)


def execute(stage: "Stage", run: "Run", job: str, context: "JobContext") -> None:
    """Run a job in this process and write its artifact; its checkpoints go when that is safe on disk."""
    from oodil.pipeline.artifacts import write_artifact
    from oodil.pipeline.versions import library_versions

    files = stage.run_job(run, job, context)
    write_artifact(run.directory.job(stage.name, job), stage.job_origin(run, job), files, library_versions())
    stage.checkpoints(run, job).clear()


@contextmanager
def _rollouts(
    link: Link, endpoint: str, run_id: str, unit_timeout_s: float, access: Access | None
) -> "Iterator[RolloutSource]":
    from oodil.pipeline.collecting import InlineRollouts
    from oodil.workers.zmq_rollouts import ZmqRollouts

    if not endpoint:
        yield InlineRollouts()
        return
    # The identity of this process is new with every attempt, and so is the learner's incarnation.
    rollouts = ZmqRollouts(
        endpoint,
        run_id,
        incarnation=link.identity,
        unit_timeout_s=unit_timeout_s,
        should_stop=link.should_stop,
        report_silent=lambda worker: link.send(Silent(worker)),
        access=access,
    )
    try:
        yield rollouts
    finally:
        rollouts.close()
