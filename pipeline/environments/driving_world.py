"""The world that is driven in: its obstacles and border, where cars start, what they see and touch, and its picture.

Lengths in m, times in s, angles in rad; x to the right, y ahead. Letters: G cars.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


@lru_cache(maxsize=1)
def car_class() -> Any:
    """Return highway-env's vehicle in the size of the car; made when it is first needed: highway-env is an extra."""
    from highway_env.vehicle.kinematics import Vehicle

    return type("Car", (Vehicle,), {"LENGTH": CAR_LENGTH, "WIDTH": CAR_WIDTH})


def things(world: Layout) -> tuple[list[Any], Any]:
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
    obstacles, goal = things(world)
    for thing in (goal, *obstacles):
        RoadObjectGraphics.display(thing, surface, offscreen=True)
    car = car_class()(None, (x, y), heading, world.speed)
    car.color = VehicleGraphics.EGO_COLOR
    VehicleGraphics.display(car, surface, offscreen=True)
    # Pygame's y points down, ours ahead.
    return np.ascontiguousarray(np.flip(pygame.surfarray.array3d(surface).transpose(1, 0, 2), axis=0))


def _resized(thing: Any, box: Box) -> Any:
    thing.LENGTH, thing.WIDTH = box.width, box.depth
    thing.diagonal = np.hypot(box.width, box.depth)
    return thing
