"""collect(unit) is a pure function: the first invariant."""

import math
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

import oodil.pipeline.collecting
from oodil.pipeline.collecting import collect
from oodil.pipeline.data import Unit
from oodil.pipeline.environments import make_batch
from oodil.pipeline.seeding import derive_key, numpy_rng
from oodil.workers.messages import Header, UnitMessage, decode, encode

HOPPER, CHEETAH = "oodil/Hopper-v0", "oodil/HalfCheetah-v0"


@pytest.fixture
def unit(network):
    """Return a unit of three Hoppers over 60 steps, in which several episodes end."""
    policy = network(observation_dim=12, action_dim=3).export()
    dynamics = (("gravity", 12.0),)
    return Unit(0, 0, HOPPER, dynamics, 3, 60, 5, policy, derive_key(0, "rollout", 0, 0), snapshot=None)


def following(unit, result):
    iteration = unit.iteration + 1
    return replace(unit, iteration=iteration, key=derive_key(0, "rollout", 0, iteration), snapshot=result.snapshot)


def test_same_unit_same_bytes(unit, assert_same_bits):
    assert_same_bits(collect(unit), collect(unit))


def test_nothing_collected_before_matters(unit, network, assert_same_bits):
    first = collect(unit)
    second = collect(following(unit, first))
    collect(replace(unit, key=(9,), num_steps=7))
    collect(replace(unit, key=(9,), dynamics=(("gravity", 3.0),)))
    collect(replace(unit, key=(9,), policy=network(12, 3, seed=4).export()))
    assert_same_bits(collect(following(unit, first)), second)
    oodil.pipeline.collecting._groups.cache_clear()  # as in a worker that has just started
    assert_same_bits(collect(following(unit, first)), second)
    assert_same_bits(collect(unit), first)


def test_collecting_leaves_the_unit_as_it_was(unit):
    unit = following(unit, collect(unit))
    snapshot = unit.snapshot.states.copy()
    weights = unit.policy.weights[0].copy()
    collect(unit)
    np.testing.assert_array_equal(unit.snapshot.states, snapshot)
    np.testing.assert_array_equal(unit.policy.weights[0], weights)


def test_a_result_does_not_change_when_the_simulators_move_on(unit, assert_same_bits):
    first = collect(unit)
    kept = first.snapshot.states.copy(), first.rollout.observations.copy()
    collect(following(unit, first))
    assert_same_bits((first.snapshot.states, first.rollout.observations), kept)


@pytest.mark.parametrize(
    "change",
    [
        {"key": (1, 2)},
        {"dynamics": (("gravity", 9.8),)},
        {"dynamics": ()},
    ],
)
def test_what_a_unit_names_matters(unit, change):
    assert (
        collect(replace(unit, **change)).rollout.observations.tobytes() != collect(unit).rollout.observations.tobytes()
    )


def test_two_halves_are_the_whole(idle_policy, assert_same_bits):
    """Without noise and without episode ends, continuing from the snapshot equals never having stopped."""
    start = Unit(0, 0, CHEETAH, (), 2, 20, 0, idle_policy(18, 6), (3,), snapshot=None)
    whole = replace(start, num_steps=80, snapshot=collect(start).snapshot)
    expected = collect(whole)
    first = collect(replace(whole, num_steps=30))
    second = collect(replace(whole, num_steps=50, key=(4,), snapshot=first.snapshot))
    for name in ("observations", "next_observations", "actions", "env_rewards"):
        joined = np.concatenate([getattr(r.rollout, name) for r in (first, second)])
        assert_same_bits(joined, getattr(expected.rollout, name), name)
    assert_same_bits(second.snapshot, expected.snapshot)


def test_rewards_do_not_reach_the_experience(unit, assert_same_bits):
    """An environment that pays NaN gives the same experience."""
    plain = collect(unit)
    poisoned = collect(replace(unit, dynamics=(*unit.dynamics, ("forward_reward_weight", math.nan))))
    assert np.isnan(poisoned.rollout.env_rewards).all()
    assert np.isnan(poisoned.rollout.episode_returns).all()
    for name in ("observations", "next_observations", "actions", "log_probs", "terminated", "truncated"):
        assert_same_bits(getattr(poisoned.rollout, name), getattr(plain.rollout, name), name)
    assert_same_bits(poisoned.snapshot.states, plain.snapshot.states)


def test_a_rollout_replayed_in_gymnasium(unit):
    """Every recorded step is what a Gymnasium environment does with the recorded action."""
    result = collect(unit).rollout
    env = gymnasium.make(HOPPER, gravity=12.0)
    rng = numpy_rng(unit.key)
    rng.standard_normal((60, 3, 3), dtype=np.float32)  # the noise is drawn first
    seeds = [int(rng.integers(2**31)) for _ in range(3)]
    current = env.reset(seed=seeds[0])[0]
    returns = 0.0
    for t in range(60):
        np.testing.assert_array_equal(result.observations[t, 0], current.astype(np.float32))
        current, reward, terminated, truncated, _ = env.step(result.actions[t, 0])
        np.testing.assert_array_equal(result.next_observations[t, 0], current.astype(np.float32))
        assert (result.env_rewards[t, 0], result.terminated[t, 0], result.truncated[t, 0]) == (
            reward,
            terminated,
            truncated,
        )
        returns += reward
        if terminated:
            break
    assert terminated, "no episode of the first simulator ended"
    assert returns in result.episode_returns
    assert t + 1 in result.episode_lengths


def test_episodes_continue_or_start_anew(unit):
    result = collect(unit).rollout
    ended = result.terminated | result.truncated
    assert ended.sum() == len(result.episode_returns) == len(result.episode_lengths) > 2
    following, successors = result.observations[1:], result.next_observations[:-1]
    np.testing.assert_array_equal(following[~ended[:-1]], successors[~ended[:-1]])
    # A fresh episode starts within the reset noise of the upright pose; an ended one does not lie there.
    upright = np.array([0, 1.25, *[0] * 10])
    assert (np.abs(following[ended[:-1]] - upright) <= 0.005 + 1e-6).all()
    assert (np.abs(successors[ended[:-1]] - upright).max(axis=1) > 0.05).all()


def test_episodes_begin_at_the_starts_that_are_given(unit, assert_same_bits):
    """Each of them, in other orders under other keys; a unit that is sent on changes nothing."""
    rng = np.random.default_rng(0)
    starts = (np.array([0, 1.25, *[0] * 10]) + 0.01 * rng.standard_normal((3, 12))).astype(np.float32)
    given = replace(unit, starts=starts)
    result = collect(given)
    assert_same_bits(collect(given), result)
    (sent,) = [decode(encode(UnitMessage(Header("run", "learner", "me", 0), given)))]
    assert_same_bits(collect(sent.unit), result)
    rollout = result.rollout
    ended = rollout.terminated | rollout.truncated
    begun = np.concatenate((rollout.observations[0], rollout.observations[1:][ended[:-1]]))
    which = (begun[:, None] == starts).all(axis=2)
    assert (which.sum(axis=1) == 1).all() and which.any(axis=0).all()
    assert collect(replace(given, key=(1,))).rollout.observations[0].tobytes() != rollout.observations[0].tobytes()
    assert rollout.episode_lengths.max() <= 60


def test_a_unit_goes_on_from_its_snapshot_whatever_the_starts(unit):
    unit = following(unit, collect(unit))
    starts = np.tile(np.array([0, 1.25, *[0] * 10], np.float32), (1, 1))
    assert (collect(replace(unit, starts=starts)).rollout.observations[0] != starts).any()


def test_log_probabilities_are_those_of_the_actions(unit, network):
    result = collect(unit).rollout
    policy = network(observation_dim=12, action_dim=3)
    with torch.no_grad():
        observations = torch.from_numpy(result.observations).flatten(0, 1)
        actions = torch.from_numpy(result.actions).flatten(0, 1)
        expected = policy.log_prob(policy(observations), actions).numpy().reshape(60, 3)
    np.testing.assert_allclose(result.log_probs, expected, rtol=1e-3, atol=1e-3)


def test_results_carry_their_origin(unit):
    result = collect(replace(unit, iteration=4, group=2))
    assert (result.iteration, result.group, result.rollout.policy_version) == (4, 2, 5)


def test_unfinished_episodes_keep_their_age_and_return(idle_policy):
    whole = Unit(0, 0, CHEETAH, (), 1, 600, 0, idle_policy(18, 6), (3,), snapshot=None)
    first = collect(whole)
    second = collect(replace(whole, key=(4,), snapshot=first.snapshot))
    assert not len(first.rollout.episode_lengths)
    assert second.rollout.episode_lengths.tolist() == [1000]
    assert second.rollout.truncated[399].all()
    assert second.rollout.truncated.sum() == 1
    total = first.rollout.env_rewards.sum() + second.rollout.env_rewards[:400].sum()
    np.testing.assert_allclose(second.rollout.episode_returns, [total])


def test_every_group_keeps_its_simulators_however_many_there_are(unit, monkeypatch):
    made = []

    def make(*arguments):
        made.append(arguments)
        return make_batch(*arguments)

    monkeypatch.setattr(oodil.pipeline.collecting, "make_batch", make)
    for _ in range(2):
        for group in range(40):
            collect(replace(unit, num_simulators=1, num_steps=1, group=group, dynamics=(("gravity", 9.5),)))
    assert len(made) == 40
