"""What an experiment has found, as JSON values: a cell per row, method and seed, of whatever is finished.

Nothing here depends on when, where or in which order anything was computed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import RunDirectory
from oodil.pipeline.config import EnvironmentConfig, RunConfig
from oodil.pipeline.environments import environment_spec, make_batch
from oodil.pipeline.environments.goals import reached_goal
from oodil.pipeline.errors import ExpertError
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.experiment import ExperimentConfig, PlannedRun, labels
from oodil.pipeline.loading import SHIPPED
from oodil.pipeline.policy import Controller
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import RunResults
from oodil.pipeline.seeding import derive_key, numpy_rng
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.demonstrations import hand_written
from oodil.pipeline.stages.experts import load_expert

EPISODES = 16
"""Of random actions, and of a hand-written controller; their seed is 0 for every row."""


def records(
    experiment: ExperimentConfig, runs: Sequence[PlannedRun], folder: Path, failed: Mapping[str, str]
) -> dict[str, Any]:
    """Return what the runs in a folder have found; ``failed`` has a traceback for each run that did not get through."""
    cells: dict[tuple[str, str, int], dict[str, Any]] = {}
    failures, missing = [], []
    for run in runs:
        results = RunResults(Run(run.config, RunDirectory(folder / run.name)))
        for method, policy in run.methods.items():
            if results.is_done(policy):
                cells[run.row, method, run.seed] = _cell(results, run, method, policy)
            elif run.name in failed:
                reason = _reason(failed[run.name], run, method).replace(f"{folder.absolute()}/", "")
                failures.append({"row": run.row, "seed": run.seed, "method": method, "reason": reason})
            else:
                missing.append([run.row, method, run.seed])
    ordered = [
        cells[row, method.name, seed]
        for row in experiment.rows
        for method in experiment.methods
        for seed in experiment.seeds_of(row)
        if (row, method.name, seed) in cells
    ]
    first = {run.row: run.config for run in reversed(runs)}
    by_environment = {config.environment.model_dump_json(): config for config in first.values()}
    random = {key: random_return(config.environment) for key, config in by_environment.items()}
    expert = {key: expert_return(config) for key, config in by_environment.items()}
    environment_of = {row: first[row].environment.model_dump_json() for row in experiment.rows}
    return {
        "experiment": experiment.name,
        "caption": experiment.caption,
        "methods": labels(experiment, list(runs)),
        "rows": list(experiment.rows),
        "seeds": sorted({run.seed for run in runs}),
        "figure": experiment.measure,
        "published": experiment.published,
        "source": experiment.source,
        "cells": ordered,
        "failed": failures,
        "missing": missing,
        "random_return": {row: random[key] for row, key in environment_of.items()},
        "expert_return": {row: expert[key] for row, key in environment_of.items()},
    }


def _reason(failed: str, run: PlannedRun, method: str) -> str:
    """Return why a method of a run failed: the last line about one of its stages, or of all if none is named."""
    lines, stages = failed.strip().splitlines(), {stage.name for stage in run.stages([method])}
    return next((line for line in reversed(lines) if line.partition(":")[0] in stages), lines[-1])


def _cell(results: RunResults, run: PlannedRun, method: str, policy: str) -> dict[str, Any]:
    """Return the figures of a method in a run."""
    final, curve, config = results.evaluation(policy), results.curve(policy), results.config
    (stage,) = [stage for stage in results.policies if stage.name == policy]
    weighting = stage.weighting
    environment = config.environment
    limit = environment_spec(environment.id, environment.dynamics).max_episode_steps
    reached = reached_goal(environment.id, final.returns, final.lengths, limit)
    separation = results.separation(weighting) if weighting else {}
    is_clustered = "clustering" in {each.name for each in run.stages([method])}
    clusters = results.cluster_diagnostics if is_clustered else None
    return {
        "row": run.row,
        "method": method,
        "seed": run.seed,
        "mean_return": final.mean_return,
        "std_return": final.std_return,
        "share_reached": None if reached is None else float(reached.mean()),
        "auroc": separation.get("auroc"),
        "share_before": separation.get("share_before"),
        "share_after": separation.get("share"),
        "effective_number": separation.get("effective_number"),
        "distance": results.trainings(policy).trainings[0].distance,
        "env_steps": results.env_steps_of(stage),
        "clusters_used": clusters and clusters.non_empty_clusters,
        "purity": clusters and clusters.purity,
        "curve": {"env_steps": curve.env_steps.tolist(), "mean_return": curve.mean_return.tolist()},
        **(_by_source(results, results.weighting(weighting)) if weighting else {"sources": {}, "scores": {}}),
    }


def _by_source(results: RunResults, found: Transferability) -> dict[str, dict[str, float]]:
    """Return the mean weight and the mean score of each source's demonstrations."""
    demonstrations = results.demonstrations
    of_source = {
        label: demonstrations.sources == i
        for i, label in enumerate(demonstrations.source_labels)
        if (demonstrations.sources == i).any()
    }
    return {
        "sources": {label: float(found.weights[mine].mean()) for label, mine in of_source.items()},
        "scores": {label: float(found.scores[mine].mean()) for label, mine in of_source.items()},
    }


class _RandomActions:
    """Acts at random, evenly between the bounds; where there is none, between -1 and 1."""

    def __init__(self, action_dim: int, rng: np.random.Generator) -> None:
        self._action_dim = action_dim
        self._rng = rng

    def mean(self, observations: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return (G, A) actions in units of the action space."""
        return self._rng.uniform(-1, 1, (len(observations), self._action_dim)).astype(np.float32)


def random_return(environment: EnvironmentConfig) -> float:
    """Return the mean true return of random actions."""
    spec, rng = environment_spec(environment.id, environment.dynamics), numpy_rng(derive_key(0, "random actions"))
    return _mean_return(environment, _RandomActions(spec.action_dim, rng))


def expert_return(config: RunConfig) -> float | None:
    """Return what an expert of the imitator's own dynamics returns; None where there is none.

    It is the environment's hand-written controller where that demonstrates, else a saved expert with its mean actions,
    which is looked for beside the experts of the sources and among those that come with oodil.
    """
    environment, sources = config.environment, config.demonstrations.sources
    beside = [source.expert_folder.parent for source in sources if source.expert_folder]
    if sources and not beside:
        controller = hand_written(make_batch(environment.id, environment.dynamics, EPISODES), environment.id)
        return _mean_return(environment, controller)
    for folder in dict.fromkeys([*beside, SHIPPED / "experts"]):
        for path in sorted(folder.iterdir()):
            try:
                described = load_expert(path)[1].json("expert.json")
            except ExpertError:
                continue
            if described["environment"] == environment.model_dump():
                return float(described["deterministic"]["return_mean"])
    return None


def _mean_return(environment: EnvironmentConfig, controller: Controller) -> float:
    simulators, rng = make_batch(environment.id, environment.dynamics, EPISODES), numpy_rng(derive_key(0, "reference"))
    episodes = run_episodes(simulators, controller, rng, stochastic=False)
    return float(np.mean([episode.env_return for episode in episodes]))
