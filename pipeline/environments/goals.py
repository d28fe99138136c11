"""Which episodes ended at the goal of their task, told by their returns and lengths. Letters: E episodes."""

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.environments.registration import NAMESPACE


def reached_goal(
    env_id: str, returns: NDArray[np.float64], lengths: NDArray[np.int64], max_episode_steps: int
) -> NDArray[np.bool_] | None:
    """Return (E,) whether each episode ended at the goal; None for an environment that has none."""
    if env_id.startswith(f"{NAMESPACE}/Driving"):
        # Without the steps' own rewards, nothing is left but what the end is worth.
        return returns + lengths > 0
    if env_id.startswith(f"{NAMESPACE}/Panda"):
        # Before its time is up an episode ends at the goal or in a failure, which outweighs all that was pushed.
        return (returns > 0) & (lengths < max_episode_steps)
    return None
