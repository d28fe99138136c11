"""Trust region policy optimization (Schulman et al. 2015), https://arxiv.org/abs/1502.05477.

The direction x solves F x = g by conjugate gradients. A product with the Fisher matrix F = J^T M J takes a forward-mode
and a reverse-mode pass through the mean network (`Linearization`), and no second derivatives. A line search then halves
the step until the surrogate improves inside the trust region. Unlike the official code of the paper that we imitate,
the line search checks the divergence, too.

Letters: B batch, S observation, A action, P parameters.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from oodil.pipeline.algorithms.networks import Linearization, PolicyNetwork
from oodil.pipeline.config import TrpoConfig


def conjugate_gradient(product: Callable[[Tensor], Tensor], b: Tensor, iterations: int, tolerance: float) -> Tensor:
    """Solve ``product(x) = b`` approximately for a positive definite product; vectors are (P,)."""
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    squared = residual @ residual
    for _ in range(iterations):
        if squared <= tolerance:
            break
        image = product(direction)
        step = squared / (direction @ image)
        x += step * direction
        residual -= step * image
        new_squared = residual @ residual
        direction = residual + (new_squared / squared) * direction
        squared = new_squared
    return x


class Trpo:
    """One natural-gradient step per batch; it has no state."""

    def __init__(self, policy: PolicyNetwork, config: TrpoConfig) -> None:
        self.policy = policy
        self.config = config
        self._parameters = list(policy.parameters())
        self._shapes = [p.shape for p in self._parameters]
        self._sizes = [p.numel() for p in self._parameters]

    def state_dict(self) -> dict[str, Tensor]:
        """Return nothing: a step depends on the policy and the batch alone."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Accept the empty state."""

    def update(
        self,
        observations: Tensor,
        actions: Tensor,
        log_probs: Tensor,
        advantages: Tensor,
        rng: torch.Generator,
        step_scale: float,
    ) -> dict[str, float]:
        """Improve the policy on one batch, see `PolicyOptimizer`.

        ``step_scale`` multiplies the trust region, and so its root the step.

        Returns metrics: kl, improvement of the surrogate, step_fraction (0 when the step was refused), entropy.
        """
        config, policy = self.config, self.policy
        max_kl = config.max_kl * step_scale
        inputs = policy.normalize(observations)
        mean = policy.net(inputs)
        surrogate = (torch.exp(policy.log_prob(mean, actions) - log_probs) * advantages).mean()
        gradient = _flatten(torch.autograd.grad(surrogate, self._parameters))
        old_mean, old_log_std = mean.detach(), policy.log_std.detach().clone()
        # The curvature may be less exact than the gradient, and products with it are the expensive part of a step. Its
        # states are drawn: rows are in the order of the simulators, and every n-th would be always of the same ones.
        chosen = torch.randperm(len(inputs), generator=rng)[: -(-len(inputs) // config.fisher_every)]
        linearization = Linearization(policy.net, inputs[chosen] if config.fisher_every > 1 else inputs)
        precision = torch.exp(-2 * old_log_std) / len(linearization.output)

        def fisher_product(vector: Tensor) -> Tensor:
            log_std_tangent, *tangents = self._unflatten(vector)
            change = linearization.output_change(tangents)
            images = [2 * log_std_tangent, *linearization.gradients(change * precision)]
            return _flatten(images) + config.damping * vector

        direction = conjugate_gradient(fisher_product, gradient, config.cg_iterations, config.cg_tolerance)
        curvature = direction @ fisher_product(direction)
        if not bool(torch.isfinite(curvature)) or float(curvature) <= 0:
            return {"kl": 0.0, "improvement": 0.0, "step_fraction": 0.0, "entropy": float(policy.entropy().detach())}
        full_step = torch.sqrt(2 * max_kl / curvature) * direction
        expected = float(gradient @ full_step)
        start = _flatten([p.detach() for p in self._parameters])
        before = float(surrogate.detach())
        fraction = 1.0
        with torch.no_grad():
            for _ in range(config.backtracks):
                self._assign(start + fraction * full_step)
                new_mean = policy.net(inputs)
                ratio = torch.exp(policy.log_prob(new_mean, actions) - log_probs)
                improvement = float((ratio * advantages).mean()) - before
                kl = float(_mean_kl(old_mean, old_log_std, new_mean, policy.log_std))
                if improvement > config.accept_ratio * fraction * expected and kl <= 1.5 * max_kl:
                    metrics = {"kl": kl, "improvement": improvement, "step_fraction": fraction}
                    return metrics | {"entropy": float(policy.entropy().detach())}
                fraction *= 0.5
            self._assign(start)
        return {"kl": 0.0, "improvement": 0.0, "step_fraction": 0.0, "entropy": float(policy.entropy().detach())}

    def _unflatten(self, vector: Tensor) -> list[Tensor]:
        """Return views of a (P,) vector in the shapes of the parameters."""
        return [part.view(shape) for part, shape in zip(vector.split(self._sizes), self._shapes, strict=True)]

    def _assign(self, vector: Tensor) -> None:
        """Set the policy's parameters to a (P,) vector."""
        for parameter, value in zip(self._parameters, self._unflatten(vector), strict=True):
            parameter.copy_(value)


def _flatten(tensors: list[Tensor] | tuple[Tensor, ...]) -> Tensor:
    """Return one (P,) vector of all elements."""
    return torch.cat([t.reshape(-1) for t in tensors])


def _mean_kl(old_mean: Tensor, old_log_std: Tensor, new_mean: Tensor, new_log_std: Tensor) -> Tensor:
    """Return KL(old || new) of diagonal Gaussians, averaged over the batch."""
    variance = torch.exp(2 * (old_log_std - new_log_std))
    shift = (new_mean - old_mean).square() * torch.exp(-2 * new_log_std)
    return (new_log_std - old_log_std + 0.5 * (variance + shift - 1)).sum(-1).mean()
