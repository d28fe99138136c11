"""The policy optimizers by the ``kind`` that a configuration names, and what all of them can do.

A new one is a class with these methods, a configuration with its own ``kind``, and a line in `POLICY_OPTIMIZERS`.

Letters: B batch, S observation, A action.
"""

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from oodil.pipeline.algorithms.networks import PolicyNetwork
from oodil.pipeline.algorithms.ppo import Ppo
from oodil.pipeline.algorithms.trpo import Trpo
from oodil.pipeline.config import PpoConfig, TrpoConfig


class PolicyOptimizer(Protocol):
    """Improves a policy on one batch at a time."""

    def update(
        self,
        observations: Tensor,
        actions: Tensor,
        log_probs: Tensor,
        advantages: Tensor,
        rng: torch.Generator,
        step_scale: float,
    ) -> dict[str, float]:
        """Improve the policy on one batch.

        Args:
            observations, actions: (B, S) and (B, A).
            log_probs: (B,) under the policy that acted; it may be one version behind.
            advantages: (B,) standardized.
            rng: for everything that is drawn.
            step_scale: factor on the size of the step.
        Returns metrics, among them kl and entropy.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything that later updates depend on, besides the policy."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""


POLICY_OPTIMIZERS: dict[str, Callable[[PolicyNetwork, Any], PolicyOptimizer]] = {"trpo": Trpo, "ppo": Ppo}


def policy_optimizer(policy: PolicyNetwork, config: TrpoConfig | PpoConfig) -> PolicyOptimizer:
    """Return the optimizer of the configured kind for a policy."""
    return POLICY_OPTIMIZERS[config.kind](policy, config)
