"""Generalized advantage estimation by hand and against the definition."""

import numpy as np
import pytest

from oodil.pipeline.algorithms.advantages import generalized_advantages, standardized


def column(*values, dtype=np.float32):
    return np.array(values, dtype)[:, None]


def three_steps(terminated=(), truncated=()):
    """Rewards 1, 2, 3; values 10, 20, 30; next values 20, 30, 40; discount 0.5, lambda 0.4, so the decay is 0.2."""
    ends = [column(*(t in when for t in range(3)), dtype=np.bool_) for when in (terminated, truncated)]
    rewards, values, following = column(1, 2, 3), column(10, 20, 30), column(20, 30, 40)
    return generalized_advantages(rewards, values, following, *ends, discount=0.5, gae_lambda=0.4)[:, 0]


def test_by_hand_without_an_end():
    # errors: 1 + 10 - 10 = 1;  2 + 15 - 20 = -3;  3 + 20 - 30 = -7 (the last step bootstraps)
    # advantages from the back: -7;  -3 + 0.2 * -7 = -4.4;  1 + 0.2 * -4.4 = 0.12
    np.testing.assert_allclose(three_steps(), [0.12, -4.4, -7.0], rtol=1e-6)


def test_termination_cuts_the_future_value_and_the_sum():
    # step 1 terminates: its error is 2 - 20 = -18, nothing of step 2 flows back; step 0: 1 + 0.2 * -18 = -2.6
    np.testing.assert_allclose(three_steps(terminated=[1]), [-2.6, -18.0, -7.0], rtol=1e-6)


def test_truncation_bootstraps_but_cuts_the_sum():
    # step 1 is truncated: its error stays 2 + 15 - 20 = -3; step 0: 1 + 0.2 * -3 = 0.4
    np.testing.assert_allclose(three_steps(truncated=[1]), [0.4, -3.0, -7.0], rtol=1e-6)


def test_termination_wins_over_truncation():
    np.testing.assert_array_equal(three_steps(terminated=[1], truncated=[1]), three_steps(terminated=[1]))


def test_termination_at_the_last_step():
    # error of the last step: 3 - 30 = -27; then -3 + 0.2 * -27 = -8.4;  1 + 0.2 * -8.4 = -0.68
    np.testing.assert_allclose(three_steps(terminated=[2]), [-0.68, -8.4, -27.0], rtol=1e-6)


def reference(rewards, values, next_values, terminated, truncated, discount, gae_lambda):
    """The defining sum: A_t = sum_k (discount lambda)^k error_{t+k}, up to the end of the episode."""
    advantages = np.zeros_like(rewards, np.float64)
    for g in range(rewards.shape[1]):
        for t in range(len(rewards)):
            weight = 1.0
            for k in range(t, len(rewards)):
                future = 0.0 if terminated[k, g] else float(next_values[k, g])
                advantages[t, g] += weight * (rewards[k, g] + discount * future - values[k, g])
                weight *= discount * gae_lambda
                if terminated[k, g] or truncated[k, g]:
                    break
    return advantages


@pytest.mark.parametrize(("discount", "gae_lambda"), [(0.995, 0.97), (1.0, 1.0), (0.9, 0.0), (0.0, 0.5)])
def test_against_the_defining_sum(discount, gae_lambda):
    rng = np.random.default_rng(0)
    shape = (40, 5)
    rewards, values, next_values = (rng.standard_normal(shape).astype(np.float32) for _ in range(3))
    terminated, truncated = rng.random(shape) < 0.1, rng.random(shape) < 0.1
    arguments = (rewards, values, next_values, terminated, truncated, discount, gae_lambda)
    result = generalized_advantages(*arguments)
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, reference(*arguments), rtol=1e-4, atol=1e-5)


def test_with_lambda_one_advantage_plus_value_is_the_discounted_return():
    rng = np.random.default_rng(1)
    rewards, values = (rng.standard_normal((30, 1)).astype(np.float32) for _ in range(2))
    terminated = np.zeros((30, 1), np.bool_)
    terminated[-1] = True
    next_values = np.concatenate((values[1:], np.full((1, 1), 99, np.float32)))
    result = generalized_advantages(rewards, values, next_values, terminated, ~terminated & False, 0.9, 1.0)
    returns = [sum(0.9**k * float(rewards[t + k, 0]) for k in range(30 - t)) for t in range(30)]
    np.testing.assert_allclose((result + values)[:, 0], returns, rtol=1e-4, atol=1e-5)


def test_standardized():
    result = standardized(np.array([[1, 2], [3, 6]], np.float32))
    # mean 3, deviations -2, -1, 0, 3, variance 14 / 4
    np.testing.assert_allclose(result, np.array([[-2, -1], [0, 3]]) / np.sqrt(3.5), rtol=1e-6)
    assert not standardized(np.full((2, 2), 7, np.float32)).any()
