"""What a training gives: of some points in its second half, the last that is as close to the demonstrations as any.

Adversarial training does not come to rest. A policy that walks at one point falls at another, and the end is as likely
as any to be one of those. The distance to the demonstrations, which needs no reward, tells them apart.

Letters: M candidates, P parameters of all networks.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import ModuleList
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.evaluation import CANDIDATE_EPISODES, distance_of
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.training import History, Probe

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner

AS_CLOSE = 1.1
"""Times the smallest distance: so far apart lie measurements of one policy. Among equals the last has learned most."""
NAME = "candidates"


class Candidates:
    """The candidates of one training."""

    def __init__(self, learner: "Learner[AdversarialReward]", environment: EnvironmentConfig, count: int) -> None:
        """Prepare for ``count`` of them, evenly spaced; the last one is the end of the training."""
        self._learner, self._environment = learner, environment
        self._networks = ModuleList([learner.policy, learner.value, learner.reward_model.discriminator])
        self.probe = Probe(NAME, count, self._measure, second_half=True)

    def keep_closest(self, history: History) -> int:
        """Set the networks back to the last of the closest; return the environment steps after which they were so."""
        candidates = history.values(NAME)
        distances = candidates[:, 0]
        kept = np.flatnonzero(distances <= AS_CLOSE * distances.min())[-1]
        parameters = torch.from_numpy(candidates[kept, 2:].astype(np.float32))
        vector_to_parameters(parameters, self._networks.parameters())
        return int(history.steps(NAME)[kept])

    def env_steps(self, history: History) -> int:
        """Return the environment steps that telling them apart took."""
        return int(history.values(NAME)[:, 1].sum())

    def _measure(self) -> NDArray[np.float64]:
        """Return (2 + P,) the distance of the networks as they are, the steps that it took, and their parameters."""
        learner, environment = self._learner, self._environment
        policy, key = learner.behavior_policy(), derive_key(learner.root_seed, NAME)
        measured = distance_of(policy, learner.reward_model, environment, CANDIDATE_EPISODES, key)
        return np.append(measured, parameters_to_vector(self._networks.parameters()).detach().numpy())
