"""How long cluster jobs have to be: what they would say if they ended after each tenth of their budget.

Trains the cluster jobs of a run whose demonstrations are clustered, on as many processes as are asked for. Ten times on
the way, a copy of each discriminator settles against the imitator as it then is and is read, as the stage does at a
job's end. The true return is recorded and decides nothing. ``python benchmarks/job_budget.py RUN_DIR --json FILE``.
"""

# ruff: noqa: E402  (threads are limited before NumPy is imported, and the program may not be installed)
import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import copy
import json
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from benchmarks.gail_reference import Quiet
from benchmarks.throughput import machine
from pipeline.algorithms.gail import AdversarialReward
from pipeline.algorithms.learner import Learner
from pipeline.algorithms.transferability import sampling_mass, share_lasted, sharpened_weights, transferability
from pipeline.artifacts import Checkpoints
from pipeline.environments import make_batch
from pipeline.evaluation import evaluate
from pipeline.seeding import derive_key, torch_seed
from pipeline.stages.demonstrations import load_demonstrations, transferable_mask
from pipeline.training import Probe, experience, train
from pipeline.versions import library_versions
from walk import read_run

READINGS = 10


def labels_of(run_dir: Path) -> NDArray[np.int64]:
    return read_run(run_dir).artifact("clustering").arrays("assignment.safetensors")["labels"]


def train_job(run_dir: Path, cluster: int, total_steps: int) -> dict[str, NDArray]:
    """Return the job's env steps (E,), its demonstrations (N,), their settled logits (E, N) and true returns (E,)."""
    run = read_run(run_dir)
    environment, section = run.config.environment, run.config.transferability
    gail = section.gail.model_copy(update={"total_steps": total_steps})
    members = np.flatnonzero(labels_of(run_dir) == cluster)
    demonstrations = load_demonstrations(run).select(members)
    seed = torch_seed(derive_key(run.config.seed, "transferability", f"cluster-{cluster}"))
    simulators = make_batch(environment.id, environment.dynamics, 1)
    reward = AdversarialReward(demonstrations, np.ones(len(members)), gail.discriminator, seed)
    learner = Learner(simulators.observation_dim, simulators.action_dim, gail, reward, seed)

    def settled() -> NDArray[np.float64]:
        training = reward.discriminator
        reward.discriminator = copy.deepcopy(training)
        policy = learner.behaviour_policy()
        rollouts = experience(policy, environment, gail, simulators.max_episode_steps, seed, Quiet())
        reward.settle(rollouts, section.final_steps, gail.steps_per_iteration)
        logits = reward.mean_logits(demonstrations)
        reward.discriminator = training
        return logits

    def true_return() -> NDArray[np.float64]:
        seen = evaluate(learner.behaviour_policy(), environment.id, environment.dynamics, 8, derive_key(seed, "budget"))
        return np.asarray(seen.returns.mean())

    probes = [Probe("logits", READINGS, settled), Probe("return", READINGS, true_return)]
    history = train(learner, environment, gail, probes, Quiet(), Checkpoints(Path("unused"), {}))
    return {
        "env_steps": history.steps("logits"),
        "demonstrations": members,
        "logits": history.values("logits"),
        "returns": history.values("return"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--steps", type=int, help="budget of each job; by default that of the run's configuration")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    run = read_run(arguments.run_dir)
    config, demonstrations = run.config, load_demonstrations(run)
    steps = arguments.steps or config.transferability.gail.total_steps
    clusters = np.unique(labels_of(arguments.run_dir)).tolist()
    with ProcessPoolExecutor(arguments.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        count = len(clusters)
        jobs = list(pool.map(train_job, [arguments.run_dir] * count, clusters, [steps] * count))

    logits = np.empty((READINGS, len(demonstrations)))
    rows = {}
    for cluster, job in zip(clusters, jobs, strict=True):
        members = job["demonstrations"]
        logits[:, members] = job["logits"]
        counts = np.bincount(demonstrations.sources[members], minlength=len(demonstrations.source_labels))
        scores = transferability(job["logits"]).mean(axis=1)
        rows[f"cluster {cluster}"] = {
            "sources": dict(zip(demonstrations.source_labels, counts.tolist(), strict=True)),
            "scores": scores.tolist(),
            "returns": job["returns"].tolist(),
        }
        print(f"cluster {cluster} {counts.tolist()}: " + " ".join(f"{score:.4f}" for score in scores))
    horizon = make_batch(config.environment.id, config.environment.dynamics, 1).max_episode_steps
    all_scores = transferability(logits) * share_lasted(demonstrations, horizon)
    summary: dict[str, list[float]] = {"env_steps": jobs[0]["env_steps"].tolist()}
    marked = transferable_mask(config, demonstrations)
    if marked is not None:
        weights = [sharpened_weights(scores, config.transferability.sharpening) for scores in all_scores]
        summary["transferable_share"] = [float(sampling_mass(w, demonstrations)[marked].sum()) for w in weights]
        summary["auroc"] = [float(roc_auc_score(marked, scores)) for scores in all_scores]
        print("transferable share: " + " ".join(f"{share:.1%}" for share in summary["transferable_share"]))
    if arguments.json:
        # Without the sources, whose paths are of this machine.
        used = config.model_dump(mode="json", include={"name", "seed", "environment", "transferability"})
        whole = {"machine": machine(), "versions": library_versions(), "config": used}
        arguments.json.write_text(json.dumps(whole | {"by_budget": summary, "jobs": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
