"""Feasibility of demonstrations from how far a policy that tracks them stays from each.

Cao, Hao, Li and Sadigh, *Learning Feasibility to Imitate Demonstrators with Different Dynamics* (CoRL 2021),
https://openreview.net/forum?id=MWtinPDqfZg: the paper's baseline f-MDP. Where alpha adapts, the released code cuts a
tenth off either end of distances that it has not sorted; here they are sorted.

Letters: N demonstrations.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST_EXPONENT = 50.0
"""No feasibility is smaller than e to minus this."""


def adaptive_alpha(distances: Array) -> float:
    """Return a tenth of what separates the mean of the middle four fifths of (N,) distances from the smallest."""
    ordered, cut = np.sort(distances), len(distances) // 10
    return float(ordered[cut : len(ordered) - cut].mean() - ordered[0]) / 10


def feasibility(distances: Array, nearest: float, alpha: float) -> Array:
    """Return (N,) exp(-min((d - nearest) / alpha, 50)) of distances d, and 1 for any that is nearer than ``nearest``.

    With an ``alpha`` of 0 all that is as near as the nearest counts for 1, and everything else for next to nothing.
    """
    with np.errstate(over="ignore"):
        exponents = np.maximum(0.0, distances - nearest) / max(alpha, np.finfo(np.float64).tiny)
    return np.asarray(np.exp(-np.minimum(exponents, LARGEST_EXPONENT)))
