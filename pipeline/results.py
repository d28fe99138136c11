"""What the stages leave behind, typed: each type knows its files, and nothing else names them or what is in them.

``files()`` gives the content of an artifact, ``load(artifact)`` reads it back, checked against the manifest.

Letters: N demonstrations, E embedding or episodes, K clusters, M points along a training, or trials, S observation,
A action.
"""

from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, Files, encode_arrays, encode_json
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets.native import decode_demonstrations, encode_demonstrations
from oodil.pipeline.errors import DamagedArtifactError, DataError
from oodil.pipeline.policy import GaussianPolicy

_DEMONSTRATIONS, _SOURCES = "demonstrations.safetensors", "demonstrations.json"
_ASSIGNMENT, _DIAGNOSTICS, _ENCODER = "assignment.safetensors", "diagnostics.json", "encoder.safetensors"
_SCORES, _HISTORY, _SUMMARY = "transferability.safetensors", "history.safetensors", "summary.json"
_POLICY, _POLICY_META, _DISCRIMINATOR = "policy.safetensors", "policy.json", "discriminator.safetensors"
_VALUE = "value.safetensors"
_CURVE, _EVALUATION = "curve.json", "evaluation.json"
_IMITATORS, _JOB_SCORES, _TRAININGS = "imitators.json", "scores.safetensors", "trainings.json"
_RESIDUALS, _DISTANCE = "residuals.safetensors", "distance.json"
_TRACKED, _FEASIBILITY = "tracked.safetensors", "feasibility.json"
_ERRORS, _BOUNDS, _INVERSE_MODEL = "errors.safetensors", "bounds.json", "inverse_model.safetensors"
_DIVERGENCES, _READING, _READERS = "divergences.safetensors", "reading.json", "readers.safetensors"

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class CollectedDemonstrations:
    """Demonstrations, and how each source's were come by."""

    demonstrations: Demonstrations
    kept_share: tuple[float, ...] = ()
    """By source, the share of collected episodes that were kept; empty for a file."""
    environment_id: str = ""
    transfer_returns: tuple[float, ...] = ()
    """By source, the mean true return of its expert's mean actions under the imitator's own dynamics; NaN for a
    hand-written controller. For reporting alone; empty for a file."""

    def files(self) -> Files:
        """Return the artifact's content."""
        sources = {"kept_share": list(self.kept_share), "transfer_returns": list(self.transfer_returns)}
        return {
            _DEMONSTRATIONS: encode_demonstrations(self.demonstrations, self.environment_id),
            _SOURCES: encode_json(sources),
        }

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        path = str(artifact.path / _DEMONSTRATIONS)
        demonstrations, environment_id = decode_demonstrations(artifact.read(_DEMONSTRATIONS), path)
        sources = artifact.json(_SOURCES)
        returns = tuple(np.nan if each is None else each for each in sources["transfer_returns"])
        return cls(demonstrations, tuple(sources["kept_share"]), environment_id, returns)


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
        return cls(**_arrays(artifact, _ASSIGNMENT, cls))

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


@dataclass(frozen=True)
class Reproducibility:
    """How far the imitator's simulator stays from the demonstrations that it follows with the best actions there are.

    A distance is the root mean square over state dimensions, in deviations of what states change by in that time. It
    depends on no return and on nothing learned. NaN: no state of the demonstration tells where the simulator is.
    """

    one_step: NDArray[np.float64]
    """(N, M) distances after one step, for M trials of each demonstration."""
    horizon: NDArray[np.float64]
    """(N, M) distances after several steps."""
    env_steps: int = 0
    """Steps of the simulator that it took."""

    SHARE, LIMIT = 0.75, 0.05
    """A source is reproducible if this share of its trials ends, after one step, within this distance. Not the mean,
    and not all: where every step can be reproduced, the search fails in up to an eighth of the trials. Not half: feet
    that slip are the smaller part of the steps (docs/decisions.md)."""

    def mean(self) -> NDArray[np.float64]:
        """Return (N,) the mean distance after one step of each demonstration."""
        return np.asarray(self.one_step.mean(axis=1))

    def median(self) -> NDArray[np.float64]:
        """Return (N,) the median distance after one step of each demonstration."""
        return np.asarray(np.median(self.one_step, axis=1))

    def horizon_mean(self) -> NDArray[np.float64]:
        """Return (N,) the mean distance after several steps of each demonstration."""
        return np.asarray(self.horizon.mean(axis=1))

    def horizon_median(self) -> NDArray[np.float64]:
        """Return (N,) the median distance after several steps of each demonstration."""
        return np.asarray(np.median(self.horizon, axis=1))

    def by_source(self, demonstrations: Demonstrations) -> dict[str, float]:
        """Return by source the distance, after one step, that `SHARE` of its trials keep; NaN where none is known."""
        found = {}
        for source, label in enumerate(demonstrations.source_labels):
            trials = self.one_step[demonstrations.sources == source]
            trials = trials[np.isfinite(trials)]
            found[label] = float(np.quantile(trials, self.SHARE)) if trials.size else float("nan")
        return found

    def reproducible_sources(self, demonstrations: Demonstrations) -> dict[str, bool]:
        """Return by source whether it is reproducible; what is not known is not."""
        return {label: kept <= self.LIMIT for label, kept in self.by_source(demonstrations).items()}

    def files(self) -> Files:
        """Return the artifact's content."""
        arrays: Arrays = {"one_step": self.one_step, "horizon": self.horizon}
        return {_RESIDUALS: encode_arrays(arrays), _SUMMARY: encode_json({"env_steps": self.env_steps})}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(**artifact.arrays(_RESIDUALS), env_steps=artifact.json(_SUMMARY)["env_steps"])

    @classmethod
    def joined(cls, parts: "list[Reproducibility]") -> Self:
        """Return that of several sets of demonstrations, one after the other."""
        one_step, horizon = (np.concatenate([getattr(p, name) for p in parts]) for name in ("one_step", "horizon"))
        return cls(one_step, horizon, sum(part.env_steps for part in parts))


@dataclass(frozen=True)
class Following:
    """How far a simulator stays behind the demonstrations that it follows, and by which errors that is judged."""

    errors: NDArray[np.float64]
    """(N,) of the run's demonstrations."""
    lowest: float
    """Up to this error a demonstration scores 1."""
    highest: float
    """From this error on it scores 0."""
    model: Arrays = field(default_factory=dict)
    """Parameters of the model that chose the actions, by name; empty where none was learned."""

    def scores(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N,) scores of errors, which fall linearly from 1 at the lowest bound to 0 at the highest."""
        highest = max(self.highest, np.nextafter(self.lowest, np.inf))
        return np.interp(errors, (self.lowest, highest), (1.0, 0.0))

    def files(self) -> Files:
        """Return the artifact's content."""
        return {
            _ERRORS: encode_arrays({"errors": self.errors}),
            _BOUNDS: encode_json({"lowest": self.lowest, "highest": self.highest}),
            _INVERSE_MODEL: encode_arrays(self.model),
        }

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        values: dict[str, Any] = artifact.arrays(_ERRORS) | artifact.json(_BOUNDS)
        return cls(**values, model=artifact.arrays(_INVERSE_MODEL))


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
        return cls(**_arrays(artifact, _JOB_SCORES, cls))


@dataclass(frozen=True)
class Imitator:
    """A policy and the discriminator that it was trained against."""

    policy: GaussianPolicy
    discriminator: Arrays
    """Its parameters by name."""
    distance: float
    """Of mean-action episodes to the demonstrations, see `AdversarialReward.distance`."""

    def files(self) -> Files:
        """Return the artifact's content."""
        described = {_DISTANCE: encode_json({"distance": self.distance})}
        return {_POLICY: encode_arrays(self.policy.arrays())} | discriminator_file(self.discriminator) | described

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(_policy(artifact), load_discriminator(artifact), artifact.json(_DISTANCE)["distance"])


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
class Tracker:
    """A policy that tracks demonstrations, and how far it stays from each."""

    policy: GaussianPolicy
    demonstrations: NDArray[np.int64]
    """(N_k,) which of all demonstrations it was trained on."""
    distances: NDArray[np.float64]
    """(N_k,) see `tracking.distances`."""

    def files(self) -> Files:
        """Return the artifact's content."""
        tracked: Arrays = {"demonstrations": self.demonstrations, "distances": self.distances}
        return {_POLICY: encode_arrays(self.policy.arrays()), _TRACKED: encode_arrays(tracked)}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(_policy(artifact), **artifact.arrays(_TRACKED))


@dataclass(frozen=True)
class FeasibilityScale:
    """What turns the distance of a tracked demonstration into its feasibility."""

    nearest: float
    """The smallest distance of the run's demonstrations."""
    alpha: float
    """The difference of two distances that divides feasibility by e."""

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_FEASIBILITY: encode_json(vars(self))}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(**artifact.json(_FEASIBILITY))


@dataclass(frozen=True)
class Transferability:
    """What a weighting says of every demonstration."""

    scores: NDArray[np.float64]
    """(N,) in [0, 1], higher where the imitator can reproduce more; NaN for new ones that are unlike any it knows."""
    weights: NDArray[np.float64]
    """(N,) not negative, summing to one."""
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


@dataclass(frozen=True)
class Training:
    """One of several trainings of the same policy."""

    job: str
    env_steps: int
    distance: float
    """Of mean-action episodes to the weighted demonstrations, see `AdversarialReward.distance`; the smallest counts."""
    mean_return: float
    """True return of the final evaluation; for reporting only."""


@dataclass(frozen=True)
class Trainings:
    """All trainings of a policy."""

    trainings: tuple[Training, ...]
    """The one that was kept is the first."""

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_TRAININGS: encode_json([vars(training) for training in self.trainings])}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(tuple(Training(**training) for training in artifact.json(_TRAININGS)))


@dataclass(frozen=True)
class Evaluation:
    """True returns and lengths of E episodes; for reporting, never for learning."""

    returns: NDArray[np.float64]
    """(E,)"""
    lengths: NDArray[np.int64]
    """(E,) steps."""

    @property
    def mean_return(self) -> float:
        """Mean over the episodes; NaN where the environment's reward is."""
        return float(self.returns.mean())

    @property
    def std_return(self) -> float:
        """Standard deviation over the episodes."""
        return float(self.returns.std())

    @property
    def mean_length(self) -> float:
        """Mean steps of an episode."""
        return float(self.lengths.mean())

    def __len__(self) -> int:
        return len(self.returns)

    def files(self) -> Files:
        """Return the artifact's content."""
        return {_EVALUATION: encode_json({"returns": self.returns.tolist(), "lengths": self.lengths.tolist()})}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        values = artifact.json(_EVALUATION)
        return cls(np.array(values["returns"], np.float64), np.array(values["lengths"], np.int64))


@dataclass(frozen=True)
class LearningCurve:
    """The deterministic policy's true return along its training."""

    env_steps: NDArray[np.int64]
    """(M,)"""
    mean_return: NDArray[np.float64]
    """(M,)"""
    std_return: NDArray[np.float64]
    """(M,) over the episodes of a point."""
    mean_length: NDArray[np.float64]
    """(M,) steps."""
    episodes: int
    """Episodes per point."""

    def files(self) -> Files:
        """Return the artifact's content."""
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        values = {name: array.tolist() for name, array in arrays.items()}
        return {_CURVE: encode_json(values | {"episodes": self.episodes})}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        values = artifact.json(_CURVE)
        floats = {name: np.array(values[name], np.float64) for name in ("mean_return", "std_return", "mean_length")}
        return cls(np.array(values["env_steps"], np.int64), **floats, episodes=values["episodes"])


@dataclass(frozen=True)
class Policy:
    """A trained policy as it is used: it flattens observations and clips actions as its training did."""

    gaussian: GaussianPolicy
    environment_id: str
    observation_shape: tuple[int, ...]
    action_low: NDArray[np.float32]
    """In the shape of the action space."""
    action_high: NDArray[np.float32]
    env_steps: int = 0
    """Environment steps of its training."""

    def act(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Return the mean action for one observation, or for a batch (B, ...) of them.

        Raises DataError when an observation has another shape than in training.
        """
        seen = np.asarray(observation)
        single = seen.shape == self.observation_shape
        if not single and seen.shape[1:] != self.observation_shape:
            raise DataError(f"observation has shape {seen.shape}; the policy was trained on {self.observation_shape}")
        flat = seen.reshape(1 if single else len(seen), -1)
        actions = self.gaussian.mean(flat).reshape(-1, *self.action_low.shape)
        clipped = np.clip(actions, self.action_low, self.action_high)
        return np.asarray(clipped[0] if single else clipped)

    def predict(
        self, observation: NDArray[Any], state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """Return ``(action, state)`` as the policies of stable-baselines3 do; the policy keeps no state.

        Only the mean action is deployed, so ``deterministic`` has to be true.
        """
        if not deterministic:
            raise DataError("only the mean action of a trained policy is deployed; call predict(deterministic=True)")
        return self.act(observation), state

    def files(self) -> Files:
        """Return the artifact's content; an infinite bound is null."""
        described = {
            "environment": self.environment_id,
            "activation": "tanh",
            "observation_shape": list(self.observation_shape),
            "action_low": self.action_low.tolist(),
            "action_high": self.action_high.tolist(),
            "env_steps": self.env_steps,
        }
        return {_POLICY: encode_arrays(self.gaussian.arrays()), _POLICY_META: encode_json(described)}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        described = artifact.json(_POLICY_META)
        return cls(
            gaussian=_policy(artifact),
            environment_id=described["environment"],
            observation_shape=tuple(described["observation_shape"]),
            action_low=_bounds(described["action_low"], -np.inf),
            action_high=_bounds(described["action_high"], np.inf),
            env_steps=described["env_steps"],
        )


def value_file(arrays: Arrays) -> Files:
    """Return the file of a policy's value function, with which its training can be continued."""
    return {_VALUE: encode_arrays(arrays)}


def load_value(artifact: Artifact) -> Arrays:
    """Return a value function's parameters by name."""
    return artifact.arrays(_VALUE)


def discriminator_file(arrays: Arrays) -> Files:
    """Return the file of a discriminator's parameters."""
    return {_DISCRIMINATOR: encode_arrays(arrays)}


def load_discriminator(artifact: Artifact) -> Arrays:
    """Return a discriminator's parameters by name."""
    return artifact.arrays(_DISCRIMINATOR)


def _arrays(artifact: Artifact, name: str, kind: type) -> Arrays:
    arrays = artifact.arrays(name)
    return {each.name: arrays[each.name] for each in fields(kind)}


def _policy(artifact: Artifact) -> GaussianPolicy:
    try:
        return GaussianPolicy.from_arrays(artifact.arrays(_POLICY))
    except ValueError as error:
        raise DamagedArtifactError(f"{artifact.path / _POLICY}: {error}") from error


def _bounds(values: Any, unbounded: float) -> NDArray[np.float32]:
    array = np.array(values, np.float32)  # null becomes NaN
    return np.where(np.isnan(array), np.float32(unbounded), array)
