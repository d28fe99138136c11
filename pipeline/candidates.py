"""What a training gives: of some points in its second half, the policy that came closest to the demonstrations.

Adversarial training does not come to rest. A policy that walks at one point falls at another, and the end is no better
than the points before it. The distance to the demonstrations, which needs no reward, tells them apart.

Letters: M candidates, P parameters of all networks.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import ModuleList
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.evaluation import distance_of
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.training import History, Probe

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner

EPISODES = 8
"""Mean-action episodes of each candidate, from the same starts for all."""
NAME = "candidates"


class Candidates:
    """The candidates of one training."""

    def __init__(self, learner: "Learner[AdversarialReward]", environment: EnvironmentConfig, count: int) -> None:
        """Prepare for ``count`` of them, evenly spaced; the last one is the end of the training."""
        self._learner, self._environment = learner, environment
        self._networks = ModuleList([learner.policy, learner.value, learner.reward_model.discriminator])
        self.probe = Probe(NAME, count, self._measure, second_half=True)

    def keep_closest(self, history: History) -> int:
        """Set the networks back to the closest candidate; return the environment steps after which it was one."""
        candidates = history.values(NAME)
        closest = int(candidates[:, 0].argmin())
        parameters = torch.from_numpy(candidates[closest, 1:].astype(np.float32))
        vector_to_parameters(parameters, self._networks.parameters())
        return int(history.steps(NAME)[closest])

    def _measure(self) -> NDArray[np.float64]:
        """Return (1 + P,) the distance of the networks as they are, and their parameters."""
        learner = self._learner
        key = derive_key(learner.root_seed, NAME)
        distance = distance_of(learner.behavior_policy(), learner.reward_model, self._environment, EPISODES, key)
        return np.append(distance, parameters_to_vector(self._networks.parameters()).detach().numpy())
