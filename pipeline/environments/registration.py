"""The ids of our environments. Nothing heavy is loaded here but Gymnasium itself.

Gymnasium 1 loads no plugins: an id is known once a module has registered it. It imports oodil by itself for
``gymnasium.make("oodil:oodil/Hopper-v0")``; after ``import oodil`` the plain id will do.
"""

from typing import Any

from gymnasium.envs.registration import register, registry

NAMESPACE = "oodil"
_OURS: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("Hopper-v0", "locomotion:HopperEnv", 1000, {}),
    ("Walker2d-v0", "locomotion:Walker2dEnv", 1000, {}),
    ("HalfCheetah-v0", "locomotion:HalfCheetahEnv", 1000, {}),
    ("Driving-v0", "driving:DrivingEnv", 1000, {}),
    ("Panda-v0", "panda:PandaEnv", 2000, {}),
    ("Panda20Hz-v0", "panda:PandaEnv", 166, {"frame_skip": 12}),
)
"""Name, class, time limit in steps, and arguments."""


def register_environments() -> None:
    """Register what is not registered yet, as ``oodil/NAME``."""
    for name, task, max_episode_steps, arguments in _OURS:
        if f"{NAMESPACE}/{name}" not in registry:
            register(
                f"{NAMESPACE}/{name}",
                entry_point=f"oodil.pipeline.environments.{task}",
                max_episode_steps=max_episode_steps,
                kwargs=arguments,
            )
