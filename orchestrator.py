"""The run: its folder, and the stages in order, each reused, resumed or computed.

Stages say what is computed, an engine says where; here it is only decided what has to be done. Nothing is printed and
no signal is handled here: an observer is told what happens, and a function is asked whether to stop.
"""

# First of all: ``python orchestrator.py`` is the command line, which loads what a command needs by itself.
if __name__ == "__main__":
    from oodil.cli import main

    main()

import json
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from oodil.pipeline.artifacts import RunDirectory, finished, remove_artifact, write_artifact, write_file
from oodil.pipeline.config import RunConfig
from oodil.pipeline.environments import check_environment
from oodil.pipeline.errors import ConfigError, StorageError, UnfinishedError
from oodil.pipeline.loading import parse_config
from oodil.pipeline.locks import held
from oodil.pipeline.metrics import check_logger
from oodil.pipeline.stage import Run, Stage, state_of
from oodil.pipeline.stages import stages
from oodil.pipeline.versions import library_versions
from oodil.workers.engine import Engine, Outcome
from oodil.workers.reports import Event

LOCK = ".lock"
"""Held in a run's folder by the process that works on the run."""


class Observer:
    """Whoever is told how a run goes; this one keeps silent. All calls come from the thread of `execute`."""

    def stage_reused(self, stage: str) -> None:
        """A finished stage is taken as it is."""

    def stage_started(self, stage: str, reason: str, jobs: int) -> None:
        """A stage begins with this many jobs; the reason says why it is computed again or goes on."""

    def stage_finished(self, stage: str, seconds: float) -> None:
        """A stage is done."""

    def event(self, event: Event) -> None:
        """An engine reports on a job."""


def open_run(path: Path, config: RunConfig, force: Collection[str] = ()) -> Run:
    """Create a run's folder, or accept one of the same run, and write the resolved configuration into it.

    Raises ConfigError, and leaves the folder as it is, when it holds something else, a finished stage of other settings
    that is not to be replaced (``force`` names those that are; what follows from them is replaced, too), or a run that
    another process works on, whose jobs would read the new configuration.
    """
    directory = RunDirectory(path)
    if not directory.config.exists():
        _make_folder(directory, config.demonstrations.file)
    with _lock(directory):
        run = Run(config, directory)
        if directory.config.exists():
            _refuse_another_run(path, config)
            refuse_to_replace(run, force)
        write_file(directory.config, (config.model_dump_json(indent=2) + "\n").encode())
    return run


def _make_folder(directory: RunDirectory, file: Path | None) -> None:
    """Make the folder of a new run, on a disk that has room for a copy of its demonstrations."""
    path = directory.path
    if path.is_file():
        raise ConfigError(f"{path}: is a file; choose another --run-dir")
    if path.exists() and {child.name for child in path.iterdir()} - {LOCK}:
        raise ConfigError(f"{path}: is not empty and not a run; choose another --run-dir")
    try:
        path.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path).free
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}") from error
    if file is not None and free < file.stat().st_size:
        raise StorageError(
            f"{path}: {free / 2**20:.1f} MiB are free, and a copy of {file} alone has {file.stat().st_size / 2**20:.1f}"
        )


def _refuse_another_run(path: Path, config: RunConfig) -> None:
    """Raise ConfigError if the folder holds a run that this configuration is not one of."""
    earlier = read_run(path).config
    for field in ("name", "seed", "environment"):
        old, new = getattr(earlier, field), getattr(config, field)
        if old != new:
            raise ConfigError(
                f"{path}: holds a run with {field} {_short(old)}, not {_short(new)}; choose another --run-dir"
            )


def read_run(path: Path) -> Run:
    """Return the run in a folder. Raises ConfigError if there is none."""
    directory = RunDirectory(path)
    if not directory.config.is_file():
        raise ConfigError(f"{path}: is not a run (it has no {directory.config.name})")
    try:
        values = json.loads(directory.config.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{directory.config}: cannot be read ({error})") from error
    return Run(parse_config(values, str(directory.config)), directory)


def refuse_to_replace(run: Run, force: Collection[str]) -> None:
    """Raise ConfigError if a finished stage was made by other code or with other settings and is not in ``force``.

    A stage whose input was replaced follows its input and needs no word of its own.
    """
    chosen = choose(run.config, force=force)
    replaced = set(force)
    for stage in chosen:
        if replaced.intersection(stage.inputs):
            replaced.add(stage.name)
        elif stage.name not in replaced:
            state = state_of(stage, run)
            if state.state == "stale" and not state.follows_input:
                raise ConfigError(
                    f"{run.directory.path}: {stage.name} is finished with other settings ({state.reason}); "
                    f"--force {stage.name} replaces it and what follows from it, another --run-dir keeps both"
                )


def check_inputs(config: RunConfig, run: Run | None = None) -> None:
    """Refuse, before any work, an environment that cannot be made and demonstrations that cannot fit it, and a
    logger that is not there.

    A ``run`` that has taken over its demonstrations is not asked for what they are from.
    """
    spec = check_environment(config.environment.id, config.environment.dynamics)
    for source in config.demonstrations.sources:
        check_environment(config.environment.id, source.dynamics)
    for stage in stages(config):
        stage.check_files(config, spec.observation_dim, run)
    check_logger(config.runtime.logger)


def choose(config: RunConfig, until: str | None = None, force: Collection[str] = ()) -> list[Stage]:
    """Return the stages of a run up to one of them, or all.

    Raises ConfigError, naming those there are, for a name that is none of them, be it of one to compute again, and for
    one to compute again that comes after the last.
    """
    chosen = stages(config)
    names = [stage.name for stage in chosen]
    for name in (*force, *([] if until is None else [until])):
        if name not in names:
            raise ConfigError(f"no stage {name!r}; this run has {', '.join(names)}")
    if until is None:
        return chosen
    for name in force:
        if names.index(name) > names.index(until):
            raise ConfigError(f"--force {name}: comes after --until {until}, so it would not be computed")
    return chosen[: names.index(until) + 1]


def execute(
    run: Run,
    chosen: Sequence[Stage],
    engine: Engine,
    observer: Observer | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    force: Collection[str] = (),
) -> None:
    """Bring every chosen stage to its finished artifact; finished ones in ``force`` are computed again.

    Raises UnfinishedError where that ends early, and ConfigError if another process works on the run.
    """
    observer = observer or Observer()
    with _lock(run.directory):
        _refuse_other_configuration(run)
        _record(run.directory, "run_started", engine=str(engine), versions=library_versions())
        for stage in chosen:
            _execute_stage(stage, run, engine, observer, should_stop, force)
        _record(run.directory, "run_finished")


def _refuse_other_configuration(run: Run) -> None:
    """Raise ConfigError if the folder's configuration, which jobs read, has become another since the run was opened."""
    if run.directory.config.exists():
        written = read_run(run.directory.path).config.model_copy(update={"runtime": run.config.runtime})
        if written.model_dump() != run.config.model_dump():
            raise ConfigError(f"{run.directory.path}: another process has changed its configuration")


def _execute_stage(
    stage: Stage,
    run: Run,
    engine: Engine,
    observer: Observer,
    should_stop: Callable[[], bool],
    force: Collection[str],
) -> None:
    state = state_of(stage, run)
    # Of a stale stage, only the jobs that differ are computed again.
    forced = state.state == "done" and stage.name in force
    if state.state == "done" and not forced:
        observer.stage_reused(stage.name)
        return
    started = time.monotonic()
    reason = f"recomputed: {state.reason}" if state.state in ("stale", "damaged") else ""
    pending = _pending(stage, run, forced)
    resumed = [job for job in pending if stage.checkpoints(run, job).exist()]
    if forced:
        reason = "computed again as asked"
    elif resumed:
        reason = "resumed from checkpoint" + ("" if resumed == [stage.name] else f" ({', '.join(resumed)})")
    observer.stage_started(stage.name, reason, len(pending))
    _record(run.directory, "stage_started", stage=stage.name, reason=reason, jobs=len(pending))
    outcome = engine.run_jobs(stage, run, pending, observer.event, should_stop)
    if outcome.stopped or outcome.failed:
        _record(run.directory, "stage_interrupted", stage=stage.name, seconds=time.monotonic() - started)
        raise _unfinished(run, stage, outcome)
    files = stage.combine(run)
    if files is not None:
        write_artifact(run.directory.stage(stage.name), stage.origin(run), files, library_versions())
    seconds = time.monotonic() - started
    _record(run.directory, "stage_finished", stage=stage.name, seconds=seconds)
    observer.stage_finished(stage.name, seconds)


def _unfinished(run: Run, stage: Stage, outcome: Outcome) -> UnfinishedError:
    """Say what became of a stage's jobs, and how to go on."""
    failures = "".join(f"{stage.name}/{job} failed:\n{traceback}\n\n" for job, traceback in outcome.failed.items())
    done = len(stage.jobs(run)) - len(outcome.failed) - len(outcome.not_run)
    return UnfinishedError(
        f"{failures}{stage.name}: {done} jobs done, {len(outcome.failed)} failed, {len(outcome.not_run)} not finished. "
        f"What is finished is kept; go on with:\n  oodil resume {run.directory.path}",
        stage.name,
        outcome.failed,
        outcome.is_final,
    )


def _pending(stage: Stage, run: Run, forced: bool) -> list[str]:
    """Return the jobs whose artifacts are not current, and clear away what is in their place."""
    if forced:  # First of all: without its jobs it is not finished any more, wherever this ends.
        remove_artifact(run.directory.stage(stage.name))
    pending = []
    for job in stage.jobs(run):
        path = run.directory.job(stage.name, job)
        if forced:
            stage.checkpoints(run, job).clear()
        if forced or finished(path, stage.job_origin(run, job)) is None:
            remove_artifact(path)
            pending.append(job)
    return pending


@contextmanager
def _lock(directory: RunDirectory) -> Iterator[None]:
    """Hold the run for this process."""
    with held(directory.path / LOCK) as is_held:
        if not is_held:
            raise ConfigError(f"{directory.path}: another process is working on this run")
        yield


def _record(directory: RunDirectory, event: str, **fields: Any) -> None:
    """Append to the run's log, the place for times, worker counts and everything else that varies."""
    try:
        with open(directory.events, "a") as file:
            file.write(json.dumps({"time": time.time(), "event": event, **fields}) + "\n")
    except OSError as error:
        raise StorageError(f"{directory.events}: {error.strerror or error}") from error


def _short(value: Any) -> str:
    return json.dumps(value.model_dump() if hasattr(value, "model_dump") else value)
