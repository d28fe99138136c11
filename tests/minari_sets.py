"""Minari data sets for tests."""

import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer


def save_minari(name: str, episodes: list[EpisodeBuffer]) -> None:
    """Save episodes of a Hopper as a local data set."""
    minari.create_dataset_from_buffers(
        name,
        episodes,
        env="Hopper-v5",
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (12,), np.float32),
        action_space=gymnasium.spaces.Box(-1, 1, (3,), np.float32),
        algorithm_name="test",
        author="test",
        author_email="test@example.org",
        code_permalink="https://example.org",
        description="test",
    )
