"""Environments: registration with Gymnasium, and batches of simulators for training.

Importing this package registers the ids below, and ``gymnasium.make("pipeline.environments:oodil/Hopper-v0",
gravity=12.0)`` imports it by itself.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium

from pipeline.environments.batch import Simulators, Snapshot, stop_the_clock
from pipeline.environments.replay import ReplayBatch, refuse_randomness

_OURS: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("oodil/Hopper-v0", "locomotion:HopperEnv", 1000, {}),
    ("oodil/Walker2d-v0", "locomotion:Walker2dEnv", 1000, {}),
    ("oodil/HalfCheetah-v0", "locomotion:HalfCheetahEnv", 1000, {}),
    ("oodil/Driving-v0", "driving:DrivingEnv", 1000, {}),
    ("oodil/Panda-v0", "panda:PandaEnv", 2000, {}),
    ("oodil/Panda20Hz-v0", "panda:PandaEnv", 166, {"frame_skip": 12}),
)
for _id, _class, _steps, _arguments in _OURS:
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id, entry_point=f"pipeline.environments.{_class}", max_episode_steps=_steps, kwargs=_arguments
        )


def make_batch(env_id: str, dynamics: Mapping[str, float], num_simulators: int) -> Simulators:
    """Build a batch of simulators of a registered environment with the given dynamics.

    Our own environments have a fast batched form; any other is stepped through Gymnasium (`ReplayBatch`). An id of the
    form ``module:Id`` imports the module that registers it.

    Raises ValueError for an id that is not registered, dynamics that the environment does not have, an environment
    without a time limit, or spaces that are no boxes.
    """
    stop_the_clock()
    try:
        arguments: dict[str, Any] = dict(dynamics)
        env = gymnasium.make(env_id, disable_env_checker=True, **arguments)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise ValueError(f"environment {env_id!r} cannot be made: {error}") from error
    except TypeError as error:
        raise ValueError(f"environment {env_id!r} does not take the dynamics {dict(dynamics)}: {error}") from error
    task: Any = env.unwrapped
    limit = env.spec.max_episode_steps if env.spec is not None else None
    if limit is None:
        raise ValueError(f"environment {env_id!r} has no time limit; register it with max_episode_steps")
    if hasattr(task, "batched"):
        batch: Simulators = task.batched(num_simulators, limit)
        return batch
    others = [gymnasium.make(env_id, disable_env_checker=True, **arguments) for _ in range(num_simulators - 1)]
    try:
        return ReplayBatch([env, *others], limit)
    except ValueError as error:
        raise ValueError(f"environment {env_id!r}: {error}") from error


def check_environment(env_id: str, dynamics: Mapping[str, float]) -> Simulators:
    """Return one simulator of an environment. Raises ValueError when it cannot be made or is not deterministic."""
    simulators = make_batch(env_id, dynamics, 1)
    if isinstance(simulators, ReplayBatch):
        refuse_randomness(simulators, env_id)
    return simulators


__all__ = ["Simulators", "Snapshot", "check_environment", "make_batch"]
