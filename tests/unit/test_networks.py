"""The networks: forward-mode derivative, initial weights, and the trip to NumPy and back."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal
from torch.func import jvp

from oodil.pipeline.algorithms.networks import MLP, PolicyNetwork


class NumpyTanh(torch.autograd.Function):
    """NumPy's tanh for autograd."""

    @staticmethod
    def forward(ctx, x):
        y = torch.from_numpy(np.tanh(x.detach().numpy()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, gradient):
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)


def test_directional_derivative_equals_forward_mode_autodiff(plain_mlp):
    rng = torch.Generator().manual_seed(0)
    for hidden in ((7,), (5, 6), (4, 3, 2)):
        net = MLP(3, hidden, 2, rng).double()
        x = torch.randn(11, 3, generator=rng, dtype=torch.float64)
        parameters = list(net.parameters())
        tangents = [torch.randn(p.shape, generator=rng, dtype=torch.float64) for p in parameters]
        _, expected = jvp(lambda p: plain_mlp(p, x), (parameters,), (tangents,))  # noqa: B023
        result = net.directional_derivative(net.layer_inputs(x), tangents)
        torch.testing.assert_close(result, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("batch", "inputs", "outputs"), [(256, 12, 1), (640, 12, 3), (5120, 24, 1), (7, 3, 2)])
def test_output_and_gradients_have_the_bits_of_autograd(plain_mlp, batch, inputs, outputs):
    rng = torch.Generator().manual_seed(0)
    for hidden in ((64, 64), (5,), (9, 8, 7)):
        net = MLP(inputs, hidden, outputs, rng)
        x, flowing = torch.randn(batch, inputs, generator=rng), torch.randn(batch, outputs, generator=rng)
        parameters = list(net.parameters())
        output = plain_mlp(parameters, x, NumpyTanh.apply)
        assert torch.equal(net(x), output)
        layer_inputs = net.layer_inputs(x)
        assert torch.equal(net.head(layer_inputs), output)
        expected = torch.autograd.grad(output, parameters, flowing)
        assert all(map(torch.equal, net.gradients(layer_inputs, flowing), expected))


def test_a_policys_gradients_are_those_of_autograd(plain_mlp, network, batch):
    policy = network().double()
    observations, actions, _, _ = batch(policy, 50)
    inputs, (log_std, *parameters) = policy.normalize(observations), policy.parameters()
    expected = torch.autograd.grad(
        policy.log_prob(plain_mlp(parameters, inputs), actions).square().mean(), [log_std, *parameters]
    )
    layer_inputs = policy.net.layer_inputs(inputs)
    mean = policy.net.head(layer_inputs).requires_grad_()
    result = policy.gradients(policy.log_prob(mean, actions).square().mean(), mean, layer_inputs)
    torch.testing.assert_close(result, list(expected), rtol=1e-10, atol=1e-12)


def test_mlp_is_linear_layers_with_tanh_between():
    net = MLP(1, (1,), 1, torch.Generator())
    with torch.no_grad():
        for parameter, value in zip(net.parameters(), (2.0, 0.5, 3.0, -1.0), strict=True):
            parameter.fill_(value)
    # 3 tanh(2 * 0.25 + 0.5) - 1 = 3 * 0.7615942 - 1
    torch.testing.assert_close(net(torch.tensor([[0.25]])), torch.tensor([[3 * 0.7615942 - 1]]))


def test_head_starts_small_and_the_seed_decides():
    one = MLP(16, (64, 64), 4, torch.Generator().manual_seed(7))
    two = MLP(16, (64, 64), 4, torch.Generator().manual_seed(7))
    other = MLP(16, (64, 64), 4, torch.Generator().manual_seed(8))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True))
    assert not torch.equal(one.layers[0].weight, other.layers[0].weight)
    # Uniform in +-1/sqrt(64) = +-0.125, and a tenth of that in the head.
    assert 0.12 < float(one.layers[1].weight.detach().abs().max()) <= 0.125
    assert 0.012 < float(one.layers[-1].weight.detach().abs().max()) <= 0.0125
    assert not one.layers[-1].bias.any()


def test_log_prob_equals_torch_distributions(network, batch):
    policy = network(action_dim=3)
    observations, actions, log_probs, _ = batch(policy, 40)
    with torch.no_grad():
        gaussian = Independent(Normal(policy(observations), policy.log_std.exp()), 1)
        torch.testing.assert_close(log_probs, gaussian.log_prob(actions + 0), rtol=1e-4, atol=1e-5)
        shifted = policy.log_prob(policy(observations), actions + 1)
        torch.testing.assert_close(shifted, gaussian.log_prob(actions + 1), rtol=1e-4, atol=1e-5)


def test_exported_policy_has_the_same_mean(network, batch):
    policy = network(observation_dim=12, action_dim=3, hidden=(64, 64))
    observations = batch(policy, 100)[0]
    with torch.no_grad():
        expected = policy(observations).numpy()
    result = policy.export().mean(observations.double().numpy())
    assert result.dtype == np.float32
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


def test_load_is_the_inverse_of_export(network, assert_same_bits):
    policy = network(seed=1)
    copy = PolicyNetwork(4, 2, (8, 8), torch.Generator().manual_seed(99))
    copy.load(policy.export())
    assert_same_bits(dict(policy.state_dict()), dict(copy.state_dict()))


@pytest.mark.parametrize(("observation_dim", "action_dim", "hidden"), [(4, 2, (8,)), (3, 1, (8, 8)), (1, 1, (1, 1))])
def test_an_exported_policy_shares_no_memory_with_the_network(network, observation_dim, action_dim, hidden):
    policy = network(observation_dim=observation_dim, action_dim=action_dim, hidden=hidden)
    exported = policy.export()
    before = {name: array.copy() for name, array in exported.arrays().items()}
    with torch.no_grad():
        for value in policy.state_dict().values():
            value.add_(1.0)
    for name, array in exported.arrays().items():
        assert array.tobytes() == before[name].tobytes(), name
        assert array.flags.c_contiguous
