"""Environments: registration with Gymnasium, and batches of simulators for training.

Importing this package registers ours, and so does ``import oodil`` once Gymnasium is there (`registration`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.environments.batch import Simulators, stop_the_clock
from oodil.pipeline.environments.registration import register_environments
from oodil.pipeline.environments.replay import ReplayBatch, box_spaces, can_be_placed, refuse_randomness, unplaceable
from oodil.pipeline.errors import UnusableEnvironmentError

register_environments()


@dataclass(frozen=True)
class EnvironmentSpec:
    """What has to be known of an environment before anything is learned in it."""

    observation_dim: int
    action_dim: int
    max_episode_steps: int
    observation_shape: tuple[int, ...]
    action_low: NDArray[np.float32]
    """In the shape of the action space."""
    action_high: NDArray[np.float32]
    can_be_placed: bool
    """Whether its simulators can be put into an observed state (`Simulators.place`)."""


def environment_spec(env_id: str, dynamics: Mapping[str, float]) -> EnvironmentSpec:
    """Return what a registered environment looks like. Raises UnusableEnvironmentError as `make_batch` does."""
    env, limit = _make(env_id, dynamics)
    seen, action = box_spaces(env)
    low, high = np.asarray(action.low, np.float32), np.asarray(action.high, np.float32)
    placeable = hasattr(env.unwrapped, "batched") or can_be_placed(env)
    return EnvironmentSpec(math.prod(seen.shape), math.prod(action.shape), limit, seen.shape, low, high, placeable)


def make_batch(env_id: str, dynamics: Mapping[str, float], num_simulators: int) -> Simulators:
    """Build a batch of simulators of a registered environment with the given dynamics.

    Our own environments have a fast batched form; any other is stepped through Gymnasium (`ReplayBatch`). An id of the
    form ``module:Id`` imports the module that registers it.

    Raises UnusableEnvironmentError for an id that is not registered, dynamics that the environment does not have, no
    time limit, or spaces that are not boxes.
    """
    env, limit = _make(env_id, dynamics)
    task: Any = env.unwrapped
    if hasattr(task, "batched"):
        batch: Simulators = task.batched(num_simulators, limit)
        return batch
    return ReplayBatch([env, *(_make(env_id, dynamics)[0] for _ in range(num_simulators - 1))], limit)


def check_environment(env_id: str, dynamics: Mapping[str, float]) -> EnvironmentSpec:
    """Return an environment's spec. Raises UnusableEnvironmentError if it cannot be made or is not deterministic."""
    simulators = make_batch(env_id, dynamics, 1)
    if isinstance(simulators, ReplayBatch):
        refuse_randomness(simulators, env_id)
    return environment_spec(env_id, dynamics)


def why_unplaceable(env_id: str, dynamics: Mapping[str, float]) -> str:
    """Return why an environment cannot be put into the states that are observed of it; empty if it can."""
    if not environment_spec(env_id, dynamics).can_be_placed:
        return unplaceable(env_id)
    simulators = make_batch(env_id, dynamics, 1)
    if not simulators.tells_state(simulators.observations()).all():
        return f"what is observed of environment {env_id!r} does not tell its state"
    return ""


def _make(env_id: str, dynamics: Mapping[str, float]) -> tuple[gymnasium.Env[Any, Any], int]:
    """Return an environment and its time limit in steps."""
    stop_the_clock()
    try:
        arguments: dict[str, Any] = dict(dynamics)
        env = gymnasium.make(env_id, disable_env_checker=True, **arguments)
        box_spaces(env)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise UnusableEnvironmentError(f"environment {env_id!r} cannot be made: {error}") from error
    except TypeError as error:
        raise UnusableEnvironmentError(
            f"environment {env_id!r} does not take the dynamics {dict(dynamics)}: {error}"
        ) from error
    except ValueError as error:
        raise UnusableEnvironmentError(f"environment {env_id!r}: {error}") from error
    limit = env.spec.max_episode_steps if env.spec is not None else None
    if limit is None:
        raise UnusableEnvironmentError(f"environment {env_id!r} has no time limit; register it with max_episode_steps")
    return env, limit


__all__ = ["EnvironmentSpec", "Simulators", "check_environment", "environment_spec", "make_batch", "why_unplaceable"]
