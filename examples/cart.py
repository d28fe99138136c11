"""An environment of your own: a cart on a rail that is pushed by a force in newtons, and observes a dictionary.

A run finds it as ``environment: {id: cart:Cart-v0, dynamics: {mass: 900.0}}``, wherever ``import cart`` works.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.wrappers import FlattenObservation

FORCE, TIME_STEP, START = 2000.0, 0.05, 4.0
"""N, s, m."""


class CartEnv(gymnasium.Env[Any, np.ndarray]):
    """A cart to be brought to rest in the middle. Its mass, in kg, is what differs between robots."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, mass: float = 900.0, render_mode: str | None = None) -> None:
        self.mass = mass
        self.render_mode = render_mode
        self.action_space = Box(-FORCE, FORCE, (1,), np.float32)
        self.observation_space = Dict({name: Box(-np.inf, np.inf, (1,), np.float64) for name in ("place", "speed")})
        self._place = self._speed = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Put the cart somewhere; whatever is drawn at random comes from ``self.np_random``."""
        super().reset(seed=seed)
        self._place, self._speed = self.np_random.uniform(-START, START), 0.0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Push for one time step. The reward is for reports alone; nothing learns from it."""
        self._speed += float(action[0]) / self.mass * TIME_STEP
        self._place += self._speed * TIME_STEP
        return self._observation(), -abs(self._place), False, False, {}

    def render(self) -> np.ndarray:
        """Return a picture (height, width, 3): the cart, and where it should come to rest."""
        picture = np.full((96, 480, 3), 255, np.uint8)
        picture[:, 239:241] = 160
        at = int(240 + 24 * np.clip(self._place, -9, 9))
        picture[40:72, at - 20 : at + 20] = (40, 90, 160)
        return picture

    def _observation(self) -> dict[str, np.ndarray]:
        return {"place": np.array([self._place]), "speed": np.array([self._speed])}


def make(**dynamics: Any) -> gymnasium.Env[Any, Any]:
    """Return the environment as oodil needs it: observations are one vector, here ``(place, speed)``."""
    return FlattenObservation(CartEnv(**dynamics))


gymnasium.register("Cart-v0", entry_point=make, max_episode_steps=100)
