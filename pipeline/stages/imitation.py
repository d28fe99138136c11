"""Stage 5, of the method: its policy goes on from the imitator of what it learns most from."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from oodil.pipeline.config import RunConfig
from oodil.pipeline.evaluation import DISTANCE_EPISODES, distance_of
from oodil.pipeline.results import Imitator, Transferability
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stage import Cost, Run, register
from oodil.pipeline.stages.imitators import ClusterJob, ImitatorsStage
from oodil.pipeline.stages.policies import PolicyStage, refuse_other_widths
from oodil.pipeline.stages.transferability import TransferabilityStage

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner


LOST = 1.5
"""An imitator is lost where the environment begins if it is so many times as far from what it learned as where its
demonstrations begin. It is about as far on Hopper and HalfCheetah, and 2.3 to 7.9 times on Driving, where the
demonstrations of a cluster begin in a part of the line."""


class ImitationStage(PolicyStage):
    """Weighted GAIL, every second training of which begins anew.

    The others, the first among them, begin where the job of a cluster ended: what was learned there is not learned
    twice. But a policy that does one thing well may never find another, so not all trainings have that in common, and
    none goes on from an imitator that is lost where the environment begins.
    """

    version = 8

    def __init__(self) -> None:
        super().__init__("imitation", title="ours", weighting=TransferabilityStage.name)
        self.inputs = (*self.inputs, ImitatorsStage.name)

    def check(self, config: RunConfig) -> None:
        """Refuse networks of other widths than those that are continued."""
        if config.imitation.warm_start:
            name = "transferability.gail, which it goes on from unless imitation.warm_start is false,"
            refuse_other_widths(name, config.transferability.gail, config.imitation.gail)

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what a training depends on, where those begin that go on included."""
        return super().job_settings(config) | {"warm_start": config.imitation.warm_start}

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all trainings, and of the episodes that decide how they begin."""
        cost, section = super().cost(config), config.imitation
        decided = (section.num_trainings + 1) // 2 if section.warm_start else 0
        return replace(cost, episodes=cost.episodes + decided * DISTANCE_EPISODES)

    def begin(self, run: Run, job: str, learner: "Learner[AdversarialReward]") -> tuple[bool, int]:
        """Take over policy and value function of the cluster of which most transitions are drawn, with less noise.

        Every second training begins anew, and so do all if that imitator is lost where the environment begins.
        """
        config = run.config
        if not config.imitation.warm_start or int(job.removeprefix("training-")) % 2 == 0:
            return False, 0
        found = Transferability.load(run.artifact(TransferabilityStage.name))
        drawn = np.bincount(found.clusters, found.weights * (self.demonstrations(run).lengths - 1))
        read_from = found.read_from[int(drawn.argmax())]
        imitator = Imitator.load(run.job_artifact(ImitatorsStage.name, read_from))
        cluster = ClusterJob.of(run, read_from)
        reward, key = cluster.learner(config).reward_model, derive_key(cluster.seed, "beginning")
        distance, steps = distance_of(imitator.policy, reward, config.environment, DISTANCE_EPISODES, key)
        if distance > LOST * imitator.distance:
            return False, steps
        learner.continue_from(imitator.policy, imitator.value, config.imitation.gail.least_std)
        return True, steps


register(ImitationStage())
