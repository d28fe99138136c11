"""The discriminator of GAIL on state pairs (s, s'), the paper's Eqn (5) and (8).

One convention everywhere: logits are high for demonstrations, ``D = sigmoid(logit)`` is the probability that a pair
comes from a demonstration, label 1 is the demonstration and 0 the policy. The paper writes the opposite class as 1.

Letters: N demonstrations, B batch, M demonstration pairs, S observation.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import softplus

from oodil.pipeline.algorithms.networks import MLP
from oodil.pipeline.algorithms.optimizer import Adam
from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.config import DiscriminatorConfig
from oodil.pipeline.data import Demonstrations, offsets_of
from oodil.pipeline.policy import LARGEST_INPUT

Array = NDArray[np.float64]


def discriminator_losses(demonstration_logits: Tensor, policy_logits: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two terms of the loss, -E_demo log D and -E_policy log(1 - D), for (M,) and (B,) logits."""
    return softplus(-demonstration_logits).mean(), softplus(policy_logits).mean()


def imitation_reward(logits_expert_is_high: Tensor) -> Tensor:
    """Return (B,) rewards -log(1 - D), large where a pair looks like a demonstration.

    They are positive, and so pay for going on; what an end is worth is the learner's affair (`RewardModel`).
    """
    return softplus(logits_expert_is_high)


class Discriminator(nn.Module):
    """A network on the view of pairs (s, s') and its optimizer."""

    input_mean: Tensor
    input_scale: Tensor

    def __init__(self, demonstrations: Demonstrations, weights: Array, config: DiscriminatorConfig, seed: int) -> None:
        """Draw a network for demonstrations that count as much as their (N,) weights say."""
        super().__init__()
        self.config = config
        dim = 2 * demonstrations.observation_dim
        self.net = MLP(dim, config.hidden, 1, torch.Generator().manual_seed(seed))
        mean, scale = np.zeros(dim, np.float32), np.ones(dim, np.float32)
        if config.view == "change":
            starts = demonstrations.transition_starts()
            states, successors = demonstrations.observations[starts], demonstrations.observations[starts + 1]
            each = np.repeat(weights, demonstrations.lengths - 1)
            mean, scale = standardization(np.concatenate((states, successors - states), axis=1), each)
        self.register_buffer("input_mean", torch.from_numpy(mean))
        self.register_buffer("input_scale", torch.from_numpy(scale))
        self.optimizer = Adam(list(self.parameters()), config.learning_rate)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (B,) logits of inputs from `inputs`; high for demonstrations."""
        return self.net(inputs).squeeze(-1)

    def inputs(self, states: NDArray[np.float32], successors: NDArray[np.float32]) -> Tensor:
        """Return (B, 2S) inputs for (B, S) states and their successors.

        The ``change`` view is (s, s' - s), each dimension standardized over the demonstrations: beside s, the change
        within one step is too small to be seen in s', and the dynamics are in nothing else.
        """
        if self.config.view == "raw":
            return torch.from_numpy(np.concatenate((states, successors), axis=1))
        pairs = np.concatenate((states, successors - states), axis=1)
        pairs -= self.input_mean.numpy()
        pairs *= self.input_scale.numpy()
        return torch.from_numpy(np.clip(pairs, -LARGEST_INPUT, LARGEST_INPUT, out=pairs))

    def update(self, demonstration_inputs: Tensor, policy_inputs: Tensor) -> dict[str, float]:
        """Take one step on (M, 2S) inputs of demonstrations against (B, 2S) of the policy.

        The squared gradient of the logit at demonstrations is penalized (R1, Mescheder et al. 2018,
        https://arxiv.org/abs/1801.04406): the discriminator cannot become so steep that it tells from each other what
        is nearly the same, and where policy and demonstrations are the same, D = 1/2 costs nothing.

        Returns metrics of the discriminator as it was before: its loss, loss and accuracy on either side, and the mean
        squared gradient.
        """
        penalty = self.config.gradient_penalty
        demonstration_inputs = demonstration_inputs.detach().requires_grad_(penalty > 0)
        demonstration_logits, policy_logits = self(demonstration_inputs), self(policy_inputs)
        demonstration_loss, policy_loss = discriminator_losses(demonstration_logits, policy_logits)
        loss = demonstration_loss + policy_loss
        squared_gradient = torch.zeros(())
        if penalty > 0:
            (gradient,) = torch.autograd.grad(demonstration_logits.sum(), demonstration_inputs, create_graph=True)
            squared_gradient = gradient.square().sum(1).mean()
            loss = loss + 0.5 * penalty * squared_gradient
        self.optimizer.step(loss)
        return {
            "discriminator_loss": float((demonstration_loss + policy_loss).detach()),
            "discriminator_demonstration_loss": float(demonstration_loss.detach()),
            "discriminator_policy_loss": float(policy_loss.detach()),
            "discriminator_squared_gradient": float(squared_gradient.detach()),
            "demonstration_accuracy": float((demonstration_logits > 0).float().mean()),
            "policy_accuracy": float((policy_logits < 0).float().mean()),
        }


@torch.no_grad()
def mean_logits(discriminator: Discriminator, inputs: Tensor, counts: NDArray[np.int64]) -> Array:
    """Return (N,) logits averaged over each of N demonstrations, of which ``counts`` (N,) of the inputs are."""
    logits = discriminator(inputs).double().numpy()
    return np.asarray(np.add.reduceat(logits, offsets_of(counts)[:-1]) / counts)


def mean_logit_per_demonstration(discriminator: Discriminator, demonstrations: Demonstrations) -> NDArray[np.float64]:
    """Return (N,) logits averaged over each demonstration, for Eqn (6)."""
    starts = demonstrations.transition_starts()
    states = demonstrations.observations
    return mean_logits(
        discriminator, discriminator.inputs(states[starts], states[starts + 1]), demonstrations.lengths - 1
    )
