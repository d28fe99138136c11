"""The learner: interrupted equals uninterrupted, the true reward stays out, and what enters each part."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
import torch

import oodil.pipeline.algorithms.learner as learner_module
from oodil.pipeline.algorithms.ends import DemonstratedEnds
from oodil.pipeline.algorithms.gail import AdversarialReward
from oodil.pipeline.algorithms.learner import EnvReward, Learner
from oodil.pipeline.artifacts import encode_arrays
from oodil.pipeline.collecting import collect
from oodil.pipeline.config import DiscriminatorConfig, GailConfig, PpoConfig, TrainingConfig, TrpoConfig, ValueConfig
from oodil.pipeline.data import Demonstrations, Episode, TransitionBatch, Unit
from oodil.pipeline.seeding import derive_key

TRPO, PPO = TrpoConfig(), PpoConfig(minibatch_size=40, epochs=2, learning_rate=1e-3)


def build(demonstrations=None, **settings):
    """Make a learner of two groups of two Hoppers; it imitates where demonstrations are given."""
    config = GailConfig(
        total_steps=480,
        num_groups=2,
        simulators_per_group=2,
        steps_per_rollout=24,
        policy_hidden=(8, 8),
        value=ValueConfig(hidden=(8,), minibatch_size=20),
        **settings,
    )
    weights = np.array([1.0, 0.3])
    reward = AdversarialReward(demonstrations, weights, config.discriminator, 9, 0) if demonstrations else EnvReward()
    return Learner(12, 3, config, reward, root_seed=0)


def train(learner, first, last, snapshots=(None, None), dynamics=()):
    """Run iterations [first, last) as a job does, without lag; return the snapshots of the groups."""
    snapshots = list(snapshots)
    for iteration in range(first, last):
        policy = learner.behavior_policy()
        results = [
            collect(
                Unit(
                    iteration,
                    group,
                    "oodil/Hopper-v0",
                    dynamics,
                    learner.config.simulators_per_group,
                    learner.config.steps_per_rollout,
                    iteration,
                    policy,
                    derive_key(learner.root_seed, "rollout", group, iteration),
                    snapshots[group],
                )
            )
            for group in range(learner.config.num_groups)
        ]
        snapshots = [result.snapshot for result in results]
        learner.update(TransitionBatch.of([result.rollout for result in results]), iteration)
    return snapshots


def through_a_file(state):
    """Write and read a state as a checkpoint does."""
    content = encode_arrays({name: value.numpy() for name, value in state.items()})
    return {name: torch.from_numpy(value) for name, value in safetensors.numpy.load(content).items()}


@pytest.fixture
def shown(demonstrations):
    return demonstrations(40, 25, observation_dim=12)


@pytest.mark.parametrize("imitate", [False, True], ids=["env_reward", "gail"])
@pytest.mark.parametrize("normalize", [False, True], ids=["raw", "normalized"])
@pytest.mark.parametrize("policy_optimizer", [TRPO, PPO], ids=["trpo", "ppo"])
def test_interrupted_equals_uninterrupted(shown, assert_same_bits, policy_optimizer, normalize, imitate):
    settings = {
        "demonstrations": shown if imitate else None,
        "policy_optimizer": policy_optimizer,
        "normalize_observations": normalize,
        "scale_rewards": normalize,
        "initial_log_std": -0.5,
    }
    whole = build(**settings)
    snapshots = train(whole, 0, 2)
    saved = through_a_file(whole.state_dict())
    train(whole, 2, 4, snapshots)

    resumed = build(**settings)
    train(resumed, 0, 1)  # whatever it was before must not matter
    resumed.load_state_dict(saved)
    train(resumed, 2, 4, snapshots)
    assert_same_bits(resumed.state_dict(), whole.state_dict())
    assert_same_bits(resumed.behavior_policy(), whole.behavior_policy())
    assert any(not torch.equal(value, saved[name]) for name, value in whole.state_dict().items())


@pytest.mark.parametrize("policy_optimizer", [TRPO, PPO], ids=["trpo", "ppo"])
def test_a_fresh_state_can_be_saved_and_loaded(shown, assert_same_bits, policy_optimizer):
    one, two = (build(shown, policy_optimizer=policy_optimizer) for _ in range(2))
    two.load_state_dict(through_a_file(one.state_dict()))
    train(one, 0, 1)
    train(two, 0, 1)
    assert_same_bits(one.state_dict(), two.state_dict())


def test_every_tensor_of_the_state_is_needed_and_restored(shown, assert_same_bits):
    """No entry is forgotten: a state of other numbers comes back as it is."""
    learner = build(shown, policy_optimizer=PPO, normalize_observations=True)
    train(learner, 0, 2)
    other = {name: torch.full_like(value, 0.5) for name, value in learner.state_dict().items()}
    learner.load_state_dict(through_a_file(other))
    assert_same_bits(dict(learner.state_dict()), other)
    parts = {name.split("/")[0] for name in other}
    assert parts == {"moments", "policy_optimizer", "value_optimizer", "reward_model", "policy", "value"}


@pytest.mark.parametrize("policy_optimizer", [TRPO, PPO], ids=["trpo", "ppo"])
def test_imitation_without_a_true_reward_gives_the_same_bits(shown, assert_same_bits, policy_optimizer):
    """The fifth invariant, in an environment that really pays NaN."""
    plain, poisoned = (build(shown, policy_optimizer=policy_optimizer) for _ in range(2))
    train(plain, 0, 3)
    train(poisoned, 0, 3, dynamics=(("forward_reward_weight", math.nan),))
    assert_same_bits(poisoned.state_dict(), plain.state_dict())
    assert all(torch.isfinite(value).all() for value in poisoned.state_dict().values())


def test_an_expert_does_learn_from_the_true_reward(assert_same_bits):
    plain, poisoned = build(), build()
    train(plain, 0, 1)
    train(poisoned, 0, 1, dynamics=(("healthy_reward", 5.0),))
    assert any(not torch.equal(plain.state_dict()[name], poisoned.state_dict()[name]) for name in plain.state_dict())


def test_the_order_of_the_groups_is_part_of_the_update(shown, rollout):
    rollouts = [rollout(seed, observation_dim=12) for seed in (0, 1)]
    rollouts = [replace(r, actions=np.concatenate((r.actions, r.actions[..., :1]), axis=2)) for r in rollouts]
    one, two = build(shown), build(shown)
    one.update(TransitionBatch.of(rollouts), 0)
    two.update(TransitionBatch.of(rollouts[::-1]), 0)
    states = one.state_dict(), two.state_dict()
    assert any(states[0][name].numpy().tobytes() != states[1][name].numpy().tobytes() for name in states[0])


def test_the_discriminator_steps_after_the_reward_is_read(shown, rollout):
    """The policy learns from the discriminator as it was when the rollouts were collected."""
    made = rollout(0, observation_dim=12)
    made = replace(made, actions=np.concatenate((made.actions, made.actions[..., :1]), axis=2))
    batch = TransitionBatch.of([made])
    learner = build(shown)
    expected = float(learner.reward_model.rewards(batch).mean())
    assert learner.update(batch, 0)["reward"] == pytest.approx(expected, rel=1e-6)
    assert float(learner.reward_model.rewards(batch).mean()) != pytest.approx(expected, rel=1e-6)


def test_values_of_next_states(shown, rollout):
    """Within an episode it is the next row's value; at its end and at the last row that of the state before reset."""
    first, second = (rollout(seed, observation_dim=12, num_steps=8) for seed in (0, 1))
    rollouts = []
    for r in (first, second):
        ended = r.terminated | r.truncated
        successors = r.next_observations.copy()
        successors[:-1][~ended[:-1]] = r.observations[1:][~ended[:-1]]
        rollouts.append(replace(r, next_observations=successors))
    learner = build(shown, normalize_observations=True)
    joined = TransitionBatch.of(rollouts)
    flat = torch.from_numpy(joined.observations).flatten(0, 1)
    learner._track(flat)
    values, next_values = learner._values(learner.policy.normalize(flat), joined)
    successors = torch.from_numpy(joined.next_observations)
    with torch.no_grad():
        expected = learner.value(learner.policy.normalize(successors.flatten(0, 1))).view(8, 6).numpy()
        present = learner.value(learner.policy.normalize(flat)).view(8, 6).numpy()
    np.testing.assert_allclose(next_values, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(values, present, rtol=1e-5, atol=1e-6)


def test_normalizer_is_the_mean_and_deviation_of_all_observations(shown):
    rng = np.random.default_rng(0)
    parts = [torch.from_numpy(rng.normal(3.0, 2.0, (50, 12)).astype(np.float32)) for _ in range(3)]
    learner = build(shown, normalize_observations=True)
    for part in parts:
        learner._track(part)
    together = torch.cat(parts).double().numpy()
    np.testing.assert_allclose(learner.policy.input_mean.numpy(), together.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(learner.policy.input_scale.numpy(), 1 / together.std(axis=0), rtol=1e-5)


@pytest.mark.parametrize("policy_optimizer", [TRPO, PPO], ids=["trpo", "ppo"])
def test_an_expert_improves_the_policy_that_collected(policy_optimizer, monkeypatch):
    """Without lag the ratio is one at the start of every update, although the normalizer moves all the time."""
    learner = build(policy_optimizer=policy_optimizer, normalize_observations=True)
    improve = learner.policy_optimizer.update
    ratios, means = [], []

    def update(observations, actions, log_probs, *rest):
        with torch.no_grad():
            present = learner.policy.log_prob(learner.policy(observations), actions)
        ratios.append((present - log_probs).exp().numpy())
        means.append(learner.policy.input_mean.numpy().copy())
        return improve(observations, actions, log_probs, *rest)

    monkeypatch.setattr(learner.policy_optimizer, "update", update)
    train(learner, 0, 4)
    # Log-densities are of order one and float32, summed over three actions.
    np.testing.assert_allclose(np.stack(ratios), 1, rtol=1e-5)
    means.append(learner.policy.input_mean.numpy())
    assert all((before != after).any() for before, after in itertools.pairwise(means))
    assert int(learner.state_dict()["moments"][0]) == 4 * 96


def test_imitators_are_normalized_by_the_demonstrations_as_they_are_weighted(demonstrations):
    both = demonstrations(4, 2)
    reward = AdversarialReward(both, np.array([1.0, 3.0]), DiscriminatorConfig(hidden=(8,)), 9, 0)
    learner = Learner(3, 2, TrainingConfig(total_steps=100, policy_hidden=(8,)), reward, 0)
    repeated = np.concatenate([both[0], both[1], both[1], both[1]]).astype(np.float64)
    np.testing.assert_allclose(learner.policy.input_mean.numpy(), repeated.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(learner.policy.input_scale.numpy(), 1 / repeated.std(axis=0), rtol=1e-5)


def test_a_constant_observation_does_not_blow_up(shown):
    learner = build(shown, normalize_observations=True)
    learner._track(torch.full((50, 12), 3.0))
    assert torch.isfinite(learner.policy.normalize(torch.full((1, 12), 3.5))).all()


def test_without_normalization_the_policy_sees_raw_observations(shown):
    learner = build(shown, normalize_observations=False)
    train(learner, 0, 1)
    assert not learner.policy.input_mean.any()
    assert (learner.policy.input_scale == 1).all()


def test_sent_policies_do_not_follow_the_learner(shown):
    learner = build(shown, normalize_observations=True)
    sent = learner.behavior_policy()
    before = {name: value.copy() for name, value in sent.arrays().items()}
    train(learner, 0, 1)
    for name, value in sent.arrays().items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize(("anneal", "expected"), [(True, [1.0, 0.75, 0.5, 0.25]), (False, [1.0] * 4)])
def test_steps_shrink_linearly_over_the_training(shown, rollout, anneal, expected):
    class Recording(EnvReward):
        scales: list[float] = []  # noqa: RUF012

        def update(self, rollouts, iteration, step_scale):
            self.scales.append(step_scale)
            return {}

    Recording.scales.clear()
    config = TrainingConfig(
        total_steps=4 * 18, num_groups=1, simulators_per_group=3, steps_per_rollout=6, policy_hidden=(8,), anneal=anneal
    )
    learner = Learner(3, 2, config, Recording(), 0)
    for iteration in range(4):
        learner.update(TransitionBatch.of([rollout(iteration)]), iteration)
    assert Recording.scales == expected


class TestEnds:
    """What the end of an episode is worth to an imitator."""

    @staticmethod
    def approaching(lengths):
        """Return demonstrations that walk from 0 towards 1, as far as each comes in 20 steps."""
        return Demonstrations.of(
            [Episode(np.linspace(0, (n - 1) / 20, n)[:, None], 0.0, True) for n in lengths], "walks"
        )

    def test_it_goes_on_where_demonstrations_of_any_weight_end(self):
        shown = self.approaching((11, 21))
        key = derive_key(0, "test")
        asked = np.array([[0.1], [0.5], [0.9], [1.0], [7.0]], np.float32)
        for weights, limit, expected in (
            ([1.0, 0.0], 100, [False, True, True, True, True]),
            ([0.0, 1.0], 100, [False, False, False, True, True]),
            ([1.0, 0.0], 10, [False] * 5),
            ([0.0, 1.0], 20, [False] * 5),
        ):
            ends = DemonstratedEnds(shown, np.array(weights), limit, key)
            assert ends.include(asked).tolist() == expected
        assert ends.include(asked[:0]).shape == (0,)

    def test_what_fails_stays_where_it_failed_until_the_time_limit(self):
        ends = DemonstratedEnds(self.approaching((11,)), np.ones(1), 15, derive_key(0, "test"))
        path = np.linspace(0, 0.5, 11, dtype=np.float32)[:, None]
        arrived, stopped, failed = Episode(path, 1.0, True), Episode(path[:4], 2.0), Episode(path[:4], 3.0, True)
        lasting = ends.until_limit([arrived, stopped, failed])
        assert lasting[0] is arrived and lasting[1] is stopped
        assert lasting[2].states.tolist() == path[:4].tolist() + 12 * path[3:4].tolist()
        assert (lasting[2].env_return, lasting[2].terminated) == (3.0, True)

    def test_the_last_reward_goes_on_for_ever(self, demonstrations, rollout, monkeypatch):
        """With discount 1/2 a reward r for ever is worth 2 r."""
        config = GailConfig(total_steps=100, discount=0.5)
        reward = AdversarialReward(demonstrations(21, 11), np.ones(2), DiscriminatorConfig(), 20, 0)
        learner, batch = Learner(3, 2, config, reward, 0), TransitionBatch.of([rollout(0)])
        batch.terminated[[1, 2], [0, 1]] = True
        monkeypatch.setattr(reward, "goes_on", lambda states: (states == batch.next_observations[2, 1]).all(1))
        expected = reward.rewards(batch)
        expected[2, 1] *= 2
        seen = []

        def advantages(rewards, *rest):
            seen.append(rewards)
            return rewards

        monkeypatch.setattr(learner_module, "generalized_advantages", advantages)
        learner.update(batch, 0)
        np.testing.assert_allclose(seen[0], expected, rtol=1e-6)


def test_noise_keeps_its_floor_and_shrinks_in_the_second_half(demonstrations, rollout):
    config = GailConfig(total_steps=6 * 10, num_groups=1, simulators_per_group=2, steps_per_rollout=3, final_std=0.2)
    assert config.num_iterations == 10
    learner = Learner(3, 2, config, AdversarialReward(demonstrations(9), np.ones(1), DiscriminatorConfig(), 9, 0), 0)
    with torch.no_grad():
        learner.policy.log_std[1] = -5.0
    ceilings = []
    for iteration in range(10):
        learner.update(TransitionBatch.of([rollout(iteration)]), iteration)
        ceilings.append(learner.policy.log_std.detach().exp().tolist())
    assert ceilings[0][1] == pytest.approx(0.4)
    assert all(low >= 0.4 - 1e-6 for _, low in ceilings[:5])
    assert ceilings[4][0] > 0.8
    for i, factor in enumerate((0.8, 0.6, 0.4, 0.2, 0.0), start=5):
        assert ceilings[i][0] <= 0.2 ** (1 - factor) + 1e-6
        assert ceilings[i][1] >= 0.4**factor * 0.2 ** (1 - factor) - 1e-6
    assert ceilings[-1] == pytest.approx([0.2, 0.2])
