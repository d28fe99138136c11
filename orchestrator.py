"""The run: its folder, and the walk over the stages that reuses, resumes or computes each.

Stages say what is computed, an engine says where; here it is only decided what has to be done.
"""

import fcntl
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from oodil.pipeline.artifacts import Artifact, RunDirectory, read_artifact, remove_artifact, write_artifact, write_file
from oodil.pipeline.config import RunConfig
from oodil.pipeline.environments import check_environment
from oodil.pipeline.errors import ConfigError, DamagedArtifactError, OodilError
from oodil.pipeline.loading import parse_config
from oodil.pipeline.results import Results, summary
from oodil.pipeline.stage import Run, Stage, is_current
from oodil.pipeline.stages import stages
from oodil.pipeline.stages.demonstrations import check_demonstrations
from oodil.pipeline.versions import library_versions
from oodil.terminal import Display, stop_flag
from oodil.workers.engine import Engine, Outcome


class UnfinishedError(OodilError):
    """A stage failed or was stopped; what was finished is kept."""

    def __init__(self, stage: str, outcome: Outcome) -> None:
        super().__init__(stage)
        self.stage = stage
        self.outcome = outcome


def open_run(path: Path, config: RunConfig) -> Run:
    """Create a run's folder, or accept one of the same run, and write the resolved configuration into it.

    Raises ConfigError when the folder holds something else.
    """
    directory = RunDirectory(path)
    if directory.config.exists():
        held = read_run(path).config
        for field in ("name", "seed", "environment"):
            old, new = getattr(held, field), getattr(config, field)
            if old != new:
                raise ConfigError(
                    f"{path}: holds a run with {field} {_short(old)}, not {_short(new)}; choose another --run-dir"
                )
    elif path.exists() and any(path.iterdir()):
        raise ConfigError(f"{path}: is not empty and not a run; choose another --run-dir")
    path.mkdir(parents=True, exist_ok=True)
    write_file(directory.config, (config.model_dump_json(indent=2) + "\n").encode())
    return Run(config, directory)


def read_run(path: Path) -> Run:
    """Return the run in a folder. Raises ConfigError if there is none."""
    directory = RunDirectory(path)
    if not directory.config.is_file():
        raise ConfigError(f"{path}: is not a run (it has no {directory.config.name})")
    return Run(parse_config(json.loads(directory.config.read_text()), str(directory.config)), directory)


def check_inputs(config: RunConfig) -> None:
    """Refuse, before any work, an environment that cannot be made and demonstrations that cannot fit it."""
    simulators = check_environment(config.environment.id, config.environment.dynamics)
    for name in ("transferability", "imitation"):
        ignored = getattr(config, name).gail.discriminator.ignored
        if not set(ignored) < set(range(simulators.observation_dim)):
            raise ConfigError(
                f"{name}.gail.discriminator.ignored is {list(ignored)}; states have the dimensions 0 to "
                f"{simulators.observation_dim - 1}, of which at least one must be seen"
            )
    for source in config.demonstrations.sources:
        check_environment(config.environment.id, source.dynamics)
    check_demonstrations(config, simulators.observation_dim)


def walk(run: Run, chosen: list[Stage], engine: Engine, force: str | None = None) -> None:
    """Bring every chosen stage to its finished artifact. Raises UnfinishedError where that ends early."""
    with _lock(run.directory), Display() as display, stop_flag(display.stopping) as should_stop:
        _record(run.directory, "run_started", engine=str(engine), versions=library_versions())
        for stage in chosen:
            _bring_up(stage, run, engine, force == stage.name, display, should_stop)
        _record(run.directory, "run_finished")


def _bring_up(
    stage: Stage,
    run: Run,
    engine: Engine,
    forced: bool,
    display: Display,
    should_stop: Callable[[], bool],
) -> None:
    origin, path = stage.origin(run), run.directory.stage(stage.name)
    found, reason = _inspect(path, origin)
    if found is not None and not forced:
        display.reused(stage.name)
        return
    started = time.monotonic()
    pending = _pending(stage, run, forced)
    resumed = [job for job in pending if stage.checkpoints(run, job).exist()]
    if forced:
        reason = "computed again as asked"
    elif resumed:
        reason = "resumed from checkpoint" + ("" if resumed == [stage.name] else f" ({', '.join(resumed)})")
    display.stage_started(stage.name, reason, len(pending))
    _record(run.directory, "stage_started", stage=stage.name, reason=reason, jobs=len(pending))
    outcome = engine.run_jobs(stage, run, pending, display.event, should_stop)
    if outcome.stopped or outcome.failed:
        _record(run.directory, "stage_interrupted", stage=stage.name, seconds=time.monotonic() - started)
        raise UnfinishedError(stage.name, outcome)
    files = stage.combine(run)
    if files is not None:
        write_artifact(path, origin, files, library_versions())
    seconds = time.monotonic() - started
    _record(run.directory, "stage_finished", stage=stage.name, seconds=seconds)
    display.stage_finished(stage.name, seconds)


def _pending(stage: Stage, run: Run, forced: bool) -> list[str]:
    """Return the jobs whose artifacts are not current, and clear away what is in their place."""
    pending = []
    for job in stage.jobs(run):
        path = run.directory.job(stage.name, job)
        if forced:
            stage.checkpoints(run, job).clear()
        if forced or _inspect(path, stage.job_origin(run, job))[0] is None:
            remove_artifact(path)
            pending.append(job)
    return pending


def _inspect(path: Path, origin: dict[str, Any]) -> tuple[Artifact | None, str]:
    """Return a current, undamaged artifact, or None and the reason to compute it."""
    try:
        artifact = read_artifact(path)
        if artifact is None:
            return None, ""
        if not is_current(artifact, origin):
            return None, f"recomputed: {_difference(artifact.origin, origin)}"
        artifact.verify()
    except DamagedArtifactError as error:
        return None, f"recomputed: {error}"
    return artifact, ""


def _difference(old: Any, new: Any, key: str = "") -> str:
    """Name the first place where two origins differ, as ``key old -> new``."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in sorted({*old, *new}):
            if old.get(name) != new.get(name):
                return _difference(old.get(name), new.get(name), f"{key}.{name}" if key else name)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (a, b) in enumerate(zip(old, new, strict=True)):
            if a != b:
                return _difference(a, b, f"{key}[{i}]")
    if key.startswith("inputs."):
        return f"its input {key.removeprefix('inputs.')} changed"
    return f"{key.removeprefix('settings.')} {old!r} -> {new!r}"


def describe(run: Run) -> dict[str, Any]:
    """Return the state of every stage and the results known so far, as JSON values."""
    seconds = Results(run).seconds()
    described = {}
    for stage in stages(run.config):
        entry: dict[str, Any] = {"state": "pending", "sha256": None}
        try:
            artifact = read_artifact(run.directory.stage(stage.name))
            if artifact is not None:
                artifact.verify()
                entry = {"state": "done", "sha256": artifact.sha256}
            elif run.directory.has_begun(stage.name):
                entry["state"] = "partial"
        except DamagedArtifactError as error:
            entry = {"state": "damaged", "sha256": None, "reason": str(error)}
        described[stage.name] = entry | ({"seconds": round(seconds[stage.name], 1)} if stage.name in seconds else {})
    return {
        "run": str(run.directory.path),
        "name": run.config.name,
        "seed": run.config.seed,
        "stages": described,
        "results": summary(run),
    }


@contextmanager
def _lock(directory: RunDirectory) -> Iterator[None]:
    """Hold the run for this process; the lock goes with the process, however it ends."""
    with open(directory.path / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"{directory.path}: another process is working on this run") from None
        yield


def _record(directory: RunDirectory, event: str, **fields: Any) -> None:
    """Append to the run's log, the place for times, worker counts and everything else that varies."""
    with open(directory.events, "a") as file:
        file.write(json.dumps({"time": time.time(), "event": event, **fields}) + "\n")


def _short(value: Any) -> str:
    return json.dumps(value.model_dump() if hasattr(value, "model_dump") else value)


if __name__ == "__main__":
    from oodil.cli import main

    main()
