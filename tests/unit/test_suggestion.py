"""The number of clusters that an embedding suggests."""

import numpy as np
import pytest
from numpy.typing import NDArray

from oodil.pipeline.results import Assignment
from oodil.pipeline.suggestion import suggest

MODES = 4


def embedding(sizes: tuple[int, ...] = (40, 40, 20, 10)) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return features around some of the axes, and around which."""
    modes = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    features = np.eye(8)[modes] + 0.05 * np.random.default_rng(0).normal(size=(len(modes), 8))
    return (features / np.linalg.norm(features, axis=1, keepdims=True)).astype(np.float32), modes


def test_clusters_that_are_the_modes_are_left_alone() -> None:
    features, modes = embedding()
    found = suggest(Assignment(modes + 2, features))
    assert found is not None
    assert (found.num_clusters, found.merged, found.split) == (MODES, (), ())
    assert found.silhouette is not None and found.silhouette > 0.9
    assert found.text == f"K suggested by the embedding: 4 (k-means, silhouette {found.silhouette:.3f})."


def test_a_cluster_of_two_modes_is_named() -> None:
    features, modes = embedding()
    found = suggest(Assignment(np.where(modes == 3, 2, modes).astype(np.int32), features))
    assert found is not None
    assert (found.num_clusters, found.merged, found.split) == (MODES, (2,), ())
    assert "Cluster 2 seems to hold more than one mode." in found.text


def test_a_mode_in_two_clusters_is_named() -> None:
    features, modes = embedding()
    half = (modes == 0) & (np.arange(len(modes)) % 2 == 0)
    found = suggest(Assignment(np.where(half, 7, modes).astype(np.int32), features))
    assert found is not None
    assert (found.num_clusters, found.merged, found.split) == (MODES, (), ((0, 7),))
    assert "Clusters 0 and 7 seem to split one mode." in found.text


def test_strays_are_no_split() -> None:
    features, modes = embedding()
    modes[0] = 1
    found = suggest(Assignment(modes, features))
    assert found is not None
    assert (found.merged, found.split) == ((), ())


def test_one_cluster_is_suggested_where_there_is_no_structure() -> None:
    features = np.random.default_rng(0).normal(size=(60, 32))
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    found = suggest(Assignment(np.zeros(60, np.int32), features.astype(np.float32)))
    assert found is not None
    assert (found.num_clusters, found.silhouette) == (1, None)
    assert found.text == "K suggested by the embedding: 1 (k-means)."


@pytest.mark.parametrize(
    "features",
    [np.zeros((6, 0)), np.ones((6, 3)), np.full((6, 3), np.nan), np.eye(2)],
    ids=["no features", "all equal", "not numbers", "two"],
)
def test_nothing_is_suggested_without_enough_features(features: NDArray[np.float64]) -> None:
    assert suggest(Assignment(np.zeros(len(features), np.int32), features.astype(np.float32))) is None


def test_of_many_demonstrations_some_are_drawn() -> None:
    features, modes = embedding((1500, 1000, 500))
    found = suggest(Assignment(modes, features))
    assert found is not None
    assert (found.num_clusters, found.merged, found.split) == (3, (), ())
