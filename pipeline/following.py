"""How far a simulator stays behind demonstrations that it follows by the actions of a learned inverse model.

Letters: N demonstrations, G simulators, S observation, A action.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import Simulators

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.inverse_dynamics import InverseModel

Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]
"""The (A,) lowest and highest action."""


class ModelFollower:
    """Simulators that follow demonstrations by the actions of an inverse model."""

    def __init__(self, simulators: Simulators, bounds: Bounds, model: "InverseModel") -> None:
        """Take over simulators, in which any number of demonstrations takes turns."""
        self._simulators, self._bounds, self._model = simulators, bounds, model

    def errors(self, demonstrations: Demonstrations) -> NDArray[np.float64]:
        """Return (N,) summed distances to the states of each demonstration, divided by their number.

        A simulator begins at the first state, and goes on from where it really gets.
        """
        size, lengths = self._simulators.num_simulators, demonstrations.lengths
        found = np.zeros(len(demonstrations))
        for first in range(0, len(demonstrations), size):
            rows = np.minimum(np.arange(first, first + size), len(demonstrations) - 1)  # The last one fills the turn.
            for g, n in enumerate(rows.tolist()):
                self._simulators.place(g, demonstrations[n][0])
            here, missed = self._simulators.observations(), np.zeros(size)
            for t in range(1, lengths[rows].max()):
                # Where a demonstration is over, its last state is wanted, and nothing is counted.
                at = demonstrations.offsets[rows] + np.minimum(t, lengths[rows] - 1)
                wanted = demonstrations.observations[at].astype(np.float64)
                self._simulators.step(np.clip(self._model.act(here, wanted), *self._bounds))
                here = self._simulators.observations()
                missed += np.where(t < lengths[rows], np.linalg.norm(here - wanted, axis=1), 0.0)
            found[rows] = missed / lengths[rows]
        return found
