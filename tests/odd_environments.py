"""Environments as people have them, each with one peculiarity; importing this registers them as ``odd/NAME-v0``."""

import random
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Step = tuple[Any, Any, bool, bool, dict[str, Any]]


class Carts(gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """Three carts on lines; what is observed is where they are and how fast, and episodes have 60 steps."""

    observation_space: Any = spaces.Box(-np.inf, np.inf, (6,), np.float32)
    action_space: Any = spaces.Box(-1.0, 1.0, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.x, self.v = 0, self.np_random.uniform(-1, 1, 3), np.zeros(3)
        return self.seen(), {}

    def seen(self) -> Any:
        return np.concatenate((self.x, self.v)).astype(np.float32)

    def push(self, action: NDArray[Any]) -> NDArray[np.float64]:
        return np.asarray(action, np.float64)

    def step(self, action: Any) -> Step:
        self.t += 1
        self.v = 0.9 * self.v + 0.1 * self.push(action)
        self.x = self.x + 0.1 * self.v
        return self.seen(), -float(np.square(self.x).sum()), False, False, {}


class Newtons(Carts):
    """Pushed with forces of other sizes, to one side only, and without a bound."""

    action_space = spaces.Box(np.array([-600.0, 2.0, -np.inf], np.float32), np.array([200.0, 6.0, 1.0], np.float32))

    def step(self, action: Any) -> Step:
        assert self.action_space.contains(action), action
        self.given = action
        return super().step(action)


class Strong(Carts):
    """Carts that are pushed with forces a thousand times as large, to the same effect."""

    action_space = spaces.Box(-1000.0, 1000.0, (3,), np.float32)

    def push(self, action: NDArray[Any]) -> NDArray[np.float64]:
        return super().push(action) / 1000


class Gears(Newtons):
    """Takes whole numbers."""

    action_space = spaces.Box(-5, 5, (3,), np.int64)


class Leaves(Carts):
    """Ends the process at its third step, as simulators with a window do."""

    def step(self, action: Any) -> Step:
        if self.t == 2:
            raise SystemExit("the simulator left")
        return super().step(action)


class Broadcast(Carts):
    """Declares six numbers and gives two."""

    def seen(self) -> Any:
        return super().seen()[:2]


class LaterColumn(Carts):
    """From step 7 on it gives a column."""

    def seen(self) -> Any:
        return super().seen().reshape(-1, 1) if self.t >= 7 else super().seen()


class Words(Carts):
    def seen(self) -> Any:
        return ["left"] * 6


class Fractions(Carts):
    """Declares whole numbers and gives others."""

    observation_space = spaces.Box(-100, 100, (6,), np.int32)


class Infinite(Carts):
    def seen(self) -> Any:
        return super().seen() + (np.inf if self.t >= 12 else 0)


class NoReward(Carts):
    def step(self, action: Any) -> Step:
        return (*super().step(action)[:1], None, False, False, {})


class Crashes(Carts):
    def step(self, action: Any) -> Step:
        if self.t >= 17:
            raise ConnectionError("no answer from the robot")
        return super().step(action)


class Unseeded(Carts):
    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()


class Bare(Carts):
    """Its reset returns the observation alone."""

    def reset(self, **keywords: Any) -> Any:
        return super().reset(**keywords)[0]


class Four(Carts):
    def step(self, action: Any) -> Any:
        return (*super().step(action)[:2], False, {})


class LateDraw(Carts):
    """A global generator has a say from step 45 on."""

    def push(self, action: NDArray[Any]) -> NDArray[np.float64]:
        return super().push(action) + (random.random() if self.t >= 45 else 0)


class Worn(Carts):
    """What came to step 50 weighs more in every later episode."""

    wear = 0.0

    def push(self, action: NDArray[Any]) -> NDArray[np.float64]:
        self.wear += 1e-4 * (self.t == 50)
        return super().push(action) * (1 - self.wear)


class Far(Carts):
    """Draws once a cart is where random actions do not get it."""

    def push(self, action: NDArray[Any]) -> NDArray[np.float64]:
        return super().push(action) + (random.random() if self.x.max() > 1.3 else 0)


class Tired(Carts):
    """Fails soon after the nine episodes of a trial."""

    steps = 0

    def step(self, action: Any) -> Step:
        Tired.steps += 1
        if Tired.steps > 560:
            raise OSError("no more")
        return super().step(action)


class Blinded(Carts):
    """Sees nothing any more soon after the nine episodes of a trial."""

    steps = 0

    def step(self, action: Any) -> Step:
        Blinded.steps += 1
        return super().step(action)

    def seen(self) -> Any:
        return super().seen() * np.float32(np.nan if Blinded.steps > 560 else 1)


class Single(Carts):
    """One simulator in a process."""

    opened: ClassVar[int] = 0

    def __init__(self) -> None:
        if Single.opened:
            raise OSError("the device is busy")
        Single.opened += 1


class Pixels(Carts):
    observation_space = spaces.Box(0, 255, (12, 10, 3), np.uint8)


class FloatPixels(Carts):
    observation_space = spaces.Box(0.0, 1.0, (3, 20, 16), np.float32)


class Scan(Carts):
    observation_space = spaces.Box(-1.0, 1.0, (1081,), np.float32)


class Named(Carts):
    observation_space = spaces.Dict({"velocity": spaces.Box(-1, 1, (3,)), "place": spaces.Box(-1, 1, (3,))})


class Table(Carts):
    """Two axes, and values that are lists and texts."""

    observation_space = spaces.Box(-np.inf, np.inf, (2, 3), np.float64)

    def __init__(self, substeps: int = 1, start: str = "left", masses: Any = (), options: Any = None) -> None:
        self.arguments = {"substeps": substeps, "start": start, "masses": masses, "options": options}

    def seen(self) -> Any:
        return np.stack((self.x, self.v))

    def step(self, action: Any) -> Step:
        for _ in range(self.arguments["substeps"]):
            outcome = super().step(action)
        return outcome


class OwnEnd(Carts):
    """Ends itself after 40 steps."""

    def step(self, action: Any) -> Step:
        seen, reward, _, _, info = super().step(action)
        return seen, reward, False, self.t >= 40, info


class NoFile(Carts):
    def __init__(self) -> None:
        with open("robots/arm.urdf") as file:
            file.read()


for _kind in Carts.__subclasses__() + Newtons.__subclasses__() + [Carts]:
    if f"odd/{_kind.__name__}-v0" not in gymnasium.registry:
        gymnasium.register(f"odd/{_kind.__name__}-v0", entry_point=_kind, max_episode_steps=60)
for _name, _kind, _limit in (("Long-v0", OwnEnd, 10**9), ("Endless-v0", Carts, 10**7)):
    if f"odd/{_name}" not in gymnasium.registry:
        gymnasium.register(f"odd/{_name}", entry_point=_kind, max_episode_steps=_limit)
