"""What is left behind by trials to follow demonstrations: the physical check, and competing methods.

Letters: N demonstrations, M trials.
"""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, Files, encode_arrays, encode_json
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results.networks import Arrays, load_policy, policy_file

_SUMMARY = "summary.json"
_RESIDUALS = "residuals.safetensors"
_TRACKED = "tracked.safetensors"
_FEASIBILITY = "feasibility.json"
_ERRORS = "errors.safetensors"
_BOUNDS = "bounds.json"
_INVERSE_MODEL = "inverse_model.safetensors"


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

    def by_source(self, demonstrations: Demonstrations) -> list[float]:
        """Return for each source the distance, after one step, that `SHARE` of its trials keep; NaN if not known."""
        found = []
        for source in range(len(demonstrations.source_labels)):
            trials = self.one_step[demonstrations.sources == source]
            trials = trials[np.isfinite(trials)]
            found.append(float(np.quantile(trials, self.SHARE)) if trials.size else float("nan"))
        return found

    def reproducible_sources(self, demonstrations: Demonstrations) -> list[bool]:
        """Return for each source whether it is reproducible; what is not known is not."""
        return [kept <= self.LIMIT for kept in self.by_source(demonstrations)]

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
        return {**policy_file(self.policy), _TRACKED: encode_arrays(tracked)}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        return cls(load_policy(artifact), **artifact.arrays(_TRACKED))


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
