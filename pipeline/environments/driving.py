"""Driving: a car of constant speed steers around two obstacles to a finish strip (the paper's 2-D driving world).

`DrivingEnv` is built of highway-env's vehicle, obstacle and landmark, and draws itself with highway-env's graphics.
`DrivingBatch` computes the same kinematic bicycle and the same touching of rectangles for all cars at once; a property
test holds it to highway-env's classes. What varies is how wide the obstacles are and how fast the car is.

Lengths in m, times in s, angles in rad; x to the right, y ahead. Letters: G cars.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from oodil.pipeline.data import Snapshot
from oodil.pipeline.environments.batch import StepOutcome
from oodil.pipeline.errors import UnusableEnvironmentError

Floats = NDArray[np.float64]

WIDTH, HEIGHT = 60.0, 50.0
"""Of the world; its border ends an episode."""
TIME_STEP = 0.1
CAR_LENGTH, CAR_WIDTH = 2.0, 1.0
OBSTACLE_Y = 25.0
OBSTACLE_DEPTHS = (2.0, 5.0)
OBSTACLE_2_X = 45.0
START_Y = 5.0
STEP_REWARD, GOAL_REWARD, CRASH_REWARD, BORDER_REWARD = -1.0, 500.0, -1100.0, -1000.0
IMITATOR_SPEED = 1.0
"""Velocities are observed in units of the imitator's speed, whoever drives."""


@dataclass(frozen=True)
class Box:
    """A rectangle along the axes."""

    x: float
    y: float
    width: float
    depth: float

    @property
    def left(self) -> float:
        """Return its smallest x."""
        return self.x - self.width / 2

    @property
    def right(self) -> float:
        """Return its largest x."""
        return self.x + self.width / 2


GOAL = Box(WIDTH / 2, 42.5, WIDTH - 2, 1.0)


@dataclass(frozen=True)
class Layout:
    """The obstacles, and the speed of the car."""

    obstacles: tuple[Box, Box]
    speed: float


def layout(obstacle_1: float, obstacle_2: float, speed: float) -> Layout:
    """Return the world for two obstacle widths, given as shares of the world's, and a speed in m/s.

    Raises ValueError outside of (0, 1) and for a speed that is not positive.
    """
    for name, share in (("obstacle_1", obstacle_1), ("obstacle_2", obstacle_2)):
        if not 0 < share < 1:
            raise ValueError(f"{name} is {share}; it is a share of the world's width, between 0 and 1")
    if not 0 < speed < np.inf:
        raise ValueError(f"speed is {speed}; it must be positive and finite (m/s)")
    wide_1, wide_2 = obstacle_1 * WIDTH, obstacle_2 * WIDTH
    first = Box(wide_1 / 2, OBSTACLE_Y, wide_1, OBSTACLE_DEPTHS[0])
    return Layout((first, Box(OBSTACLE_2_X, OBSTACLE_Y, wide_2, OBSTACLE_DEPTHS[1])), speed)


def draw_start(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw x, y and heading: one of three parts of the start line, roughly straight ahead."""
    x = int(rng.integers(3)) * 25 + int(rng.integers(11))
    return float(np.clip(x, 1, WIDTH - 1)), START_Y, np.pi / 2 + rng.uniform(-0.5, 0.5)


def observe(x: Floats, y: Floats, heading: Floats, speed: float) -> Floats:
    """Return (G, 5): position in [-1, 1], velocity in units of the imitator's speed, heading in [-pi/2, 3 pi/2).

    The angle jumps opposite to straight ahead, where no demonstrator drives. The steering is not in it, so states alone
    do not tell the actions.
    """
    units = speed / IMITATOR_SPEED
    turns = np.floor(heading / (2 * np.pi) + 0.25)  # none for an angle that has been observed: it stays as it is
    return np.stack(
        (
            2 * (x / WIDTH - 0.5),
            2 * (y / HEIGHT - 0.5),
            units * np.cos(heading),
            units * np.sin(heading),
            heading - 2 * np.pi * turns,
        ),
        axis=-1,
    )


def positions(observations: NDArray[np.floating]) -> Floats:
    """Return (P, 2) x and y in metres of (P, S) observations."""
    return np.asarray((observations[:, :2].astype(np.float64) / 2 + 0.5) * (WIDTH, HEIGHT))


def touches(x: Floats, y: Floats, heading: Floats, box: Box) -> NDArray[np.bool_]:
    """Return (G,) whether each car and the box overlap: they do unless one of four axes lies between them."""
    dx, dy = np.abs(x - box.x), np.abs(y - box.y)
    cos, sin = np.cos(heading), np.sin(heading)
    long, wide = CAR_LENGTH / 2, CAR_WIDTH / 2
    half_x, half_y = box.width / 2, box.depth / 2
    along_x = dx <= half_x + long * np.abs(cos) + wide * np.abs(sin)
    along_y = dy <= half_y + long * np.abs(sin) + wide * np.abs(cos)
    ahead = np.abs((x - box.x) * cos + (y - box.y) * sin)
    aside = np.abs((y - box.y) * cos - (x - box.x) * sin)
    along_car = ahead <= long + half_x * np.abs(cos) + half_y * np.abs(sin)
    across_car = aside <= wide + half_x * np.abs(sin) + half_y * np.abs(cos)
    return np.asarray(along_x & along_y & along_car & across_car)


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
        self._car = _car_class()(None, (x, y), heading, self.layout.speed)
        self._obstacles, self._goal = _things(self.layout)
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


@lru_cache(maxsize=1)
def _car_class() -> Any:
    # Made when it is first needed: highway-env is an extra.
    from highway_env.vehicle.kinematics import Vehicle

    return type("Car", (Vehicle,), {"LENGTH": CAR_LENGTH, "WIDTH": CAR_WIDTH})


def _things(world: Layout) -> tuple[list[Any], Any]:
    """Return the obstacles and the finish strip as highway-env has them."""
    from highway_env.vehicle.objects import Landmark, Obstacle

    obstacles = [_resized(Obstacle(None, (box.x, box.y)), box) for box in world.obstacles]
    return obstacles, _resized(Landmark(None, (GOAL.x, GOAL.y)), GOAL)


def draw(world: Layout, x: float, y: float, heading: float) -> NDArray[np.uint8]:
    """Return the world with a car as seen from above (height, width, 3)."""
    try:
        import pygame
        from highway_env.road.graphics import RoadObjectGraphics, WorldSurface
        from highway_env.vehicle.graphics import VehicleGraphics
    except ImportError as error:
        raise UnusableEnvironmentError(
            f"driving is drawn by highway-env, and {error.name} is not installed; pip install 'oodil[driving]'"
        ) from error

    scale = 10
    size = (int(WIDTH * scale), int(HEIGHT * scale))
    surface = WorldSurface(size, 0, pygame.Surface(size))
    surface.scaling = scale
    surface.fill(WorldSurface.GREY)
    obstacles, goal = _things(world)
    for thing in (goal, *obstacles):
        RoadObjectGraphics.display(thing, surface, offscreen=True)
    car = _car_class()(None, (x, y), heading, world.speed)
    car.color = VehicleGraphics.EGO_COLOR
    VehicleGraphics.display(car, surface, offscreen=True)
    # Pygame's y points down, ours ahead.
    return np.ascontiguousarray(np.flip(pygame.surfarray.array3d(surface).transpose(1, 0, 2), axis=0))


def _resized(thing: Any, box: Box) -> Any:
    thing.LENGTH, thing.WIDTH = box.width, box.depth
    thing.diagonal = np.hypot(box.width, box.depth)
    return thing


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
