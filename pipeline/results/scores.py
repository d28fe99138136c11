"""What weightings leave behind, and the jobs that ours is made of.

Letters: N demonstrations, K clusters, M points along a training, R repetitions.
"""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, Files, encode_arrays, encode_json
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results.networks import (
    Arrays,
    discriminator_file,
    fields_of,
    load_discriminator,
    load_policy,
    load_value,
    policy_file,
    value_file,
)

_SCORES = "transferability.safetensors"
_HISTORY = "history.safetensors"
_SUMMARY = "summary.json"
_IMITATORS = "imitators.json"
_JOB_SCORES = "scores.safetensors"
_IMITATOR = "imitator.json"
_DIVERGENCES = "divergences.safetensors"
_READING = "reading.json"
_READERS = "readers.safetensors"


@dataclass(frozen=True)
class ScoreHistory:
    """The mean logits of a cluster's demonstrations while its imitator was trained."""

    demonstrations: NDArray[np.int64]
    """(N_k,) which of all demonstrations they are."""
    env_steps: NDArray[np.int64]
    """(M,) environment steps of the job."""
    logits: NDArray[np.float64]
    """(M, N_k) high for demonstrations that the discriminator tells from the imitator."""

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_JOB_SCORES: encode_arrays(vars(self))}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(**fields_of(artifact, _JOB_SCORES, cls))


@dataclass(frozen=True)
class Imitator:
    """A policy, its value function and the discriminator that it was trained against."""

    policy: GaussianPolicy
    value: Arrays
    """Its parameters by name."""
    discriminator: Arrays
    """Its parameters by name."""
    distance: float
    """Of mean-action episodes to the demonstrations, see `AdversarialReward.distance`."""
    env_steps: int
    """Of its training and of those episodes."""

    def files(self) -> Files:
        """Return the artifact's content."""
        described = {_IMITATOR: encode_json({"distance": self.distance, "env_steps": self.env_steps})}
        networks = policy_file(self.policy) | value_file(self.value) | discriminator_file(self.discriminator)
        return networks | described

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        networks = load_policy(artifact), load_value(artifact), load_discriminator(artifact)
        return cls(*networks, **artifact.json(_IMITATOR))


@dataclass(frozen=True)
class Reading:
    """What an imitator reproduces of the demonstrations of its cluster, before it is turned into scores."""

    demonstrations: NDArray[np.int64]
    """(N_k,) which of all demonstrations they are."""
    divergences: NDArray[np.float64]
    """(R, N_k) nats per transition, see `Readers.train`."""
    env_steps: int
    """Environment steps that the reading took."""
    readers: Arrays
    """What reads other demonstrations (`Readers.arrays`)."""

    def files(self) -> Files:
        """Return the artifact's content."""
        arrays: Arrays = {"demonstrations": self.demonstrations, "divergences": self.divergences}
        described = {"env_steps": self.env_steps}
        return {
            _DIVERGENCES: encode_arrays(arrays),
            _READING: encode_json(described),
            _READERS: encode_arrays(self.readers),
        }

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        arrays: dict[str, Any] = artifact.arrays(_DIVERGENCES) | artifact.json(_READING)
        return cls(**arrays, readers=artifact.arrays(_READERS))


@dataclass(frozen=True)
class TrainedImitators:
    """Which imitators were trained, and what that took."""

    env_steps: int
    """Environment steps of all of them together."""
    sha256: dict[str, str]
    """Of each job's artifact, by job."""

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_IMITATORS: encode_json(vars(self))}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(**artifact.json(_IMITATORS))


@dataclass(frozen=True)
class Transferability:
    """What a weighting says of every demonstration."""

    scores: NDArray[np.float64]
    """(N,) in [0, 1], higher where the imitator can reproduce more; NaN for new ones that are unlike any it knows."""
    weights: NDArray[np.float64]
    """(N,) not negative, summing to one; all 0 if no demonstration has a score."""
    clusters: NDArray[np.int32]
    """(N,) cluster ids; -1 for a weighting without clusters."""
    intervals: NDArray[np.float64]
    """(N, 2) in which the scores lie."""
    threshold: float
    """From which score a demonstration is kept."""
    env_steps: int = 0
    """Environment steps that the weighting took."""
    read_from: dict[int, str] = field(default_factory=dict)
    """By cluster, the job whose imitator was read, where several were trained."""
    history: dict[int, ScoreHistory] = field(default_factory=dict)
    """By cluster, for a weighting that trains imitators: how its demonstrations were told from them meanwhile."""

    @property
    def verdicts(self) -> NDArray[np.str_]:
        """(N,) ``kept`` if the whole interval reaches the threshold, ``not kept`` if none of it does, else ``open``.

        One without a score is ``unlike`` all that the run has seen.
        """
        low, high = self.intervals.T
        told = np.where(low >= self.threshold, "kept", np.where(high < self.threshold, "not kept", "open"))
        return np.where(np.isnan(self.scores), "unlike", told)

    def files(self) -> Files:
        """Return the artifact's content."""
        arrays = {name: getattr(self, name) for name in ("scores", "weights", "clusters", "intervals")}
        history: Arrays = {
            f"cluster_{k}/{name}": array for k, seen in self.history.items() for name, array in vars(seen).items()
        }
        return {
            _SCORES: encode_arrays(arrays),
            _HISTORY: encode_arrays(history),
            _SUMMARY: encode_json(
                {"threshold": self.threshold, "env_steps": self.env_steps, "read_from": self.read_from}
            ),
        }

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        named: dict[int, Arrays] = {}
        for key, array in artifact.arrays(_HISTORY).items():
            cluster, _, name = key.removeprefix("cluster_").partition("/")
            named.setdefault(int(cluster), {})[name] = array
        history = {k: ScoreHistory(**named[k]) for k in sorted(named)}
        held: dict[str, Any] = artifact.arrays(_SCORES) | artifact.json(_SUMMARY)
        held["read_from"] = {int(cluster): job for cluster, job in held["read_from"].items()}
        return cls(**held, history=history)

    def columns(self) -> Arrays:
        """Return (N,) arrays by the names that tables and exported files use."""
        low, high = self.intervals.T
        return {
            "cluster": self.clusters,
            "transferability": self.scores,
            "low": low,
            "high": high,
            "verdict": self.verdicts,
            "weight": self.weights,
        }

    def table(self) -> list[dict[str, Any]]:
        """Return one row a demonstration: its number, cluster, transferability with interval, verdict and weight."""
        columns = self.columns()
        return [
            {"demonstration": n, **{name: column[n].item() for name, column in columns.items()}}
            for n in range(len(self.scores))
        ]
