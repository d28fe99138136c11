"""The pure function at the heart of the runtime: collect(unit) -> (rollout, end snapshot).

Letters: T steps, G simulators of one env group, A action.
"""

import json
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Rollout, Unit, UnitResult
from oodil.pipeline.environments import Simulators, make_batch
from oodil.pipeline.seeding import numpy_rng

Follow = Callable[[UnitResult], list[Unit]]
"""What a result is followed by: its group's next unit, or nothing yet."""


def nothing_follows(result: UnitResult) -> list[Unit]:
    """Leave it to the caller of `gather` to submit what comes next."""
    return []


class RolloutSource(Protocol):
    """Who collects: the job's own process, rollout workers behind a socket, or a cluster. All give the same bits."""

    def submit(self, units: list[Unit]) -> None:
        """Hand over units; collection may begin at once."""

    def gather(self, follow: Follow = nothing_follows) -> list[UnitResult]:
        """Wait for the iteration that was submitted first and return its results in group order.

        What ``follow`` makes of a result is submitted as soon as the result is there, so that nobody who collects
        waits for the slowest group. It is called once for each result, in any order, on the caller's thread.
        """


@lru_cache(maxsize=4)
def _groups(env_id: str, dynamics: str, num_simulators: int) -> dict[int, Simulators]:
    """Return the simulators of each group there was so far; those of the settings used last are kept."""
    return {}


def _simulators(unit: Unit) -> Simulators:
    # One for each group, since some can go on much faster from where they stand.
    groups = _groups(unit.env_id, json.dumps(unit.dynamics), unit.num_simulators)
    if unit.group not in groups:
        groups[unit.group] = make_batch(unit.env_id, dict(unit.dynamics), unit.num_simulators)
    return groups[unit.group]


def begin(simulators: Simulators, simulator: int, rng: np.random.Generator, starts: NDArray[np.float32] | None) -> None:
    """Start a new episode in one simulator, as the environment does or in one of the (P, S) ``starts``."""
    if starts is None:
        simulators.reset(simulator, seed=int(rng.integers(2**31)))
    else:
        simulators.place(simulator, starts[rng.integers(len(starts))])


def collect(unit: Unit) -> UnitResult:
    """Run one env group for ``num_steps`` steps; the result depends on nothing but ``unit``."""
    return collect_in(_simulators(unit), unit)


def collect_in(simulators: Simulators, unit: Unit) -> UnitResult:
    """Run a unit in simulators of the caller's own kind, wherever they stand."""
    rng = numpy_rng(unit.key)
    shape = (unit.num_steps, unit.num_simulators)
    noise = rng.standard_normal((*shape, simulators.action_dim), dtype=np.float32)

    if unit.snapshot is None:
        for g in range(unit.num_simulators):
            begin(simulators, g, rng, unit.starts)
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
                begin(simulators, g, rng, unit.starts)
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

    def __init__(self, collect: Callable[[Unit], UnitResult] = collect) -> None:
        self._collect = collect
        self._units: deque[Unit] = deque()

    def submit(self, units: list[Unit]) -> None:
        """Keep units for `gather`."""
        self._units.extend(units)

    def gather(self, follow: Follow = nothing_follows) -> list[UnitResult]:
        """Collect the iteration that was submitted first, in order; see `RolloutSource`."""
        results: list[UnitResult] = []
        first = self._units[0].iteration
        while self._units and self._units[0].iteration == first:
            result = self._collect(self._units.popleft())
            results.append(result)
            self.submit(follow(result))
        return results
