"""The command line: ``oodil ...`` and ``python orchestrator.py ...`` are the same program.

No mathematics and no sockets. Heavy imports follow argument parsing, so that ``--help`` answers at once.
"""

import os
import sys
from typing import Annotated, Any

import typer

from oodil import __version__
from oodil.cli import demonstrations, doctor, experiments, machines, policies, runs
from oodil.cli.encoding import fit_encoding
from oodil.cli.options import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_STOPPED
from oodil.pipeline.errors import OodilError, UnfinishedError

# Before NumPy and torch are loaded: one compute thread per process, so that the bits do not depend on the machine.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"


class _Commands(typer.core.TyperGroup):
    """Ends every command in the same way: what a user can mend is one message, and a defect keeps its traceback."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except UnfinishedError as error:
            print(f"\n{error}", file=sys.stderr)
            raise typer.Exit(EXIT_FAILED if error.failed else EXIT_STOPPED) from None
        except OodilError as error:
            print(f"oodil: {error}", file=sys.stderr)
            raise typer.Exit(EXIT_BAD_INPUT) from None


app = typer.Typer(
    name="oodil",
    cls=_Commands,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _oodil(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", is_eager=True, help="Show the version and exit.")] = False,
) -> None:
    """Imitation learning from demonstrators whose dynamics differ from your robot's."""
    if version:
        print(f"oodil {__version__}")
    elif ctx.invoked_subcommand is None:
        print(ctx.get_help())
    else:
        return
    raise typer.Exit


for _command in (
    runs.run,
    runs.resume,
    runs.configs,
    machines.worker,
    runs.status,
    runs.report,
    policies.evaluate,
    policies.export_policy,
    policies.score,
    policies.finetune,
    experiments.table,
    runs.bench,
    doctor.doctor,
):
    app.command()(_command)

demos_app = typer.Typer(help="Look at demonstrations, collect, convert and export them.", no_args_is_help=True)
demos_app.command("inspect")(demonstrations.inspect_demos)
demos_app.command("collect")(demonstrations.collect_demos)
demos_app.command("convert")(demonstrations.convert_demos)
demos_app.command("export")(demonstrations.export_demos)
app.add_typer(demos_app, name="demos")

keys_app = typer.Typer(help="Keys for rollout workers on other machines.", no_args_is_help=True)
keys_app.command("new")(machines.new_keys)
app.add_typer(keys_app, name="keys")


def main() -> None:
    """Entry point of the ``oodil`` command."""
    fit_encoding()
    app()
