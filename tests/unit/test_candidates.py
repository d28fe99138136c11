"""Which point of a training is kept, and that it is what remains."""

import numpy as np
import pytest
import torch

from oodil.pipeline.algorithms.gail import imitator
from oodil.pipeline.candidates import NAME, Candidates
from oodil.pipeline.config import EnvironmentConfig, GailConfig
from oodil.pipeline.evaluation import CANDIDATE_EPISODES, evaluate
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.training import History


@pytest.mark.parametrize(
    ("told", "kept"), [((1, 2, 3), 0), ((3, 1, 2), 1), ((3, 2, 1), 2), ((1, 1.09, 1.11), 1), ((1.05, 1, 1.05), 2)]
)
def test_the_last_of_the_closest_is_what_remains_of_a_training(demonstrations, assert_same_bits, told, kept) -> None:
    learner = imitator(12, 3, 1000, demonstrations(30, observation_dim=12), np.ones(1), GailConfig(total_steps=1), 0)
    environment = EnvironmentConfig()
    candidates, history, states, distances = Candidates(learner, environment, 3), History(), [], []
    env_steps = 0
    for n in range(3):
        for network in (learner.policy, learner.value, learner.reward_model.discriminator):
            with torch.no_grad():
                for parameter in network.parameters():
                    parameter.mul_(1.1)
        measured = candidates.probe.measure()
        key = derive_key(learner.root_seed, NAME)
        seen = evaluate(learner.behavior_policy(), environment.id, environment.dynamics, CANDIDATE_EPISODES, key)
        env_steps += int(seen.lengths.sum())
        distances.append(measured[0])
        measured[0] = told[n]
        history.append(candidates.probe.name, 100 * (n + 1), measured)
        arrays = learner.behavior_policy().arrays() | learner.value_arrays()
        states.append(arrays | {k: v.copy() for k, v in learner.reward_model.discriminator_arrays().items()})
    assert len(set(distances)) == 3, "the policies are not told apart"
    assert candidates.env_steps(history) == env_steps
    assert candidates.keep_closest(history) == 100 * (kept + 1)
    remaining = (
        learner.behavior_policy().arrays() | learner.value_arrays() | learner.reward_model.discriminator_arrays()
    )
    assert_same_bits(remaining, states[kept])
