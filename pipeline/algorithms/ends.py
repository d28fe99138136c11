"""Where demonstrations end: what the end of an imitator's episode is worth.

Letters: N demonstrations, E ends of episodes, P known states, S observation.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.data import Demonstrations
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

    def _standardized(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.clip((states - self._mean) * self._scale, -LARGEST_INPUT, LARGEST_INPUT)
