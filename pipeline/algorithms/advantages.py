"""Generalized advantage estimation. Letters: T steps, G simulators."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def generalized_advantages(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    discount: float,
    gae_lambda: float,
) -> Array:
    """Return (T, G) advantages; the sum over later steps stops where an episode ends.

    The value after a terminated step is zero. A truncated step (a time limit) bootstraps from ``next_values``, and so
    does the last step of the rollout. All arrays are (T, G).
    """
    errors = rewards + discount * next_values * ~terminated - values
    decay = np.float32(discount * gae_lambda) * ~(terminated | truncated)
    advantages = np.empty_like(errors)
    running = np.zeros(rewards.shape[1], np.float32)
    for t in range(len(rewards) - 1, -1, -1):
        running = errors[t] + decay[t] * running
        advantages[t] = running
    return advantages


def standardized(advantages: Array) -> Array:
    """Return advantages with mean 0 and standard deviation 1 over the batch."""
    return np.asarray((advantages - advantages.mean()) / (advantages.std() + 1e-8))
