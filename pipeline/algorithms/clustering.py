"""Phase 1 of the method: contrastive clustering (Algorithm 1 of the appendix), or k-means of states (appendix C.6).

The encoder is trained first by the contrastive loss alone, then together with K centers that follow their members as
running means. Unlike the paper, centers may begin at the groups of average linkage, the counters of their means start
above zero, as in the official code, centers stay on the unit sphere, and a demonstration is represented, when centers
are initialized and when it is labeled, by the mean feature of several sub-trajectories. The warm-up is skipped where
the sub-trajectories of a demonstration agree on its cluster without it: it would only spread demonstrations evenly over
the sphere and close the gap around a small mode (docs/decisions.md).

Letters: N demonstrations, B batch, l states of a sub-trajectory, S observation, E embedding, K clusters.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.cluster import AgglomerativeClustering, KMeans
from sklearn.metrics import silhouette_score
from torch import Tensor
from torch.nn.functional import normalize

from oodil.pipeline.algorithms.contrastive import Encoder, Sampling, States, Subtrajectories, contrastive_loss
from oodil.pipeline.algorithms.optimizer import Adam
from oodil.pipeline.artifacts import below, nested
from oodil.pipeline.config import ClusteringConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import DataError
from oodil.pipeline.seeding import Key, derive_key, numpy_rng, torch_seed

ENCODED_AT_ONCE = 1024
"""Sub-trajectories per forward pass outside training; a limit on memory."""
COMPARED_AT_ONCE = 5000
"""Demonstrations by which centers are initialized; of more, some are drawn: linkage compares all pairs."""


def assign(features: Tensor, centers: Tensor) -> Tensor:
    """Return (...) int64 ids of the nearest of (K, E) centers for (..., E) features, Eqn (2)."""
    # ||f - c||^2 = ||f||^2 + ||c||^2 - 2 <f, c>, and the first term is the same for every center.
    return (centers.square().sum(-1) - 2 * features @ centers.T).argmin(-1)


def center_loss(features: Tensor, own_centers: Tensor, reduction: str) -> Tensor:
    """Return ||F(xi) - C y||^2 / 2, the second term of Eqn (3) without lambda, as sum or mean; both are (2B, E)."""
    distances = 0.5 * (features - own_centers).square().sum(-1)
    return distances.sum() if reduction == "sum" else distances.mean()


def moved_centers(centers: Tensor, counts: Tensor, features: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return centers (K, E) and counters (K,) after Eqn (4) for all samples in sequence.

    The running mean of m samples that begins at (n, c) ends at (n c + sum f) / (n + m), in any order.

    Args:
        centers, counts: (K, E) float32 and (K,) int64 before the update.
        features, labels: (2B, E) and (2B,) int64 in [0, K).
    """
    new = torch.bincount(labels, minlength=len(centers))
    sums = torch.zeros_like(centers).index_add_(0, labels, features)
    # In this form a center without new members keeps its bits.
    moved = centers + (sums - new[:, None] * centers) / (counts + new)[:, None]
    return moved, counts + new


@dataclass(frozen=True)
class Labeling:
    """What a cluster model says about N demonstrations."""

    labels: NDArray[np.int32]
    """(N,) cluster ids."""
    features: NDArray[np.float32]
    """(N, E) features; those of an encoder have length 1."""
    stability: float
    """Share of single draws whose own label is the final one."""


@dataclass(frozen=True)
class ClusterModel:
    """A frozen encoder and its centers: all that is needed to label demonstrations, old or new."""

    encoder: Encoder | States
    centers: Tensor
    """(K, E)"""
    counts: Tensor
    """(K,) int64 counters of Eqn (4), or members in k-means."""
    sampling: Sampling
    state_mean: NDArray[np.float32]
    """(S,) subtracted from the states."""
    state_scale: NDArray[np.float32]
    """(S,) multiplied afterwards."""

    @torch.no_grad()
    def label(self, demonstrations: Demonstrations, draws: int, root_seed: int) -> Labeling:
        """Label each demonstration by the center nearest to its feature, that of ``draws`` sub-trajectories of it.

        Raises DataError when the states have another dimension than those of the training set.
        """
        if demonstrations.observation_dim != len(self.state_mean):
            raise DataError(
                f"states have {demonstrations.observation_dim} dimensions; the clusters were learned "
                f"from states with {len(self.state_mean)}"
            )
        subtrajectories = Subtrajectories(demonstrations, self.sampling, self.state_mean, self.state_scale)
        features = _encode_all(self.encoder, subtrajectories, draws, _label_key(root_seed))
        mean = self.encoder.of_demonstrations(features)
        labels = assign(mean, self.centers).numpy().astype(np.int32)
        return Labeling(labels, mean.numpy(), _stability(features, mean, self.centers))

    def arrays(self) -> dict[str, NDArray]:
        """Return everything by name, for a file; `from_arrays` is the inverse."""
        return {name: value.numpy() for name, value in self.encoder.state_dict().items()} | {
            "centers": self.centers.numpy(),
            "counts": self.counts.numpy(),
            "length": np.array([self.sampling.length], np.int32),
            "stride": np.array([self.sampling.stride], np.int32),
            "state_mean": self.state_mean,
            "state_scale": self.state_scale,
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray]) -> "ClusterModel":
        """Rebuild a model from `arrays`. Raises ValueError when a name is missing or shapes do not fit."""
        try:
            centers, counts = torch.from_numpy(arrays["centers"]), torch.from_numpy(arrays["counts"])
            sampling = Sampling(length=int(arrays["length"][0]), stride=int(arrays["stride"][0]))
            mean, scale = arrays["state_mean"], arrays["state_scale"]
            encoder: Encoder | States = States()
            if any(name.startswith("lstm.") for name in arrays):
                encoder = Encoder(len(mean), centers.shape[1], torch.Generator())
            elif centers.shape[1] != sampling.length * len(mean):
                raise IndexError(f"{centers.shape[1]} numbers a center, {sampling.length} states of {len(mean)}")
            encoder.load_state_dict({name: torch.from_numpy(arrays[name]) for name in encoder.state_dict()})
        except KeyError as error:
            raise ValueError(f"cluster model has no array {error.args[0]!r}") from None
        except (RuntimeError, IndexError) as error:
            raise ValueError(f"arrays of the cluster model do not fit together: {error}") from error
        return cls(encoder, centers, counts, sampling, mean, scale)


class ContrastiveClustering:
    """Algorithm 1, one iteration per `update`; `state_dict` is all of its state."""

    def __init__(self, demonstrations: Demonstrations, config: ClusteringConfig, root_seed: int) -> None:
        """Prepare the encoder. Raises DataError when there are fewer demonstrations than clusters."""
        self._subtrajectories = Subtrajectories.plan(demonstrations, config)
        self.config = config
        self.root_seed = root_seed
        # With one cluster there is nothing for the encoder to learn.
        self._warmup = config.warmup_iterations if config.num_clusters > 1 else 0
        self.num_iterations = self._warmup + config.joint_iterations if config.num_clusters > 1 else 0
        self.iteration = 0
        rng = torch.Generator().manual_seed(torch_seed(self._key("encoder")))
        self.encoder = Encoder(demonstrations.observation_dim, config.hidden, rng)
        self._optimizer = Adam(list(self.encoder.parameters()), config.learning_rate, config.weight_decay)
        self.centers = torch.zeros(config.num_clusters, config.hidden)
        self.counts = torch.full((config.num_clusters,), config.initial_count)
        self._begin()

    def update(self) -> dict[str, float]:
        """Run one iteration and return metrics: loss, contrastive_loss."""
        config = self.config
        rng = numpy_rng(self._key("batch", self.iteration))
        chosen = rng.permutation(len(self._subtrajectories))[: config.batch_size]
        views = self._subtrajectories.draw(np.concatenate((chosen, chosen)), rng)
        features = self.encoder(views)
        contrastive = loss = contrastive_loss(features, config.temperature)
        joint = self.iteration >= self._warmup
        if joint:
            labels = assign(features.detach(), self.centers)
            if config.update_order == "centers_first":
                self._move_centers(features.detach(), labels)
            loss = loss + config.center_weight * center_loss(features, self.centers[labels], config.reduction)
        self._optimizer.step(loss)
        if joint and config.update_order == "step_first":
            with torch.no_grad():
                features = self.encoder(views)
            self._move_centers(features, assign(features, self.centers))
        self.iteration += 1
        if self.iteration == self._warmup:
            self.centers, _ = self._initial_centers()
        return {"loss": float(loss.detach()), "contrastive_loss": float(contrastive.detach())}

    def model(self) -> ClusterModel:
        """Return the current encoder and centers."""
        return _model(self.encoder, self.centers, self.counts, self._subtrajectories)

    def state_dict(self) -> dict[str, NDArray]:
        """Return everything that later iterations depend on."""
        tensors = nested("encoder", self.encoder.state_dict()) | nested("optimizer", self._optimizer.state_dict())
        tensors |= {"centers": self.centers, "counts": self.counts, "iteration": torch.tensor([self.iteration])}
        return {name: value.numpy() for name, value in tensors.items()}

    def load_state_dict(self, state: dict[str, NDArray]) -> None:
        """Continue from `state_dict`."""
        tensors = {name: torch.from_numpy(value) for name, value in state.items()}
        self.encoder.load_state_dict(below("encoder", tensors))
        self._optimizer.load_state_dict(below("optimizer", tensors))
        self.centers, self.counts = tensors["centers"], tensors["counts"]
        self.iteration = int(tensors["iteration"])

    def _begin(self) -> None:
        """Initialize the centers and skip the warm-up where there is none, or where labels are stable without it."""
        sufficient = self.config.sufficient_stability
        if self._warmup == 0 or sufficient is not None:
            centers, stability = self._initial_centers()
            if sufficient is None or self._warmup == 0 or stability >= sufficient:
                self.centers, self.iteration = centers, self._warmup

    @torch.no_grad()
    def _initial_centers(self) -> tuple[Tensor, float]:
        """Return (K, E) centers to begin with, and how stable labels are by k-means, or by random demonstrations."""
        config = self.config
        rng = numpy_rng(self._key("centres"))
        features = _encode_all(self.encoder, self._subtrajectories, config.label_draws, self._key("centres", "views"))
        mean = self.encoder.of_demonstrations(features)
        if config.initial_centers == "trajectories":
            centers = features[0, rng.permutation(len(mean))[: config.num_clusters]]
        else:
            centers, _ = _kmeans(mean, config.num_clusters, rng)
        centers = self._scaled(centers)
        # The groups of linkage are coarse beside outliers, and stable also where features do not suffice.
        stability = _stability(features, mean, centers)
        drawn = mean[rng.permutation(len(mean))[:COMPARED_AT_ONCE]]
        if config.initial_centers == "silhouette" and 1 < config.num_clusters < len(drawn):
            centers = clearer_centers(drawn, centers, self._scaled(linked_centers(drawn, config.num_clusters)))
        return centers, stability

    def _move_centers(self, features: Tensor, labels: Tensor) -> None:
        """Update centers and counters with a batch (Eqn 4)."""
        centers, self.counts = moved_centers(self.centers, self.counts, features, labels)
        self.centers = self._scaled(centers)

    def _scaled(self, centers: Tensor) -> Tensor:
        """Return centers on the unit sphere, if they are kept there."""
        return normalize(centers, dim=-1) if self.config.normalize_centers else centers

    def _key(self, *path: str | int) -> Key:
        return derive_key(self.root_seed, "clustering", *path)


def clusters_of_states(demonstrations: Demonstrations, config: ClusteringConfig, root_seed: int) -> ClusterModel:
    """Return the clusters that k-means finds in the sub-trajectories by which demonstrations are labeled.

    Raises DataError when there are fewer demonstrations than clusters.
    """
    subtrajectories, encoder = Subtrajectories.plan(demonstrations, config), States()
    features = encoder.of_demonstrations(_encode_all(encoder, subtrajectories, 1, _label_key(root_seed)))
    rng = numpy_rng(derive_key(root_seed, "clustering", "states"))
    centers, labels = _kmeans(features, config.num_clusters, rng)
    return _model(encoder, centers, labels.bincount(minlength=config.num_clusters), subtrajectories)


def linked_centers(features: Tensor, num_clusters: int) -> Tensor:
    """Return (K, E) means of the groups of average linkage of (N, E) features, 1 < K < N.

    The squared distances of k-means would rather divide a large, wide mode once more than tell a rare one from it.
    Linkage goes by the distance between groups, whatever their size, but spends groups on outliers.
    """
    groups = AgglomerativeClustering(num_clusters, linkage="average").fit_predict(features.numpy())
    return torch.stack([features[groups == k].mean(0) for k in range(num_clusters)])


def clearer_centers(features: Tensor, *candidates: Tensor) -> Tensor:
    """Return that of some (K, E) centers whose groups of (N, E) features have the greatest silhouette, K < N."""
    return max(candidates, key=lambda centers: _silhouette(features, centers))


def _silhouette(features: Tensor, centers: Tensor) -> float:
    """Return the mean silhouette by cosine of (N, E) features in the groups of (K, E) centers; -1 for one group."""
    labels = assign(features, centers).numpy()
    return float(silhouette_score(features.numpy(), labels, metric="cosine")) if len(set(labels)) > 1 else -1.0


def _kmeans(features: Tensor, num_clusters: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Return (K, E) centers and (N,) labels by the best of ten runs of k-means on (N, E) features."""
    kmeans = KMeans(num_clusters, n_init=10, random_state=int(rng.integers(2**31))).fit(features.numpy())
    return torch.from_numpy(kmeans.cluster_centers_), torch.from_numpy(kmeans.labels_)


def _model(
    encoder: Encoder | States, centers: Tensor, counts: Tensor, subtrajectories: Subtrajectories
) -> ClusterModel:
    mean, scale = subtrajectories.state_mean, subtrajectories.state_scale
    return ClusterModel(encoder, centers, counts, subtrajectories.sampling, mean, scale)


def _label_key(root_seed: int) -> Key:
    return derive_key(root_seed, "clustering", "label")


def _stability(features: Tensor, mean: Tensor, centers: Tensor) -> float:
    """Return the share of (draws, N, E) single features whose label is that of their (N, E) mean."""
    return float((assign(features, centers) == assign(mean, centers)).double().mean())


def _encode_all(encoder: Encoder | States, subtrajectories: Subtrajectories, draws: int, key: Key) -> Tensor:
    """Return (draws, N, E) features of ``draws`` sub-trajectories of every demonstration."""
    everyone = np.arange(len(subtrajectories))
    return torch.stack([_encode(encoder, subtrajectories, everyone, (*key, draw)) for draw in range(draws)])


def _encode(encoder: Encoder | States, subtrajectories: Subtrajectories, chosen: NDArray[np.int64], key: Key) -> Tensor:
    """Return (B, E) features of one sub-trajectory, drawn with ``key``, of each of the (B,) chosen demonstrations."""
    views = subtrajectories.draw(chosen, numpy_rng(key))
    return torch.cat([encoder(part) for part in views.split(ENCODED_AT_ONCE, dim=1)])
