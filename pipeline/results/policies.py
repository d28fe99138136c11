"""What trainings of policies leave behind.

Letters: E episodes, M points along a training, S observation, A action.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, Files, encode_json
from oodil.pipeline.errors import DataError
from oodil.pipeline.policy import GaussianPolicy, action_units
from oodil.pipeline.results.networks import load_policy, policy_file

_POLICY_META = "policy.json"
_CURVE = "curve.json"
_EVALUATION = "evaluation.json"
_TRAININGS = "trainings.json"


@dataclass(frozen=True)
class Training:
    """One of several trainings of the same policy."""

    job: str
    goes_on: bool
    """Whether it began with a policy that had been trained before."""
    env_steps: int
    """Of the training, and of the episodes by which its beginning, its candidates and its end were measured."""
    kept_after: int
    """Environment steps after which its policy was what is kept of it."""
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
    """A trained policy as it is used: it flattens observations, and scales, clips and, where only whole numbers are
    taken, rounds actions, as its training did."""

    gaussian: GaussianPolicy
    """Its actions are in units of the action space (`action_units`)."""
    environment_id: str
    observation_shape: tuple[int, ...]
    action_low: NDArray[np.float32]
    """In the shape of the action space."""
    action_high: NDArray[np.float32]
    env_steps: int = 0
    """Environment steps of its training."""
    acts_in_integers: bool = False
    """Whether the action space holds whole numbers."""

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
        middle, half = action_units(self.action_low, self.action_high)
        clipped = np.clip(middle + half * actions, self.action_low, self.action_high)
        applied = np.rint(clipped) if self.acts_in_integers else clipped
        return np.asarray(applied[0] if single else applied)

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
        described: dict[str, Any] = {
            "environment": self.environment_id,
            "activation": "tanh",
            "observation_shape": list(self.observation_shape),
            "action_low": self.action_low.tolist(),
            "action_high": self.action_high.tolist(),
            "env_steps": self.env_steps,
        }
        if self.acts_in_integers:
            described["acts_in_integers"] = True
        return {**policy_file(self.gaussian), _POLICY_META: encode_json(described)}

    @classmethod
    def load(cls, artifact: Artifact) -> Self:
        """Read an artifact."""
        described = artifact.json(_POLICY_META)
        return cls(
            gaussian=load_policy(artifact),
            environment_id=described["environment"],
            observation_shape=tuple(described["observation_shape"]),
            action_low=_bounds(described["action_low"], -np.inf),
            action_high=_bounds(described["action_high"], np.inf),
            env_steps=described["env_steps"],
            acts_in_integers=described.get("acts_in_integers", False),
        )


def _bounds(values: Any, unbounded: float) -> NDArray[np.float32]:
    array = np.array(values, np.float32)  # null becomes NaN
    return np.where(np.isnan(array), np.float32(unbounded), array)
