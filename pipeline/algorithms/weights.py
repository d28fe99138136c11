"""From logits to transferability to weights: the paper's Eqn (6) and (7).

Letters: N demonstrations, E scores taken while a job ran and at its end.
"""

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations

Array = NDArray[np.float64]


def transferability_of_logits(mean_logits: Array) -> Array:
    """Return sigmoid(-mean logit): 0.5 where the imitator cannot be told from the demonstration, 0 where it fails.

    ``mean_logits`` is (N,) or (E, N), of logits that are high for demonstrations; the paper's D is one minus ours.
    """
    return np.exp(-np.logaddexp(0, mean_logits))


def share_lasted(demonstrations: Demonstrations, horizon: int) -> Array:
    """Return (N,) shares of ``horizon`` steps that the demonstrations lasted; 1 for those that did not fail.

    All demonstrations are scored over the whole horizon, and nothing can be reproduced after a failure: one that fell
    after a tenth of the horizon scores at most a tenth, however well that tenth can be imitated.
    """
    lasted = np.minimum(1.0, (demonstrations.lengths - 1) / horizon)
    return np.where(demonstrations.terminated, lasted, 1.0)


def sharpened_weights(scores: Array, sharpening: float) -> Array:
    """Return (N,) weights that sum to one, proportional to score ** sharpening; uniform when every score is zero."""
    largest = scores.max()
    if largest <= 0:
        return np.full(len(scores), 1 / len(scores))
    weights = (scores / largest) ** sharpening
    return np.asarray(weights / weights.sum())


def sampling_mass(weights: Array, demonstrations: Demonstrations) -> Array:
    """Return (N,) shares of the sampled transitions, proportional to weight times number of transitions (Eqn 7)."""
    mass = weights * (demonstrations.lengths - 1)
    return np.asarray(mass / mass.sum())
