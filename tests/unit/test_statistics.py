"""Statistics over seeds, held against scipy."""

import numpy as np
import pytest
from scipy import stats

from oodil.pipeline.statistics import (
    Statistics,
    interquartile_mean,
    interval,
    normalized,
    probability_of_improvement,
)


@pytest.mark.parametrize("shape", [(3,), (5,), (8,), (4, 5)])
def test_interquartile_mean_is_scipys_trimmed_mean(shape):
    values = np.random.default_rng(len(shape)).normal(size=shape)
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25, axis=None))


def test_probability_of_improvement_is_the_mann_whitney_statistic():
    ours, theirs = np.array([1.0, 2.0, 2.0, 5.0]), np.array([0.0, 2.0, 3.0])
    expected = stats.mannwhitneyu(ours, theirs).statistic / (len(ours) * len(theirs))
    assert probability_of_improvement(ours, theirs) == pytest.approx(expected)
    assert probability_of_improvement(ours, ours) == 0.5


def test_interval_of_one_task_is_scipys_percentile_bootstrap():
    values = np.random.default_rng(1).normal(size=10)
    expected = stats.bootstrap(
        (values,),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        n_resamples=20_000,
        method="percentile",
        random_state=0,
    ).confidence_interval
    assert interval(values[None]) == pytest.approx((expected.low, expected.high), abs=0.1)


def test_interval_resamples_within_tasks():
    """Seeds that agree in every task leave nothing to resample, however far the tasks lie apart."""
    values = np.repeat([[0.0], [10.0], [20.0], [100.0]], 6, axis=1)
    assert interval(values) == (15.0, 15.0)


def test_few_seeds_have_no_interval():
    three = Statistics.of(np.array([1.0, 2.0, 6.0]))
    assert three.interval is None
    assert (three.values, three.mean, three.deviation) == ((1.0, 2.0, 6.0), 3.0, pytest.approx(np.sqrt(7)))
    five = Statistics.of(np.arange(5.0))
    assert five.interval is not None
    assert five.interval[0] <= five.interquartile_mean == 2.0 <= five.interval[1]
    assert np.isnan(Statistics.of(np.array([4.0])).deviation)


def test_normalized_returns():
    np.testing.assert_allclose(normalized(np.array([10.0, 110.0, 60.0]), random=10.0, expert=110.0), [0.0, 1.0, 0.5])
    with pytest.raises(ValueError, match="expert's return 5 is not above the random policy's 5"):
        normalized(np.ones(2), 5.0, 5.0)
