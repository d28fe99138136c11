"""The sliced Wasserstein distance: against known answers and scipy."""

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from oodil.pipeline.algorithms.divergence import sliced_wasserstein


def test_in_one_dimension_it_is_scipys():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(4000, 1)), rng.normal(0.7, 2.0, size=(3000, 1))
    expected = wasserstein_distance(a[:, 0], b[:, 0])
    assert sliced_wasserstein(a, b, np.random.default_rng(1)) == pytest.approx(expected, rel=0.01)


def test_a_shift_costs_its_mean_length_along_the_directions():
    points = np.random.default_rng(0).normal(size=(2000, 3))
    # The mean of |u . e| over unit vectors u of three dimensions is 1/2.
    assert sliced_wasserstein(points, points + np.array([2.0, 0, 0]), np.random.default_rng(1)) == pytest.approx(
        1.0, rel=0.15
    )


def test_it_is_zero_for_the_same_points_in_another_order_and_symmetric():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(500, 4)), rng.normal(size=(300, 4)) * 2
    assert sliced_wasserstein(a, a[::-1], np.random.default_rng(1)) == pytest.approx(0, abs=1e-12)
    there, back = (sliced_wasserstein(*pair, np.random.default_rng(1)) for pair in ((a, b), (b, a)))
    assert there == pytest.approx(back)
