"""Stage 2: which demonstrations share a mode. One job; its artifact is the stage's.

Letters: N demonstrations, E embedding, K clusters.
"""

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.results import Assignment, ClusterDiagnostics, cluster_model_files
from oodil.pipeline.stage import Cost, JobContext, JobStoppedError, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.clustering import ClusterModel, Labeling


ITERATION_S = 0.04
"""Seconds of one core that 128 demonstrations take in an iteration; in quickstarts, final labels included."""


class ClusteringStage(Stage):
    """Clustering of whole demonstrations (`oodil.pipeline.algorithms.clustering`)."""

    name = "clustering"
    version = 3
    inputs = ("demonstrations",)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the whole section."""
        return config.clustering.model_dump(mode="json")

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of all iterations, the warm-up included."""
        section = config.clustering
        if section.features == "states" or section.num_clusters == 1:
            return Cost()
        iterations = section.warmup_iterations + section.joint_iterations
        return Cost(compute_s=iterations * ITERATION_S * section.batch_size / 128)

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train the encoder and the centers, or find those of the states, and label every demonstration.

        The artifact holds an `Assignment`, the cluster model and its `ClusterDiagnostics`.
        """
        import torch
        from threadpoolctl import threadpool_limits

        torch.set_num_threads(1)
        # scikit-learn and NumPy have threads of their own, and sums depend on how many take part.
        with threadpool_limits(1):
            demonstrations = load_demonstrations(run)
            model = self._model(demonstrations, run, job, context)
            labeling = model.label(demonstrations, run.config.clustering.label_draws, run.config.seed)
            shortened = model.sampling.num_shortened(demonstrations.lengths)
            found = diagnostics(labeling, demonstrations, len(model.centers), shortened)
        assignment = Assignment(labeling.labels, labeling.features)
        return assignment.files() | cluster_model_files(model.arrays()) | found.files()

    def _model(self, demonstrations: Demonstrations, run: Run, job: str, context: JobContext) -> "ClusterModel":
        """Return the clusters; those that are trained go on from a checkpoint."""
        from oodil.pipeline.algorithms.clustering import ContrastiveClustering, clusters_of_states

        if run.config.clustering.features == "states":
            return clusters_of_states(demonstrations, run.config.clustering, run.config.seed)
        clustering = ContrastiveClustering(demonstrations, run.config.clustering, run.config.seed)
        checkpoints = self.checkpoints(run, job)
        state, warnings = checkpoints.load()
        for warning in warnings:
            context.warn(warning)
        if state is not None:
            clustering.load_state_dict(state)
        saved_at = time.monotonic()
        while clustering.iteration < clustering.num_iterations:
            metrics = clustering.update()
            context.progress(clustering.iteration, clustering.num_iterations, **metrics)
            stop = context.should_stop()
            if stop or time.monotonic() - saved_at >= context.checkpoint_interval_s:
                checkpoints.save(clustering.iteration, clustering.state_dict())
                saved_at = time.monotonic()
            if stop:
                raise JobStoppedError
        return clustering.model()


def diagnostics(
    labeling: "Labeling", demonstrations: Demonstrations, num_clusters: int, shortened_subtrajectories: int = 0
) -> ClusterDiagnostics:
    """Return what is said about an assignment; what needs the sources is for reporting only."""
    from sklearn.metrics import calinski_harabasz_score, silhouette_score

    sizes = np.bincount(labeling.labels, minlength=num_clusters)
    silhouette = calinski_harabasz = None
    if 2 <= int((sizes > 0).sum()) < len(labeling.labels):
        silhouette = float(silhouette_score(labeling.features, labeling.labels, metric="cosine"))
        calinski_harabasz = float(calinski_harabasz_score(labeling.features, labeling.labels))
    table = contingency(labeling.labels, demonstrations.sources, num_clusters, len(demonstrations.source_labels))
    return ClusterDiagnostics(
        num_clusters=num_clusters,
        cluster_sizes=tuple(sizes.tolist()),
        label_stability=labeling.stability,
        silhouette=silhouette,
        calinski_harabasz=calinski_harabasz,
        purity=purity(table),
        contingency=tuple(map(tuple, table.tolist())),
        shortened_subtrajectories=shortened_subtrajectories,
    )


def contingency(
    labels: NDArray[np.int32], sources: NDArray[np.int32], num_clusters: int, num_sources: int
) -> NDArray[np.int64]:
    """Return (sources, K) counts of the demonstrations of each source in each cluster; both inputs are (N,)."""
    table = np.zeros((num_sources, num_clusters), np.int64)
    np.add.at(table, (sources, labels), 1)
    return table


def purity(table: NDArray[np.int64]) -> float:
    """Return the share of demonstrations that come from the most frequent source of their cluster."""
    return float(table.max(axis=0).sum() / table.sum())


register(ClusteringStage())
