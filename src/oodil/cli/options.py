"""What commands have in common: their options, and how the chosen stages are executed and shown."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from oodil.pipeline.errors import ConfigError

if TYPE_CHECKING:
    from oodil.estimate import RunCost
    from oodil.pipeline.config import RunConfig
    from oodil.pipeline.stage import Run, Stage
    from oodil.terminal import Display
    from oodil.workers.engine import Engine

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_STOPPED = 1, 2, 130

ConfigSource = Annotated[
    str, typer.Argument(metavar="CONFIG", help="A YAML file, or the name of a configuration (`oodil configs`).")
]
Overrides = Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Fields to override.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN_DIR", help="The folder of a run.")]
Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", "-w", min=0, help="Parallel processes, 0 for this one alone; default: runtime.workers (2)."
    ),
]
Until = Annotated[str | None, typer.Option(metavar="STAGE", help="Stop after this stage.")]
Force = Annotated[
    list[str] | None, typer.Option(metavar="STAGE", help="Compute a finished stage again; can be repeated.")
]
Bind = Annotated[str | None, typer.Option(help="Let workers of other machines join here, e.g. tcp://0.0.0.0:5555.")]
Keys = Annotated[Path | None, typer.Option(help="Folder of keys, made by `oodil keys new`; --bind needs it.")]
EngineName = Annotated[Literal["local", "ray"], typer.Option(help="This machine's processes, or a Ray cluster.")]
StateKeys = Annotated[
    str, typer.Option("--keys", help="For observations with several entries: those of a state, such as obs/arm,box.")
]
EndsAreFailures = Annotated[
    bool, typer.Option(help="Episodes that the environment ended are ones in which the demonstrator failed.")
]
TrustCluster = Annotated[bool, typer.Option("--trust-cluster", help="Use a Ray cluster that asks for no token.")]


def state_keys(keys: str) -> tuple[str, ...]:
    """Return the names in an option that joins them by commas."""
    return tuple(key.strip() for key in keys.split(",") if key.strip())


def engine_of(
    config: "RunConfig",
    name: str,
    workers: int | None,
    bind: str | None = None,
    keys: Path | None = None,
    trust_cluster: bool = False,
) -> "Engine":
    """Return where jobs run; refuse options that belong to another engine."""
    if name == "local":
        from oodil.workers.channels import open_access
        from oodil.workers.local_engine import LocalEngine

        if trust_cluster:
            raise ConfigError("--trust-cluster belongs to --engine ray")
        count = config.runtime.workers if workers is None else workers
        if bind is not None and count == 0:
            raise ConfigError("--bind needs a learner process; --workers 0 runs everything in one")
        return LocalEngine(count, access=open_access(bind, keys))
    if (workers, bind, keys) != (None, None, None):
        raise ConfigError("--workers, --bind and --keys belong to --engine local; a Ray cluster has its own workers")
    try:
        from oodil.workers.ray_engine import RayEngine, connect
    except ImportError as error:
        raise ConfigError(f"--engine ray needs Ray (pip install 'oodil[ray]'): {error}") from None
    connect(trust_cluster)
    return RayEngine()


def execute_and_report(opened: "Run", chosen: "list[Stage]", engine: "Engine", force: list[str] | None) -> None:
    """Execute the stages, then write the report and print the summary."""
    from oodil.pipeline.report import write_report
    from oodil.pipeline.runs import RunResults
    from oodil.terminal import print_summary

    try:
        show_execution(opened, chosen, engine, force)
    finally:
        results = RunResults(opened)
        path = write_report(results)
    print_summary(results, path)


def show_execution(opened: "Run", chosen: "list[Stage]", engine: "Engine", force: list[str] | None = None) -> None:
    """Execute the stages and show how far they are."""
    from oodil.estimate import run_cost
    from oodil.orchestrator import execute

    cost = run_cost(opened, chosen, engine.workers, force or ())
    with shown(cost, f"oodil resume {opened.directory.path}") as (display, should_stop):
        execute(opened, chosen, engine, display, should_stop, force or ())


@contextmanager
def shown(cost: "RunCost", resume: str) -> "Iterator[tuple[Display, Callable[[], bool]]]":
    """Show what is computed; give the display, and what tells whether to stop.

    Ctrl-C once stops politely; twice at once, which names the command that goes on.
    """
    from oodil.terminal import Display, stop_flag

    try:
        with Display(cost) as display, stop_flag(display.stopping) as is_asked_to_stop:

            def should_stop() -> bool:
                display.tick()  # Engines ask all the time, also while nothing is reported.
                return is_asked_to_stop()

            yield display, should_stop
    except KeyboardInterrupt:
        print(f"\nstopped at once; go on with: {resume}", file=sys.stderr)
        raise typer.Exit(EXIT_STOPPED) from None
