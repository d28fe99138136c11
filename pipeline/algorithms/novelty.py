"""Which demonstrations are unlike all that a cluster holds: frozen discriminators say nothing of them.

Letters: N demonstrations, D dimensions of a transition's view, E embedding.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from oodil.pipeline.algorithms.discriminator import Discriminator
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.seeding import numpy_rng

Array = NDArray[np.float64]

MARGIN = 1.5
"""How much farther than the farthest member a demonstration may be."""
TRANSITIONS = 100
"""Of a demonstration that are compared, evenly spread."""
MEMBERS = 100
"""Of a cluster that others are compared with."""


class Neighborhood:
    """The members of a cluster, by their transitions and by their features."""

    def __init__(self, members: Demonstrations, features: NDArray[np.float32], view: Discriminator) -> None:
        """Note how far (N, E) features and transitions of members are from those of the other members.

        Half of the members are compared with the other half, and the other way round. A single member is compared with
        itself, every second transition with those between.
        """
        self._view = view
        chosen = numpy_rng((len(members),)).permutation(len(members))[:MEMBERS]
        inputs = [self._inputs(members, int(n)) for n in chosen]
        halves = (inputs[::2], inputs[1::2]) if len(inputs) > 1 else ([inputs[0][::2]], [inputs[0][1::2]])
        farthest = 0.0
        for here, there in (halves, halves[::-1]):
            tree = cKDTree(np.concatenate(there))
            farthest = max(farthest, *(_mean_distance(tree, each) for each in here))
        self._limit = MARGIN * farthest
        self._tree = cKDTree(np.concatenate(inputs))
        self._center = features.mean(axis=0)
        self._feature_limit = MARGIN * float(self._from_center(features).max())

    def unlike(self, demonstrations: Demonstrations, features: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return (N,) whether transitions or (N, E) features are farther away than `MARGIN` times any member's."""
        far = [_mean_distance(self._tree, self._inputs(demonstrations, n)) for n in range(len(demonstrations))]
        return (np.array(far) > self._limit) | (self._from_center(features) > self._feature_limit + 1e-6)

    def _from_center(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (N,) halved squared distances of features from the middle of the members'."""
        return np.asarray(np.square(features - self._center).sum(axis=1) / 2)

    def _inputs(self, demonstrations: Demonstrations, n: int) -> NDArray[np.float32]:
        states = demonstrations[n]
        rows = np.unique(np.linspace(0, len(states) - 2, min(TRANSITIONS, len(states) - 1)).astype(int))
        return np.asarray(self._view.inputs(states[rows], states[rows + 1]).numpy())


def _mean_distance(tree: cKDTree, points: NDArray[np.float32]) -> float:
    return float(tree.query(points)[0].mean())
