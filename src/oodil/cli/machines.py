"""Commands for rollout workers on other machines."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from oodil.cli.options import EXIT_FAILED


def worker(
    connect: Annotated[str, typer.Option(help="Address of a run started with --bind, e.g. tcp://lab-server:5555.")],
    keys: Annotated[Path, typer.Option(help="This machine's folder of keys, made beside the run by `oodil keys new`.")],
    workers: Annotated[int, typer.Option("--workers", "-w", min=1, help="Processes.")] = 1,
    logs: Annotated[Path, typer.Option(help="Folder for their logs.")] = Path("worker-logs"),
) -> None:
    """Collect rollouts for a run on another machine, until Ctrl-C; come and go as you like."""
    from oodil.terminal import stop_flag
    from oodil.workers.channels import check_address
    from oodil.workers.keys import client_keys
    from oodil.workers.remote import WorkersError, serve

    check_address(connect)
    client_keys(keys)
    with stop_flag(lambda: print("stopping")) as should_stop:
        try:
            serve(connect, keys, workers, logs, print, should_stop)
        except WorkersError as error:
            print(f"oodil: {error}", file=sys.stderr)
            raise typer.Exit(EXIT_FAILED) from None


def new_keys(
    folder: Annotated[Path, typer.Argument(metavar="KEYS", help="The folder of the learner's keys.")],
    worker: Annotated[str | None, typer.Option(help="Allow one more machine, and make its keys.")] = None,
) -> None:
    """Make the learner's keys, or with --worker those of a machine that may join."""
    from oodil.workers.channels import new_key_pair
    from oodil.workers.keys import create_learner_keys, create_worker_keys

    if worker is None:
        create_learner_keys(folder, new_key_pair)
        print(f"{folder}: the learner's keys; allow a machine with: oodil keys new {folder} --worker NAME")
    else:
        own = create_worker_keys(folder, worker, new_key_pair)
        print(f"{own}: copy this folder to the machine, by a way that nobody else can read, and remove it here")
