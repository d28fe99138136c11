"""Environments: registration with Gymnasium, and batches of simulators for training.

Importing this package registers the ids below, and ``gymnasium.make("pipeline.environments:oodil/Hopper-v0",
gravity=12.0)`` imports it by itself.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium

from pipeline.environments.batch import MujocoBatch, Snapshot

MAX_EPISODE_STEPS = 1000

for _id, _class in {
    "oodil/Hopper-v0": "HopperEnv",
    "oodil/Walker2d-v0": "Walker2dEnv",
    "oodil/HalfCheetah-v0": "HalfCheetahEnv",
}.items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id, entry_point=f"pipeline.environments.mujoco:{_class}", max_episode_steps=MAX_EPISODE_STEPS
        )


def make_batch(env_id: str, dynamics: Mapping[str, float], num_simulators: int) -> MujocoBatch:
    """Build a batch of simulators of a registered environment with the given dynamics.

    Raises ValueError for an id that is not registered, dynamics that the environment does not have, or a task without
    a batched form.
    """
    try:
        arguments: dict[str, Any] = dict(dynamics)
        env = gymnasium.make(env_id, **arguments)
    except gymnasium.error.Error as error:
        raise ValueError(f"environment {env_id!r} cannot be made: {error}") from error
    except TypeError as error:
        raise ValueError(f"environment {env_id!r} does not take the dynamics {dict(dynamics)}: {error}") from error
    task: Any = env.unwrapped
    if not hasattr(task, "batch_healthy"):
        raise ValueError(f"environment {env_id!r} has no batched form; those that have are {', '.join(batched_ids())}")
    assert env.spec is not None and env.spec.max_episode_steps is not None
    return MujocoBatch(task, num_simulators, env.spec.max_episode_steps)


def batched_ids() -> list[str]:
    """Return the ids of the environments that have a batched form."""
    return sorted(env_id for env_id in gymnasium.registry if env_id.startswith("oodil/"))


__all__ = ["MujocoBatch", "Snapshot", "batched_ids", "make_batch"]
