"""The contrastive half of phase 1: sub-trajectories, the sequence encoder and the loss of Eqn (1).

Two sub-trajectories of one demonstration form a positive pair; those of the other demonstrations in the batch are its
negatives. Unlike the paper's Eqn (1), both members of a pair serve as the anchor, and features are on the unit sphere
for every use, so that distances and cosines agree.

Letters: N demonstrations, B batch, T states of one demonstration, l states of a sub-trajectory, S observation,
E embedding.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, normalize

from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.config import ClusteringConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import DataError

LONGEST_SUBTRAJECTORY = 50
"""In states; a recurrent encoder forgets earlier ones (appendix B)."""


@dataclass(frozen=True)
class Sampling:
    """Length and stride of sub-trajectories: equal for all demonstrations, so that their speeds can be compared."""

    length: int
    """l, states per sub-trajectory."""
    stride: int
    """Steps from one of its states to the next."""

    @classmethod
    def plan(cls, lengths: NDArray[np.int64], config: ClusteringConfig) -> "Sampling":
        """Choose length and stride so that they span most of the shortest demonstration, for (N,) lengths."""
        shortest, size = int(lengths.min()), config.subtrajectory_length
        if config.sampling == "fixed_length":
            return cls(length=size, stride=max(1, shortest // size))
        return cls(length=min(max(2, shortest // size), LONGEST_SUBTRAJECTORY), stride=size)

    def strides(self, lengths: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return (N,) strides, smaller for demonstrations that are too short for the common one."""
        longest = np.maximum(1, (lengths - 1) // (self.length - 1))
        return np.minimum(self.stride, longest)

    def num_shortened(self, lengths: NDArray[np.int64]) -> int:
        """Return how many of the demonstrations are too short for the common stride."""
        return int((self.stride * (self.length - 1) > lengths - 1).sum())

    def draw(
        self, starts: NDArray[np.int64], lengths: NDArray[np.int64], rng: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draw one sub-trajectory of each of B demonstrations, with uniform phase.

        Args:
            starts: (B,) row of each demonstration's first state.
            lengths: (B,) its number of states; where it is below l, the last state is repeated.
            rng: used for one call.
        Returns: (l, B) rows, time first.
        """
        strides = self.strides(lengths)
        slack = np.maximum(0, lengths - 1 - strides * (self.length - 1))
        first = rng.integers(0, slack, endpoint=True)
        steps = np.minimum(first + strides * np.arange(self.length)[:, None], lengths - 1)
        return starts + steps


class Subtrajectories:
    """Standardized demonstrations in one tensor, from which a batch of sub-trajectories is one gather."""

    def __init__(
        self,
        demonstrations: Demonstrations,
        sampling: Sampling,
        state_mean: NDArray[np.float32],
        state_scale: NDArray[np.float32],
    ) -> None:
        """Standardize the states: the (S,) mean is subtracted, the (S,) scale multiplied afterwards."""
        self.sampling = sampling
        self.state_mean, self.state_scale = state_mean, state_scale
        self._starts, self._lengths = demonstrations.offsets[:-1], demonstrations.lengths
        self._states = torch.from_numpy((demonstrations.observations - state_mean) * state_scale)

    @classmethod
    def plan(cls, demonstrations: Demonstrations, config: ClusteringConfig) -> "Subtrajectories":
        """Return those from which clusters are learned.

        Raises DataError when there are fewer demonstrations than clusters.
        """
        if len(demonstrations) < config.num_clusters:
            raise DataError(f"{len(demonstrations)} demonstrations cannot form {config.num_clusters} clusters")
        dim = demonstrations.observation_dim
        mean, scale = np.zeros(dim, np.float32), np.ones(dim, np.float32)
        if config.standardize_states:
            mean, scale = standardization(demonstrations.observations)
        return cls(demonstrations, Sampling.plan(demonstrations.lengths, config), mean, scale)

    def __len__(self) -> int:
        return len(self._lengths)

    def draw(self, chosen: NDArray[np.int64], rng: np.random.Generator) -> Tensor:
        """Return (l, B, S): one random sub-trajectory of each of the (B,) chosen demonstrations, time first."""
        return self._states[torch.from_numpy(self.sampling.draw(self._starts[chosen], self._lengths[chosen], rng))]


class Encoder(nn.Module):
    """F: a one-layer LSTM whose last hidden output, scaled to length 1, is the feature of a sub-trajectory."""

    def __init__(self, observation_dim: int, hidden: int, rng: torch.Generator) -> None:
        super().__init__()
        self.lstm = nn.LSTM(observation_dim, hidden)
        for parameter in self.lstm.parameters():
            nn.init.uniform_(parameter, -(hidden**-0.5), hidden**-0.5, generator=rng)

    def forward(self, subtrajectories: Tensor) -> Tensor:
        """Return (B, E) unit features of (l, B, S) standardized states."""
        _, (hidden, _) = self.lstm(subtrajectories)
        return normalize(hidden[0], dim=-1)

    def of_demonstrations(self, features: Tensor) -> Tensor:
        """Return (N, E) unit features of demonstrations: the means of (draws, N, E) ones of their sub-trajectories."""
        return normalize(features.mean(0), dim=-1)


class States(nn.Module):
    """Instead of F, the standardized states one after the other: the k-means variant of appendix C.6."""

    def forward(self, subtrajectories: Tensor) -> Tensor:
        """Return (B, l * S) features of (l, B, S) standardized states."""
        return subtrajectories.transpose(0, 1).flatten(1)

    def of_demonstrations(self, features: Tensor) -> Tensor:
        """Return the first of (draws, N, l * S) features: a mean of states at other times is nobody's state."""
        return features[0]


def contrastive_loss(features: Tensor, temperature: float) -> Tensor:
    """Return the symmetric form of Eqn (1), averaged over all 2B anchors.

    For each anchor i with partner j: -log exp(<f_i, f_j> / t) / sum over m != i of exp(<f_i, f_m> / t).

    Args:
        features: (2B, E) unit vectors; row n and row B + n are the two views of one demonstration.
        temperature: t; 1 is the paper's form.
    """
    similarities = features @ features.T / temperature
    itself = torch.eye(len(features), dtype=torch.bool)
    partners = torch.arange(len(features)).roll(len(features) // 2)
    return cross_entropy(similarities.masked_fill(itself, -torch.inf), partners)
