"""From logits to scores to weights, by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from oodil.pipeline.algorithms.discriminator import Discriminator, mean_logit_per_demonstration
from oodil.pipeline.algorithms.weights import (
    sampling_mass,
    share_lasted,
    sharpened_weights,
    transferability_of_logits,
)
from oodil.pipeline.config import DiscriminatorConfig


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


def test_transferability_is_half_where_nothing_can_be_told_and_falls_with_the_logit():
    np.testing.assert_allclose(transferability_of_logits(np.array([0.0, np.log(3.0), -np.log(3.0)])), [0.5, 0.25, 0.75])


def test_a_failure_counts_for_the_part_of_the_horizon_that_it_lasted(demonstrations):
    """Of 20 steps: 5 and then a fall, 5 of a recording that goes no further, all 20 and then a fall, and beyond."""
    made = replace(demonstrations(6, 6, 21, 31), terminated=np.array([True, False, True, True]))
    np.testing.assert_allclose(share_lasted(made, 20), [0.25, 1, 1, 1])


def test_weights_are_powers_of_the_scores():
    scores = np.array([0.4, 0.2, 0.0])
    np.testing.assert_allclose(sharpened_weights(scores, 1.0), [2 / 3, 1 / 3, 0])
    np.testing.assert_allclose(sharpened_weights(scores, 2.0), [0.8, 0.2, 0])
    np.testing.assert_allclose(sharpened_weights(np.zeros(4), 2.0), [0.25] * 4)
    np.testing.assert_allclose(sharpened_weights(np.array([1e-300, 2e-300]), 2.0), [0.2, 0.8])


def test_mass_is_weight_times_transitions(demonstrations):
    """Two demonstrations with 3 and 1 transitions and weights 1 and 3 weigh the same."""
    np.testing.assert_allclose(sampling_mass(np.array([1.0, 3.0]), demonstrations(4, 2)), [0.5, 0.5])
    assert sampling_mass(np.array([1.0, 1.0]), demonstrations(4, 2)) == pytest.approx([0.75, 0.25])
