"""Commands for demonstrations: inspect, collect, convert, export."""

from pathlib import Path
from typing import Annotated, Any

import typer

from oodil.cli.options import (
    ConfigSource,
    EndsAreFailures,
    Overrides,
    RunPath,
    StateKeys,
    Workers,
    engine_of,
    show_execution,
    state_keys,
)
from oodil.pipeline.errors import DataError


def inspect_demos(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="A file of demonstrations, or a run's folder.")],
) -> None:
    """Show what a set of demonstrations contains."""
    from oodil.api import open_run
    from oodil.pipeline.datasets import read_demonstrations
    from oodil.terminal import print_demonstrations

    if path.is_dir():
        results = open_run(path)
        print_demonstrations(path, results.demonstrations, results.config.environment.id)
    else:
        print_demonstrations(path, *read_demonstrations(path))


def collect_demos(
    config_source: ConfigSource,
    overrides: Overrides = None,
    train: Annotated[
        bool,
        typer.Option("--train", help="First train the experts anew; a saved one is kept unless the new one is better."),
    ] = False,
    output: Annotated[Path, typer.Option(help="The file to write.")] = Path("demonstrations.safetensors"),
    workers: Workers = None,
) -> None:
    """Collect demonstrations from the experts of a configuration into one file; interrupted, it goes on."""
    from oodil.orchestrator import check_inputs, choose, open_run
    from oodil.pipeline.artifacts import write_file
    from oodil.pipeline.datasets import encode_demonstrations
    from oodil.pipeline.datasets.foreign import check_output
    from oodil.pipeline.loading import load_config
    from oodil.pipeline.stages.demonstrations import load_demonstrations
    from oodil.pipeline.stages.experts import ExpertsStage

    check_output(output, ())
    config = load_config(config_source, overrides)
    experts = ExpertsStage()
    if train:
        experts.check(config)
    else:
        check_inputs(config)
    engine = engine_of(config, "local", workers)
    first = choose(config, until="demonstrations")
    # What was collected for other settings is of no further use.
    opened = open_run(output.with_name(f".{output.name}.run"), config, [stage.name for stage in first])
    if train:
        show_execution(opened, [experts], engine)
        print("\n".join(experts.export(opened)))
    show_execution(opened, first, engine)
    write_file(output, encode_demonstrations(load_demonstrations(opened), config.environment.id))
    inspect_demos(output)


def convert_demos(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="FILE.npz, FILE.hdf5, FILE.pkl, FILE.parquet, a folder of LeRobot's, minari:DATASET_ID.",
        ),
    ],
    environment: Annotated[str, typer.Option(help="Id of the imitator's environment, such as oodil/Hopper-v0.")],
    output: Annotated[Path, typer.Option(help="The file to write.")] = Path("demonstrations.safetensors"),
    keys: StateKeys = "",
    dynamics: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Of the environment, if what it observes depends on it; repeatable."),
    ] = None,
    ends_are_failures: EndsAreFailures = False,
) -> None:
    """Make one file of demonstrations from files in other formats; each becomes a source, named by its file."""
    from oodil.pipeline.artifacts import write_file
    from oodil.pipeline.data import Demonstrations
    from oodil.pipeline.datasets import encode_demonstrations
    from oodil.pipeline.datasets.foreign import check_output, labels_of, read_foreign
    from oodil.pipeline.environments import environment_spec
    from oodil.pipeline.loading import apply_override, find_modules_in

    check_output(output, sources)
    if ":" in environment:
        for folder in (Path.cwd(), output.absolute().parent):  # The configuration will lie in one of them.
            find_modules_in(str(folder))
    arguments: dict[str, Any] = {}
    for each in dynamics or ():
        apply_override(arguments, each)
    expected = environment_spec(environment, arguments).observation_dim
    parts = []
    for source, label in zip(sources, labels_of(sources), strict=True):
        part, recorded = read_foreign(source, label, state_keys(keys), ends_are_failures, warn=print)
        print(f"{source}: {len(part)} demonstrations" + (f" from {recorded}" if recorded else ""))
        parts.append(part)
    joined = Demonstrations.joined(parts)
    if joined.observation_dim != expected:
        raise DataError(
            f"{', '.join(sources)}: states have {joined.observation_dim} dimensions; environment {environment} has "
            f"{expected} (with other dynamics, perhaps: --dynamics KEY=VALUE)"
        )
    write_file(output, encode_demonstrations(joined, environment))
    inspect_demos(output)


def export_demos(
    run_dir: RunPath,
    target: Annotated[
        str, typer.Argument(metavar="TARGET", help="FILE.csv, FILE.hdf5 (robomimic) or minari:DATASET_ID.")
    ],
) -> None:
    """Write cluster, score with interval, verdict and weight of every demonstration to a table, or to their origin."""
    from oodil.api import open_run
    from oodil.pipeline.datasets.export import export

    results = open_run(run_dir)
    print(export(results.demonstrations, results.transferability.columns(), target))
