"""Driving: a car of constant speed steers around two obstacles to a finish strip (the paper's 2-D driving world).

`DrivingEnv` is built of highway-env's vehicle, obstacle and landmark, and draws itself with highway-env's graphics.
`DrivingBatch` computes the same kinematic bicycle and the same touching of rectangles for all cars at once; a property
test holds it to highway-env's classes. What varies is how wide the obstacles are and how fast the car is.

Units and axes are those of `oodil.pipeline.environments.driving_world`. Letters: G cars.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from oodil.pipeline.data import Snapshot
from oodil.pipeline.environments.batch import StepOutcome
from oodil.pipeline.environments.driving_world import (
    CAR_LENGTH,
    CAR_WIDTH,
    GOAL,
    HEIGHT,
    IMITATOR_SPEED,
    TIME_STEP,
    WIDTH,
    Floats,
    Layout,
    car_class,
    draw,
    draw_start,
    layout,
    observe,
    things,
    touches,
)

STEP_REWARD, GOAL_REWARD, CRASH_REWARD, BORDER_REWARD = -1.0, 500.0, -1100.0, -1000.0


class DrivingEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """The world with one car, made of highway-env's classes; the action is the steering angle in [-1, 1]."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(
        self, obstacle_1: float = 0.4, obstacle_2: float = 0.25, speed: float = 1.0, render_mode: str | None = None
    ) -> None:
        self.layout = layout(obstacle_1, obstacle_2, speed)
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        fast = speed / IMITATOR_SPEED
        low, high = [-1.1, -1.1, -fast, -fast, -0.5 * np.pi], [1.1, 1.1, fast, fast, 1.5 * np.pi]
        self.observation_space = gymnasium.spaces.Box(np.array(low), np.array(high), dtype=np.float64)
        self._car: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Put a new car on the start line."""
        super().reset(seed=seed)
        x, y, heading = draw_start(self.np_random)
        self._car = car_class()(None, (x, y), heading, self.layout.speed)
        self._obstacles, self._goal = things(self.layout)
        return self._observation(), {}

    def step(self, action: NDArray[np.floating]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Steer for one time step."""
        car = self._car
        car.act({"steering": float(np.clip(np.asarray(action).ravel()[0], -1, 1)), "acceleration": 0.0})
        car.step(TIME_STEP)
        for obstacle in self._obstacles:
            car.handle_collisions(obstacle)
        car.handle_collisions(self._goal)
        x, y = car.position
        outside = not (0 < x < WIDTH and 0 < y < HEIGHT)
        reached = self._goal.hit
        reward = STEP_REWARD + GOAL_REWARD * reached + CRASH_REWARD * car.crashed + BORDER_REWARD * outside
        ended = bool(car.crashed or outside or reached)
        return self._observation(), float(reward), ended, False, {"is_success": bool(reached)}

    def render(self) -> NDArray[np.uint8]:
        """Return the world as seen from above (height, width, 3)."""
        x, y = self._car.position
        return draw(self.layout, x, y, self._car.heading)

    def batched(self, num_simulators: int, max_episode_steps: int) -> "DrivingBatch":
        """Return many cars in this world."""
        return DrivingBatch(self.layout, num_simulators, max_episode_steps)

    def _observation(self) -> Floats:
        x, y, heading = (np.asarray(value) for value in (*self._car.position, self._car.heading))
        return observe(x, y, heading, self.layout.speed)


class DrivingBatch:
    """G cars, each alone in the same world; a `Simulators` whose snapshot is x, y and heading."""

    observation_dim = 5
    action_dim = 1
    steps_per_second = 1 / TIME_STEP

    def __init__(self, world: Layout, num_simulators: int, max_episode_steps: int) -> None:
        self.layout = world
        self.num_simulators = num_simulators
        self.max_episode_steps = max_episode_steps
        self._x, self._y, self._heading = np.zeros((3, num_simulators))
        self._elapsed = np.zeros(num_simulators, np.int64)
        self._returns = np.zeros(num_simulators)

    def observations(self) -> Floats:
        """Return (G, 5) observations of the present states."""
        return observe(self._x, self._y, self._heading, self.layout.speed)

    def reset(self, simulator: int, seed: int) -> None:
        """Put a new car on the start line, where ``gymnasium.make(...).reset(seed=seed)`` would."""
        rng, _ = np_random(seed)
        self._put(simulator, *draw_start(rng))

    def place(self, simulator: int, observation: NDArray[np.floating]) -> None:
        """Put a new car where (5,) is observed; its speed is this world's, whatever was observed."""
        east, north, _, _, heading = observation.astype(np.float64).tolist()
        self._put(simulator, (east / 2 + 0.5) * WIDTH, (north / 2 + 0.5) * HEIGHT, heading)

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) that all do."""
        return np.ones(len(observations), np.bool_)

    def _put(self, simulator: int, x: float, y: float, heading: float) -> None:
        self._x[simulator], self._y[simulator], self._heading[simulator] = x, y, heading
        self._elapsed[simulator] = 0
        self._returns[simulator] = 0.0

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Steer (G, 1) for one time step: the kinematic bicycle of highway-env's Vehicle."""
        slip = np.arctan(0.5 * np.tan(np.clip(actions[:, 0].astype(np.float64), -1, 1)))
        distance = self.layout.speed * TIME_STEP
        self._x += distance * np.cos(self._heading + slip)
        self._y += distance * np.sin(self._heading + slip)
        self._heading += distance * np.sin(slip) / (CAR_LENGTH / 2)
        outside = ~((self._x > 0) & (self._x < WIDTH) & (self._y > 0) & (self._y < HEIGHT))
        first, second = self.layout.obstacles
        car = self._x, self._y, self._heading
        crashed, reached = touches(*car, first) | touches(*car, second), touches(*car, GOAL)
        rewards = STEP_REWARD + GOAL_REWARD * reached + CRASH_REWARD * crashed + BORDER_REWARD * outside
        self._elapsed += 1
        self._returns += rewards
        return StepOutcome(rewards, crashed | outside | reached, self._elapsed >= self.max_episode_steps)

    def demonstrator(self) -> "Driver":
        """Return the hand-written driver of this world."""
        return Driver(self.layout)

    def elapsed_steps(self) -> NDArray[np.int64]:
        """Return (G,) steps since the last reset of each car."""
        return self._elapsed.copy()

    def episode_returns(self) -> Floats:
        """Return (G,) sums of the environment's own reward since the last reset; for evaluation only."""
        return self._returns.copy()

    def snapshot(self) -> Snapshot:
        """Save all cars; `restore` continues from here to the same bits."""
        states = np.stack((self._x, self._y, self._heading), axis=1)
        return Snapshot(states, self._elapsed.copy(), self._returns.copy())

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of a batch of the same size and world."""
        expected = (self.num_simulators, 3)
        if snapshot.states.shape != expected:
            raise ValueError(f"snapshot holds states of shape {snapshot.states.shape}; this batch needs {expected}")
        self._x[:], self._y[:], self._heading[:] = snapshot.states.T
        self._elapsed[:] = snapshot.elapsed_steps
        self._returns[:] = snapshot.episode_returns

    def render(self, simulator: int) -> NDArray[np.uint8]:
        """Return the world of one car as seen from above (height, width, 3)."""
        return draw(self.layout, self._x[simulator], self._y[simulator], self._heading[simulator])

    def close(self) -> None:
        """Nothing is held."""


@dataclass(frozen=True)
class Driver:
    """The hand-written driver: straight ahead in a gap, otherwise towards the nearest edge that leaves room."""

    layout: Layout

    def mean(self, observations: Floats) -> NDArray[np.float32]:
        """Return (G, 1) steering angles for (G, 5) observations."""
        east, north, heading = observations[:, [0, 1, 4]].T
        seen = zip(east, north, np.mod(heading, 2 * np.pi), strict=True)
        return np.array([[self._steer(*row)] for row in seen], np.float32)

    def _steer(self, east: float, north: float, heading: float) -> float:
        """Return the steering angle for a heading in [0, 2 pi)."""
        x, y = (east / 2 + 0.5) * WIDTH, (north / 2 + 0.5) * HEIGHT
        if self._in_gap(x, heading):
            return float(np.clip(self._straighten(heading), -1, 1))
        raw = self._towards_edge(x)
        is_safe = not any(0 <= box.y - y <= 10 for box in self.layout.obstacles)
        sideways = min(heading, abs(np.pi - heading)) < 1e-5
        if is_safe and not 0.1 * np.pi < heading < 0.9 * np.pi:
            raw = 0.0 if sideways else np.pi / 2 - heading
        if not is_safe and (heading < 1e-5 or np.pi - heading < 0.2):
            raw = 0.0
        return float(np.clip(raw, -1, 1))

    def _in_gap(self, x: float, heading: float) -> bool:
        reach = max(CAR_LENGTH / 2 * abs(np.cos(heading)), CAR_WIDTH / 2 * abs(np.sin(heading))) + 0.1
        return all(x + reach < box.left or x - reach > box.right for box in self.layout.obstacles)

    @staticmethod
    def _straighten(heading: float) -> float:
        if np.pi < heading <= 1.5 * np.pi:
            return -1.0
        return (2.5 if heading > 1.5 * np.pi else 0.5) * np.pi - heading

    def _towards_edge(self, x: float) -> float:
        """Return the steering towards the nearest edge with more than 2 m to the wall: left is positive."""
        edges = [(abs(x - box.left), 1.0) for box in self.layout.obstacles if box.left > 2]
        edges += [(abs(x - box.right), -1.0) for box in self.layout.obstacles if box.right < WIDTH - 2]
        distance, side = min(edges)
        widest = max(box.width for box in self.layout.obstacles)
        return side * (distance / widest * np.pi / 2 + 0.1)
