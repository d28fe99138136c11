"""Proximal policy optimization with the clipped surrogate (Schulman et al. 2017), https://arxiv.org/abs/1707.06347.

Letters: B batch, S observation, A action.
"""

import torch
from torch import Tensor

from oodil.pipeline.algorithms.networks import PolicyNetwork
from oodil.pipeline.algorithms.optimizer import Adam
from oodil.pipeline.config import PpoConfig


def clipped_surrogate(log_probs: Tensor, old_log_probs: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """Return the mean of min(r A, clip(r, 1 - clip, 1 + clip) A) with r = exp(log_probs - old_log_probs); all (B,)."""
    ratio = torch.exp(log_probs - old_log_probs)
    return torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()


class Ppo:
    """Several epochs of minibatch gradient steps per batch; Adam's moments are its only state."""

    def __init__(self, policy: PolicyNetwork, config: PpoConfig) -> None:
        self.policy = policy
        self.config = config
        self._optimizer = Adam(list(policy.parameters()), config.learning_rate)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the optimizer's moments."""
        return self._optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""
        self._optimizer.load_state_dict(state)

    def update(
        self,
        observations: Tensor,
        actions: Tensor,
        log_probs: Tensor,
        advantages: Tensor,
        rng: torch.Generator,
        step_scale: float,
    ) -> dict[str, float]:
        """Improve the policy on one batch, see `PolicyOptimizer`; minibatches are drawn with ``rng``.

        Returns metrics: kl (estimated in the last minibatch, before its step), entropy.
        """
        config, policy = self.config, self.policy
        self._optimizer.learning_rate = config.learning_rate * step_scale
        inputs = policy.normalize(observations)
        kl = 0.0
        for _ in range(config.epochs):
            for chosen in torch.randperm(len(observations), generator=rng).split(config.minibatch_size):
                new = policy.log_prob(policy.net(inputs[chosen]), actions[chosen])
                old = log_probs[chosen]
                loss = -clipped_surrogate(new, old, advantages[chosen], config.clip)
                if config.entropy_bonus:
                    loss = loss - config.entropy_bonus * policy.entropy()
                self._optimizer.step(loss, config.max_grad_norm)
                kl = float((old - new.detach()).mean())
        return {"kl": kl, "entropy": float(policy.entropy().detach())}
