"""Stage 2: which demonstrations share a mode. One job; its artifact is the stage's.

Letters: N demonstrations, E embedding, K clusters.
"""

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Files, encode_arrays, encode_json
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.stage import JobContext, JobStoppedError, Run, Stage, register
from oodil.pipeline.stages.demonstrations import load_demonstrations

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.clustering import ContrastiveClustering, Labelling


class ClusteringStage(Stage):
    """Contrastive clustering of whole demonstrations (`oodil.pipeline.algorithms.clustering`)."""

    name = "clustering"
    version = 1
    inputs = ("demonstrations",)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the whole section."""
        return config.clustering.model_dump(mode="json")

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train the encoder and the centers, or continue from a checkpoint, and label every demonstration.

        Returns:
            assignment.safetensors: labels (N,) int32 and features (N, E) float32.
            encoder.safetensors: the cluster model, see `ClusterModel.from_arrays`.
            diagnostics.json: see `diagnostics`.
        """
        import torch
        from threadpoolctl import threadpool_limits

        from oodil.pipeline.algorithms.clustering import ContrastiveClustering

        torch.set_num_threads(1)
        # scikit-learn and NumPy have threads of their own, and sums depend on how many take part.
        with threadpool_limits(1):
            demonstrations = load_demonstrations(run)
            clustering = ContrastiveClustering(demonstrations, run.config.clustering, run.config.seed)
            self._train(clustering, run, job, context)
            model = clustering.model()
            labelling = model.label(demonstrations, run.config.clustering.label_draws, run.config.seed)
            report = diagnostics(labelling, demonstrations, len(model.centers))
            report["shortened_subtrajectories"] = model.sampling.num_shortened(demonstrations.lengths)
        return {
            "assignment.safetensors": encode_arrays({"labels": labelling.labels, "features": labelling.features}),
            "encoder.safetensors": encode_arrays(model.arrays()),
            "diagnostics.json": encode_json(report),
        }

    def _train(self, clustering: "ContrastiveClustering", run: Run, job: str, context: JobContext) -> None:
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


def diagnostics(labelling: "Labelling", demonstrations: Demonstrations, num_clusters: int) -> dict[str, Any]:
    """Return what the report says about an assignment; what needs source labels is for reporting only.

    silhouette (by cosine) and calinski_harabasz are None unless there are at least 2 clusters with members and one of
    them has more than one; contingency is {source label: demonstrations per cluster}.
    """
    from sklearn.metrics import calinski_harabasz_score, silhouette_score

    sizes = np.bincount(labelling.labels, minlength=num_clusters)
    non_empty = int((sizes > 0).sum())
    scores: dict[str, float | None] = {"silhouette": None, "calinski_harabasz": None}
    if 2 <= non_empty < len(labelling.labels):
        scores["silhouette"] = float(silhouette_score(labelling.features, labelling.labels, metric="cosine"))
        scores["calinski_harabasz"] = float(calinski_harabasz_score(labelling.features, labelling.labels))
    table = contingency(labelling.labels, demonstrations.sources, num_clusters, len(demonstrations.source_labels))
    return scores | {
        "num_clusters": num_clusters,
        "non_empty_clusters": non_empty,
        "cluster_sizes": sizes.tolist(),
        "label_stability": labelling.stability,
        "purity": purity(table),
        "contingency": dict(zip(demonstrations.source_labels, table.tolist(), strict=True)),
    }


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
