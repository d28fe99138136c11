"""The command that makes a table or a figure: rows x methods x seeds, as many runs at once as there are cores."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from oodil.cli.options import EngineName, TrustCluster, engine_of, shown
from oodil.pipeline.errors import UnfinishedError

if TYPE_CHECKING:
    from oodil.experiments import Table
    from oodil.pipeline.stage import Stage
    from oodil.workers.engine import Engine, Outcome

Names = list[str] | None


def table(
    source: Annotated[str, typer.Argument(metavar="EXPERIMENT", help="A YAML file, or one that comes with oodil.")],
    seeds: Annotated[str | None, typer.Option(help="A-B, or the first N of the file's seeds.")] = None,
    rows: Annotated[Names, typer.Option("--rows", metavar="ROW", help="Compute this row now; can be repeated.")] = None,
    methods: Annotated[
        Names, typer.Option("--methods", metavar="METHOD", help="Compute this method now; can be repeated.")
    ] = None,
    workers: Annotated[int | None, typer.Option("--workers", "-w", min=0, help="Runs at once; default: cores.")] = None,
    engine: EngineName = "local",
    trust_cluster: TrustCluster = False,
    plan: Annotated[bool, typer.Option("--plan", help="Say what it would take, and compute nothing.")] = False,
    folder: Annotated[Path, typer.Option(help="Where the experiment has its folder.")] = Path("tables"),
) -> None:
    """Make a table of an experiment; what is finished is reused, what was interrupted goes on."""
    from oodil.bench import usable_cores
    from oodil.experiments import Table
    from oodil.pipeline.artifacts import MADE
    from oodil.pipeline.experiment import load_experiment
    from oodil.pipeline.report.table import write_table
    from oodil.workers.engine import Outcome

    experiment = load_experiment(source)
    if seeds is not None:
        experiment = experiment.with_seeds(seeds)
    made = Table.of(experiment, folder / experiment.name)
    selected = made.select(rows, methods)
    if plan:
        _print_plan(made, selected, usable_cores() if workers is None else max(workers, 1))
        return
    count = usable_cores() if workers is None and engine == "local" else workers
    where = engine_of(made.runs[0].config, engine, count, trust_cluster=trust_cluster)
    command = shlex.join(["oodil", *sys.argv[1:]])
    left = made.unfinished(selected)
    outcome = _compute(made, left, where, command) if left else Outcome()
    made.write_results(outcome.failed)
    if left or not (made.folder / MADE).exists():
        made.write_made(sys.argv[1:])
    print(write_table(made.folder))
    if outcome.failed or outcome.stopped:
        raise UnfinishedError(_unfinished(outcome, len(selected), command), made.experiment.name, outcome.failed)


def _compute(made: "Table", selected: "dict[str, list[Stage]]", engine: "Engine", command: str) -> "Outcome":
    """Compute and show how far the runs are."""
    from oodil.estimate import outlook, table_cost
    from oodil.workers.reports import DONE, Event, Finished

    with shown(table_cost(outlook(made, selected), engine.workers), command) as (display, should_stop):

        def on_event(event: Event) -> None:
            display.event(event)
            if event.report == Finished(DONE):
                display.say(f"✓ {event.name}", "green")

        display.stage_started("table", "", len(selected))
        return made.compute(selected, engine, on_event, should_stop)


def _unfinished(outcome: "Outcome", runs: int, command: str) -> str:
    failures = "".join(f"{run} failed:\n{reason.rstrip()}\n\n" for run, reason in sorted(outcome.failed.items()))
    named = f" ({', '.join(sorted(outcome.failed))})" if outcome.failed else ""
    done = runs - len(outcome.failed) - len(outcome.not_run)
    return (
        f"{failures}{done} runs done, {len(outcome.failed)} failed{named}, "
        f"{len(outcome.not_run)} not finished. What is finished is kept; go on with: {command}"
    )


def _print_plan(made: "Table", selected: "dict[str, list[Stage]]", workers: int) -> None:
    """Print the runs, what each computes and takes over, and how long all of it takes here."""
    from rich.console import Console
    from rich.table import Table as Columns

    from oodil.estimate import outlook, table_cost

    console, found = Console(), outlook(made, selected)
    columns = Columns(box=None, padding=(0, 2))
    columns.add_column("run", no_wrap=True)
    for heading in ("environment steps", "to compute", "finished"):
        columns.add_column(heading, justify="right")
    columns.add_column("taken over from another run")
    for each in found:
        counts = f"{each.cost.env_steps:,}", str(len(each.own)), str(len(each.finished))
        columns.add_row(each.name, *counts, ", ".join(each.shared))
    console.print(columns)
    own, shared, done = (
        sum(len(stages) for stages in kind)
        for kind in zip(*((each.own, each.shared, each.finished) for each in found), strict=True)
    )
    console.print(
        f"{len(found)} run{'' if len(found) == 1 else 's'}: {own} stages to compute, {shared} to take over, "
        f"{done} finished",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        f"{table_cost(found, workers)} with {workers} runs at once; by a short measurement, it may be off by half",
        highlight=False,
        soft_wrap=True,
    )
