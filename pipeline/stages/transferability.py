"""Stage 4: how transferable every demonstration is, read from the discriminators of the clusters' imitators (Eqn 6).

A discriminator is read after it has gone on learning for a while against the finished imitator. One job per imitator;
what is done with the readings (which training counts, weights) trains nothing again.
"""

from typing import Any

import numpy as np

from oodil.pipeline.algorithms.weights import share_lasted, sharpened_weights, transferability_of_logits
from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.results import (
    Imitator,
    ScoreHistory,
    Transferability,
    discriminator_file,
    load_cluster_model,
    load_discriminator,
)
from oodil.pipeline.stage import JobContext, Run, register
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.imitators import ClusterJob, ImitatorsStage, cluster_of, load_assignment
from oodil.pipeline.stages.weighting import Weighting


class TransferabilityStage(Weighting):
    """The weighting of the method: what an imitator of its own cluster can reproduce of a demonstration."""

    name = "transferability"
    title = "ours"
    version = 2
    inputs = ("demonstrations", "clustering", "imitators")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return how the discriminators are read, and how scores become weights."""
        return self.job_settings(config) | {"sharpening": config.transferability.sharpening}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return how the discriminators are read."""
        return {"final_steps": config.transferability.final_steps}

    def rule(self, config: RunConfig) -> str:
        """Say how sharp the weights are."""
        power = config.transferability.sharpening
        return super().rule(config) + ("" if power == 1 else f" to the power {power:g}")

    def jobs(self, run: Run) -> list[str]:
        """Return one job per imitator, under its name."""
        return ImitatorsStage().jobs(run)

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Let a discriminator go on against the imitator as it is, and score the demonstrations of its cluster."""
        from oodil.pipeline.training import experience

        config, section = run.config, run.config.transferability
        cluster = ClusterJob.of(run, job)
        trained = run.job_artifact(ImitatorsStage.name, job)
        imitator = Imitator.load(trained)
        reward = cluster.reward(config, imitator.discriminator)
        horizon = environment_spec(config.environment.id, config.environment.dynamics).max_episode_steps
        batch = experience(imitator.policy, config.environment, section.gail, horizon, cluster.seed, context)
        reward.settle(batch, section.final_steps, section.gail.steps_per_iteration)
        history = ScoreHistory.load(trained).then(batch.terminated.size, reward.mean_logits(cluster.demonstrations))
        return history.files() | discriminator_file(reward.discriminator_arrays())

    def combine(self, run: Run) -> Files:
        """Take each cluster's closest imitator and turn the scores into weights."""
        demonstrations = load_demonstrations(run)
        logits = np.full(len(demonstrations), np.nan)
        history, env_steps = {}, 0
        for cluster, jobs in self._by_cluster(run).items():
            readings = {job: ScoreHistory.load(run.job_artifact(self.name, job)) for job in jobs}
            env_steps += sum(int(reading.env_steps[-1] - reading.env_steps[-2]) for reading in readings.values())
            history[cluster] = readings[_closest(readings)]
            logits[history[cluster].demonstrations] = history[cluster].logits[-1]
        return self._weighted(run, demonstrations, logits, load_assignment(run).labels, env_steps, history).files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Return scores by the frozen clusters and discriminators, and weights among these demonstrations.

        Raises DataError when the states have another dimension than those of the run.
        """
        from oodil.pipeline.algorithms.clustering import ClusterModel

        model = ClusterModel.from_arrays(load_cluster_model(run.artifact("clustering")))
        labels = model.label(demonstrations, run.config.clustering.label_draws, run.config.seed).labels
        logits = np.full(len(demonstrations), np.nan)
        by_cluster = self._by_cluster(run)
        for cluster in np.unique(labels).tolist():
            if cluster not in by_cluster:
                logits[labels == cluster] = np.inf  # Nothing like it was imitated, so nothing of it is reproduced.
                continue
            jobs = by_cluster[cluster]
            readings = {job: ScoreHistory.load(run.job_artifact(self.name, job)) for job in jobs}
            job = _closest(readings)
            settled = load_discriminator(run.job_artifact(self.name, job))
            reward = ClusterJob.of(run, job).reward(run.config, settled)
            members = np.flatnonzero(labels == cluster)
            logits[members] = reward.mean_logits(demonstrations.select(members))
        return self._weighted(run, demonstrations, logits, labels, 0, {})

    def _by_cluster(self, run: Run) -> dict[int, list[str]]:
        """Return the jobs of each cluster that has demonstrations."""
        jobs: dict[int, list[str]] = {}
        for job in self.jobs(run):
            jobs.setdefault(cluster_of(job), []).append(job)
        return jobs

    def _weighted(
        self,
        run: Run,
        demonstrations: Demonstrations,
        logits: np.ndarray,
        labels: np.ndarray,
        env_steps: int,
        history: dict[int, ScoreHistory],
    ) -> Transferability:
        environment = run.config.environment
        horizon = environment_spec(environment.id, environment.dynamics).max_episode_steps
        scores = transferability_of_logits(logits) * share_lasted(demonstrations, horizon)
        weights = sharpened_weights(scores, run.config.transferability.sharpening)
        return Transferability(scores, weights, labels, env_steps, history)


def _closest(readings: dict[str, ScoreHistory]) -> str:
    """Return the job whose imitator is told apart least: what one imitator can reproduce is transferable."""
    return min(readings, key=lambda job: float(readings[job].logits[-1].mean()))


register(TransferabilityStage())
