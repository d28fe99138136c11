"""The discriminator of GAIL on state pairs (s, s'), the paper's Eqn (5) and (8).

One convention everywhere: logits are high for demonstrations, ``D = sigmoid(logit)`` is the probability that a pair
comes from a demonstration, label 1 is the demonstration and 0 the policy. The paper writes the opposite class as 1.

Letters: N demonstrations, B batch, M demonstration pairs, S observation.
"""

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import softplus

from oodil.pipeline.algorithms.networks import MLP
from oodil.pipeline.algorithms.optimizer import Adam
from oodil.pipeline.config import DiscriminatorConfig
from oodil.pipeline.data import Demonstrations, offsets_of


def discriminator_losses(demonstration_logits: Tensor, policy_logits: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two terms of the loss, -E_demo log D and -E_policy log(1 - D), for (M,) and (B,) logits."""
    return softplus(-demonstration_logits).mean(), softplus(policy_logits).mean()


def imitation_reward(logits_expert_is_high: Tensor, kind: Literal["positive", "logit"]) -> Tensor:
    """Return (B,) rewards, large where a pair looks like a demonstration.

    ``positive`` is -log(1 - D), the reward of GAIL, which also rewards survival; see docs/algorithms.md. ``logit`` is
    log D - log(1 - D), the logit itself, the reward of AIRL (Fu et al. 2018, https://arxiv.org/abs/1710.11248).
    """
    return softplus(logits_expert_is_high) if kind == "positive" else logits_expert_is_high


class Discriminator(nn.Module):
    """A network on pairs (s, s') and its optimizer."""

    def __init__(self, observation_dim: int, config: DiscriminatorConfig, rng: torch.Generator) -> None:
        super().__init__()
        self.config = config
        self._seen = np.setdiff1d(np.arange(observation_dim), config.ignored)
        self.net = MLP(2 * len(self._seen), config.hidden, 1, rng)
        self.restart_optimizer()

    def restart_optimizer(self) -> None:
        """Reset the optimizer's moments and learning rate."""
        self.optimizer = Adam(list(self.parameters()), self.config.learning_rate)

    def forward(self, pairs: Tensor) -> Tensor:
        """Return (B,) logits of `pairs`; high for demonstrations."""
        return self.net(pairs).squeeze(-1)

    def pairs(self, states: NDArray[np.float32], successors: NDArray[np.float32]) -> Tensor:
        """Return (B, 2S) inputs from (B, S) states and their successors, without the ignored dimensions."""
        if self.config.ignored:
            states, successors = states[:, self._seen], successors[:, self._seen]
        return torch.from_numpy(np.concatenate((states, successors), axis=1))

    def update(self, demonstration_pairs: Tensor, policy_pairs: Tensor) -> dict[str, float]:
        """Take one full-batch step on (M, 2S) demonstration pairs against (B, 2S) policy pairs.

        Returns metrics of the discriminator as it was before: its loss, and loss and accuracy on either side.
        """
        count = len(demonstration_pairs)
        logits = self(torch.cat((demonstration_pairs, policy_pairs)))
        demonstration_loss, policy_loss = discriminator_losses(logits[:count], logits[count:])
        loss = demonstration_loss + policy_loss
        self.optimizer.step(loss)
        return {
            "discriminator_loss": float(loss.detach()),
            "discriminator_demonstration_loss": float(demonstration_loss.detach()),
            "discriminator_policy_loss": float(policy_loss.detach()),
            "demonstration_accuracy": float((logits[:count] > 0).float().mean()),
            "policy_accuracy": float((logits[count:] < 0).float().mean()),
        }


@torch.no_grad()
def mean_logit_per_demonstration(discriminator: Discriminator, demonstrations: Demonstrations) -> NDArray[np.float64]:
    """Return (N,) logits averaged over each demonstration, for Eqn (6)."""
    starts = demonstrations.transition_starts()
    states = demonstrations.observations
    logits = discriminator(discriminator.pairs(states[starts], states[starts + 1])).double().numpy()
    counts = demonstrations.lengths - 1
    return np.asarray(np.add.reduceat(logits, offsets_of(counts)[:-1]) / counts)
