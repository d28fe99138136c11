"""The pure function at the heart of the runtime: collect(unit) -> (rollout, end snapshot).

Letters: T steps, G simulators of one env group, S observation, A action.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.environments import Simulators, Snapshot, make_batch
from pipeline.policy import GaussianPolicy
from pipeline.seeding import Key, generator


@dataclass(frozen=True)
class Unit:
    """Everything that one rollout depends on."""

    iteration: int
    group: int
    env_id: str
    dynamics: tuple[tuple[str, float], ...]
    num_simulators: int
    num_steps: int
    policy_version: int
    policy: GaussianPolicy
    key: Key
    snapshot: Snapshot | None
    """Where the group stands; None starts every simulator with a fresh episode."""


@dataclass(frozen=True)
class Rollout:
    """Experience of one env group under exactly one policy version."""

    policy_version: int
    observations: NDArray[np.float32]
    """(T, G, S)"""
    next_observations: NDArray[np.float32]
    """(T, G, S), before any reset."""
    actions: NDArray[np.float32]
    """(T, G, A)"""
    log_probs: NDArray[np.float32]
    """(T, G) under the policy that acted."""
    terminated: NDArray[np.bool_]
    """(T, G)"""
    truncated: NDArray[np.bool_]
    """(T, G)"""
    env_rewards: NDArray[np.float64]
    """(T, G); only experts learn from it."""
    episode_returns: NDArray[np.float64]
    """(E,) true returns of the episodes that ended; evaluation only."""
    episode_lengths: NDArray[np.int64]
    """(E,)"""


@dataclass(frozen=True)
class UnitResult:
    """A unit's rollout and where its env group stands afterwards."""

    iteration: int
    group: int
    rollout: Rollout
    snapshot: Snapshot


Follow = Callable[[UnitResult], list[Unit]]
"""What a result is followed by: its group's next unit, or nothing yet."""


def nothing_follows(result: UnitResult) -> list[Unit]:
    """Leave it to the caller of `gather` to submit what comes next."""
    return []


@lru_cache(maxsize=32)
def _simulators(env_id: str, dynamics: tuple[tuple[str, float], ...], num_simulators: int, group: int) -> Simulators:
    # One for each group, since some can go on much faster from where they stand.
    return make_batch(env_id, dict(dynamics), num_simulators)


def collect(unit: Unit) -> UnitResult:
    """Run one env group for ``num_steps`` steps; the result depends on nothing but ``unit``."""
    simulators = _simulators(unit.env_id, unit.dynamics, unit.num_simulators, unit.group)
    rng = generator(unit.key)
    shape = (unit.num_steps, unit.num_simulators)
    noise = rng.standard_normal((*shape, simulators.action_dim), dtype=np.float32)
    if unit.snapshot is None:
        for g in range(unit.num_simulators):
            simulators.reset(g, seed=int(rng.integers(2**31)))
    else:
        simulators.restore(unit.snapshot)

    observations = np.empty((*shape, simulators.observation_dim), np.float32)
    next_observations = np.empty_like(observations)
    env_rewards = np.empty(shape)
    terminated = np.empty(shape, np.bool_)
    truncated = np.empty(shape, np.bool_)
    returns: list[float] = []
    lengths: list[int] = []
    perturbations = noise * np.exp(unit.policy.log_std)
    actions = np.empty_like(noise)
    current = simulators.observations()
    for t in range(unit.num_steps):
        observations[t] = current
        np.add(unit.policy.mean(current), perturbations[t], out=actions[t])
        outcome = simulators.step(actions[t])
        current = simulators.observations()
        next_observations[t] = current
        env_rewards[t], terminated[t], truncated[t] = outcome.env_rewards, outcome.terminated, outcome.truncated
        ends = outcome.terminated | outcome.truncated
        if ends.any():
            ended = np.flatnonzero(ends)
            returns.extend(simulators.episode_returns()[ended].tolist())
            lengths.extend(simulators.elapsed_steps()[ended].tolist())
            for g in ended.tolist():
                simulators.reset(g, seed=int(rng.integers(2**31)))
            current = simulators.observations()

    rollout = Rollout(
        policy_version=unit.policy_version,
        observations=observations,
        next_observations=next_observations,
        actions=actions,
        log_probs=unit.policy.log_prob_of_noise(noise),
        terminated=terminated,
        truncated=truncated,
        env_rewards=env_rewards,
        episode_returns=np.array(returns, np.float64),
        episode_lengths=np.array(lengths, np.int64),
    )
    return UnitResult(unit.iteration, unit.group, rollout, simulators.snapshot())


class InlineRollouts:
    """A rollout source that collects in the learner's own process, one unit after another."""

    def __init__(self) -> None:
        self._units: deque[Unit] = deque()

    def submit(self, units: list[Unit]) -> None:
        """Keep units for `gather`."""
        self._units.extend(units)

    def gather(self, follow: Follow = nothing_follows) -> list[UnitResult]:
        """Collect the iteration that was submitted first, in order; see `RolloutSource`."""
        results: list[UnitResult] = []
        first = self._units[0].iteration
        while self._units and self._units[0].iteration == first:
            result = collect(self._units.popleft())
            results.append(result)
            self.submit(follow(result))
        return results
