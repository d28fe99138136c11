"""How many clusters the embedding itself suggests, and where the run's clusters differ; sources play no part.

One silhouette judges all groups at once, so that a cluster whose modes lie much closer together than clusters do counts
as one. Silhouettes within each cluster would not do better: contrastive features fall apart in every cluster.

Letters: N demonstrations, E embedding, K clusters, G groups that the embedding suggests.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.results import Assignment

MOST_CLUSTERS = 10
LEAST_SILHOUETTE = 0.25
"""With less at every K from 2, one cluster is suggested: there is no structure to speak of (Kaufman and Rousseeuw)."""
MOST_DEMONSTRATIONS = 2000
"""Of more, some are drawn: a silhouette compares all pairs."""


@dataclass(frozen=True)
class Suggestion:
    """The number of clusters with the best silhouette by k-means, and what differs from it."""

    num_clusters: int
    silhouette: float | None
    """By cosine; None for one cluster."""
    merged: tuple[int, ...]
    """Clusters that are the home of several groups: they hold more of each than any other cluster does."""
    split: tuple[tuple[int, ...], ...]
    """Clusters that have most of their members in the same group."""

    @property
    def text(self) -> str:
        """Say it."""
        known = "" if self.silhouette is None else f", silhouette {self.silhouette:.3f}"
        told = [f"K suggested by the embedding: {self.num_clusters} (k-means{known})."]
        told += [f"Cluster {k} seems to hold more than one mode." for k in self.merged]
        told += [f"Clusters {' and '.join(map(str, parts))} seem to split one mode." for parts in self.split]
        return " ".join(told)


def suggest(assignment: Assignment) -> Suggestion | None:
    """Return what the embedding of a run suggests; None for features that tell too few demonstrations apart."""
    features, labels = assignment.features.astype(np.float64), assignment.labels
    if len(features) > MOST_DEMONSTRATIONS:
        drawn = np.random.default_rng(0).choice(len(features), MOST_DEMONSTRATIONS, replace=False)
        features, labels = features[drawn], labels[drawn]
    different = len(np.unique(features, axis=0)) if features.size and np.isfinite(features).all() else 0
    if different < 3:
        return None
    groups, best = _groups(features, min(MOST_CLUSTERS, different - 1))
    if best < LEAST_SILHOUETTE:
        return Suggestion(1, None, (), ())
    counts = np.zeros((groups.max() + 1, labels.max() + 1), int)
    np.add.at(counts, (groups, labels), 1)
    used = np.flatnonzero(counts.sum(axis=0))
    homes, parts = counts.argmax(axis=1), counts[:, used].argmax(axis=0)
    shared = [tuple(used[parts == g].tolist()) for g in range(len(counts))]
    return Suggestion(
        num_clusters=len(counts),
        silhouette=best,
        merged=tuple(np.flatnonzero(np.bincount(homes) > 1).tolist()),
        split=tuple(each for each in shared if len(each) > 1),
    )


def _groups(features: NDArray[np.float64], most: int) -> tuple[NDArray[np.int32], float]:
    """Return (N,) groups by k-means with the best silhouette by cosine, and that silhouette."""
    from sklearn.cluster import KMeans
    from sklearn.metrics import silhouette_score
    from threadpoolctl import threadpool_limits

    found: list[tuple[float, NDArray[np.int32]]] = []
    with threadpool_limits(1):  # equal bits on every machine
        for k in range(2, most + 1):
            groups = KMeans(k, n_init=10, random_state=0).fit_predict(features)
            found.append((float(silhouette_score(features, groups, metric="cosine")), groups))
    best, groups = max(found, key=lambda each: each[0])
    return groups, best
