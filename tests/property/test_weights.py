"""Whatever the weights, draws follow them and nothing else is drawn."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from oodil.pipeline.algorithms.gail import AdversarialReward
from oodil.pipeline.config import DiscriminatorConfig
from oodil.pipeline.data import Demonstrations

SETTINGS = settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])

weighted_lengths = st.lists(
    st.tuples(st.integers(2, 12), st.one_of(st.just(0.0), st.floats(1e-6, 1e6))), min_size=1, max_size=8
).filter(lambda pairs: any(weight > 0 for _, weight in pairs))


def build(pairs):
    lengths = np.array([length for length, _ in pairs])
    numbers = np.repeat(np.arange(len(lengths)), lengths)
    times = np.concatenate([np.arange(length) for length in lengths])
    states = np.stack((numbers, times), axis=1).astype(np.float32)
    demonstrations = Demonstrations(
        observations=states,
        offsets=np.cumsum([0, *lengths]).astype(np.int64),
        sources=np.zeros(len(lengths), np.int32),
        source_labels=("only",),
        returns=np.full(len(lengths), np.nan),
        terminated=np.zeros(len(lengths), np.bool_),
    )
    weights = np.array([weight for _, weight in pairs])
    return (
        AdversarialReward(demonstrations, weights, DiscriminatorConfig(hidden=(2,), view="raw"), 9, 0),
        lengths,
        weights,
    )


class Grid:
    """Stands for a random generator: evenly spaced points, so that shares are exact up to one point."""

    def random(self, count):
        return (np.arange(count) + 0.5) / count


@SETTINGS
@given(weighted_lengths)
def test_shares_are_proportional_to_weight_times_transitions(pairs):
    reward, lengths, weights = build(pairs)
    count = 2000
    drawn = reward.draw(count, Grid()).numpy()
    mass = weights * (lengths - 1)
    expected = count * mass / mass.sum()
    observed = np.bincount(drawn[:, 0].astype(int), minlength=len(pairs))
    # Each demonstration's share of the unit interval holds its number of points, give or take one at each end.
    assert (np.abs(observed - expected) <= 2).all()


@SETTINGS
@given(weighted_lengths, st.integers(0, 2**32 - 1))
def test_only_weighted_transitions_within_one_demonstration(pairs, seed):
    reward, lengths, weights = build(pairs)
    drawn = reward.draw(300, np.random.default_rng(seed)).numpy()
    numbers, times = drawn[:, 0].astype(int), drawn[:, 1]
    assert (weights[numbers] > 0).all()
    assert (drawn[:, 2] == drawn[:, 0]).all()
    assert (drawn[:, 3] == times + 1).all()
    assert (times + 1 < lengths[numbers]).all()


@SETTINGS
@given(weighted_lengths, st.floats(1e-3, 1e3))
def test_the_scale_of_the_weights_does_not_matter(pairs, scale):
    one = build(pairs)[0].draw(2000, Grid()).numpy()
    two = build([(length, weight * scale) for length, weight in pairs])[0].draw(2000, Grid()).numpy()
    # Rounding may move a point that lies on a border to the neighbor.
    assert (one != two).any(axis=1).sum() <= len(pairs) * 12
