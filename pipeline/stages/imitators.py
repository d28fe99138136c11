"""Stage 3: one independent GAIL job per cluster, in the imitator's own environment (Eqn 5).

The true reward plays no part. What the discriminators say of the demonstrations is the next stage's affair.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.results import Arrays, Assignment, Imitator, ScoreHistory, TrainedImitators
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import JobContext, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward


@dataclass(frozen=True)
class ClusterJob:
    """The demonstrations of one cluster, which an imitator of their own is trained on."""

    members: NDArray[np.intp]
    """Which of all demonstrations they are."""
    demonstrations: Demonstrations
    seed: int

    @classmethod
    def of(cls, run: Run, job: str) -> "ClusterJob":
        """Return the job of that name."""
        members = load_assignment(run).members(cluster_of(job))
        seed = torch_seed(derive_key(run.config.seed, "transferability", job))
        return cls(members, load_demonstrations(run).select(members), seed)

    def reward(self, config: RunConfig, discriminator: Arrays) -> "AdversarialReward":
        """Return the reward model of a trained discriminator."""
        from oodil.pipeline.algorithms.gail import AdversarialReward

        weights = np.ones(len(self.members))
        section = config.transferability.gail.discriminator
        reward = AdversarialReward(self.demonstrations, weights, section, 1, self.seed)
        reward.load_discriminator(discriminator)
        return reward


class ImitatorsStage(Stage):
    """A job per cluster and training, each with its own checkpoint and artifact; empty clusters have none."""

    name = "imitators"
    version = 1
    inputs = ("demonstrations", "clustering")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the number of trainings and what each depends on."""
        return self.job_settings(config) | {"num_trainings": config.transferability.num_trainings}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what a training depends on."""
        gail = config.transferability.gail.model_dump(mode="json")
        return {"gail": gail, "environment": config.environment.model_dump()}

    def jobs(self, run: Run) -> list[str]:
        """Return the jobs of each cluster that has demonstrations, named by the cluster's id."""
        clusters = [f"cluster-{k}" for k in np.unique(load_assignment(run).labels)]
        again = range(2, run.config.transferability.num_trainings + 1)
        return clusters + [f"{cluster}-training-{n}" for n in again for cluster in clusters]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Imitate one cluster, and note what the discriminator says of its demonstrations along the way."""
        from oodil.pipeline.algorithms.gail import imitator
        from oodil.pipeline.training import Probe, train

        config, gail = run.config, run.config.transferability.gail
        cluster = ClusterJob.of(run, job)
        spec = environment_spec(config.environment.id, config.environment.dynamics)
        weights = np.ones(len(cluster.members))  # All demonstrations of a cluster weigh the same.
        learner = imitator(
            spec.observation_dim,
            spec.action_dim,
            spec.max_episode_steps,
            cluster.demonstrations,
            weights,
            gail,
            cluster.seed,
        )
        reward = learner.reward_model
        probe = Probe("logits", config.evaluation.num_scores, lambda: reward.mean_logits(cluster.demonstrations))
        seen = train(learner, config.environment, gail, [probe], context, self.checkpoints(run, job))
        history = ScoreHistory(cluster.members.astype(np.int64), seen.steps("logits"), seen.values("logits"))
        trained = Imitator(learner.behavior_policy(), reward.discriminator_arrays())
        return trained.files() | history.files()

    def combine(self, run: Run) -> Files:
        """List the trained imitators, and add up what they took."""
        gail = run.config.transferability.gail
        jobs = self.jobs(run)
        return TrainedImitators(
            env_steps=len(jobs) * gail.num_iterations * gail.steps_per_iteration,
            sha256={job: run.job_artifact(self.name, job).sha256 for job in jobs},
        ).files()

    def env_steps(self, run: Run) -> int:
        """Return the environment steps of all imitators together."""
        return TrainedImitators.load(run.artifact(self.name)).env_steps


def cluster_of(job: str) -> int:
    """Return the id of the cluster that a job is about."""
    return int(job.split("-")[1])


def load_assignment(run: Run) -> Assignment:
    """Return which cluster each demonstration belongs to."""
    return Assignment.load(run.artifact("clustering"))


register(ImitatorsStage())
