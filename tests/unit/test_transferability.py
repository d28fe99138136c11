"""From readings to scores to weights, by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from oodil.pipeline.algorithms.discriminator import Discriminator, mean_logit_per_demonstration
from oodil.pipeline.algorithms.weights import (
    best_mode,
    effective_number,
    intervals,
    kept_weights,
    sampling_mass,
    share_lasted,
    transferability_of_divergences,
)
from oodil.pipeline.config import DiscriminatorConfig
from oodil.pipeline.results import Transferability


def test_mean_logit_is_over_the_transitions_of_each_demonstration(demonstrations):
    made = demonstrations(4, 2, 3)
    discriminator = Discriminator(made, np.ones(3), DiscriminatorConfig(hidden=(8,), view="raw"), seed=0)
    with torch.no_grad():
        for p in discriminator.parameters():
            p.copy_(torch.randn(p.shape, generator=torch.Generator().manual_seed(1)))
        expected = []
        for n in range(3):
            states = torch.from_numpy(made[n])
            expected.append(float(discriminator(torch.cat((states[:-1], states[1:]), dim=1)).mean()))
    np.testing.assert_allclose(mean_logit_per_demonstration(discriminator, made), expected, rtol=1e-5)


def test_transferability_is_one_where_nothing_can_be_told_and_falls_with_the_divergence():
    # D = sigmoid(divergence / 2): 0 -> 1/2, 2 log 3 -> 3/4; what looks more like the imitator than itself is no better.
    found = transferability_of_divergences(np.array([0.0, 2 * np.log(3.0), -1.0, np.inf]))
    np.testing.assert_allclose(found, [1, 0.5, 1, 0])


def test_a_failure_counts_for_the_part_of_the_horizon_that_it_lasted(demonstrations):
    """Of 20 steps: 5 and then a fall, 5 of a recording that goes no further, all 20 and then a fall, and beyond."""
    made = replace(demonstrations(6, 6, 21, 31), terminated=np.array([True, False, True, True]))
    np.testing.assert_allclose(share_lasted(made, 20), [0.25, 1, 1, 1])


def test_weights_are_the_scores_of_what_surely_reaches_the_threshold():
    scores, limits = np.array([0.6, 0.2, 0.5, np.nan]), np.array([[0.5, 0.7], [0.1, 0.3], [0.3, 0.7], [np.nan] * 2])
    np.testing.assert_allclose(kept_weights(scores, limits, 0.3), [0.6 / 1.1, 0, 0.5 / 1.1, 0])
    np.testing.assert_allclose(kept_weights(scores, limits, 0.4), [1, 0, 0, 0])
    np.testing.assert_allclose(kept_weights(scores, limits, 0.6), [0.6 / 1.1, 0, 0.5 / 1.1, 0], err_msg="all open")
    np.testing.assert_allclose(kept_weights(scores, limits, 0.9), [1 / 3, 1 / 3, 1 / 3, 0])
    np.testing.assert_array_equal(kept_weights(scores[3:], limits[3:], 0.3), [0])


@pytest.mark.parametrize("others", [0, 1, 500])
def test_what_the_best_of_a_cluster_score_does_not_depend_on_how_many_others_it_holds(others: int):
    best, worse = np.tile([[0.3, 0.2, 0.1], [0.5, 0.2, 0.3]], 10), np.tile([[0.09], [0.01]], others)
    readings = np.concatenate((best, worse), axis=1)
    clusters = np.zeros(30 + others, np.int32)
    assert best_mode(readings, clusters, 0.5) == pytest.approx((0.4 + 0.2 + 0.2) / 3)
    assert best_mode(readings, clusters, 0.0) == pytest.approx((8 + 0.05 * others) / (30 + others))


def test_outliers_are_no_mode():
    """A hundredth of 300 is three: 0.9 is alone, 0.3 and 0.2 are two, and 0.08, 0.06 and 0.05 are three."""
    scores, others = [0.05, 0.9, 0.2, 0.01, 0.06, 0.3, 0.08], [0.001] * 293
    clusters = np.repeat(np.array([0, 1], np.int32), [7, 293])
    assert best_mode(np.array([scores + others]), clusters, 0.5) == pytest.approx(0.19 / 3)
    assert best_mode(np.array([scores]), clusters[:7], 0.5) == pytest.approx(0.25), "of seven, two are a mode"


def test_a_single_demonstration_is_a_mode_where_there_is_no_other():
    readings = np.array([[0.9, 0.3, 0.1]])
    assert best_mode(readings, np.arange(3, dtype=np.int32), 0.5) == pytest.approx(0.9)
    assert best_mode(readings, np.zeros(3, np.int32), 0.5) == pytest.approx(0.9)


def test_an_interval_is_two_errors_around_the_mean_and_everything_where_that_is_not_known():
    readings = np.array([[0.5, 0.9, 0.0], [0.3, 0.9, 0.1]])
    spread = 2 * np.sqrt(0.02 / 2)
    expected = [[0.4 - spread, 0.4 + spread], [0.9, 0.9], [0, 0.05 + spread / 2]]
    seen, none = np.array([False, True, False]), np.zeros(3, np.bool_)
    np.testing.assert_allclose(intervals(readings, none), expected)
    np.testing.assert_allclose(intervals(readings, seen), [expected[0], [0, 1], expected[2]])
    np.testing.assert_allclose(intervals(readings[:1], none), [[0, 1]] * 3)


def test_verdicts_follow_from_the_interval():
    limits = np.array([[0.5, 0.7], [0.4, 0.6], [0.1, 0.49]])
    found = Transferability(limits.mean(axis=1), np.ones(3) / 3, np.zeros(3, np.int32), limits, threshold=0.5)
    assert found.verdicts.tolist() == ["kept", "open", "not kept"]


def test_the_effective_number_counts_equal_weights():
    assert effective_number(np.array([0.2, 0.2, 0.2, 0.0])) == pytest.approx(3)
    assert effective_number(np.array([1.0, 1e-9])) == pytest.approx(1)
    assert effective_number(np.zeros(2)) == 0


def test_mass_is_weight_times_transitions(demonstrations):
    """Two demonstrations with 3 and 1 transitions and weights 1 and 3 weigh the same."""
    np.testing.assert_allclose(sampling_mass(np.array([1.0, 3.0]), demonstrations(4, 2)), [0.5, 0.5])
    assert sampling_mass(np.array([1.0, 1.0]), demonstrations(4, 2)) == pytest.approx([0.75, 0.25])
    np.testing.assert_array_equal(sampling_mass(np.zeros(2), demonstrations(4, 2)), [0, 0])
