"""Stage 3: one independent GAIL job per cluster, in the imitator's own environment (Eqn 5).

The true reward plays no part. What the discriminators say of the demonstrations is the next stage's affair.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import environment_spec, make_batch
from oodil.pipeline.evaluation import DISTANCE_EPISODES, distance_of
from oodil.pipeline.results import Assignment, Imitator, ScoreHistory, TrainedImitators
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import Cost, JobContext, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner
    from oodil.pipeline.algorithms.reading import LastDiscriminator, Readers


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

    def starts(self, config: RunConfig) -> NDArray[np.float32] | None:
        """Return the (P, S) states from which its imitator begins: where the demonstrations do, if it can be put there.

        Where a demonstration begins is part of what is seen; an imitator that begins elsewhere could be told by that.
        """
        environment = config.environment
        if not environment_spec(environment.id, environment.dynamics).can_be_placed:
            return None
        first = self.demonstrations.observations[self.demonstrations.offsets[:-1]]
        told = make_batch(environment.id, environment.dynamics, 1).tells_state(first)
        return first[told] if told.any() else None

    def learner(self, config: RunConfig) -> "Learner[AdversarialReward]":
        """Return the untrained learner of its imitator; all demonstrations of a cluster weigh the same."""
        from oodil.pipeline.algorithms.gail import imitator

        spec = environment_spec(config.environment.id, config.environment.dynamics)
        dims = spec.observation_dim, spec.action_dim, spec.max_episode_steps
        return imitator(*dims, self.demonstrations, np.ones(len(self.members)), config.transferability.gail, self.seed)

    def readers(self, config: RunConfig) -> "Readers | LastDiscriminator":
        """Return what is to read the demonstrations; it is still untrained."""
        from oodil.pipeline.algorithms.reading import LastDiscriminator, Readers

        section = config.transferability
        if section.reading.discriminator == "last":
            return LastDiscriminator(self.demonstrations, section.gail.discriminator, self.seed)
        return Readers(self.demonstrations, section.gail.discriminator, section.reading, self.seed)


class ImitatorsStage(Stage):
    """A job per cluster and training, each with its own checkpoint and artifact; empty clusters have none."""

    name = "imitators"
    version = 5
    jobs_are_read = True
    inputs = ("demonstrations", "clustering")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the number of trainings and what each depends on."""
        return self.job_settings(config) | {"num_trainings": config.transferability.num_trainings}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what a training depends on."""
        gail = config.transferability.gail.model_dump(mode="json")
        return {"gail": gail, "environment": config.environment.settings()}

    def jobs(self, run: Run) -> list[str]:
        """Return the jobs of each cluster that has demonstrations, named by the cluster's id."""
        clusters = [f"cluster-{k}" for k in np.unique(load_assignment(run).labels)]
        again = range(2, run.config.transferability.num_trainings + 1)
        return clusters + [f"{cluster}-training-{n}" for n in again for cluster in clusters]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Imitate one cluster, and note what the discriminator says of its demonstrations along the way."""
        from oodil.pipeline.training import Probe, train

        config, gail = run.config, run.config.transferability.gail
        cluster = ClusterJob.of(run, job)
        learner = cluster.learner(config)
        reward = learner.reward_model
        probe = Probe("logits", config.evaluation.num_scores, lambda: reward.mean_logits(cluster.demonstrations))
        starts, checkpoints = cluster.starts(config), self.checkpoints(run, job)
        seen = train(learner, config.environment, gail, [probe], context, checkpoints, starts=starts)
        history = ScoreHistory(cluster.members.astype(np.int64), seen.steps("logits"), seen.values("logits"))
        policy = learner.behavior_policy()
        key = derive_key(cluster.seed, "distance")
        distance, measured = distance_of(policy, reward, config.environment, DISTANCE_EPISODES, key, starts)
        env_steps = gail.env_steps + measured
        trained = Imitator(policy, learner.value_arrays(), reward.discriminator_arrays(), distance, env_steps)
        return trained.files() | history.files()

    def combine(self, run: Run) -> Files:
        """List the trained imitators, and add up what they took."""
        artifacts = {job: run.job_artifact(self.name, job) for job in self.jobs(run)}
        return TrainedImitators(
            env_steps=sum(Imitator.load(artifact).env_steps for artifact in artifacts.values()),
            sha256={job: artifact.sha256 for job, artifact in artifacts.items()},
        ).files()

    def env_steps(self, run: Run) -> int:
        """Return the environment steps of all imitators together."""
        return TrainedImitators.load(run.artifact(self.name)).env_steps

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all imitators if no cluster is empty."""
        gail, jobs = config.transferability.gail, config.clustering.num_clusters * config.transferability.num_trainings
        cost = Cost.of_training(jobs * gail.env_steps, jobs)
        return replace(cost, episodes=jobs * DISTANCE_EPISODES)


def cluster_of(job: str) -> int:
    """Return the id of the cluster that a job is about."""
    return int(job.split("-")[1])


def load_assignment(run: Run) -> Assignment:
    """Return which cluster each demonstration belongs to."""
    return Assignment.load(run.artifact("clustering"))


register(ImitatorsStage())
