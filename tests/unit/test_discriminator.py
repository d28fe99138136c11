"""The discriminator: its loss by hand and the sign of its logits."""

import math

import numpy as np
import pytest
import torch

from oodil.pipeline.algorithms.discriminator import Discriminator, discriminator_losses, imitation_reward
from oodil.pipeline.config import DiscriminatorConfig
from oodil.pipeline.data import Demonstrations, Episode


@pytest.fixture
def pairs():
    """Return overlapping clouds: demonstrations around +0.5, the policy around -0.5."""
    rng = torch.Generator().manual_seed(0)
    return torch.randn(40, 6, generator=rng) + 0.5, torch.randn(60, 6, generator=rng) - 0.5


def build(shown=None, weights=None, **settings):
    """Return a discriminator of pairs of three-dimensional states, without a penalty unless one is given."""
    if shown is None:
        states = np.random.default_rng(0).normal(size=(9, 3))
        shown = Demonstrations.of([Episode(states)], "shown")
    settings = {"gradient_penalty": 0.0} | settings
    weights = np.ones(len(shown)) if weights is None else np.array(weights)
    return Discriminator(shown, weights, DiscriminatorConfig(**settings), seed=1)


def test_loss_by_hand():
    # D = sigmoid(logit): log 3 -> 3/4, -log 3 -> 1/4, 0 -> 1/2.
    demonstration_logits = torch.tensor([math.log(3), 0.0])
    policy_logits = torch.tensor([-math.log(3), 0.0, math.log(3)])
    expected = (
        -(math.log(3 / 4) + math.log(1 / 2)) / 2,
        -(math.log(3 / 4) + math.log(1 / 2) + math.log(1 / 4)) / 3,
    )
    losses = discriminator_losses(demonstration_logits, policy_logits)
    assert [float(loss) for loss in losses] == pytest.approx(expected, rel=1e-6)


def test_loss_is_binary_cross_entropy_with_demonstrations_as_one():
    rng = torch.Generator().manual_seed(0)
    demonstration, policy = torch.randn(7, generator=rng), torch.randn(9, generator=rng)
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    expected = entropy(demonstration, torch.ones(7)), entropy(policy, torch.zeros(9))
    torch.testing.assert_close(discriminator_losses(demonstration, policy), expected)


def test_loss_stays_finite_for_extreme_logits():
    losses = discriminator_losses(torch.tensor([-200.0]), torch.tensor([300.0]))
    assert [float(loss) for loss in losses] == pytest.approx([200.0, 300.0])


def test_reward_by_hand():
    # -log(1 - D): D = 1/2 -> log 2, D = 3/4 -> log 4, D = 1/4 -> log(4/3)
    logits = torch.tensor([0.0, math.log(3), -math.log(3)])
    expected = torch.tensor([math.log(2), math.log(4), math.log(4 / 3)])
    torch.testing.assert_close(imitation_reward(logits), expected)


def test_reward_is_positive_and_grows_with_the_logit():
    rewards = imitation_reward(torch.linspace(-20, 20, 401))
    assert (rewards > 0).all()
    assert (rewards.diff() > 0).all()


def test_a_step_raises_demonstrations_and_lowers_the_policy(pairs):
    demonstration, policy = pairs
    discriminator = build()
    with torch.no_grad():
        before = discriminator(demonstration).mean(), discriminator(policy).mean()
    discriminator.update(demonstration, policy)
    with torch.no_grad():
        assert discriminator(demonstration).mean() > before[0]
        assert discriminator(policy).mean() < before[1]


def test_training_separates_the_two_and_rewards_what_looks_like_a_demonstration(pairs):
    demonstration, policy = pairs
    discriminator = build(learning_rate=1e-2)
    metrics = [discriminator.update(demonstration, policy) for _ in range(100)]
    assert metrics[-1]["discriminator_loss"] < 0.5 * metrics[0]["discriminator_loss"]
    assert metrics[-1]["demonstration_accuracy"] > 0.95
    assert metrics[-1]["policy_accuracy"] > 0.95
    with torch.no_grad():
        assert (
            imitation_reward(discriminator(demonstration)).mean() > 2 * imitation_reward(discriminator(policy)).mean()
        )


class TestView:
    """What the discriminator sees of a pair."""

    @pytest.fixture
    def shown(self):
        rng = np.random.default_rng(3)
        scales = np.array([0.01, 1.0, 100.0])
        walks = [(rng.normal(size=(n, 3)) * scales).cumsum(0) + 5 * scales for n in (60, 40)]
        return Demonstrations.of([Episode(walk) for walk in walks], "shown")

    def test_states_and_changes_have_mean_zero_and_deviation_one_over_the_demonstrations(self, shown):
        starts = shown.transition_starts()
        seen = build(shown).inputs(shown.observations[starts], shown.observations[starts + 1]).numpy()
        np.testing.assert_allclose(seen.mean(0), 0, atol=1e-4)
        np.testing.assert_allclose(seen.std(0), 1, rtol=1e-3)

    def test_it_is_the_change_that_is_seen_beside_the_state(self, shown):
        state = shown.observations[10:11]
        change = np.diff(shown[0], axis=0).std(0, keepdims=True).astype(np.float32)
        still, moved = (build(shown).inputs(state, state + c).numpy()[0] for c in (0 * change, change))
        np.testing.assert_array_equal(still[:3], moved[:3])
        assert (np.abs(moved - still)[3:] > 0.5).all(), "a change of one deviation is of order one in every dimension"

    def test_demonstrations_count_by_their_weights(self, shown):
        alone = build(shown.select(np.array([1])))
        weighted = build(shown, [0.0, 1.0])
        torch.testing.assert_close(weighted.input_mean, alone.input_mean)
        torch.testing.assert_close(weighted.input_scale, alone.input_scale)

    def test_a_constant_dimension_is_only_centered_and_what_is_far_away_is_clipped(self, shown):
        states = shown[0].copy()
        states[:, 1] = 7.0
        seen = build(Demonstrations.of([Episode(states)], "shown")).inputs
        here = np.array([[0.05, 7.5, 500.0]], np.float32)
        assert seen(here, here).numpy()[0, 1] == pytest.approx(0.5)
        far = here + np.array([[1e6, -1e6, 1e6]], np.float32)
        assert seen(far, far).numpy()[0, :3].tolist() == [10, -10, 10]

    def test_the_raw_view_is_the_pair_as_it_is(self, shown):
        states = np.arange(12, dtype=np.float32).reshape(4, 3)
        expected = np.concatenate((states, 10 * states), axis=1)
        np.testing.assert_array_equal(build(shown, view="raw").inputs(states, 10 * states).numpy(), expected)


class TestGradientPenalty:
    """R1: half the squared gradient of the logit at demonstrations."""

    def test_it_is_that_of_the_inputs_by_finite_differences(self, pairs):
        demonstration, policy = pairs
        discriminator = build(gradient_penalty=1.0).double()
        metrics = discriminator.update(demonstration.double(), policy.double())
        again = build().double()
        x, h = demonstration.double(), 1e-5
        with torch.no_grad():
            slopes = [(again(x + h * e) - again(x - h * e)) / (2 * h) for e in torch.eye(6, dtype=torch.float64)]
        assert metrics["discriminator_squared_gradient"] == pytest.approx(
            float(torch.stack(slopes).square().sum(0).mean()), rel=1e-5
        )

    def test_a_penalized_discriminator_is_flatter(self, pairs):
        plain, penalized = build(learning_rate=1e-2), build(learning_rate=1e-2, gradient_penalty=1.0)
        for _ in range(100):
            plain.update(*pairs)
            penalized.update(*pairs)
        with torch.no_grad():
            steep, flat = (float(net(pairs[0]).mean() - net(pairs[1]).mean()) for net in (plain, penalized))
        assert 0.2 < flat < 0.5 * steep

    def test_what_is_the_same_still_reads_one_half(self):
        rng = torch.Generator().manual_seed(0)
        discriminator = build(gradient_penalty=1.0, learning_rate=3e-3)
        for _ in range(200):
            discriminator.update(torch.randn(256, 6, generator=rng), torch.randn(256, 6, generator=rng))
        with torch.no_grad():
            assert float(discriminator(torch.randn(4096, 6, generator=rng)).abs().mean()) < 0.1


def test_metrics_describe_the_state_before_the_step(pairs):
    demonstration, policy = pairs
    discriminator = build()
    with torch.no_grad():
        logits = discriminator(demonstration), discriminator(policy)
    metrics = discriminator.update(demonstration, policy)
    losses = [float(loss) for loss in discriminator_losses(*logits)]
    assert metrics["discriminator_loss"] == pytest.approx(sum(losses), rel=1e-5)
    assert metrics["discriminator_demonstration_loss"] == pytest.approx(losses[0], rel=1e-5)
    assert metrics["discriminator_policy_loss"] == pytest.approx(losses[1], rel=1e-5)
    assert metrics["demonstration_accuracy"] == pytest.approx(float((logits[0] > 0).float().mean()))
    assert metrics["policy_accuracy"] == pytest.approx(float((logits[1] < 0).float().mean()))


def test_terms_are_averaged_so_that_their_numbers_do_not_matter(pairs):
    demonstration, policy = pairs
    one, two = build(), build()
    one.update(demonstration, policy)
    two.update(demonstration.repeat(3, 1), policy)
    for a, b in zip(one.parameters(), two.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)
