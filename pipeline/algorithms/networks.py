"""The networks of the method: two tanh layers and a small output layer (docs/algorithms.md).

Losses are differentiated by autograd, twice where a gradient is penalized. Only what a Fisher-vector product needs, and
the regression of the value function, uses the derivatives of `Linearization`, which cost less than a graph.

Letters: B batch, S observation, A action, H hidden.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import linear

from oodil.pipeline.policy import LARGEST_INPUT, GaussianPolicy


class Tanh(torch.autograd.Function):
    """NumPy's tanh, which takes a tenth of the time of torch's; that would be half of a pass through a network.

    It can be differentiated any number of times in reverse mode.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Return tanh of every element."""
        y = torch.from_numpy(np.tanh(x.detach().numpy()))
        # The output, not the input: the derivative is 1 - y^2, and the graph of a second derivative goes through y.
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Return the gradient with respect to the input."""
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)


class MLP(nn.Module):
    """Linear layers with tanh between them; the output layer starts small (weights x 0.1, bias 0)."""

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
        """Return (B, outputs) for (B, inputs)."""
        for layer in self.layers[:-1]:
            x = Tanh.apply(layer(x))
        return self.layers[-1](x)


class Linearization:
    """An MLP at fixed inputs and parameters: its output, and products with its Jacobian J with respect to parameters.

    Both products reuse the one forward pass and build no graph. They have the bits of reverse-mode and forward-mode
    automatic differentiation.
    """

    @torch.no_grad()
    def __init__(self, net: MLP, x: Tensor) -> None:
        """Run a forward pass on (B, inputs)."""
        self._layers = net.layers
        self._layer_inputs = [x]
        for layer in self._layers[:-1]:
            hidden = linear(self._layer_inputs[-1], layer.weight, layer.bias)
            np.tanh(hidden.numpy(), out=hidden.numpy())
            self._layer_inputs.append(hidden)
        self.output = self._layers[-1](self._layer_inputs[-1])
        """(B, outputs)"""

    @torch.no_grad()
    def gradients(self, output_gradient: Tensor) -> list[Tensor]:
        """Return J^T u for u of (B, outputs): the gradient of each parameter, ordered as `MLP.parameters()`."""
        gradients: list[Tensor] = []
        flowing = output_gradient
        for layer, inputs in zip(reversed(self._layers), reversed(self._layer_inputs), strict=True):
            gradients[:0] = [flowing.T.mm(inputs), flowing.sum(0)]
            if layer is not self._layers[0]:
                flowing = torch.ops.aten.tanh_backward(flowing.mm(layer.weight), inputs)
        return gradients

    @torch.no_grad()
    def output_change(self, tangents: Sequence[Tensor]) -> Tensor:
        """Return J v of (B, outputs): the output's change when parameters, in that order, move along v (tangents)."""
        change = linear(self._layer_inputs[0], tangents[0], tangents[1])
        for i, layer in enumerate(self._layers[1:], start=1):
            # The derivative of tanh is the same in both modes.
            change = torch.ops.aten.tanh_backward(change, self._layer_inputs[i])
            change = linear(self._layer_inputs[i], tangents[2 * i], tangents[2 * i + 1]).addmm_(change, layer.weight.T)
        return change


class PolicyNetwork(nn.Module):
    """Gaussian policy with a mean network and a log standard deviation that does not depend on the observation."""

    input_mean: Tensor
    input_scale: Tensor
    input_limit: Tensor

    def __init__(self, observation_dim: int, action_dim: int, hidden: tuple[int, ...], rng: torch.Generator) -> None:
        super().__init__()
        self.net = MLP(observation_dim, hidden, action_dim, rng)
        self.log_std = nn.Parameter(torch.zeros(action_dim))
        self.register_buffer("input_mean", torch.zeros(observation_dim))
        self.register_buffer("input_scale", torch.ones(observation_dim))
        self.register_buffer("input_limit", torch.tensor(torch.inf))

    def standardize_by(self, mean: NDArray[np.float32], scale: NDArray[np.float32]) -> None:
        """Subtract a (S,) mean from observations, multiply them by a (S,) scale, and clip them."""
        self.input_mean.copy_(torch.from_numpy(mean))
        self.input_scale.copy_(torch.from_numpy(scale))
        self.input_limit.fill_(LARGEST_INPUT)

    def normalize(self, observations: Tensor) -> Tensor:
        """Return (B, S) observations as the network sees them."""
        inputs = (observations - self.input_mean) * self.input_scale
        return inputs.clamp_(-self.input_limit, self.input_limit)

    def forward(self, observations: Tensor) -> Tensor:
        """Return (B, A) mean actions."""
        return self.net(self.normalize(observations))

    def log_prob(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return (B,) log-densities of ``actions`` (B, A) under the Gaussian with this ``mean`` (B, A)."""
        standardized = (actions - mean) * torch.exp(-self.log_std)
        constant = 0.5 * float(np.log(2 * np.pi)) * actions.shape[-1]
        return -0.5 * standardized.square().sum(-1) - self.log_std.sum() - constant

    def entropy(self) -> Tensor:
        """Return the entropy of the Gaussian in nats, which does not depend on the observation."""
        return self.log_std.sum() + 0.5 * (1 + float(np.log(2 * np.pi))) * len(self.log_std)

    @torch.no_grad()
    def load_mean(self, policy: GaussianPolicy) -> None:
        """Take over everything of an exported policy but its noise. The networks must have the same widths."""
        for layer, weight, bias in zip(self.net.layers, policy.weights, policy.biases, strict=True):
            layer.weight.copy_(torch.from_numpy(weight.T))
            layer.bias.copy_(torch.from_numpy(bias))
        self.input_mean.copy_(torch.from_numpy(policy.input_mean))
        self.input_scale.copy_(torch.from_numpy(policy.input_scale))
        self.input_limit.fill_(policy.input_limit)

    def export(self) -> GaussianPolicy:
        """Return a copy for rollout workers."""
        layers = self.net.layers
        return GaussianPolicy(
            # ascontiguousarray would not copy a single column, which would then change while it is being sent.
            weights=tuple(np.array(layer.weight.detach().numpy().T, order="C") for layer in layers),
            biases=tuple(layer.bias.detach().numpy().copy() for layer in layers),
            log_std=self.log_std.detach().numpy().copy(),
            input_mean=self.input_mean.numpy().copy(),
            input_scale=self.input_scale.numpy().copy(),
            input_limit=float(self.input_limit),
        )
