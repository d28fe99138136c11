"""A job, a learner's included, wherever it runs: what it sees of the runtime, and how its artifact is written."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from oodil.pipeline.artifacts import RunDirectory, write_artifact
from oodil.pipeline.collecting import InlineRollouts, RolloutSource
from oodil.pipeline.config import RunConfig
from oodil.pipeline.loading import find_modules
from oodil.pipeline.metrics import Logger, Metrics
from oodil.pipeline.stage import JobStoppedError, Run, Stage, stage_named
from oodil.pipeline.versions import library_versions
from oodil.workers.channels import Access
from oodil.workers.reports import DONE, STOPPED, Progress, Report, Silent, Warn
from oodil.workers.supervisor import Link
from oodil.workers.threads import one_thread
from oodil.workers.wire import shortened

_REPORT_INTERVAL_S = 0.2
"""Progress is not reported more often than anybody can read."""


class Context:
    """A job's view of where it runs, the same for every engine: ``send`` takes its reports to the engine.

    All figures are kept by ``metrics``; the engine hears of some.
    """

    def __init__(
        self,
        rollouts: RolloutSource,
        checkpoint_interval_s: float,
        send: Callable[[Report], None],
        should_stop: Callable[[], bool],
        metrics: Metrics,
    ) -> None:
        self.rollouts = rollouts
        self.checkpoint_interval_s = checkpoint_interval_s
        self.should_stop = should_stop
        self._send = send
        self._metrics = metrics
        self._next_report = 0.0

    def progress(self, done: int, total: int, **metrics: float) -> None:
        """Report ``done`` of ``total`` environment steps (or iterations) and current figures; cheap to call often."""
        figures = {name: float(value) for name, value in metrics.items()}
        self._metrics.write(int(done), int(total), figures)
        now = time.monotonic()
        if now >= self._next_report or done >= total:
            self._next_report = now + _REPORT_INTERVAL_S
            self._send(Progress(int(done), int(total), figures))

    def warn(self, message: str) -> None:
        """Say something the user should see."""
        self._send(Warn(shortened(message)))


def run_job(
    stage: Stage,
    run: Run,
    job: str,
    rollouts: RolloutSource,
    send: Callable[[Report], None],
    should_stop: Callable[[], bool],
) -> str:
    """Run a job in this process, with one compute thread, and write its artifact.

    Its checkpoints are deleted when that is safe on disk.
    Returns DONE, or STOPPED when it stopped because ``should_stop`` returned true. Raises what the job raises.
    """
    directory = run.directory
    try:
        with (
            one_thread(),
            Metrics(
                directory.metrics(stage.name, job), directory.tensorboard(stage.name, job), _logger(run, stage, job)
            ) as metrics,
        ):
            interval_s = run.config.runtime.checkpoint_interval_s
            files = stage.run_job(run, job, Context(rollouts, interval_s, send, should_stop, metrics))
    except JobStoppedError:
        return STOPPED
    write_artifact(directory.job(stage.name, job), stage.job_origin(run, job), files, library_versions())
    stage.checkpoints(run, job).clear()
    return DONE


def _logger(run: Run, stage: Stage, job: str) -> Logger | None:
    """Return where a job's figures are shown besides; a run is a group of a project, and an attempt one of its runs."""
    config = run.config
    if config.runtime.logger is None:
        return None
    group, name = f"{config.name}-seed{config.seed}", f"{stage.name}/{job}"
    return Logger(config.runtime.logger, "oodil", group, name, run.directory.path)


def open_stage(run_path: str, name: str, module: str) -> tuple[Stage, Run]:
    """Return a stage, which importing ``module`` registers, and the run in a folder."""
    directory = RunDirectory(Path(run_path))
    config = RunConfig.model_validate_json(directory.config.read_text())
    find_modules(config)
    return stage_named(name, module), Run(config, directory)


def main(
    link: Link,
    run_path: str,
    stage: str,
    module: str,
    job: str,
    endpoint: str = "",
    run_id: str = "",
    address: str = "",
    keys: str = "",
) -> str:
    """Run one job in a process of its own and return its outcome.

    Rollout workers collect for it if there is an endpoint, those of other machines at the address.
    """
    found, run = open_stage(run_path, stage, module)
    access = Access(address, Path(keys)) if address else None
    with _rollouts(link, endpoint, run_id, run.config.runtime.unit_timeout_s, access) as rollouts:
        return run_job(found, run, job, rollouts, link.send, link.should_stop)


@contextmanager
def _rollouts(
    link: Link, endpoint: str, run_id: str, unit_timeout_s: float, access: Access | None
) -> Iterator[RolloutSource]:
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
