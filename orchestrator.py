"""The command line, and the run: load the configuration, walk the stages, reuse, resume or compute each, report.

No mathematics and no sockets: stages say what is computed, an engine where it runs, `terminal` how it looks. Heavy imports
follow argument parsing, so that ``--help`` answers at once.
"""

import os

# Before NumPy and torch are loaded: one compute thread per process, so that the bits do not depend on the machine's cores.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import fcntl
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from pipeline.artifacts import Artifact, RunDirectory
    from pipeline.config import RunConfig
    from pipeline.stage import Run, Stage
    from terminal import Display

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_STOPPED = 1, 2, 130

app = typer.Typer(
    name="oodil",
    help="Imitation learning from demonstrators whose dynamics differ from your robot's.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
demos_app = typer.Typer(help="Inspect and collect demonstrations.", no_args_is_help=True)
app.add_typer(demos_app, name="demos")

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="A YAML file; configs/ has examples.")]
Overrides = Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Fields to override.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN_DIR", help="The folder of a run.")]
Workers = Annotated[int | None, typer.Option("--workers", "-w", min=0, help="Parallel processes; 0 runs inline.")]
Until = Annotated[str | None, typer.Option(help="Stop after this stage.")]
Force = Annotated[str | None, typer.Option(help="Compute this stage again although it is finished.")]


@app.command()
def run(
    config_path: ConfigPath,
    overrides: Overrides = None,
    workers: Workers = None,
    run_dir: Annotated[Path | None, typer.Option(help="Default: runs/NAME-seedSEED.")] = None,
    until: Until = None,
    force: Force = None,
) -> None:
    """Run the pipeline; what is already finished is reused, what was interrupted goes on."""
    from pipeline.config import load_config

    with _bad_input():
        config = load_config(config_path, overrides)
        directory = _open_run_directory(run_dir or Path("runs") / f"{config.name}-seed{config.seed}", config)
        _check_inputs(config)
    _execute(config, directory, workers, until, force)


@app.command()
def resume(run_dir: RunPath, workers: Workers = None, until: Until = None, force: Force = None) -> None:
    """Go on with an interrupted run, with any number of workers."""
    with _bad_input():
        opened = _read_run(run_dir)
        _check_inputs(opened.config)
    _execute(opened.config, opened.directory, workers, until, force)


@app.command()
def status(run_dir: RunPath, as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False) -> None:
    """Say which stages are finished and what is known so far."""
    from terminal import print_status

    with _bad_input():
        opened = _read_run(run_dir)
    described = _describe(opened)
    if as_json:
        print(json.dumps(described, indent=2))
    else:
        print_status(described)


@app.command()
def report(run_dir: RunPath) -> None:
    """Write the report anew, of whatever is finished."""
    from pipeline.report import write_report

    with _bad_input():
        opened = _read_run(run_dir)
    print(write_report(opened))


@app.command()
def evaluate(
    run_dir: RunPath,
    episodes: Annotated[int, typer.Option(min=1, help="Deterministic episodes.")] = 32,
    stage: Annotated[str, typer.Option(help="Whose policy: imitation, naive_gail or oracle.")] = "imitation",
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = 0,
    video: Annotated[bool, typer.Option("--video", help="Also film one episode.")] = False,
) -> None:
    """Evaluate a trained policy on the true return of the imitator's environment."""
    with _bad_input():
        opened = _read_run(run_dir)
        policy = _trained_policy(opened, stage)
    from pipeline.evaluation import evaluate as evaluate_policy
    from pipeline.evaluation import film
    from pipeline.seeding import derive_key

    environment = opened.config.environment
    seen = evaluate_policy(policy, environment.id, environment.dynamics, episodes, derive_key(seed, "evaluate"))
    print(
        f"{stage}: return {seen.returns.mean():.1f} +- {seen.returns.std():.1f}, "
        f"length {seen.lengths.mean():.0f}, {episodes} deterministic episodes, seed {seed}"
    )
    if video:
        path = opened.directory.path / f"{stage}.mp4"
        with _bad_input():
            film(policy, environment.id, environment.dynamics, seed, path)
        print(path)


@demos_app.command("inspect")
def inspect_demos(path: Annotated[Path, typer.Argument(help="A file of demonstrations, or a run's folder.")]) -> None:
    """Show what a set of demonstrations contains."""
    from pipeline.datasets import read_demonstrations
    from terminal import print_demonstrations

    with _bad_input():
        if path.is_dir():
            file = _read_run(path).artifact("demonstrations").path / "demonstrations.safetensors"
        else:
            file = path
        demonstrations, environment = read_demonstrations(file)
    print_demonstrations(file, demonstrations, environment)


@demos_app.command("collect")
def collect_demos(
    config_path: ConfigPath,
    overrides: Overrides = None,
    train: Annotated[bool, typer.Option("--train", help="Train the experts anew first, and save them.")] = False,
    output: Annotated[Path, typer.Option(help="The file to write.")] = Path("demonstrations.safetensors"),
    workers: Workers = None,
) -> None:
    """Collect demonstrations from the experts of a configuration into one file."""
    from pipeline.config import load_config
    from pipeline.stages.experts import ExpertsStage

    with _bad_input():
        config = load_config(config_path, overrides)
    scratch = _scratch(output)
    if train:
        with _bad_input():
            directory = _open_run_directory(scratch, config)
        _walk(config, directory, [ExpertsStage()], workers, None)
        print("\n".join(ExpertsStage().export(_as_run(config, directory))))
    with _bad_input():
        _check_inputs(config)
        directory = _open_run_directory(scratch, config)
    _walk(config, directory, _stages(config)[:1], workers, None)
    source = _as_run(config, directory).artifact("demonstrations").path / "demonstrations.safetensors"
    output.write_bytes(source.read_bytes())
    inspect_demos(output)


def _scratch(output: Path) -> Path:
    return output.with_name(f".{output.name}.run")


# --- the run -----------------------------------------------------------------------------------------------------------


def _execute(
    config: "RunConfig", directory: "RunDirectory", workers: int | None, until: str | None, force: str | None
) -> None:
    """Walk all stages, then write the report and print the summary."""
    from pipeline.report import write_report
    from pipeline.results import summary
    from terminal import print_summary

    stages = _stages(config)
    with _bad_input():
        for name in (until, force):
            if name is not None and name not in (known := [stage.name for stage in stages]):
                raise ValueError(f"no stage {name!r}; this run has {', '.join(known)}")
    last = next((i for i, stage in enumerate(stages) if stage.name == until), len(stages) - 1)
    try:
        _walk(config, directory, stages[: last + 1], workers, force)
    finally:
        opened = _as_run(config, directory)
        path = write_report(opened)
    print_summary(summary(opened), path)


def _walk(
    config: "RunConfig", directory: "RunDirectory", stages: list["Stage"], workers: int | None, force: str | None
) -> None:
    """Bring every stage to its finished artifact, or exit with what went wrong."""
    from pipeline.versions import library_versions
    from terminal import Display
    from workers.engine import LocalEngine

    with _bad_input():
        lock = _lock(directory)
    workers = config.runtime.workers if workers is None else workers
    engine = LocalEngine(workers)
    opened = _as_run(config, directory)
    with lock, Display() as display, _stop_flag(display) as should_stop:
        _record(directory, "run_started", workers=workers, versions=library_versions())
        for stage in stages:
            _bring_up(stage, opened, engine, workers, force == stage.name, display, should_stop)
        _record(directory, "run_finished")


def _bring_up(
    stage: "Stage",
    opened: "Run",
    engine: Any,
    workers: int,
    forced: bool,
    display: "Display",
    should_stop: Callable[[], bool],
) -> None:
    from pipeline.artifacts import remove_artifact, write_artifact
    from pipeline.stage import is_current
    from pipeline.versions import library_versions

    origin = stage.origin(opened)
    path = opened.directory.stage(stage.name)
    found, reason = _inspect(path, origin)
    if found is not None and not forced:
        display.reused(stage.name)
        return
    started = time.monotonic()
    pending = []
    for job in stage.jobs(opened):
        job_path = opened.directory.job(stage.name, job)
        artifact, _ = _inspect(job_path, stage.job_origin(opened, job))
        if forced:
            stage.checkpoints(opened, job).clear()
        if artifact is None or forced:
            pending.append(job)
            remove_artifact(job_path)
    resumed = [job for job in pending if stage.checkpoints(opened, job).exist()]
    if forced:
        reason = "computed again as asked"
    elif resumed:
        reason = f"resumed from checkpoint ({', '.join(resumed)})" if resumed != [stage.name] else "resumed from checkpoint"
    display.stage_started(stage.name, reason, len(pending))
    _record(opened.directory, "stage_started", stage=stage.name, reason=reason, workers=workers)
    outcome = engine.run_jobs(stage, opened, pending, display.event, should_stop)
    seconds = time.monotonic() - started
    if outcome.stopped or outcome.failed:
        _record(opened.directory, "stage_interrupted", stage=stage.name, seconds=seconds)
        display.close()
        _give_up(stage.name, outcome, opened.directory)
    files = stage.combine(opened)
    if files is not None:
        write_artifact(path, origin, files, library_versions())
    seconds = time.monotonic() - started
    _record(opened.directory, "stage_finished", stage=stage.name, seconds=seconds, workers=workers)
    display.stage_finished(stage.name, seconds)


def _inspect(path: Path, origin: dict[str, Any]) -> tuple["Artifact | None", str]:
    """Return a current, undamaged artifact, or None and the reason to compute it."""
    from pipeline.artifacts import DamagedArtifactError, read_artifact
    from pipeline.stage import is_current

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


def _give_up(stage: str, outcome: Any, directory: "RunDirectory") -> NoReturn:
    for job, traceback in outcome.failed.items():
        print(f"\n{stage}/{job} failed:\n{traceback}", file=sys.stderr)
    print(
        f"\n{stage}: {len(outcome.done)} jobs done, {len(outcome.failed)} failed, {len(outcome.not_run)} not run. "
        f"Finished work is kept; go on with: oodil resume {directory.path}",
        file=sys.stderr,
    )
    raise typer.Exit(EXIT_FAILED if outcome.failed else EXIT_STOPPED)


@contextmanager
def _stop_flag(display: "Display") -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a polite stop; a second one ends the run at once."""
    received: list[int] = []

    def handle(number: int, _frame: Any) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        display.say("stopping after a checkpoint; press Ctrl-C again to stop at once")

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


# --- the run directory -------------------------------------------------------------------------------------------------


def _stages(config: "RunConfig") -> list["Stage"]:
    from pipeline.stages import stages

    return stages(config)


def _as_run(config: "RunConfig", directory: "RunDirectory") -> "Run":
    from pipeline.stage import Run

    return Run(config, directory)


def _open_run_directory(path: Path, config: "RunConfig") -> "RunDirectory":
    """Create the folder, or accept one of the same run, and write the resolved configuration into it."""
    from pipeline.artifacts import RunDirectory, write_file
    from pipeline.config import ConfigError, parse_config

    directory = RunDirectory(path)
    if directory.config.exists():
        held = parse_config(json.loads(directory.config.read_text()), str(directory.config))
        for field in ("name", "seed", "environment"):
            old, new = getattr(held, field), getattr(config, field)
            if old != new:
                raise ConfigError(f"{path}: holds a run with {field} {_short(old)}, not {_short(new)}; choose another --run-dir")
    elif path.exists() and any(path.iterdir()):
        raise ConfigError(f"{path}: is not empty and not a run; choose another --run-dir")
    path.mkdir(parents=True, exist_ok=True)
    write_file(directory.config, (config.model_dump_json(indent=2) + "\n").encode())
    return directory


def _short(value: Any) -> str:
    return json.dumps(value.model_dump() if hasattr(value, "model_dump") else value)


def _read_run(path: Path) -> "Run":
    from pipeline.artifacts import RunDirectory
    from pipeline.config import ConfigError, parse_config

    directory = RunDirectory(path)
    if not directory.config.is_file():
        raise ConfigError(f"{path}: is not a run (it has no {directory.config.name})")
    return _as_run(parse_config(json.loads(directory.config.read_text()), str(directory.config)), directory)


def _check_inputs(config: "RunConfig") -> None:
    """Refuse, before any work, an environment that cannot be made and demonstrations that cannot fit it."""
    from pipeline.environments import make_batch
    from pipeline.stages.demonstrations import check_demonstrations

    simulators = make_batch(config.environment.id, config.environment.dynamics, 1)
    for source in config.demonstrations.sources:
        make_batch(config.environment.id, source.dynamics, 1)
    check_demonstrations(config, simulators.observation_dim)


def _trained_policy(opened: "Run", stage: str) -> Any:
    from pipeline.policy import GaussianPolicy

    return GaussianPolicy.from_arrays(opened.artifact(stage).arrays("policy.safetensors"))


def _describe(opened: "Run") -> dict[str, Any]:
    """Return the state of every stage and the results known so far, as JSON values."""
    from pipeline.artifacts import DamagedArtifactError, read_artifact
    from pipeline.results import Results, summary

    seconds = Results(opened).seconds()
    described = {}
    for stage in _stages(opened.config):
        entry: dict[str, Any] = {"state": "pending", "sha256": None}
        try:
            artifact = read_artifact(opened.directory.stage(stage.name))
            if artifact is not None:
                artifact.verify()
                entry = {"state": "done", "sha256": artifact.sha256}
            elif opened.directory.has_begun(stage.name):
                entry["state"] = "partial"
        except DamagedArtifactError as error:
            entry = {"state": "damaged", "sha256": None, "reason": str(error)}
        described[stage.name] = entry | ({"seconds": round(seconds[stage.name], 1)} if stage.name in seconds else {})
    return {
        "run": str(opened.directory.path),
        "name": opened.config.name,
        "seed": opened.config.seed,
        "stages": described,
        "results": summary(opened),
    }


def _record(directory: "RunDirectory", event: str, **fields: Any) -> None:
    """Append to the run's log, the place for times, worker counts and everything else that varies."""
    with open(directory.events, "a") as file:
        file.write(json.dumps({"time": time.time(), "event": event, **fields}) + "\n")


@contextmanager
def _bad_input() -> Iterator[None]:
    """Print what is wrong with the user's input in one message and exit with code 2."""
    try:
        yield
    except (ValueError, LookupError, TypeError, OSError) as error:
        print(f"oodil: {error}", file=sys.stderr)
        raise typer.Exit(EXIT_BAD_INPUT) from None


def _lock(directory: "RunDirectory") -> Any:
    """Hold the run for this process; the lock goes with the process, however it ends."""
    file = open(directory.path / ".lock", "w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise ValueError(f"{directory.path}: another process is running this run") from None
    return file


def main() -> None:
    """Entry point of the ``oodil`` command."""
    app()


if __name__ == "__main__":
    main()
