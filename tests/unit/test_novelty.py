"""What is unlike the members of a cluster: walkers on a circle, and what nobody has shown."""

import numpy as np
import pytest

from oodil.pipeline.algorithms.discriminator import Discriminator
from oodil.pipeline.algorithms.novelty import Neighborhood
from oodil.pipeline.config import DiscriminatorConfig
from oodil.pipeline.data import Demonstrations, Episode


def circles(count, seed, change=lambda states: states):
    """Return demonstrations that go round a circle, each from another place, with a little noise."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, 2 * np.pi, count)[:, None] + np.arange(150) / 15
    noise = 0.003 * rng.normal(size=(count, 150, 2))
    walks = np.stack((np.cos(angles), np.sin(angles)), axis=2) + noise
    return Demonstrations.of([Episode(change(walk)) for walk in walks], "circles")


def features(count):
    return np.tile(np.array([1.0, 0.0], np.float32), (count, 1))


@pytest.fixture(scope="module", params=[1, 2, 9], ids="{} members".format)
def neighborhood(request):
    members = circles(request.param, 0)
    view = Discriminator(members, np.ones(len(members)), DiscriminatorConfig(), 0)
    return Neighborhood(members, features(len(members)), view)


@pytest.mark.parametrize(
    "change",
    [
        lambda states: states[::-1],
        lambda states: np.random.default_rng(0).permutation(states),
        lambda states: states[::3],
        lambda states: states + np.array([0.0, 1.0]),
        lambda states: states + 0.1 * np.random.default_rng(0).normal(size=states.shape),
        lambda states: np.repeat(states[:1], 100, axis=0),
    ],
    ids=["reversed", "shuffled", "every third state", "elsewhere", "noisy", "standing still"],
)
def test_what_no_member_does_is_unlike(neighborhood, change):
    assert neighborhood.unlike(circles(4, 1, change), features(4)).all()


def test_fresh_ones_of_the_same_kind_are_like_several_members():
    members = circles(9, 0)
    view = Discriminator(members, np.ones(9), DiscriminatorConfig(), 0)
    assert not Neighborhood(members, features(9), view).unlike(circles(6, 1), features(6)).any()


def test_a_feature_far_from_those_of_the_members_is_unlike():
    members = circles(9, 0)
    view = Discriminator(members, np.ones(9), DiscriminatorConfig(), 0)
    other = np.array([[1.0, 0.0], [0.0, 1.0]], np.float32)
    assert Neighborhood(members, features(9), view).unlike(circles(2, 1), other).tolist() == [False, True]


def test_features_need_not_have_length_one():
    """Members lie 1 and 3 from their middle, so the limit is 1.5 times 3 squared, by halves: 3.67 from it."""
    members = circles(4, 0)
    view = Discriminator(members, np.ones(4), DiscriminatorConfig(), 0)
    around = Neighborhood(members, np.array([[9.0, 0], [11, 0], [10, 3], [10, -3]], np.float32), view)
    new = np.array([[10.0, 3.6], [10, 3.8], [1, 0]], np.float32)
    assert around.unlike(circles(4, 0).select(np.arange(3)), new).tolist() == [False, True, True]
