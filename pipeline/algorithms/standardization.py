"""Inputs of order one: every dimension less its mean and divided by its own deviation.

Letters: M rows, D dimensions.
"""

import numpy as np
from numpy.typing import NDArray


def standardization(
    rows: NDArray[np.floating], weights: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the (D,) mean of (M, D) rows and the reciprocal of their deviation, 1 where a dimension is constant.

    Rows count as much as their (M,) ``weights`` say.
    """
    wide = rows.astype(np.float64)
    mean = np.average(wide, axis=0, weights=weights)
    deviation = np.sqrt(np.average(np.square(wide - mean), axis=0, weights=weights))
    return mean_and_scale(mean, deviation)


def mean_and_scale(
    mean: NDArray[np.float64], deviation: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what `standardization` does for a known (D,) mean and deviation."""
    constant = deviation <= 1e-6 * np.maximum(1.0, np.abs(mean))
    return mean.astype(np.float32), np.where(constant, 1.0, 1 / np.where(constant, 1.0, deviation)).astype(np.float32)
