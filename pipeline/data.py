"""What flows between stages, and between a learner and whoever collects for it: NumPy alone.

Shapes are checked where a value is made, so that no stage has to ask again.

Letters: N demonstrations, T states of one or steps of a rollout, G simulators, S observation, A action.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.errors import DataError
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import Key


def offsets_of(lengths: Iterable[int]) -> NDArray[np.int64]:
    """Return (N + 1,) where each of N demonstrations of these lengths starts, and the end."""
    return np.cumsum([0, *lengths], dtype=np.int64)


@dataclass(frozen=True)
class Episode:
    """One episode from its first state to its last."""

    states: NDArray[np.floating]
    """(T, S), the first and the last state included."""
    env_return: float = float("nan")
    """Sum of the environment's own reward, NaN where unknown."""
    terminated: bool = False
    """Whether it ended by failure, as opposed to a time limit or the end of a recording."""


@dataclass(frozen=True)
class Demonstrations:
    """States of N demonstrations of unequal length, one after the other."""

    observations: NDArray[np.float32]
    """(sum T, S) states."""
    offsets: NDArray[np.int64]
    """(N + 1,) where each demonstration starts; the last entry is sum T."""
    sources: NDArray[np.int32]
    """(N,) index into ``source_labels``; for reporting only, never an input of the method."""
    source_labels: tuple[str, ...]
    """What each source is called."""
    returns: NDArray[np.float64]
    """(N,) true returns in the demonstrator's own environment, NaN where unknown; for reporting only."""
    terminated: NDArray[np.bool_]
    """(N,) whether it ended because the demonstrator failed, as opposed to a time limit or the end of a recording."""

    def __post_init__(self) -> None:
        if self.observations.ndim != 2 or self.observations.dtype != np.float32 or not self.observations.shape[1]:
            raise DataError(
                f"observations are {self.observations.dtype}{self.observations.shape}; expected float32 (sum T, S)"
            )
        if self.offsets.ndim != 1 or len(self.offsets) < 2 or self.offsets[0] != 0:
            raise DataError("offsets must be (N + 1,) integers that start at 0, with at least one demonstration")
        if self.offsets[-1] != len(self.observations):
            raise DataError(f"offsets end at {self.offsets[-1]} but there are {len(self.observations)} states")
        short = np.flatnonzero(self.lengths < 2)
        if short.size:
            raise DataError(
                f"demonstration {short[0]} has {self.lengths[short[0]]} state(s); a transition needs at least 2"
            )
        finite = np.isfinite(self.observations).all(axis=1)
        if not finite.all():
            row = int(np.flatnonzero(~finite)[0])
            n = int(np.searchsorted(self.offsets, row, side="right")) - 1
            value = self.observations[row][~np.isfinite(self.observations[row])][0]
            raise DataError(f"demonstration {n} has the value {value} in state {row - self.offsets[n]}; must be finite")
        for name in ("sources", "returns", "terminated"):
            if getattr(self, name).shape != (len(self),):
                raise DataError(f"{name} must have one entry for each of the {len(self)} demonstrations")
        if self.sources.min() < 0 or self.sources.max() >= len(self.source_labels):
            raise DataError(f"source indices must lie in [0, {len(self.source_labels)})")

    @classmethod
    def of(cls, episodes: list[Episode], label: str) -> "Demonstrations":
        """Return the states of the episodes of one source. Raises DataError when one does not fit the others."""
        if not episodes:
            raise DataError("there is no demonstration")
        dim = episodes[0].states.shape[-1] if episodes[0].states.ndim == 2 else 0
        for n, episode in enumerate(episodes):
            if episode.states.ndim != 2 or not dim or episode.states.shape[1] != dim:
                raise DataError(
                    f"demonstration {n} has states of shape {episode.states.shape}; expected (T, {dim or 'S'})"
                )
        with np.errstate(over="ignore"):  # What does not fit into 32 bits becomes infinite, and is named below.
            observations = np.concatenate([episode.states for episode in episodes]).astype(np.float32)
        return cls(
            observations=observations,
            offsets=offsets_of(len(episode.states) for episode in episodes),
            sources=np.zeros(len(episodes), np.int32),
            source_labels=(label,),
            returns=np.array([episode.env_return for episode in episodes]),
            terminated=np.array([episode.terminated for episode in episodes]),
        )

    @classmethod
    def joined(cls, parts: "list[Demonstrations]") -> "Demonstrations":
        """Return the demonstrations of several sets, one after the other; each keeps its own sources.

        Raises DataError when their states have different dimensions.
        """
        for part in parts:
            if part.observation_dim != parts[0].observation_dim:
                raise DataError(
                    f"{part.source_labels[0]} has states with {part.observation_dim} dimensions; "
                    f"{parts[0].source_labels[0]} has {parts[0].observation_dim}"
                )
        first_label = offsets_of(len(part.source_labels) for part in parts).astype(np.int32)
        return cls(
            observations=np.concatenate([part.observations for part in parts]),
            offsets=offsets_of(length for part in parts for length in part.lengths),
            sources=np.concatenate([part.sources + first for part, first in zip(parts, first_label, strict=False)]),
            source_labels=tuple(label for part in parts for label in part.source_labels),
            returns=np.concatenate([part.returns for part in parts]),
            terminated=np.concatenate([part.terminated for part in parts]),
        )

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, n: int) -> NDArray[np.float32]:
        """Return the (T, S) states of demonstration ``n``."""
        return self.observations[self.offsets[n] : self.offsets[n + 1]]

    @property
    def observation_dim(self) -> int:
        """S."""
        return int(self.observations.shape[1])

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(N,) states of each demonstration."""
        return np.diff(self.offsets)

    def transition_starts(self) -> NDArray[np.int64]:
        """Return (M,) rows that have a successor in the same demonstration."""
        last = np.zeros(len(self.observations), np.bool_)
        last[self.offsets[1:] - 1] = True
        return np.flatnonzero(~last)

    def select(self, chosen: NDArray[np.int64]) -> "Demonstrations":
        """Return the chosen demonstrations, in the given order."""
        if not len(chosen):
            raise DataError("no demonstration was selected")
        parts = [self[int(n)] for n in chosen]
        return Demonstrations(
            observations=np.concatenate(parts),
            offsets=offsets_of(len(p) for p in parts),
            sources=self.sources[chosen],
            source_labels=self.source_labels,
            returns=self.returns[chosen],
            terminated=self.terminated[chosen],
        )


@dataclass(frozen=True)
class Snapshot:
    """Everything that the future of G simulators depends on."""

    states: NDArray[np.float64]
    """(G, N); what it means is the batch's own affair. MuJoCo's integration states, or a seed and actions."""
    elapsed_steps: NDArray[np.int64]
    """(G,) steps since the last reset."""
    episode_returns: NDArray[np.float64]
    """(G,) sum of the environment's own reward since the last reset; for evaluation only."""


@dataclass(frozen=True)
class Unit:
    """Everything that one rollout depends on."""

    iteration: int
    group: int
    env_id: str
    dynamics: tuple[tuple[str, Any], ...]
    """Keyword arguments of the environment, values that JSON holds."""
    num_simulators: int
    num_steps: int
    policy_version: int
    policy: GaussianPolicy
    key: Key
    snapshot: Snapshot | None
    """Where the group stands; None starts every simulator with a fresh episode."""
    starts: NDArray[np.float32] | None = None
    """(P, S) observations; every fresh episode begins at one of them, drawn evenly. None leaves it to the environment.
    They travel with each unit, so a few thousand are many."""


@dataclass(frozen=True)
class Rollout:
    """Experience of G simulators, those of one env group, under exactly one policy version."""

    policy_version: int
    observations: NDArray[np.float32]
    """(T, G, S)"""
    next_observations: NDArray[np.float32]
    """(T, G, S), before any reset."""
    actions: NDArray[np.float32]
    """(T, G, A)"""
    log_probs: NDArray[np.float32]
    """(T, G) under the policy that acted."""
    terminated: NDArray[np.bool_]
    """(T, G)"""
    truncated: NDArray[np.bool_]
    """(T, G)"""
    env_rewards: NDArray[np.float64]
    """(T, G); only experts learn from it."""
    episode_returns: NDArray[np.float64]
    """(E,) true returns of the episodes that ended; evaluation only."""
    episode_lengths: NDArray[np.int64]
    """(E,)"""


@dataclass(frozen=True)
class TransitionBatch(Rollout):
    """What one update learns from: the rollouts of all env groups, their G simulators side by side in group order."""

    @classmethod
    def of(cls, rollouts: Sequence[Rollout]) -> "TransitionBatch":
        """Join rollouts of equal length, given in group order.

        Raises ValueError when there is none, or when they were collected under different policy versions.
        """
        versions = {rollout.policy_version for rollout in rollouts}
        if len(versions) != 1:
            raise ValueError(f"a batch needs rollouts of one policy version; these have {sorted(versions)}")

        def joined(name: str, axis: int) -> NDArray:
            return np.concatenate([getattr(rollout, name) for rollout in rollouts], axis=axis)

        per_step = (
            "observations",
            "next_observations",
            "actions",
            "log_probs",
            "terminated",
            "truncated",
            "env_rewards",
        )
        per_episode = ("episode_returns", "episode_lengths")
        return cls(
            policy_version=versions.pop(),
            **{name: joined(name, axis=1) for name in per_step},
            **{name: joined(name, axis=0) for name in per_episode},
        )

    def __len__(self) -> int:
        """Return B = T * G, the number of transitions."""
        return self.terminated.size

    @property
    def ended(self) -> NDArray[np.bool_]:
        """(T, G) whether the transition is its episode's last."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class UnitResult:
    """A unit's rollout and where its env group stands afterwards."""

    iteration: int
    group: int
    rollout: Rollout
    snapshot: Snapshot
