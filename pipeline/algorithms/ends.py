"""Where demonstrations end: what the end of an imitator's episode is worth.

Letters: N demonstrations, E ends of episodes, P known states, S observation.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.policy import LARGEST_INPUT
from oodil.pipeline.seeding import Key, numpy_rng

KNOWN_STATES = 10_000
"""Demonstrated states that an end is compared with."""
LAST_PART = 0.1
"""Of a demonstration; around its states an episode may end."""


class DemonstratedEnds:
    """The states around which weighted demonstrations end: those whose nearest demonstrated state is among the last.

    A demonstration of ``max_episode_steps`` transitions or more was cut off by the time limit and has no end.
    """

    def __init__(
        self, demonstrations: Demonstrations, weights: NDArray[np.float64], max_episode_steps: int, key: Key
    ) -> None:
        """Draw states in proportion to the (N,) weights of their demonstrations."""
        self._max_episode_steps = max_episode_steps
        steps = demonstrations.lengths - 1
        each = np.repeat(weights, demonstrations.lengths)
        self._mean, self._scale = standardization(demonstrations.observations, each)
        count = min(KNOWN_STATES, len(each))
        rows = numpy_rng(key).choice(len(each), count, p=each / each.sum())
        owners = np.searchsorted(demonstrations.offsets, rows, side="right") - 1
        left = demonstrations.offsets[owners + 1] - 1 - rows
        self._is_last = (steps < max_episode_steps)[owners] & (left <= LAST_PART * steps[owners])
        self._known = cKDTree(self._standardized(demonstrations.observations[rows]))

    def include(self, states: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return (E,) whether demonstrations end around each of (E, S) states."""
        if not len(states) or not self._is_last.any():
            return np.zeros(len(states), np.bool_)
        _, nearest = self._known.query(self._standardized(states))
        return np.asarray(self._is_last[nearest])

    def until_limit(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return episodes of which those that fail, as no demonstration ends where they do, stay there.

        One that fails has few transitions. What it does not do any more would not be seen if it did not last until
        the time limit.
        """
        demonstrated = self.include(np.stack([episode.states[-1] for episode in episodes]))
        pairs = zip(episodes, demonstrated, strict=True)
        return [self._lasting(each) if each.terminated and not ended else each for each, ended in pairs]

    def _lasting(self, episode: Episode) -> Episode:
        missing = max(0, self._max_episode_steps + 1 - len(episode.states))
        return replace(episode, states=np.pad(episode.states, ((0, missing), (0, 0)), mode="edge"))

    def _standardized(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.clip((states - self._mean) * self._scale, -LARGEST_INPUT, LARGEST_INPUT)
