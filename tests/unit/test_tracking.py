"""Simulators that track demonstrations: what they observe, are rewarded for, and where they begin and end."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from oodil.pipeline.collecting import collect_in
from oodil.pipeline.data import Demonstrations, Episode, Unit
from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.tracking import TrackingSimulators, distances
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import derive_key
from tests.unit.test_reproducibility import CART, STEP, driven

DRIVING, HOPPER = "oodil/Driving-v0", "oodil/Hopper-v0"


def tracking(
    demonstrations: Demonstrations, env_id: str, count: int = 3, discount: float = 0.9, scale: Any = None
) -> TrackingSimulators:
    ones = np.ones(demonstrations.observation_dim)
    return TrackingSimulators(make_batch(env_id, {}, count), demonstrations, discount, ones if scale is None else scale)


def recorded(env_id: str, actions: np.ndarray, seed: int = 0) -> Demonstrations:
    """Return one demonstration of (T, A) actions, begun at an observation of 32 bits."""
    simulators = make_batch(env_id, {}, 1)
    simulators.reset(0, seed)
    simulators.place(0, simulators.observations()[0].astype(np.float32))
    states = [simulators.observations()[0]]
    for action in actions:
        simulators.step(action[None])
        states.append(simulators.observations()[0])
    return Demonstrations.of([Episode(np.array(states))], "recorded")


UNPUSHED = 0.6
"""The action that does not push a cart: 0 in units of its pushes, which lie in [-2, 0.5]."""


class Idle:
    """Whoever does not push."""

    def mean(self, observations: np.ndarray) -> np.ndarray:
        return np.full((len(observations), 1), UNPUSHED, np.float32)


def test_the_return_is_minus_the_discounted_distance() -> None:
    """A cart that is not pushed stays 0.1 behind in velocity after one step of 1, 0.2 after two, 0.01 in position."""
    demonstrations = driven(1.0, 0.0, steps=3)
    scale = np.array([2.0, 1.0, 1.0])
    simulators = tracking(demonstrations, CART, discount=0.5, scale=scale)
    slower, behind = STEP * np.array([1, 2, 3]), STEP**2 * np.array([0, 1, 3])
    missed = np.hypot(2 * behind, slower)
    expected = missed[0] + 0.5 * missed[1] + 0.25 * missed[2]
    np.testing.assert_allclose(distances(simulators, Idle()), [expected, 0.0], atol=1e-6)
    simulators.track(0, 0)
    rewards = [simulators.step(np.full((3, 1), UNPUSHED)).env_rewards[0] for _ in range(5)]
    np.testing.assert_allclose(rewards, [-missed[0], -0.5 * missed[1], -0.25 * missed[2], 0, 0], atol=1e-6)


def test_each_is_tracked_from_its_first_state_to_its_last() -> None:
    long, short = driven(0.5, steps=9), driven(-1.0, steps=2)
    demonstrations = Demonstrations.joined([long, short])
    simulators = tracking(demonstrations, CART)
    for g, n in enumerate((1, 0, 1)):
        simulators.track(g, n)
    seen = simulators.observations()
    assert seen.shape == (3, simulators.observation_dim) == (3, 6)
    np.testing.assert_array_equal(seen[:, :3], seen[:, 3:])
    ends = []
    for _ in range(2):
        outcome = simulators.step(np.zeros((3, 1)))
        assert not outcome.truncated.any()
        ends.append(outcome.terminated.tolist())
    assert ends == [[False, False, False], [True, False, True]]
    np.testing.assert_array_equal(simulators.observations()[:, 3:], demonstrations.observations[[10, 0, 10]])
    assert simulators.max_episode_steps == 9
    assert simulators.elapsed_steps().tolist() == [2, 2, 2]


def test_seeds_draw_demonstrations_evenly() -> None:
    simulators = tracking(driven(0.0, 0.5, 1.0, -1.0, -2.0), CART, count=1)
    counts = np.zeros(5)
    for seed in range(1000):
        simulators.reset(0, seed)
        counts[int(simulators.snapshot().states[0, -1])] += 1
    assert (np.abs(counts - 200) < 50).all()
    with pytest.raises(UnusableEnvironmentError, match="begin where one of them does"):
        simulators.place(0, np.zeros(6))


@pytest.mark.parametrize(("env_id", "action_dim"), [(DRIVING, 1), (HOPPER, 3)])
def test_recorded_actions_stay_with_their_demonstration(env_id: str, action_dim: int) -> None:
    """To the precision of its states, 32 bits; others do not. An environment's own end plays no part."""
    actions = np.random.default_rng(0).uniform(-1, 1, (150, action_dim))
    demonstrations = recorded(env_id, actions)
    simulators = tracking(demonstrations, env_id, count=2, discount=1.0)
    for g in range(2):
        simulators.track(g, 0)
    for t, action in enumerate(actions):
        outcome = simulators.step(np.stack((action, -action)))
        assert outcome.terminated.all() == (t == 149)
    exact, other = -simulators.episode_returns()
    assert exact < 1e-3 and other > 1


@pytest.mark.parametrize("env_id", [CART, DRIVING, HOPPER])
def test_a_snapshot_continues_to_the_same_bits(
    env_id: str, idle_policy: Callable[[int, int], GaussianPolicy], assert_same_bits: Any
) -> None:
    """Of one rollout, what two halves in other simulators give; episodes end and begin in both."""
    if env_id == CART:
        demonstrations = driven(0.0, 0.5, -1.0, steps=7)
    else:
        actions = np.random.default_rng(1).uniform(-1, 1, (2, 13, 3 if env_id == HOPPER else 1))
        parts = [recorded(env_id, actions[0], seed=0), recorded(env_id, actions[1][:8], seed=1)]
        demonstrations = Demonstrations.joined(parts)
    made = [tracking(demonstrations, env_id) for _ in range(2)]
    policy = idle_policy(made[0].observation_dim, made[0].action_dim)

    def unit(iteration: int, snapshot: Any) -> Unit:
        return Unit(iteration, 0, env_id, (), 3, 20, 0, policy, derive_key(0, "rollout", 0, iteration), snapshot)

    first = collect_in(made[0], unit(0, None))
    assert first.rollout.terminated.any() and not first.rollout.truncated.any()
    assert len(first.rollout.episode_returns) == first.rollout.terminated.sum()
    assert (first.rollout.env_rewards <= 0).all() and (first.rollout.env_rewards < 0).any()
    going_on = collect_in(made[0], unit(1, first.snapshot))
    assert_same_bits(collect_in(made[1], unit(1, first.snapshot)), going_on)
    assert_same_bits(collect_in(made[1], unit(0, None)), first)


def test_distances_do_not_depend_on_who_is_tracked_beside() -> None:
    demonstrations = driven(0.0, 0.5, 1.0, -1.0, -2.0)
    found = [distances(tracking(demonstrations, CART, count), Idle()) for count in (1, 2, 8)]
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    assert found[0].argmin() == 0
