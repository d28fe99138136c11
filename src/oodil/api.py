"""The functions behind ``import oodil``; each is what a command of the command line does."""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from oodil.orchestrator import Observer, check_inputs, choose, execute, read_run
from oodil.orchestrator import open_run as open_folder
from oodil.pipeline.config import RunConfig
from oodil.pipeline.config.sections import is_same
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets.foreign import read_any
from oodil.pipeline.errors import DataError
from oodil.pipeline.evaluation import evaluate as evaluate_policy
from oodil.pipeline.loading import load_config
from oodil.pipeline.results import Evaluation, Policy
from oodil.pipeline.runs import RunResults
from oodil.pipeline.scoring import Scored
from oodil.pipeline.scoring import score as score_by
from oodil.pipeline.seeding import derive_key
from oodil.workers.engine import Engine
from oodil.workers.local_engine import LocalEngine

__all__ = ["evaluate", "finetune", "open_run", "run", "score"]


def run(
    config: str | Path | Mapping[str, Any] | RunConfig,
    overrides: Sequence[str] = (),
    *,
    workers: int | None = None,
    run_dir: str | Path | None = None,
    until: str | None = None,
    force: Collection[str] = (),
    observer: Observer | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    engine: Engine | None = None,
) -> RunResults:
    """Run the pipeline; what is finished is reused, what was interrupted goes on.

    It works in a notebook, in a thread and in a script without a ``__main__`` guard; it prints nothing, and handles no
    signal. The report is not written; `oodil.write_report` does that.

    Args:
        config: a YAML file, the name of a configuration that comes with oodil, plain values or a `RunConfig`.
        overrides: ``key.sub=value`` each, as on the command line.
        workers: parallel processes; 0 computes everything in this one. Default: ``runtime.workers`` of the
            configuration. It changes no bit of the result.
        run_dir: the run's folder; default: ``runs/NAME-seedSEED``.
        until: stop after this stage.
        force: stages to compute again although they are finished.
        observer: is told what happens, in this thread.
        should_stop: once it returns true, running jobs write a checkpoint and stop.
        engine: where jobs run, instead of ``workers`` processes of this machine.

    Raises OodilError for what the caller can mend, `UnfinishedError` when a job failed or a stop was asked for.

    Example:
        >>> results = oodil.run("quickstart", overrides=["seed=3"], workers=2)  # doctest: +SKIP
        >>> results.summary()["policies"]["imitation"]["mean_return"]  # doctest: +SKIP
    """
    loaded = load_config(config, overrides)
    check_inputs(loaded)
    chosen = choose(loaded, until, force)
    where = engine or LocalEngine(loaded.runtime.workers if workers is None else workers)
    opened = open_folder(default_folder(loaded) if run_dir is None else Path(run_dir), loaded, force)
    execute(opened, chosen, where, observer, should_stop, force)
    return RunResults(opened)


def open_run(path: str | Path) -> RunResults:
    """Return what a run's folder holds, whether or not the run is finished.

    Raises ConfigError if it is not a run.

    Example:
        >>> results = oodil.open_run("runs/quickstart-seed0")  # doctest: +SKIP
        >>> results.transferability.table()[0]  # doctest: +SKIP
        {'demonstration': 0, 'cluster': 2, 'transferability': 0.41, 'weight': 0.049}
    """
    return RunResults(read_run(Path(path)))


def score(
    run: str | Path | RunResults, demonstrations: Demonstrations | str | Path, weighting: str | None = None
) -> Scored:
    """Return what a finished run says of demonstrations that come later; nothing is trained.

    Args:
        run: a run, or its folder.
        demonstrations: what to score, or what `oodil score` takes: a file, or ``minari:DATASET_ID``.
        weighting: one weighting alone; default: every one of the run that can.

    Raises OodilError for what the caller can mend: states of another dimension or environment, a stage that is not
    finished, a weighting that cannot score what was not part of its run.

    Example:
        >>> scored = oodil.score("runs/quickstart-seed0", "later.safetensors")  # doctest: +SKIP
        >>> scored.found["transferability"].verdicts  # doctest: +SKIP
        array(['kept', 'unlike'], dtype='<U8')
    """
    results = run if isinstance(run, RunResults) else open_run(run)
    if not isinstance(demonstrations, Demonstrations):
        demonstrations = read_later(results, str(demonstrations))
    return score_by(results, demonstrations, weighting)


def finetune(
    run: str | Path | RunResults,
    file: str | Path,
    overrides: Sequence[str] = (),
    *,
    weighting: str | None = None,
    workers: int | None = None,
    run_dir: str | Path | None = None,
    observer: Observer | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> RunResults:
    """Go on training a finished run's policy, on its demonstrations and later ones; interrupted, it goes on.

    It is a run of its own, with the old demonstrations before the new ones.

    Args:
        run: the finished run, or its folder.
        file: the later demonstrations, in a file of ours.
        overrides: ``key.sub=value`` each, such as ``finetuning.total_steps=500000``.
        weighting: of the run, by which the later demonstrations are scored; default: ours.
        workers, observer, should_stop: as for `oodil.run`.
        run_dir: the new run's folder; default: beside the old one, named after it, the file and the weighting.

    Raises OodilError for what the caller can mend, `UnfinishedError` when a job failed or a stop was asked for.

    Example:
        >>> tuned = oodil.finetune("runs/quickstart-seed0", "later.safetensors")  # doctest: +SKIP
        >>> tuned.curve("finetuning").mean_return  # doctest: +SKIP
    """
    config, folder = finetuning(run if isinstance(run, RunResults) else open_run(run), Path(file), overrides, weighting)
    where = LocalEngine(config.runtime.workers if workers is None else workers)
    opened = open_folder(folder if run_dir is None else Path(run_dir), config)
    execute(opened, choose(config), where, observer, should_stop)
    return RunResults(opened)


def finetuning(
    results: RunResults, file: Path, overrides: Sequence[str] = (), weighting: str | None = None
) -> tuple[RunConfig, Path]:
    """Return the configuration of a fine-tuning and its default folder. Raises OodilError if there can be none."""
    name = weighting or results.weightings[0].name
    results.artifact(results.policies[0].name)
    if file.suffix != ".safetensors":
        raise DataError(f"{file}: is no file of ours (.safetensors); `oodil demos convert` makes one")
    later = read_later(results, str(file))
    results.score(later.select(np.array([0])), name)  # One tells whether the weighting can score any.
    values = results.config.model_dump(mode="json") | {
        "name": f"{results.config.name}-finetuned",
        "demonstrations": {"file": str(file.absolute())},
        "baselines": [],
        "reproducibility": None,
    }
    values["finetuning"] |= {"run": str(results.path.absolute()), "weighting": name}
    config = load_config(values, overrides)
    check_inputs(config)
    path = results.path.absolute()
    return config, path.with_name(f"{path.name}-finetuned-{file.stem}-{name}")


def read_later(
    results: RunResults, source: str, keys: tuple[str, ...] = (), ends_are_failures: bool = False
) -> Demonstrations:
    """Return demonstrations that a run is to score. Raises DataError that names the source, and what does not fit."""
    demonstrations, environment = read_any(source, keys, ends_are_failures)
    results.refuse_other_states(demonstrations, source)
    if environment and not is_same(environment, results.config.environment.id):
        raise DataError(f"{source}: recorded in {environment}, but the run is for {results.config.environment.id}")
    return demonstrations


def evaluate(
    policy: Policy,
    environment: str,
    dynamics: Mapping[str, Any] | None = None,
    *,
    episodes: int = 32,
    seed: int = 0,
) -> Evaluation:
    """Return true returns and lengths of fresh episodes with the policy's mean actions.

    Raises UnusableEnvironmentError for an environment that cannot be made.

    Example:
        >>> policy = oodil.open_run("runs/quickstart-seed0").policy()  # doctest: +SKIP
        >>> oodil.evaluate(policy, "oodil/Hopper-v0", {"gravity": 12.0}).mean_return  # doctest: +SKIP
    """
    return evaluate_policy(policy.gaussian, environment, dynamics or {}, episodes, derive_key(seed, "evaluate"))


def default_folder(config: RunConfig) -> Path:
    """Return where a run lies unless its caller says otherwise."""
    return Path("runs") / f"{config.name}-seed{config.seed}"
