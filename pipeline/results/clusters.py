"""What clustering leaves behind.

Letters: N demonstrations, E embedding, K clusters, S observation.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, Files, encode_arrays, encode_json
from oodil.pipeline.results.networks import Arrays, fields_of

_ASSIGNMENT = "assignment.safetensors"
_DIAGNOSTICS = "diagnostics.json"
_ENCODER = "encoder.safetensors"


@dataclass(frozen=True)
class Assignment:
    """Which cluster each demonstration belongs to."""

    labels: NDArray[np.int32]
    """(N,) cluster ids."""
    features: NDArray[np.float32]
    """(N, E) unit features."""

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_ASSIGNMENT: encode_arrays({"labels": self.labels, "features": self.features})}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(**fields_of(artifact, _ASSIGNMENT, cls))

    def members(self, cluster: int) -> NDArray[np.intp]:
        """Return the demonstrations of a cluster."""
        return np.flatnonzero(self.labels == cluster)


@dataclass(frozen=True)
class ClusterDiagnostics:
    """How good the clusters are; what needs the sources of the demonstrations is for reporting only."""

    num_clusters: int
    cluster_sizes: tuple[int, ...]
    """(K,)"""
    label_stability: float
    """Share of single sub-trajectories whose own label is that of their demonstration."""
    silhouette: float | None
    """By cosine; None unless at least 2 clusters have members and one of them has more than one."""
    calinski_harabasz: float | None
    purity: float
    """Share of demonstrations that come from the most frequent source of their cluster."""
    contingency: tuple[tuple[int, ...], ...]
    """(sources, K) demonstrations of each source in each cluster."""
    shortened_subtrajectories: int
    """Demonstrations that are too short for the common stride."""

    @property
    def non_empty_clusters(self) -> int:
        """Clusters with members."""
        return sum(size > 0 for size in self.cluster_sizes)

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_DIAGNOSTICS: encode_json(vars(self))}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        values = artifact.json(_DIAGNOSTICS)
        values["cluster_sizes"] = tuple(values["cluster_sizes"])
        values["contingency"] = tuple(map(tuple, values["contingency"]))
        return cls(**values)


def cluster_model_files(arrays: Arrays) -> Files:
    """Return the file of a frozen encoder and its centers (`ClusterModel.arrays`)."""
    return {_ENCODER: encode_arrays(arrays)}


def load_cluster_model(artifact: Artifact) -> Arrays:
    """Return what `ClusterModel.from_arrays` takes."""
    return artifact.arrays(_ENCODER)
