"""Stage 4: how transferable each demonstration is, and its weight, from readings of the clusters' imitators (Eqn 6).

One job per imitator; what is done with the readings (which training counts, verdicts, weights) trains nothing again.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import (
    best_mode,
    intervals,
    kept_weights,
    share_lasted,
    transferability_of_divergences,
)
from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.environments import environment_spec, make_batch
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import (
    Imitator,
    Reading,
    ScoreHistory,
    Transferability,
    load_cluster_model,
)
from oodil.pipeline.seeding import derive_key, numpy_rng
from oodil.pipeline.stage import Cost, JobContext, Run, register
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.imitators import ClusterJob, ImitatorsStage, cluster_of, load_assignment
from oodil.pipeline.stages.weighting import Weighting

READ_EPISODES = 32
"""Fresh episodes of an imitator that its demonstrations are held against."""
READING_STEP_S = 7e-3
"""Seconds of one core that a step of a repetition takes with batches of 512; in quickstarts, episodes included."""


class TransferabilityStage(Weighting):
    """The weighting of the method: what an imitator of its own cluster can reproduce of a demonstration."""

    name = "transferability"
    title = "ours"
    version = 7
    jobs_are_read = True
    inputs = ("demonstrations", "clustering", "imitators")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return how the imitators are read, and how scores become weights."""
        return self.job_settings(config) | {"kept_from": config.transferability.kept_from}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return how the imitators are read."""
        section = config.transferability.reading
        reader = {"discriminator": section.discriminator}
        if section.discriminator == "last":
            return reader  # The other fields are about fresh ones alone.
        return reader | {"reading": section.model_dump(exclude={"discriminator"})}

    def rule(self, config: RunConfig) -> str:
        """Say what is kept."""
        share = config.transferability.kept_from
        if share == 0:
            return super().rule(config)
        return f"{super().rule(config)}, if the whole interval reaches {share:.0%} of the best mode's score"

    def weights(self, found: Transferability) -> NDArray[np.float64]:
        """Return (N,) weights of scores and intervals, of those that are kept."""
        return kept_weights(found.scores, found.intervals, found.threshold)

    def jobs(self, run: Run) -> list[str]:
        """Return one job per imitator, under its name."""
        return ImitatorsStage().jobs(run)

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all readings if no cluster is empty."""
        section = config.transferability
        if section.reading.discriminator == "last":
            return Cost()
        jobs, reading = config.clustering.num_clusters * section.num_trainings, section.reading
        job_s = reading.steps * reading.repetitions * READING_STEP_S * reading.batch_size / 512
        return Cost(episodes=jobs * READ_EPISODES, compute_s=jobs * job_s, jobs=jobs)

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Read the demonstrations of a cluster against fresh episodes of its imitator, or by its own discriminator."""
        from oodil.pipeline.algorithms.reading import LastDiscriminator

        cluster = ClusterJob.of(run, job)
        imitator = Imitator.load(run.job_artifact(ImitatorsStage.name, job))
        readers = cluster.readers(run.config)
        if isinstance(readers, LastDiscriminator):
            readers.load(imitator.discriminator)
            divergences = readers.divergences(cluster.demonstrations)
            return Reading(cluster.members, divergences, env_steps=0, readers=imitator.discriminator).files()
        played = self._episodes(run.config, cluster, imitator.policy)
        env_steps = sum(len(episode.states) - 1 for episode in played)
        lasting = cluster.learner(run.config).reward_model.ends.until_limit(played)
        divergences = readers.train(Demonstrations.of(lasting, "imitator"), context.progress)
        return Reading(cluster.members, divergences, env_steps, readers.arrays()).files()

    def _episodes(self, config: RunConfig, cluster: ClusterJob, policy: GaussianPolicy) -> list[Episode]:
        """Return fresh episodes of an imitator's mean actions: noise is no part of what it can do."""
        simulators = make_batch(config.environment.id, config.environment.dynamics, READ_EPISODES)
        rng, starts = numpy_rng(derive_key(cluster.seed, "episodes")), cluster.starts(config)
        return run_episodes(simulators, policy, rng, stochastic=False, starts=starts)

    def combine(self, run: Run) -> Files:
        """Take each cluster's closest imitator and turn its readings into scores, verdicts and weights."""
        demonstrations, section = load_demonstrations(run), run.config.transferability
        fresh = section.reading.discriminator == "fresh"
        divergences = np.empty((section.reading.repetitions if fresh else 1, len(demonstrations)))
        history, read_from, env_steps = {}, {}, 0
        for cluster, jobs in self._by_cluster(run).items():
            env_steps += sum(Reading.load(run.job_artifact(self.name, job)).env_steps for job in jobs)
            job = read_from[cluster] = self._closest(run, jobs)
            reading = Reading.load(run.job_artifact(self.name, job))
            divergences[:, reading.demonstrations] = reading.divergences
            history[cluster] = ScoreHistory.load(run.job_artifact(ImitatorsStage.name, job))
        labels = load_assignment(run).labels
        readings = self._readings(run.config, demonstrations, divergences)
        threshold = section.kept_from * best_mode(readings, labels, section.kept_from)
        # The readers of a demonstration that is alone in its cluster have seen it: there are no halves.
        found = self._judged(run.config, readings, labels, threshold, seen=np.bincount(labels)[labels] == 1)
        return replace(found, env_steps=env_steps, read_from=read_from, history=history).files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Return scores by the frozen clusters and readers, and weights among these demonstrations.

        One that is unlike all members of its cluster (`Neighborhood`) gets no score.
        """
        from oodil.pipeline.algorithms.clustering import ClusterModel
        from oodil.pipeline.algorithms.novelty import Neighborhood

        model = ClusterModel.from_arrays(load_cluster_model(run.artifact("clustering")))
        labeled = model.label(demonstrations, run.config.clustering.label_draws, run.config.seed)
        labels, assignment, known = labeled.labels, load_assignment(run), load_demonstrations(run)
        unlike = ~np.isin(labels, assignment.labels)
        divergences = np.full((run.config.transferability.reading.num_readers, len(demonstrations)), np.inf)
        read_from = self.load(run).read_from
        for cluster in set(np.unique(labels).tolist()) & set(read_from):
            job = read_from[cluster]
            reading = Reading.load(run.job_artifact(self.name, job))
            readers = ClusterJob.of(run, job).readers(run.config)
            readers.load(reading.readers)
            new, members = np.flatnonzero(labels == cluster), assignment.members(cluster)
            chosen = demonstrations.select(new)
            divergences[:, new] = readers.divergences(chosen)
            around = Neighborhood(known.select(members), assignment.features[members], readers.view)
            unlike[new] = around.unlike(chosen, labeled.features[new])
        readings = self._readings(run.config, demonstrations, divergences)
        readings[:, unlike] = np.nan
        seen = np.zeros(len(demonstrations), np.bool_)
        return self._judged(run.config, readings, labels, self.load(run).threshold, seen)

    def _by_cluster(self, run: Run) -> dict[int, list[str]]:
        """Return the jobs of each cluster that has demonstrations."""
        jobs: dict[int, list[str]] = {}
        for job in self.jobs(run):
            jobs.setdefault(cluster_of(job), []).append(job)
        return jobs

    def _closest(self, run: Run, jobs: list[str]) -> str:
        """Return the job whose imitator comes closest to its cluster: what one can reproduce is transferable."""
        return min(jobs, key=lambda job: Imitator.load(run.job_artifact(ImitatorsStage.name, job)).distance)

    def _readings(self, config: RunConfig, demonstrations: Demonstrations, divergences: np.ndarray) -> np.ndarray:
        environment = config.environment
        horizon = environment_spec(environment.id, environment.dynamics).max_episode_steps
        return transferability_of_divergences(divergences) * share_lasted(demonstrations, horizon)

    def _judged(
        self, config: RunConfig, readings: np.ndarray, labels: np.ndarray, threshold: float, seen: NDArray[np.bool_]
    ) -> Transferability:
        scores = readings.mean(axis=0)
        single = config.transferability.reading.discriminator == "last"
        limits = np.stack((scores, scores), axis=1) if single else intervals(readings, seen)
        return Transferability(scores, kept_weights(scores, limits, threshold), labels, limits, threshold)


register(TransferabilityStage())
