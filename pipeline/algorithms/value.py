"""The value function and its fit. Letters: B batch, S observation."""

import torch
from torch import Tensor, nn

from oodil.pipeline.algorithms.networks import MLP, Linearization
from oodil.pipeline.algorithms.optimizer import Adam
from oodil.pipeline.config import ValueConfig


class ValueFunction(nn.Module):
    """A network that predicts discounted imitation returns, fitted by minibatch regression."""

    def __init__(self, observation_dim: int, config: ValueConfig, rng: torch.Generator) -> None:
        super().__init__()
        self.config = config
        self.net = MLP(observation_dim, config.hidden, 1, rng)
        self.optimizer = Adam(list(self.parameters()), config.learning_rate)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (B,) values of (B, S) normalized observations."""
        return self.net(inputs).squeeze(-1)

    def fit(self, inputs: Tensor, targets: Tensor, rng: torch.Generator) -> dict[str, float]:
        """Fit the values of ``inputs`` (B, S) to ``targets`` (B,), in newly drawn minibatches each epoch.

        Returns metrics: value_loss, the mean squared error in the last minibatch before its step.
        """
        errors = torch.zeros(1)
        for _ in range(self.config.epochs):
            order = torch.randperm(len(inputs), generator=rng)
            size = self.config.minibatch_size
            for some_inputs, some_targets in zip(inputs[order].split(size), targets[order].split(size), strict=True):
                # No graph: it would double the time of a batch this small, and this loop is half of an update.
                at = Linearization(self.net, some_inputs)
                errors = at.output.squeeze(-1) - some_targets
                gradient = errors * (2 / len(errors))
                self.optimizer.apply(at.gradients(gradient.unsqueeze(-1)))
        return {"value_loss": float(errors.square().mean())}
