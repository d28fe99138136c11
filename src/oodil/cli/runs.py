"""Commands that run the pipeline and say what a run has found."""

import json
import shutil
import sys
from itertools import takewhile
from pathlib import Path
from typing import Annotated

import typer

from oodil.cli.options import (
    Bind,
    ConfigSource,
    EngineName,
    Force,
    Keys,
    Overrides,
    RunPath,
    TrustCluster,
    Until,
    Workers,
    engine_of,
    execute_and_report,
)
from oodil.pipeline.errors import ConfigError, StorageError


def run(
    config_source: ConfigSource,
    overrides: Overrides = None,
    workers: Workers = None,
    run_dir: Annotated[Path | None, typer.Option(help="Default: runs/NAME-seedSEED.")] = None,
    until: Until = None,
    force: Force = None,
    bind: Bind = None,
    keys: Keys = None,
    engine: EngineName = "local",
    trust_cluster: TrustCluster = False,
) -> None:
    """Run the pipeline; what is already finished is reused, what was interrupted goes on."""
    from oodil.api import default_folder
    from oodil.orchestrator import check_inputs, choose, open_run
    from oodil.pipeline.loading import load_config

    config = load_config(config_source, overrides)
    check_inputs(config)
    chosen = choose(config, until, force or ())
    where = engine_of(config, engine, workers, bind, keys, trust_cluster)
    execute_and_report(open_run(run_dir or default_folder(config), config, force or ()), chosen, where, force)


def resume(
    run_dir: RunPath,
    workers: Workers = None,
    until: Until = None,
    force: Force = None,
    bind: Bind = None,
    keys: Keys = None,
    engine: EngineName = "local",
    trust_cluster: TrustCluster = False,
) -> None:
    """Go on with an interrupted run, with any number of workers or on another engine."""
    from oodil.orchestrator import check_inputs, choose, read_run, refuse_to_replace

    opened = read_run(run_dir)
    check_inputs(opened.config, opened)
    chosen = choose(opened.config, until, force or ())
    refuse_to_replace(opened, force or ())
    execute_and_report(opened, chosen, engine_of(opened.config, engine, workers, bind, keys, trust_cluster), force)


def configs(
    copy: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy them, and their experts, to be edited.")
    ] = None,
) -> None:
    """List the configurations that come with oodil; each runs by its name."""
    from oodil.pipeline.loading import SHIPPED, shipped_configs

    if copy is not None:
        if copy.exists():
            raise ConfigError(f"{copy}: exists already; choose a new folder")
        try:
            shutil.copytree(SHIPPED, copy)
        except OSError as error:
            raise StorageError(f"{copy}: {error.strerror or error}") from error
        print(f"{copy}: try `oodil run {copy}/quickstart.yaml`")
        return
    for name, path in shipped_configs().items():
        print(f"{name:<24} {_first_sentence(path.read_text())}")


def _first_sentence(text: str) -> str:
    """Return the first sentence of the comment that a file begins with."""
    comment = takewhile(lambda line: line.startswith("#"), text.splitlines())
    return " ".join(line.removeprefix("# ") for line in comment).partition(". ")[0].rstrip(".")


def status(run_dir: RunPath, as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False) -> None:
    """Say which stages are finished and what is known so far."""
    from oodil.api import open_run
    from oodil.terminal import print_status

    results = open_run(run_dir)
    if as_json:
        print(json.dumps(results.describe(), indent=2))
    else:
        print_status(results)


def report(run_dir: RunPath) -> None:
    """Write the report anew, of whatever is finished."""
    from oodil.orchestrator import read_run
    from oodil.pipeline.report import write_report

    print(write_report(read_run(run_dir)))


def bench(
    config_source: ConfigSource,
    overrides: Overrides = None,
    workers: Annotated[list[int] | None, typer.Option("--workers", "-w", min=0, help="Repeat for several.")] = None,
) -> None:
    """Find the number of workers with which the learner is fastest here; takes about a minute."""
    from oodil.bench import compare, worker_counts
    from oodil.orchestrator import check_inputs
    from oodil.pipeline.loading import load_config
    from oodil.terminal import print_bench

    config = load_config(config_source, overrides)
    check_inputs(config)

    def show(count: int, figures: dict[str, float]) -> None:
        print(f"{count} workers: {figures['steps_per_s']:,.0f} environment steps per second", file=sys.stderr)

    print_bench(config.environment.id, compare(config, sorted(set(workers or worker_counts())), show))
