"""Stage 5, of the method: its policy goes on from the imitator of what it learns most from."""

from typing import TYPE_CHECKING, Any

import numpy as np

from oodil.pipeline.config import RunConfig
from oodil.pipeline.results import Imitator, Transferability
from oodil.pipeline.stage import Run, register
from oodil.pipeline.stages.imitators import ImitatorsStage
from oodil.pipeline.stages.policies import PolicyStage, refuse_other_widths
from oodil.pipeline.stages.transferability import TransferabilityStage

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner


class ImitationStage(PolicyStage):
    """Weighted GAIL, every second training of which begins anew.

    The others, the first among them, begin where the job of a cluster ended: what was learned there is not learned
    twice. But a policy that does one thing well may never find another, so not all trainings have that in common.
    """

    version = 7

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

    def goes_on(self, config: RunConfig, job: str) -> bool:
        """Return whether a training goes on from an imitator."""
        return config.imitation.warm_start and int(job.removeprefix("training-")) % 2 == 1

    def begin(self, run: Run, learner: "Learner[AdversarialReward]") -> None:
        """Take over policy and value function of the cluster of which most transitions are drawn, with less noise."""
        found = Transferability.load(run.artifact(TransferabilityStage.name))
        drawn = np.bincount(found.clusters, found.weights * (self.demonstrations(run).lengths - 1))
        imitator = Imitator.load(run.job_artifact(ImitatorsStage.name, found.read_from[int(drawn.argmax())]))
        learner.continue_from(imitator.policy, imitator.value, run.config.imitation.gail.least_std)


register(ImitationStage())
