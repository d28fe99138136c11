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

from benchmarks.gail_reference import Quiet
from benchmarks.throughput import machine
from oodil.orchestrator import read_run
from oodil.pipeline.algorithms.weights import share_lasted, transferability_of_logits
from oodil.pipeline.artifacts import Checkpoints
from oodil.pipeline.environments import make_batch
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.transferability import ClusterJob, TransferabilityStage, told_apart
from oodil.pipeline.training import Probe, train
from oodil.pipeline.versions import library_versions

READINGS = 10


def train_job(run_dir: Path, name: str) -> dict[str, NDArray]:
    """Return the job's env steps (E,), its demonstrations (N,), their settled logits (E, N) and true returns (E,)."""
    run = read_run(run_dir)
    environment, gail = run.config.environment, run.config.transferability.gail
    job = ClusterJob.of(run, name)

    def settled() -> NDArray[np.float64]:
        training = job.reward.discriminator
        job.reward.discriminator = copy.deepcopy(training)
        job.settle(Quiet())
        logits = job.reward.mean_logits(job.demonstrations)
        job.reward.discriminator = training
        return logits

    def true_return() -> NDArray[np.float64]:
        policy, key = job.learner.behavior_policy(), derive_key(job.seed, "budget")
        seen = evaluate(policy, environment.id, environment.dynamics, 8, key)
        return np.asarray(seen.returns.mean())

    probes = [Probe("logits", READINGS, settled), Probe("return", READINGS, true_return)]
    history = train(job.learner, environment, gail, probes, Quiet(), Checkpoints(Path("unused"), {}))
    return {
        "env_steps": history.steps("logits"),
        "demonstrations": job.members,
        "logits": history.values("logits"),
        "returns": history.values("return"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    run = read_run(arguments.run_dir)
    config, demonstrations = run.config, load_demonstrations(run)
    names = TransferabilityStage().jobs(run)
    with ProcessPoolExecutor(arguments.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = list(pool.map(train_job, [arguments.run_dir] * len(names), names))

    logits = np.empty((READINGS, len(demonstrations)))
    rows = {}
    for name, job in zip(names, jobs, strict=True):
        members = job["demonstrations"]
        logits[:, members] = job["logits"]
        counts = np.bincount(demonstrations.sources[members], minlength=len(demonstrations.source_labels))
        scores = transferability_of_logits(job["logits"]).mean(axis=1)
        rows[name] = {
            "sources": dict(zip(demonstrations.source_labels, counts.tolist(), strict=True)),
            "scores": scores.tolist(),
            "returns": job["returns"].tolist(),
        }
        print(f"{name} {counts.tolist()}: " + " ".join(f"{score:.4f}" for score in scores))
    horizon = make_batch(config.environment.id, config.environment.dynamics, 1).max_episode_steps
    all_scores = transferability_of_logits(logits) * share_lasted(demonstrations, horizon)
    readings = [told_apart(config, scores, demonstrations) for scores in all_scores]
    by_budget = {"env_steps": jobs[0]["env_steps"].tolist()}
    by_budget |= {figure: [reading[figure] for reading in readings] for figure in readings[0]}
    for figure, values in by_budget.items():
        print(f"{figure}: " + " ".join(f"{value:.7g}" for value in values))
    if arguments.json:
        # Without the sources, whose paths are of this machine.
        used = config.model_dump(mode="json", include={"name", "seed", "environment", "transferability"})
        whole = {"machine": machine(), "versions": library_versions(), "config": used}
        arguments.json.write_text(json.dumps(whole | {"by_budget": by_budget, "jobs": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
