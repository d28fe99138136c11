"""The adversarial reward: weights, draws, and which reward belongs to which step."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from oodil.pipeline.algorithms.discriminator import imitation_reward
from oodil.pipeline.algorithms.gail import AdversarialReward, imitator
from oodil.pipeline.algorithms.learner import Learner
from oodil.pipeline.config import DiscriminatorConfig, GailConfig
from oodil.pipeline.data import Episode, TransitionBatch
from oodil.pipeline.errors import DataError


def build(demonstrations, weights, **settings):
    settings = {"view": "raw"} | settings  # so that a drawn pair says where it comes from
    return AdversarialReward(
        demonstrations, np.array(weights, np.float64), DiscriminatorConfig(**settings), max_episode_steps=1, root_seed=0
    )


def batch_of(*rollouts):
    return TransitionBatch.of(rollouts)


def drawn_numbers(pairs):
    """Demonstration and time of the first state of each drawn pair, after checking the second is its successor."""
    first, second = pairs.numpy()[:, :3], pairs.numpy()[:, 3:]
    np.testing.assert_array_equal(second[:, 0], first[:, 0], err_msg="a pair crosses a border")
    np.testing.assert_array_equal(second[:, 1], first[:, 1] + 1)
    return first[:, 0].astype(int), first[:, 1].astype(int)


def test_draws_follow_the_weights(demonstrations):
    lengths, weights = np.array([5, 2, 9, 4]), np.array([0.3, 1.0, 0.05, 0.6])
    reward = build(demonstrations(*lengths), weights)
    count = 20_000
    chosen, times = drawn_numbers(reward.draw(count, np.random.default_rng(0)))
    # The mass of a demonstration is its weight times its transitions, and all its transitions share it equally.
    mass = np.repeat(weights, lengths - 1)
    places = np.concatenate([[0], np.cumsum(lengths - 1)])[chosen] + times
    assert times.max() == 7, "the last transition of the longest demonstration was never drawn"
    observed = np.bincount(places, minlength=len(mass))
    assert chisquare(observed, count * mass / mass.sum()).pvalue > 1e-3


def test_no_weight_no_draw(demonstrations):
    reward = build(demonstrations(4, 3, 5, 4), [0.0, 1.0, 0.0, 0.5])
    chosen, _ = drawn_numbers(reward.draw(5_000, np.random.default_rng(0)))
    assert set(chosen) == {1, 3}


def test_the_ends_of_the_unit_interval_hit_no_unweighted_demonstration(demonstrations):
    class Ends:
        def random(self, count):
            return np.array([0.0, np.nextafter(1.0, 0.0)] * (count // 2))

    for weights, expected in (([0.0, 0.7, 0.3, 0.0], {1, 2}), ([0.0, 0.0, 1e-9, 0.0], {2})):
        chosen, _ = drawn_numbers(build(demonstrations(3, 3, 3, 3), weights).draw(2, Ends()))
        assert set(chosen) == expected


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([1.0, 1.0], "3 finite numbers"),
        ([1.0, np.nan, 1.0], "finite"),
        ([1.0, np.inf, 1.0], "finite"),
        ([1.0, -0.1, 1.0], ">= 0"),
        ([0.0, 0.0, 0.0], "nothing to imitate"),
    ],
)
def test_bad_weights_are_refused(demonstrations, weights, message):
    with pytest.raises(ValueError, match=message):
        build(demonstrations(3, 3, 3), weights)


def test_rewards_belong_to_the_steps_that_earned_them(demonstrations, rollout):
    """Groups stand side by side: reward [t, g] is that of step t of simulator g."""
    reward = build(demonstrations(5, 5), [1.0, 1.0])
    rollouts = [rollout(0, num_simulators=2), rollout(1, num_simulators=3)]
    result = reward.rewards(batch_of(*rollouts))
    assert result.shape == (6, 5)
    for t in range(6):
        for g, (part, column) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]):
            states = rollouts[part].observations[t, column], rollouts[part].next_observations[t, column]
            with torch.no_grad():
                logit = reward.discriminator(torch.from_numpy(np.concatenate(states))[None])
            assert result[t, g] == pytest.approx(float(imitation_reward(logit)[0]), rel=1e-5)


def test_inputs_are_built_once_for_a_batch(demonstrations, rollout, monkeypatch):
    reward = build(demonstrations(20), [1.0])
    batches = [batch_of(rollout(seed)) for seed in range(2)]
    built = []
    inputs = reward.discriminator.inputs

    def count(states, successors):
        built.append(len(states))
        return inputs(states, successors)

    monkeypatch.setattr(reward.discriminator, "inputs", count)
    monkeypatch.setattr(reward, "draw", lambda count, rng: inputs(*2 * [np.ones((count, 3), np.float32)]))
    for iteration, batch in enumerate(batches):
        reward.rewards(batch)
        reward.update(batch, iteration, 1.0)
        assert built == [18] * (iteration + 1)


def test_update_raises_the_reward_of_demonstrations(demonstrations, rollout):
    shown = demonstrations(30, 30)
    reward = build(shown, [1.0, 1.0], learning_rate=1e-2)
    pairs = reward.draw(50, np.random.default_rng(0))
    batch = batch_of(rollout(0, num_steps=20))

    def margin():
        with torch.no_grad():
            return float(imitation_reward(reward.discriminator(pairs)).mean()) - float(reward.rewards(batch).mean())

    before = margin()
    for iteration in range(20):
        reward.update(batch, iteration, 1.0)
    assert margin() > before + 0.1


@pytest.mark.parametrize("num_states", [5, 200])
def test_each_step_sees_its_share_of_the_batch_and_as_many_demonstration_pairs(
    demonstrations, rollout, monkeypatch, num_states
):
    reward = build(demonstrations(num_states), [1.0], steps_per_iteration=4)
    seen = []
    monkeypatch.setattr(reward.discriminator, "update", lambda shown, policy: seen.append((shown, policy)))
    batch = batch_of(rollout(0, num_steps=10))  # 30 transitions
    reward.update(batch, 0, 1.0)
    assert [(len(shown), len(policy)) for shown, policy in seen] == [(8, 8), (8, 8), (7, 7), (7, 7)]
    together = torch.cat([policy for _, policy in seen]).numpy()
    everything = np.concatenate([batch.observations, batch.next_observations], axis=-1).reshape(30, -1)
    np.testing.assert_array_equal(np.sort(together, axis=0), np.sort(everything, axis=0))


def test_an_update_depends_on_the_iteration_and_not_on_what_was_drawn_before(demonstrations, rollout, assert_same_bits):
    one, two = (build(demonstrations(20, 20), [1.0, 0.5], steps_per_iteration=3) for _ in range(2))
    two.draw(17, np.random.default_rng(9))
    for iteration in range(2):
        one.update(batch_of(rollout(iteration)), iteration, 1.0)
        two.update(batch_of(rollout(iteration)), iteration, 1.0)
    assert_same_bits(one.state_dict(), two.state_dict())


def test_an_artificial_reward_of_the_environment_changes_nothing(demonstrations, rollout, assert_same_bits):
    plain = batch_of(rollout(0))
    poisoned = replace(plain, env_rewards=np.full_like(plain.env_rewards, np.nan))
    one, two = (build(demonstrations(20), [1.0]) for _ in range(2))
    assert_same_bits(one.rewards(plain), two.rewards(poisoned))
    one.update(plain, 0, 1.0)
    two.update(poisoned, 0, 1.0)
    assert_same_bits(one.state_dict(), two.state_dict())


def test_state_restores_another_instance(demonstrations, rollout, assert_same_bits):
    one = build(demonstrations(20), [1.0])
    one.update(batch_of(rollout(0)), 0, 1.0)
    two = build(demonstrations(20), [1.0])
    two.load_state_dict({name: value.clone() for name, value in one.state_dict().items()})
    for iteration in (1, 2):
        one.update(batch_of(rollout(iteration)), iteration, 1.0)
        two.update(batch_of(rollout(iteration)), iteration, 1.0)
    assert_same_bits(one.state_dict(), two.state_dict())


def test_loading_a_state_does_not_tie_two_instances_together(demonstrations, rollout, assert_same_bits):
    one, two = (build(demonstrations(20), [1.0]) for _ in range(2))
    one.update(batch_of(rollout(0)), 0, 1.0)
    two.load_state_dict(one.state_dict())
    kept = {name: value.clone() for name, value in one.state_dict().items()}
    two.update(batch_of(rollout(1)), 1, 1.0)
    assert_same_bits(one.state_dict(), kept)


def test_step_scale_multiplies_the_step_size(demonstrations, rollout):
    """Adam's first step moves each parameter by about its step size, whatever the gradient."""

    def moved(step_scale):
        reward = build(demonstrations(20), [1.0], learning_rate=1e-2, steps_per_iteration=1)
        before = [p.detach().clone() for p in reward.discriminator.parameters()]
        reward.update(batch_of(rollout(0)), 0, step_scale)
        after = reward.discriminator.parameters()
        return max(float((a.detach() - b).abs().max()) for a, b in zip(after, before, strict=True))

    assert moved(1.0) == pytest.approx(1e-2, rel=1e-2)
    assert moved(0.25) == pytest.approx(0.25e-2, rel=1e-2)


def test_a_failed_episode_stays_where_it_failed_until_the_time_limit(demonstrations):
    shown = demonstrations(101, 101)
    reward = AdversarialReward(shown, np.ones(2), DiscriminatorConfig(), max_episode_steps=100, root_seed=0)
    path = shown.observations[:101]
    whole, short = Episode(path), path[:31]
    held = Episode(np.concatenate([short, np.repeat(short[-1:], 70, axis=0)]))
    failed = reward.distance([whole, Episode(short, terminated=True)])
    assert failed == reward.distance([whole, held])
    assert failed > reward.distance([whole, Episode(short)]), "a recording that ends says nothing of what follows"


def test_an_episode_that_ends_where_demonstrations_do_has_not_failed(demonstrations):
    shown = demonstrations(201, 201)
    reward = AdversarialReward(shown, np.ones(2), DiscriminatorConfig(), max_episode_steps=1000, root_seed=0)
    distances = [reward.distance([Episode(shown.observations[:201], terminated=ends)]) for ends in (False, True)]
    assert distances[0] == distances[1]


def test_an_imitator_is_a_learner_with_an_adversarial_reward(demonstrations, rollout, assert_same_bits):
    shown, weights, config = demonstrations(20, 20), np.array([1.0, 0.5]), GailConfig(total_steps=100)
    one = imitator(3, 2, 9, shown, weights, config, seed=7)
    two = Learner(3, 2, config, AdversarialReward(shown, weights, config.discriminator, 9, 7), 7)
    for learner in (one, two):
        learner.update(batch_of(rollout(0)), 0)
    assert_same_bits(one.state_dict(), two.state_dict())
    assert one.reward_model.mean_logits(shown).shape == (2,)


def test_an_imitator_needs_demonstrations_of_its_own_states(demonstrations):
    with pytest.raises(DataError, match="states with 3 dimensions; the imitator's have 12"):
        imitator(12, 3, 9, demonstrations(5), np.ones(1), GailConfig(total_steps=100), seed=0)
