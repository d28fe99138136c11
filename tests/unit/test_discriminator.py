"""The discriminator: its loss by hand and the sign of its logits."""

import math

import numpy as np
import pytest
import torch

from oodil.pipeline.algorithms.discriminator import Discriminator, discriminator_losses, imitation_reward
from oodil.pipeline.config import DiscriminatorConfig


@pytest.fixture
def pairs():
    """Return overlapping clouds: demonstrations around +0.5, the policy around -0.5."""
    rng = torch.Generator().manual_seed(0)
    return torch.randn(40, 6, generator=rng) + 0.5, torch.randn(60, 6, generator=rng) - 0.5


def build(**settings):
    return Discriminator(3, DiscriminatorConfig(**settings), torch.Generator().manual_seed(1))


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
    torch.testing.assert_close(imitation_reward(logits, "positive"), expected)
    # log D - log(1 - D): D = 1/2 -> 0, D = 3/4 -> log 3, D = 1/4 -> -log 3
    torch.testing.assert_close(imitation_reward(logits, "logit"), logits)


def test_reward_is_positive_and_grows_with_the_logit():
    rewards = imitation_reward(torch.linspace(-20, 20, 401), "positive")
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
            imitation_reward(discriminator(demonstration), "positive").mean()
            > 2 * imitation_reward(discriminator(policy), "positive").mean()
        )


def test_ignored_dimensions_are_not_seen(pairs):
    half_blind = build(ignored=(0, 2))
    states = np.arange(12, dtype=np.float32).reshape(4, 3)
    assert half_blind.pairs(states, 10 * states).tolist() == [[1, 10], [4, 40], [7, 70], [10, 100]]
    elsewhere = states + np.array([5, 0, -3], np.float32)
    same = [half_blind(half_blind.pairs(each, each)).tolist() for each in (states, elsewhere)]
    assert same[0] == same[1]


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
