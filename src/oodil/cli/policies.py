"""Commands that use a finished run: its policies, and its scores for later demonstrations."""

from pathlib import Path
from typing import Annotated

import typer

from oodil.cli.options import (
    EndsAreFailures,
    Overrides,
    RunPath,
    StateKeys,
    Workers,
    engine_of,
    execute_and_report,
    state_keys,
)
from oodil.pipeline.errors import ConfigError


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
    from oodil.pipeline.filming import check_writable, film
    from oodil.pipeline.seeding import derive_key

    results = open_run(run_dir)
    environment = results.config.environment
    done = [each.name for each in results.policies if results.is_done(each.name)]
    names = [policy] if policy else done or [results.policies[0].name]
    policies = {name: results.policy(name) for name in names}
    films = {name: results.path / f"{name}.mp4" for name in names if video}
    for path in films.values():
        check_writable(path)
    for name, trained in policies.items():
        told = ""
        if name in films:
            key = derive_key(seed, "evaluate")
            env_return = film(trained.gaussian, environment.id, environment.dynamics, key, films[name])
            told = f"\n{films[name]}: its first episode, return {env_return:.1f}"
        seen = evaluate_policy(trained, environment.id, environment.dynamics, episodes=episodes, seed=seed)
        print(
            f"{name}: return {seen.mean_return:.1f} ± {seen.std_return:.1f}, "
            f"length {seen.mean_length:.0f}, {episodes} deterministic episodes, seed {seed}{told}"
        )


def export_policy(
    run_dir: RunPath,
    onnx: Annotated[Path, typer.Option(metavar="FILE.onnx", help="Where the model goes.")],
    policy: Annotated[str | None, typer.Option(metavar="NAME", help="Of the run's policies; default: ours.")] = None,
) -> None:
    """Write a trained policy as an ONNX model, from raw observations to the actions to apply."""
    from oodil.api import open_run

    results = open_run(run_dir)
    name = policy or results.policies[0].name
    trained = results.policy(name)
    try:
        from oodil.pipeline.onnx_export import write_onnx
    except ImportError as error:
        raise ConfigError(f"--onnx needs {error.name}; pip install 'oodil[onnx]'") from None
    write_onnx(trained, name, onnx)
    seen, action = (list(shape) for shape in (trained.observation_shape, trained.action_low.shape))
    print(f"{onnx}: {name}, observation {['batch', *seen]} to action {['batch', *action]}, float32")


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
    scored = score_by(results, read_later(results, source, state_keys(keys), ends_are_failures), weighting)
    print_scores(results, scored)
    if output is not None:
        write_new(scored.demonstrations, results.config.environment.id, scored.columns(), output)
        print(f"{output}: {len(scored.demonstrations)} demonstrations")


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
    where = engine_of(config, "local", workers)
    execute_and_report(open_run(folder or default, config), choose(config), where, None)
