"""The networks: derivatives of every kind, initial weights, and the trip to NumPy and back."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck
from torch.distributions import Independent, Normal
from torch.func import jvp

from oodil.pipeline.algorithms.networks import MLP, Linearization, Tanh


def test_tanh_can_be_differentiated_twice():
    x = torch.linspace(-3, 3, 12, dtype=torch.float64).view(4, 3).requires_grad_()
    assert gradcheck(Tanh.apply, x)
    assert gradgradcheck(Tanh.apply, x)
    torch.testing.assert_close(Tanh.apply(x), torch.tanh(x), rtol=1e-14, atol=1e-15)


def test_tanh_has_the_derivatives_of_torch():
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(50, generator=rng, dtype=torch.float64).requires_grad_()
    derivatives = {}
    for tanh in (Tanh.apply, torch.tanh):
        (first,) = torch.autograd.grad(tanh(x).sum(), x, create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), x, create_graph=True)
        (third,) = torch.autograd.grad(second.sum(), x)
        derivatives[tanh] = (first, second, third)
    for own, expected in zip(*derivatives.values(), strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-12, atol=1e-14)


def test_a_gradient_penalty_has_the_gradients_of_torch(plain_mlp):
    """The penalty is of the gradient with respect to the input; its own gradient is with respect to the parameters."""
    rng = torch.Generator().manual_seed(0)
    net = MLP(6, (9, 8), 1, rng).double()
    parameters = list(net.parameters())
    x = torch.randn(20, 6, generator=rng, dtype=torch.float64)

    def penalty(network):
        inputs = x.clone().requires_grad_()
        (slope,) = torch.autograd.grad(network(inputs).sum(), inputs, create_graph=True)
        return slope.square().sum(-1).mean()

    own, expected = penalty(net), penalty(lambda inputs: plain_mlp(parameters, inputs))
    assert own.item() > 0
    torch.testing.assert_close(own, expected, rtol=1e-12, atol=1e-14)
    # The last bias has no part in the slope.
    own_gradients, expected_gradients = (
        torch.autograd.grad(each, parameters, allow_unused=True, materialize_grads=True) for each in (own, expected)
    )
    assert all(gradient.abs().max() > 1e-6 for gradient in own_gradients[:-1])
    torch.testing.assert_close(own_gradients, expected_gradients, rtol=1e-10, atol=1e-12)


def test_a_gradient_penalty_passes_a_numerical_check():
    rng = torch.Generator().manual_seed(0)
    net = MLP(3, (4, 5), 2, rng).double()
    with torch.no_grad():
        net.layers[-1].weight.mul_(10)
    x = torch.randn(7, 3, generator=rng, dtype=torch.float64, requires_grad=True)
    parameters = [p.detach().clone().requires_grad_() for p in net.parameters()]
    names = [name for name, _ in net.named_parameters()]

    def output(x, *values):
        return torch.func.functional_call(net, dict(zip(names, values, strict=True)), x)

    assert gradcheck(output, (x, *parameters))
    assert gradgradcheck(output, (x, *parameters))


@pytest.mark.parametrize("hidden", [(7,), (5, 6), (4, 3, 2)])
def test_output_change_equals_forward_mode_autodiff(plain_mlp, hidden):
    rng = torch.Generator().manual_seed(0)
    net = MLP(3, hidden, 2, rng).double()
    x = torch.randn(11, 3, generator=rng, dtype=torch.float64)
    parameters = list(net.parameters())
    tangents = [torch.randn(p.shape, generator=rng, dtype=torch.float64) for p in parameters]
    _, expected = jvp(lambda p: plain_mlp(p, x), (parameters,), (tangents,))
    torch.testing.assert_close(Linearization(net, x).output_change(tangents), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("batch", "inputs", "outputs"), [(256, 12, 1), (640, 12, 3), (5120, 24, 1), (7, 3, 2)])
def test_a_linearization_has_the_bits_of_autograd(batch, inputs, outputs):
    rng = torch.Generator().manual_seed(0)
    for hidden in ((64, 64), (5,), (9, 8, 7)):
        net = MLP(inputs, hidden, outputs, rng)
        x, flowing = torch.randn(batch, inputs, generator=rng), torch.randn(batch, outputs, generator=rng)
        output, linearization = net(x), Linearization(net, x)
        assert torch.equal(linearization.output, output)
        expected = torch.autograd.grad(output, list(net.parameters()), flowing)
        assert all(map(torch.equal, linearization.gradients(flowing), expected))


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


def test_entropy_equals_torch_distributions(network):
    policy = network(action_dim=3)
    gaussian = Independent(Normal(torch.zeros(3), policy.log_std.detach().exp()), 1)
    torch.testing.assert_close(policy.entropy().detach(), gaussian.entropy())


def test_exported_policy_has_the_same_mean(network, batch):
    policy = network(observation_dim=12, action_dim=3, hidden=(64, 64))
    observations = batch(policy, 100)[0]
    with torch.no_grad():
        expected = policy(observations).numpy()
    result = policy.export().mean(observations.double().numpy())
    assert result.dtype == np.float32
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


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
