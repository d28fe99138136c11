"""Evaluation on the true return, which nothing ever learns from. Letters: E episodes, T states, S observation."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.collecting import begin
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.data import Episode
from oodil.pipeline.environments import Simulators, make_batch
from oodil.pipeline.policy import Controller, GaussianPolicy
from oodil.pipeline.results import Evaluation
from oodil.pipeline.seeding import Key, numpy_rng

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward

DISTANCE_EPISODES = 16
"""Mean-action episodes that the distance of a finished policy to demonstrations is measured with."""
CANDIDATE_EPISODES = 8
"""Those for each candidate of a training, from the same starts for all."""


def run_episodes(
    simulators: Simulators,
    controller: Controller,
    rng: np.random.Generator,
    *,
    stochastic: bool,
    starts: NDArray[np.float32] | None = None,
) -> list[Episode]:
    """Run one fresh episode in every simulator side by side; only a Gaussian policy can be ``stochastic``.

    An episode begins as the environment has it begin, or in one of the (P, S) ``starts``.
    """
    count = simulators.num_simulators
    for g in range(count):
        begin(simulators, g, rng, starts)
    trace = [simulators.observations().astype(np.float32)]
    returns, lengths, terminated = np.zeros(count), np.zeros(count, np.int64), np.zeros(count, np.bool_)
    while not lengths.all():
        actions: NDArray[np.floating] = controller.mean(simulators.observations())
        if stochastic:
            assert isinstance(controller, GaussianPolicy)
            actions = actions + np.exp(controller.log_std) * rng.standard_normal(actions.shape, dtype=np.float32)
        outcome = simulators.step(actions)
        trace.append(simulators.observations().astype(np.float32))
        ended = (outcome.terminated | outcome.truncated) & (lengths == 0)
        lengths[ended] = simulators.elapsed_steps()[ended]
        returns[ended] = simulators.episode_returns()[ended]
        terminated[ended] = outcome.terminated[ended]
    states = np.stack(trace)
    return [Episode(states[: lengths[g] + 1, g], float(returns[g]), bool(terminated[g])) for g in range(count)]


def evaluate(
    policy: GaussianPolicy,
    env_id: str,
    dynamics: Mapping[str, Any],
    episodes: int,
    key: Key,
    *,
    stochastic: bool = False,
) -> Evaluation:
    """Run ``episodes`` fresh episodes, with mean actions unless ``stochastic``."""
    seen = run_episodes(make_batch(env_id, dynamics, episodes), policy, numpy_rng(key), stochastic=stochastic)
    return Evaluation(np.array([e.env_return for e in seen]), np.array([len(e.states) - 1 for e in seen]))


def distance_of(
    policy: GaussianPolicy,
    reward: "AdversarialReward",
    environment: EnvironmentConfig,
    episodes: int,
    key: Key,
    starts: NDArray[np.float32] | None = None,
) -> tuple[float, int]:
    """Return how far fresh episodes of mean actions are from a reward model's demonstrations, and their steps."""
    simulators = make_batch(environment.id, environment.dynamics, episodes)
    seen = run_episodes(simulators, policy, numpy_rng(key), stochastic=False, starts=starts)
    return reward.distance(seen), sum(len(episode.states) - 1 for episode in seen)
