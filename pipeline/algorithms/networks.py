"""The networks of the method: two tanh layers, a small head (docs/algorithms.md).

Letters: B batch, S observation, A action, H hidden.
"""

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from oodil.pipeline.policy import GaussianPolicy


class MLP(nn.Module):
    """Linear layers with tanh between them; the head starts small (weights x 0.1, bias 0)."""

    def __init__(self, inputs: int, hidden: tuple[int, ...], outputs: int, rng: torch.Generator) -> None:
        super().__init__()
        self.layers = [nn.Linear(a, b) for a, b in pairwise((inputs, *hidden, outputs))]
        for i, layer in enumerate(self.layers):
            self.add_module(f"layer_{i}", layer)
            bound = layer.in_features**-0.5
            nn.init.uniform_(layer.weight, -bound, bound, generator=rng)
            nn.init.uniform_(layer.bias, -bound, bound, generator=rng)
        with torch.no_grad():
            self.layers[-1].weight.mul_(0.1)
            self.layers[-1].bias.zero_()

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, outputs) for (B, inputs), without a graph: `gradients` differentiates."""
        return self.head(self.layer_inputs(x))

    @torch.no_grad()
    def layer_inputs(self, x: Tensor) -> list[Tensor]:
        """Return what each layer sees for (B, inputs), for `head` and the derivatives."""
        inputs = [x]
        for layer in self.layers[:-1]:
            hidden = layer(inputs[-1])
            # NumPy's tanh takes a tenth of the time of torch's, which would be half of a pass.
            np.tanh(hidden.numpy(), out=hidden.numpy())
            inputs.append(hidden)
        return inputs

    @torch.no_grad()
    def head(self, layer_inputs: list[Tensor]) -> Tensor:
        """Return (B, outputs) from what `layer_inputs` returned."""
        return self.layers[-1](layer_inputs[-1])

    @torch.no_grad()
    def gradients(self, layer_inputs: list[Tensor], output_gradient: Tensor) -> list[Tensor]:
        """Return the gradient of each parameter, ordered as `parameters()`, for a gradient (B, outputs) of the output.

        Reverse-mode differentiation by hand, to the bits that autograd would give.
        """
        gradients: list[Tensor] = []
        flowing = output_gradient
        for layer, inputs in zip(reversed(self.layers), reversed(layer_inputs), strict=True):
            gradients[:0] = [flowing.T.mm(inputs), flowing.sum(0)]
            if layer is not self.layers[0]:
                flowing = torch.ops.aten.tanh_backward(flowing.mm(layer.weight), inputs)
        return gradients

    @torch.no_grad()
    def directional_derivative(self, layer_inputs: list[Tensor], tangents: list[Tensor]) -> Tensor:
        """Return (B, outputs): the change of the output when the parameters move along ``tangents``.

        Forward-mode differentiation by hand, one pass; ``tangents`` are ordered as `parameters()`.
        """
        change = torch.nn.functional.linear(layer_inputs[0], tangents[0], tangents[1])
        for i, layer in enumerate(self.layers[1:], start=1):
            # The derivative of tanh is the same in both modes.
            change = torch.ops.aten.tanh_backward(change, layer_inputs[i])
            change = torch.nn.functional.linear(layer_inputs[i], tangents[2 * i], tangents[2 * i + 1]).addmm_(
                change, layer.weight.T
            )
        return change


class PolicyNetwork(nn.Module):
    """Gaussian policy with a mean network and a log standard deviation that does not depend on the observation."""

    input_mean: Tensor
    input_scale: Tensor

    def __init__(self, observation_dim: int, action_dim: int, hidden: tuple[int, ...], rng: torch.Generator) -> None:
        super().__init__()
        self.net = MLP(observation_dim, hidden, action_dim, rng)
        self.log_std = nn.Parameter(torch.zeros(action_dim))
        self.register_buffer("input_mean", torch.zeros(observation_dim))
        self.register_buffer("input_scale", torch.ones(observation_dim))

    def normalize(self, observations: Tensor) -> Tensor:
        """Return (B, S) observations as the network sees them."""
        return (observations - self.input_mean) * self.input_scale

    def forward(self, observations: Tensor) -> Tensor:
        """Return (B, A) mean actions."""
        return self.net(self.normalize(observations))

    def gradients(self, loss: Tensor, mean: Tensor, layer_inputs: list[Tensor]) -> list[Tensor]:
        """Return the gradient of each parameter, ordered as `parameters()`.

        ``loss`` depends on `log_std` and on ``mean`` (B, A): the output for ``layer_inputs``, as a leaf of the graph.
        """
        log_std_gradient, mean_gradient = torch.autograd.grad(loss, (self.log_std, mean))
        return [log_std_gradient, *self.net.gradients(layer_inputs, mean_gradient)]

    def log_prob(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return (B,) log-densities of ``actions`` (B, A) under the Gaussian with this ``mean`` (B, A)."""
        standardized = (actions - mean) * torch.exp(-self.log_std)
        constant = 0.5 * float(np.log(2 * np.pi)) * actions.shape[-1]
        return -0.5 * standardized.square().sum(-1) - self.log_std.sum() - constant

    def export(self) -> GaussianPolicy:
        """Return a copy for rollout workers."""
        layers = self.net.layers
        return GaussianPolicy(
            # A plain ascontiguousarray would not copy a column, which would then change while it is being sent.
            weights=tuple(np.array(layer.weight.detach().numpy().T, order="C") for layer in layers),
            biases=tuple(layer.bias.detach().numpy().copy() for layer in layers),
            log_std=self.log_std.detach().numpy().copy(),
            input_mean=self.input_mean.numpy().copy(),
            input_scale=self.input_scale.numpy().copy(),
        )

    @torch.no_grad()
    def load(self, policy: GaussianPolicy) -> None:
        """Take over the parameters of an exported policy; shapes must agree."""
        for layer, weight, bias in zip(self.net.layers, policy.weights, policy.biases, strict=True):
            layer.weight.copy_(torch.tensor(weight.T))
            layer.bias.copy_(torch.tensor(bias))
        self.log_std.copy_(torch.tensor(policy.log_std))
        self.input_mean.copy_(torch.tensor(policy.input_mean))
        self.input_scale.copy_(torch.tensor(policy.input_scale))
