"""The command line: ``oodil ...`` and ``python orchestrator.py ...`` are the same program.

No mathematics and no sockets. Heavy imports follow argument parsing, so that ``--help`` answers at once.
"""

import json
import os
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from oodil.pipeline.errors import ConfigError, OodilError, StorageError, UnfinishedError

if TYPE_CHECKING:
    from oodil.pipeline.config import RunConfig
    from oodil.pipeline.stage import Run, Stage
    from oodil.workers.engine import Engine

# Before NumPy and torch are loaded: one compute thread per process, so that the bits do not depend on the machine.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_STOPPED = 1, 2, 130


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
    help="Imitation learning from demonstrators whose dynamics differ from your robot's.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
demos_app = typer.Typer(help="Inspect and collect demonstrations.", no_args_is_help=True)
app.add_typer(demos_app, name="demos")
keys_app = typer.Typer(help="Keys for rollout workers on other machines.", no_args_is_help=True)
app.add_typer(keys_app, name="keys")

ConfigSource = Annotated[
    str, typer.Argument(metavar="CONFIG", help="A YAML file, or the name of a configuration (`oodil configs`).")
]
Overrides = Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Fields to override.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN_DIR", help="The folder of a run.")]
Workers = Annotated[int | None, typer.Option("--workers", "-w", min=0, help="Parallel processes; 0 runs inline.")]
Until = Annotated[str | None, typer.Option(metavar="STAGE", help="Stop after this stage.")]
Force = Annotated[
    list[str] | None, typer.Option(metavar="STAGE", help="Compute a finished stage again; can be repeated.")
]
Bind = Annotated[str | None, typer.Option(help="Let workers of other machines join here, e.g. tcp://0.0.0.0:5555.")]
Keys = Annotated[Path | None, typer.Option(help="Folder of keys, made by `oodil keys new`; --bind needs it.")]
EngineName = Annotated[Literal["local", "ray"], typer.Option(help="This machine's processes, or a Ray cluster.")]
StateKeys = Annotated[
    str, typer.Option("--keys", help="For observations with several entries: those of a state, joined by commas.")
]
EndsAreFailures = Annotated[
    bool, typer.Option(help="Episodes that the environment ended are ones in which the demonstrator failed.")
]
TrustCluster = Annotated[bool, typer.Option("--trust-cluster", help="Use a Ray cluster that asks for no token.")]


@app.command()
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
    chosen = choose(config, until)
    where = _engine(config, engine, workers, bind, keys, trust_cluster)
    _execute(open_run(run_dir or default_folder(config), config, force or ()), chosen, where, force)


@app.command()
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
    check_inputs(opened.config)
    chosen = choose(opened.config, until)
    refuse_to_replace(opened, force or ())
    _execute(opened, chosen, _engine(opened.config, engine, workers, bind, keys, trust_cluster), force)


@app.command()
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
        first = path.read_text().splitlines()[0]
        print(f"{name:<24} {first.removeprefix('# ') if first.startswith('# ') else ''}")


@app.command()
def worker(
    connect: Annotated[str, typer.Option(help="Address of a run started with --bind, e.g. tcp://lab-server:5555.")],
    keys: Annotated[Path, typer.Option(help="This machine's folder of keys, made beside the run by `oodil keys new`.")],
    workers: Annotated[int, typer.Option("--workers", "-w", min=1, help="Processes.")] = 1,
    logs: Annotated[Path, typer.Option(help="Folder for their logs.")] = Path("worker-logs"),
) -> None:
    """Collect rollouts for a run on another machine, until Ctrl-C; come and go as you like."""
    from oodil.terminal import stop_flag
    from oodil.workers.keys import client_keys
    from oodil.workers.remote import WorkersError, serve

    client_keys(keys)
    with stop_flag(lambda: print("stopping")) as should_stop:
        try:
            serve(connect, keys, workers, logs, print, should_stop)
        except WorkersError as error:
            print(f"oodil: {error}", file=sys.stderr)
            raise typer.Exit(EXIT_FAILED) from None


@keys_app.command("new")
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


@app.command()
def status(run_dir: RunPath, as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False) -> None:
    """Say which stages are finished and what is known so far."""
    from oodil.api import open_run
    from oodil.terminal import print_status

    results = open_run(run_dir)
    if as_json:
        print(json.dumps(results.describe(), indent=2))
    else:
        print_status(results)


@app.command()
def report(run_dir: RunPath) -> None:
    """Write the report anew, of whatever is finished."""
    from oodil.orchestrator import read_run
    from oodil.pipeline.report import write_report

    print(write_report(read_run(run_dir)))


@app.command()
def evaluate(
    run_dir: RunPath,
    episodes: Annotated[int, typer.Option(min=1, help="Deterministic episodes.")] = 32,
    policy: Annotated[str | None, typer.Option(metavar="NAME", help="One policy; default: all that are done.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episodes.")] = 0,
    video: Annotated[bool, typer.Option("--video", help="Also film one episode of each.")] = False,
) -> None:
    """Evaluate trained policies on the true return of the imitator's environment."""
    from oodil.api import evaluate as evaluate_policy
    from oodil.api import open_run
    from oodil.pipeline.evaluation import film

    results = open_run(run_dir)
    environment = results.config.environment
    done = [each.name for each in results.policies if results.is_done(each.name)]
    for name in [policy] if policy else done or [results.policies[0].name]:
        trained = results.policy(name)
        seen = evaluate_policy(trained, environment.id, environment.dynamics, episodes=episodes, seed=seed)
        print(
            f"{name}: return {seen.mean_return:.1f} ± {seen.std_return:.1f}, "
            f"length {seen.mean_length:.0f}, {episodes} deterministic episodes, seed {seed}"
        )
        if video:
            path = results.path / f"{name}.mp4"
            env_return = film(trained, environment.id, environment.dynamics, seed, path)
            print(f"{path}: one episode, return {env_return:.1f}")


@app.command()
def score(
    run_dir: RunPath,
    source: Annotated[
        str,
        typer.Argument(metavar="FILE", help="FILE.safetensors, or whatever `oodil demos convert` reads."),
    ],
    weighting: Annotated[str | None, typer.Option(metavar="NAME", help="One weighting; default: all that can.")] = None,
    output: Annotated[
        Path | None, typer.Option(help="A table FILE.csv, or the demonstrations with scores in FILE.hdf5 or FILE.npz.")
    ] = None,
    keys: StateKeys = "",
    ends_are_failures: EndsAreFailures = False,
) -> None:
    """Score demonstrations that come later by a finished run; nothing is trained."""
    from oodil.api import open_run, read_later
    from oodil.pipeline.datasets.export import check_new_file, write_new
    from oodil.pipeline.scoring import score as score_by
    from oodil.terminal import print_scores

    if output is not None:
        check_new_file(output, source)
    results = open_run(run_dir)
    scored = score_by(results, read_later(results, source, _state_keys(keys), ends_are_failures), weighting)
    print_scores(results, scored)
    if output is not None:
        write_new(scored.demonstrations, results.config.environment.id, scored.columns(), output)
        print(f"{output}: {len(scored.demonstrations)} demonstrations")


@app.command()
def finetune(
    run_dir: RunPath,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Later demonstrations, a file of ours.")],
    overrides: Overrides = None,
    weighting: Annotated[str | None, typer.Option(metavar="NAME", help="Scores them; default: ours.")] = None,
    workers: Workers = None,
    folder: Annotated[
        Path | None, typer.Option("--run-dir", help="Of the fine-tuning; default: RUN_DIR-finetuned-FILE-NAME.")
    ] = None,
) -> None:
    """Go on training a finished run's policy with later demonstrations; it is a run of its own."""
    from oodil.api import finetuning
    from oodil.api import open_run as open_results
    from oodil.orchestrator import choose, open_run

    config, default = finetuning(open_results(run_dir), file, overrides or (), weighting)
    where = _engine(config, "local", workers)
    _execute(open_run(folder or default, config), choose(config), where, None)


@app.command()
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


@demos_app.command("inspect")
def inspect_demos(path: Annotated[Path, typer.Argument(help="A file of demonstrations, or a run's folder.")]) -> None:
    """Show what a set of demonstrations contains."""
    from oodil.api import open_run
    from oodil.pipeline.datasets import read_demonstrations
    from oodil.terminal import print_demonstrations

    if path.is_dir():
        results = open_run(path)
        print_demonstrations(path, results.demonstrations, results.config.environment.id)
    else:
        print_demonstrations(path, *read_demonstrations(path))


@demos_app.command("collect")
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
    from oodil.pipeline.loading import load_config
    from oodil.pipeline.stages.demonstrations import load_demonstrations
    from oodil.pipeline.stages.experts import ExpertsStage

    config = load_config(config_source, overrides)
    experts = ExpertsStage()
    if train:
        experts.check(config)
    else:
        check_inputs(config)
    engine = _engine(config, "local", workers)
    first = choose(config, until="demonstrations")
    # What was collected for other settings is of no further use.
    opened = open_run(output.with_name(f".{output.name}.run"), config, [stage.name for stage in first])
    if train:
        _show_execution(opened, [experts], engine)
        print("\n".join(experts.export(opened)))
    _show_execution(opened, first, engine)
    write_file(output, encode_demonstrations(load_demonstrations(opened), config.environment.id))
    inspect_demos(output)


@demos_app.command("convert")
def convert_demos(
    sources: Annotated[
        list[str],
        typer.Argument(help="FILE.npz, FILE.hdf5 (robomimic), FILE.pkl (released code) or minari:DATASET_ID."),
    ],
    environment: Annotated[str, typer.Option(help="Id of the imitator's environment, such as oodil/Hopper-v0.")],
    output: Annotated[Path, typer.Option(help="The file to write.")] = Path("demonstrations.safetensors"),
    keys: StateKeys = "",
    ends_are_failures: EndsAreFailures = False,
) -> None:
    """Make one file of demonstrations from files in other formats; each becomes a source, named by its file."""
    from oodil.pipeline.artifacts import write_file
    from oodil.pipeline.data import Demonstrations
    from oodil.pipeline.datasets import encode_demonstrations
    from oodil.pipeline.datasets.foreign import read_foreign

    parts = []
    for source in sources:
        label = source if source.startswith("minari:") else Path(source).stem
        part, recorded = read_foreign(source, label, _state_keys(keys), ends_are_failures)
        print(f"{source}: {len(part)} demonstrations" + (f" from {recorded}" if recorded else ""))
        parts.append(part)
    write_file(output, encode_demonstrations(Demonstrations.joined(parts), environment))
    inspect_demos(output)


@demos_app.command("export")
def export_demos(
    run_dir: RunPath,
    target: Annotated[str, typer.Argument(help="FILE.csv, FILE.hdf5 (robomimic) or minari:DATASET_ID.")],
) -> None:
    """Write cluster, score with interval, verdict and weight of every demonstration to a table, or to their origin."""
    from oodil.api import open_run
    from oodil.pipeline.datasets.export import export

    results = open_run(run_dir)
    print(export(results.demonstrations, results.transferability.columns(), target))


def _state_keys(keys: str) -> tuple[str, ...]:
    return tuple(key for key in keys.split(",") if key)


def _engine(
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


def _execute(opened: "Run", chosen: "list[Stage]", engine: "Engine", force: list[str] | None) -> None:
    """Execute the stages, then write the report and print the summary."""
    from oodil.pipeline.report import write_report
    from oodil.pipeline.runs import RunResults
    from oodil.terminal import print_summary

    try:
        _show_execution(opened, chosen, engine, force)
    finally:
        results = RunResults(opened)
        path = write_report(results)
    print_summary(results, path)


def _show_execution(opened: "Run", chosen: "list[Stage]", engine: "Engine", force: list[str] | None = None) -> None:
    from oodil.orchestrator import execute
    from oodil.terminal import Display, stop_flag

    try:
        with Display() as display, stop_flag(display.stopping) as should_stop:
            execute(opened, chosen, engine, display, should_stop, force or ())
    except KeyboardInterrupt:
        print(f"\nstopped at once; go on with: oodil resume {opened.directory.path}", file=sys.stderr)
        raise typer.Exit(EXIT_STOPPED) from None


def main() -> None:
    """Entry point of the ``oodil`` command."""
    app()


if __name__ == "__main__":
    main()
