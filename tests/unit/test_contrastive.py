"""Sub-trajectories stay inside their demonstration, and the contrastive loss is NT-Xent."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from oodil.pipeline.algorithms.contrastive import Encoder, Sampling, Subtrajectories, contrastive_loss
from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.config import ClusteringConfig
from oodil.pipeline.data import Demonstrations


def counting(lengths: list[int]) -> Demonstrations:
    """State t of demonstration n is (n, t), so that a sub-trajectory shows where it was taken."""
    states = [np.stack((np.full(t, n), np.arange(t)), axis=1).astype(np.float32) for n, t in enumerate(lengths)]
    return Demonstrations(
        observations=np.concatenate(states),
        offsets=np.cumsum([0, *lengths]).astype(np.int64),
        sources=np.zeros(len(lengths), np.int32),
        source_labels=("only",),
        returns=np.zeros(len(lengths)),
        terminated=np.zeros(len(lengths), np.bool_),
    )


def as_they_are(demonstrations: Demonstrations, sampling: Sampling) -> Subtrajectories:
    return Subtrajectories(demonstrations, sampling, np.zeros(2, np.float32), np.ones(2, np.float32))


@given(
    lengths=st.lists(st.integers(2, 300), min_size=1, max_size=12),
    size=st.integers(2, 40),
    mode=st.sampled_from(["fixed_length", "fixed_stride"]),
    seed=st.integers(0, 2**32),
)
def test_a_subtrajectory_is_equally_spaced_inside_its_own_demonstration(lengths, size, mode, seed):
    sampling = Sampling.plan(np.array(lengths), ClusteringConfig(subtrajectory_length=size, sampling=mode))
    chosen = np.arange(len(lengths))
    drawn = as_they_are(counting(lengths), sampling).draw(chosen, np.random.default_rng(seed)).numpy()

    assert drawn.shape == (sampling.length, len(lengths), 2)
    shortened = 0
    for n, length in enumerate(lengths):
        assert (drawn[:, n, 0] == n).all()
        times = drawn[:, n, 1]
        steps = np.diff(times)
        assert times[0] >= 0 and times[-1] <= length - 1
        if length >= 1 + sampling.stride * (sampling.length - 1):
            assert (steps == sampling.stride).all()
        else:
            shortened += 1
            if length >= sampling.length:
                assert (steps == steps[0]).all() and 1 <= steps[0] < sampling.stride
            else:  # every state once, then the last one repeated
                np.testing.assert_array_equal(times, np.minimum(np.arange(sampling.length), length - 1))
    assert sampling.num_shortened(np.array(lengths)) == shortened


@pytest.mark.parametrize(
    ("mode", "shortest", "size", "expected"),
    [
        ("fixed_length", 1000, 20, Sampling(length=20, stride=50)),
        ("fixed_length", 1999, 20, Sampling(length=20, stride=99)),
        ("fixed_length", 7, 20, Sampling(length=20, stride=1)),
        ("fixed_stride", 1000, 20, Sampling(length=50, stride=20)),
        ("fixed_stride", 80, 15, Sampling(length=5, stride=15)),
        ("fixed_stride", 2000, 15, Sampling(length=50, stride=15)),
        ("fixed_stride", 10, 15, Sampling(length=2, stride=15)),
    ],
)
def test_both_readings_of_the_length_are_planned_by_the_shortest_demonstration(mode, shortest, size, expected):
    config = ClusteringConfig(subtrajectory_length=size, sampling=mode)
    assert Sampling.plan(np.array([shortest, shortest + 500]), config) == expected


def test_every_phase_is_drawn_the_last_one_included():
    # 10 states, 3 of them 4 apart: first states 0 and 1 fit.
    subtrajectories = as_they_are(counting([10]), Sampling(length=3, stride=4))
    drawn = subtrajectories.draw(np.zeros(200, np.int64), np.random.default_rng(0)).numpy()
    assert set(drawn[0, :, 1]) == {0.0, 1.0}
    assert set(drawn[-1, :, 1]) == {8.0, 9.0}


def test_standardized_states_have_mean_0_and_deviation_1_and_constants_become_0():
    rng = np.random.default_rng(0)
    states = np.stack((1000 + 3 * rng.standard_normal(5000), np.full(5000, 7.3)), axis=1).astype(np.float32)
    mean, scale = standardization(states)
    standardized = (states - mean) * scale
    np.testing.assert_allclose(standardized.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(standardized.std(axis=0), [1, 0], atol=1e-4)


def unit_features(pairs: int, width: int = 16) -> torch.Tensor:
    features = torch.randn(2 * pairs, width, generator=torch.Generator().manual_seed(pairs))
    return torch.nn.functional.normalize(features, dim=1)


@pytest.mark.parametrize("temperature", [1.0, 0.1])
def test_the_loss_agrees_with_pytorch_metric_learning(temperature):
    losses = pytest.importorskip("pytorch_metric_learning.losses")
    features = unit_features(pairs=9)
    labels = torch.arange(9).repeat(2)
    expected = losses.NTXentLoss(temperature=temperature)(features, labels)
    assert float(contrastive_loss(features, temperature)) == pytest.approx(float(expected), abs=1e-5)


def test_the_loss_of_two_pairs_by_hand():
    # Pair a has both views at (1, 0), pair b both at (0, 1): each anchor has its partner at cosine 1 and the two
    # others at cosine 0, so each term is -log(e / (e + 1 + 1)).
    features = torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    assert float(contrastive_loss(features, 1.0)) == pytest.approx(math.log(math.e + 2) - 1, abs=1e-6)
    # Rows 0 and 2 orthogonal, as are 1 and 3; rows 0, 1 and rows 2, 3 equal: partner at 0, one other at 1, one at 0.
    features = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    assert float(contrastive_loss(features, 1.0)) == pytest.approx(math.log(math.e + 2), abs=1e-6)


def test_the_loss_survives_a_tiny_temperature():
    features = unit_features(pairs=4).requires_grad_()
    contrastive_loss(features, 1e-3).backward()
    assert torch.isfinite(features.grad).all()


def test_features_are_unit_vectors_that_depend_on_order_and_seed():
    def encoder(seed: int) -> Encoder:
        return Encoder(3, 8, torch.Generator().manual_seed(seed))

    states = torch.randn(20, 5, 3, generator=torch.Generator().manual_seed(0))
    features = encoder(0)(states)
    assert features.shape == (5, 8)
    torch.testing.assert_close(features.norm(dim=1), torch.ones(5))
    torch.testing.assert_close(encoder(0)(states), features, rtol=0, atol=0)
    assert not torch.allclose(encoder(1)(states), features, atol=1e-2)
    assert not torch.allclose(encoder(0)(states.flip(0)), features, atol=1e-2)
