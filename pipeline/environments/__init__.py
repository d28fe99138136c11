"""Environments: registration with Gymnasium, and batches of simulators for training.

``gymnasium.make("oodil/Hopper-v0", gravity=12.0)`` works wherever oodil is installed (`registration`).
"""

from collections.abc import Mapping
from typing import Any

import gymnasium

from oodil.pipeline.environments.batch import Simulators, stop_the_clock
from oodil.pipeline.environments.registration import register_environments
from oodil.pipeline.environments.replay import ReplayBatch, refuse_randomness
from oodil.pipeline.errors import UnusableEnvironmentError

# An installed oodil is registered by its entry point; one that is only on the path is not.
register_environments()


def make_batch(env_id: str, dynamics: Mapping[str, float], num_simulators: int) -> Simulators:
    """Build a batch of simulators of a registered environment with the given dynamics.

    Our own environments have a fast batched form; any other is stepped through Gymnasium (`ReplayBatch`). An id of the
    form ``module:Id`` imports the module that registers it.

    Raises UnusableEnvironmentError for an id that is not registered, dynamics that the environment does not have, no
    time limit, or spaces that are not boxes.
    """
    stop_the_clock()
    try:
        arguments: dict[str, Any] = dict(dynamics)
        env = gymnasium.make(env_id, disable_env_checker=True, **arguments)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise UnusableEnvironmentError(f"environment {env_id!r} cannot be made: {error}") from error
    except TypeError as error:
        raise UnusableEnvironmentError(
            f"environment {env_id!r} does not take the dynamics {dict(dynamics)}: {error}"
        ) from error
    except ValueError as error:
        raise UnusableEnvironmentError(f"environment {env_id!r}: {error}") from error
    task: Any = env.unwrapped
    limit = env.spec.max_episode_steps if env.spec is not None else None
    if limit is None:
        raise UnusableEnvironmentError(f"environment {env_id!r} has no time limit; register it with max_episode_steps")
    if hasattr(task, "batched"):
        batch: Simulators = task.batched(num_simulators, limit)
        return batch
    others = [gymnasium.make(env_id, disable_env_checker=True, **arguments) for _ in range(num_simulators - 1)]
    try:
        return ReplayBatch([env, *others], limit)
    except ValueError as error:
        raise UnusableEnvironmentError(f"environment {env_id!r}: {error}") from error


def check_environment(env_id: str, dynamics: Mapping[str, float]) -> Simulators:
    """Return one simulator. Raises UnusableEnvironmentError when it cannot be made or is not deterministic."""
    simulators = make_batch(env_id, dynamics, 1)
    if isinstance(simulators, ReplayBatch):
        refuse_randomness(simulators, env_id)
    return simulators


__all__ = ["Simulators", "check_environment", "make_batch"]
