"""The policy that travels: densities, arrays and their checks."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from oodil.pipeline.policy import GaussianPolicy


@pytest.fixture
def policy(network):
    return network(observation_dim=4, action_dim=2, hidden=(8, 6)).export()


def test_log_prob_of_noise_equals_torch_distributions(policy):
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((5, 3, 2), dtype=np.float32)
    mean = rng.standard_normal((5, 3, 2), dtype=np.float32)
    std = np.exp(policy.log_std)
    gaussian = Independent(Normal(torch.from_numpy(mean), torch.from_numpy(std)), 1)
    expected = gaussian.log_prob(torch.from_numpy(mean + noise * std)).numpy()
    result = policy.log_prob_of_noise(noise)
    assert (result.shape, result.dtype) == ((5, 3), np.float32)
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-4)


def test_mean_by_hand():
    policy = GaussianPolicy(
        weights=(np.array([[2.0]], np.float32), np.array([[3.0]], np.float32)),
        biases=(np.array([0.5], np.float32), np.array([-1.0], np.float32)),
        log_std=np.zeros(1, np.float32),
        input_mean=np.array([1.0], np.float32),
        input_scale=np.array([0.5], np.float32),
    )
    # (1.5 - 1) * 0.5 = 0.25;  3 tanh(2 * 0.25 + 0.5) - 1
    np.testing.assert_allclose(policy.mean(np.array([[1.5]])), [[3 * np.tanh(1.0) - 1]], rtol=1e-6)


def test_a_row_does_not_depend_on_the_rest_of_the_values(policy):
    """Within one batch shape, a simulator's action depends on its own observation only."""
    rng = np.random.default_rng(0)
    one, two = rng.standard_normal((8, 4)), rng.standard_normal((8, 4))
    two[3] = one[3]
    assert policy.mean(one)[3].tobytes() == policy.mean(two)[3].tobytes()


def test_arrays_and_back(policy, assert_same_bits):
    assert_same_bits(policy, GaussianPolicy.from_arrays(policy.arrays()))


@pytest.mark.parametrize("missing", ["log_std", "input_mean", "input_scale", "weight_0", "bias_1"])
def test_a_missing_array_is_refused(policy, missing):
    arrays = policy.arrays()
    del arrays[missing]
    with pytest.raises(ValueError, match="policy"):
        GaussianPolicy.from_arrays(arrays)


@pytest.mark.parametrize("name", ["weight_0", "weight_1", "weight_2", "log_std", "input_mean", "input_scale", "bias_1"])
def test_a_wrong_shape_is_refused(policy, name):
    arrays = policy.arrays()
    arrays[name] = np.concatenate((arrays[name], arrays[name]))
    with pytest.raises(ValueError, match="policy"):
        GaussianPolicy.from_arrays(arrays)


def test_no_layers_are_refused(policy):
    arrays = {name: value for name, value in policy.arrays().items() if name.startswith(("log", "input"))}
    with pytest.raises(ValueError, match="fit together"):
        GaussianPolicy.from_arrays(arrays)
