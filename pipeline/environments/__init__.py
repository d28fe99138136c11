"""Environments: registration with Gymnasium, and batches of simulators for training.

Importing this package registers ours, and so does ``import oodil`` once Gymnasium is there (`registration`).
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import find_highest_version, get_env_id, parse_env_id
from numpy.typing import NDArray

from oodil.pipeline.environments.batch import Simulators, stop_the_clock
from oodil.pipeline.environments.foreign import (
    ForeignEnvironment,
    box_spaces,
    can_be_placed,
    takes_integers,
    unplaceable,
)
from oodil.pipeline.environments.registration import register_environments
from oodil.pipeline.environments.replay import ReplayBatch, refuse_randomness
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.policy import has_bounds

register_environments()


@dataclass(frozen=True)
class EnvironmentSpec:
    """What has to be known of an environment before anything is learned in it."""

    observation_dim: int
    action_dim: int
    max_episode_steps: int
    observation_shape: tuple[int, ...]
    action_low: NDArray[np.float32]
    """In the shape of the action space, and in its own numbers."""
    action_high: NDArray[np.float32]
    acts_in_integers: bool
    """Whether the action space holds whole numbers."""
    can_be_placed: bool
    """Whether its simulators can be put into an observed state (`Simulators.place`)."""

    def bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the (A,) lowest and highest action in units of the action space, in which simulators take them."""
        bounded = has_bounds(self.action_low, self.action_high)
        low, high = np.where(bounded, -1, self.action_low), np.where(bounded, 1, self.action_high)
        return low.ravel().astype(np.float32), high.ravel().astype(np.float32)


def environment_spec(env_id: str, dynamics: Mapping[str, Any]) -> EnvironmentSpec:
    """Return what a registered environment looks like. Raises UnusableEnvironmentError as `make_batch` does."""
    env, limit = _make(env_id, dynamics)
    seen, action = box_spaces(env)
    low, high = np.asarray(action.low, np.float32), np.asarray(action.high, np.float32)
    placeable, whole = hasattr(env.unwrapped, "batched") or can_be_placed(env), takes_integers(action)
    env.close()
    return EnvironmentSpec(
        math.prod(seen.shape), math.prod(action.shape), limit, seen.shape, low, high, whole, placeable
    )


def make_batch(env_id: str, dynamics: Mapping[str, Any], num_simulators: int) -> Simulators:
    """Build a batch of simulators of a registered environment with the given dynamics.

    Our own environments have a fast batched form, whose actions lie in [-1, 1]; any other is stepped through Gymnasium
    (`ReplayBatch`). An id of the form ``module:Id`` imports the module that registers it.

    Raises UnusableEnvironmentError for an id that is not registered, dynamics that the environment does not have, no
    time limit, or spaces that cannot be learned with.
    """
    env, limit = _make(env_id, dynamics)
    task: Any = env.unwrapped
    if hasattr(task, "batched"):
        batch: Simulators = task.batched(num_simulators, limit)
        return batch
    others = (_make(env_id, dynamics)[0] for _ in range(num_simulators - 1))
    return ReplayBatch([ForeignEnvironment(each, env_id) for each in (env, *others)], limit)


def check_environment(env_id: str, dynamics: Mapping[str, Any]) -> EnvironmentSpec:
    """Return an environment's spec, once two of it have been tried side by side, unless it is ours.

    Raises UnusableEnvironmentError if it cannot be made, does not do what it declares, or is not deterministic.
    """
    env, limit = _make(env_id, dynamics)
    if not hasattr(env.unwrapped, "batched"):
        pair = [ForeignEnvironment(each, env_id) for each in (env, _make(env_id, dynamics)[0])]
        try:
            refuse_randomness(pair[0], pair[1], limit)
        except (RuntimeError, FloatingPointError) as error:
            raise UnusableEnvironmentError(str(error)) from error
        finally:
            for each in pair:
                each.close()
    return environment_spec(env_id, dynamics)


def why_unplaceable(env_id: str, dynamics: Mapping[str, Any]) -> str:
    """Return why an environment cannot be put into the states that are observed of it; empty if it can."""
    if not environment_spec(env_id, dynamics).can_be_placed:
        return unplaceable(env_id)
    simulators = make_batch(env_id, dynamics, 1)
    if not simulators.tells_state(simulators.observations()).all():
        return f"what is observed of environment {env_id!r} does not tell its state"
    return ""


_MADE: set[str] = set()
"""Environments that could be made in this process."""


def _make(env_id: str, dynamics: Mapping[str, Any]) -> tuple[gymnasium.Env[Any, Any], int]:
    """Return an environment and its time limit in steps."""
    stop_the_clock()
    try:
        arguments: dict[str, Any] = dict(dynamics)
        env = gymnasium.make(env_id, disable_env_checker=True, **arguments)
        box_spaces(env)
    except TypeError as error:
        raise UnusableEnvironmentError(
            f"environment {env_id!r} does not take the dynamics {dict(dynamics)}: {error}"
        ) from error
    except ValueError as error:
        raise UnusableEnvironmentError(f"environment {env_id!r}: {error}") from error
    except Exception as error:
        raise UnusableEnvironmentError(f"environment {env_id!r} {_why_unmade(env_id, error)}") from error
    limit = env.spec.max_episode_steps if env.spec is not None else None
    if limit is None:
        raise UnusableEnvironmentError(
            f"environment {env_id!r} has no time limit; register it with max_episode_steps, or set one, as in "
            "dynamics: {max_episode_steps: 1000}"
        )
    _MADE.add(env_id)
    return env, limit


def _why_unmade(env_id: str, error: Exception) -> str:
    """Return what went wrong when an environment was made, and what to do about it where that is known."""
    said = str(error) if isinstance(error, gymnasium.error.Error) else f"{type(error).__name__}: {error}"
    if isinstance(error, ModuleNotFoundError):
        module = env_id.partition(":")[0].partition(".")[0]
        is_own = f"No module named '{module}'" in said
        hint = (
            f"; {module} has to lie beside the configuration file or, for oodil demos convert, in the current folder, "
            "or on PYTHONPATH"
        ) * is_own
    elif isinstance(error, ImportError) and (newer := _newest(env_id)):
        hint = f"; there is {newer}"
    elif isinstance(error, gymnasium.error.UnregisteredEnv) and ":" not in env_id:
        hint = f"; one that a module of yours registers is called MODULE:{env_id}"
    elif isinstance(error, FileNotFoundError) and error.filename and not os.path.isabs(error.filename):
        hint = (
            f"; it is looked for in {os.getcwd()}, where the program was started: let the environment find its files "
            "beside its own, as in Path(__file__).with_name(...)"
        )
    elif env_id in _MADE:
        return (
            f"can be made only once in a process ({said}), but simulators stand side by side in one, for training and "
            "for evaluation: it cannot be used unless its class can be made several times"
        )
    else:
        hint = ""
    return f"cannot be made: {said}{hint}"


def _newest(env_id: str) -> str:
    """Return the id of the newest version of an environment if that is another one, else nothing."""
    namespace, name, version = parse_env_id(env_id.rpartition(":")[2])
    newest = find_highest_version(namespace, name)
    return "" if newest in (None, version) else get_env_id(namespace, name, newest)


__all__ = ["EnvironmentSpec", "Simulators", "check_environment", "environment_spec", "make_batch", "why_unplaceable"]
