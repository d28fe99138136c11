"""How long cluster jobs have to be: what they would say if they ended after each tenth of their budget.

Trains the cluster jobs of a run whose demonstrations are clustered, on as many processes as are asked for. Ten times on
the way, a copy of each discriminator settles against the imitator as it then is and is read, as the stage does at a
job's end. The true return is recorded and decides nothing. Run ``python benchmarks/job_budget.py RUN_DIR --json FILE``.
"""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from common import UNUSED, Quiet, arguments_of, circumstances, one_thread, save
from numpy.typing import NDArray

import oodil
from oodil.pipeline.algorithms.gail import imitator
from oodil.pipeline.algorithms.weights import share_lasted, sharpened_weights, transferability_of_logits
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.runs import separation_metrics
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stages.imitators import ClusterJob, ImitatorsStage
from oodil.pipeline.training import Probe, experience, train

READINGS = 10
EPISODES = 8


def train_job(run_dir: Path, name: str) -> dict[str, NDArray]:
    """Return the job's env steps (E,), its demonstrations (N,), their settled logits (E, N) and true returns (E,)."""
    run = oodil.open_run(run_dir).run
    config, section = run.config, run.config.transferability
    environment, gail = config.environment, section.gail
    cluster, spec = ClusterJob.of(run, name), environment_spec(environment.id, environment.dynamics)
    weights = np.ones(len(cluster.members))
    learner = imitator(
        spec.observation_dim,
        spec.action_dim,
        spec.max_episode_steps,
        cluster.demonstrations,
        weights,
        gail,
        cluster.seed,
    )

    def settled() -> NDArray[np.float64]:
        reward = cluster.reward(config, learner.reward_model.discriminator_arrays())
        policy, horizon = learner.behavior_policy(), spec.max_episode_steps
        batch = experience(policy, environment, gail, horizon, cluster.seed, Quiet())
        reward.settle(batch, section.final_steps, gail.steps_per_iteration)
        return reward.mean_logits(cluster.demonstrations)

    def true_return() -> NDArray[np.float64]:
        policy, key = learner.behavior_policy(), derive_key(cluster.seed, "budget")
        return np.array(evaluate(policy, environment.id, environment.dynamics, EPISODES, key).mean_return)

    probes = [Probe("logits", READINGS, settled), Probe("return", READINGS, true_return)]
    history = train(learner, environment, gail, probes, Quiet(), UNUSED)
    return {
        "env_steps": history.steps("logits"),
        "demonstrations": cluster.members,
        "logits": history.values("logits"),
        "returns": history.values("return"),
    }


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    found = circumstances()
    results = oodil.open_run(arguments.run_dir)
    config, demonstrations, marks = results.config, results.demonstrations, results.marks()
    names = ImitatorsStage().jobs(results.run)
    with ProcessPoolExecutor(arguments.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = list(pool.map(train_job, [arguments.run_dir] * len(names), names))

    logits = np.full((READINGS, len(demonstrations)), np.inf)
    rows = {}
    for name, job in zip(names, jobs, strict=True):
        members = job["demonstrations"]
        # Of several trainings of a cluster the one that comes closest counts, as it does in a run.
        closer = job["logits"].mean(axis=1) < logits[:, members].mean(axis=1)
        logits[np.ix_(closer, members)] = job["logits"][closer]
        counts = np.bincount(demonstrations.sources[members], minlength=len(demonstrations.source_labels))
        scores = transferability_of_logits(job["logits"]).mean(axis=1)
        rows[name] = {
            "sources": dict(zip(demonstrations.source_labels, counts.tolist(), strict=True)),
            "scores": scores.tolist(),
            "returns": job["returns"].tolist(),
        }
        print(f"{name} {counts.tolist()}: " + " ".join(f"{score:.4f}" for score in scores))
    horizon = environment_spec(config.environment.id, config.environment.dynamics).max_episode_steps
    by_budget: dict[str, list[float]] = {"env_steps": jobs[0]["env_steps"].tolist()}
    if marks is not None and 0 < marks.sum() < len(marks):
        for scores in transferability_of_logits(logits) * share_lasted(demonstrations, horizon):
            weights = sharpened_weights(scores, config.transferability.sharpening)
            for figure, value in separation_metrics(marks, scores, weights, demonstrations).items():
                by_budget.setdefault(figure, []).append(value)
    for figure, values in by_budget.items():
        print(f"{figure}: " + " ".join(f"{value:.7g}" for value in values))
    # Without the sources, whose paths are of this machine.
    used = config.model_dump(mode="json", include={"name", "seed", "environment", "transferability"})
    save(arguments.json, found | {"config": used, "by_budget": by_budget, "jobs": rows})


if __name__ == "__main__":
    main()
