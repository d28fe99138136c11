"""One Gymnasium environment that is not ours: what it is given, and what it gives, held to its declared spaces.

It takes actions in units of its action space (`oodil.pipeline.policy.action_units`), and remembers the episode it is
in, so that it can be played again and compared with what was seen.

Letters: S observation, A action, T steps of the episode so far.
"""

import struct
import weakref
import zlib
from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.environments.pictures import checked, follow
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.policy import action_units

STEPS_PER_SECOND = 30
"""Of a film of an environment that does not say how fast it is."""
LONGEST_OBSERVATION = 1_000
"""Numbers that are observed; more are an image or the like, which small networks do not learn from."""
_LARGEST = float(np.finfo(np.float32).max)
_OLD_INTERFACE = (
    "; that is how environments of Gym before 0.26 did it. Gymnasium's have `reset(self, *, seed=None, options=None)`, "
    "which returns (observation, info), and `step`, which returns (observation, reward, terminated, truncated, info)"
)


def box_spaces(env: gymnasium.Env[Any, Any]) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return observation and action space. Raises ValueError unless both are boxes that can be learned with."""
    seen, action = env.observation_space, env.action_space
    if isinstance(seen, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
        parts = list(seen.spaces) if isinstance(seen, gymnasium.spaces.Dict) else range(len(seen.spaces))
        raise ValueError(
            f"the observation space is {seen}; only Box spaces can be used. Register the environment with "
            "gymnasium.wrappers.FlattenObservation around it; a state then is, in this order, "
            + ", ".join(str(part) for part in parts)
        )
    for what, space in (("observation", seen), ("action", action)):
        if not isinstance(space, gymnasium.spaces.Box):
            raise ValueError(f"the {what} space is {space}; only Box spaces can be used")
        if not np.prod(space.shape):
            raise ValueError(f"the {what} space has the shape {space.shape}, which is no number at all")
    assert isinstance(seen, gymnasium.spaces.Box) and isinstance(action, gymnasium.spaces.Box)
    size = int(np.prod(seen.shape))
    what = f"{seen.dtype} of shape {seen.shape}, {size} numbers"
    if _is_image(seen):
        raise ValueError(
            f"observations are images ({what}), which cannot be learned from; let the environment observe its state, "
            "or what a trained encoder makes of the image"
        )
    if size > LONGEST_OBSERVATION:
        raise ValueError(
            f"observations are {what}; at most {LONGEST_OBSERVATION} can be learned from. Let the environment observe "
            "its state alone"
        )
    return seen, action


def _is_image(space: gymnasium.spaces.Box) -> bool:
    """Return whether a space is one of bytes in two axes or more, or has rows, columns and channels."""
    as_bytes = space.dtype == np.uint8 and len(space.shape) >= 2
    return as_bytes or (len(space.shape) >= 3 and sorted(space.shape)[-2] >= 8)


def takes_integers(space: gymnasium.spaces.Box) -> bool:
    """Return whether a space holds whole numbers; what is between them is rounded."""
    return np.dtype(space.dtype).kind in "iu"


def can_be_placed(env: gymnasium.Env[Any, Any]) -> bool:
    """Return whether an environment has a method ``place(observation)``, which returns what it then observes."""
    return hasattr(env.unwrapped, "place")


def unplaceable(env_id: str) -> str:
    """Say that an environment cannot be placed."""
    return f"environment {env_id!r} cannot be put into an observed state: its class has no method place(observation)"


def _close(env: gymnasium.Env[Any, Any]) -> None:
    with suppress(Exception):
        env.close()


class ForeignEnvironment:
    """A Gymnasium environment and the episode that it is in.

    What it returns against its declared spaces raises UnusableEnvironmentError. An exception of its own becomes a
    RuntimeError, and a number that is not finite a FloatingPointError. All name the environment and the step.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], env_id: str) -> None:
        """Take over an environment. Raises ValueError unless both spaces are boxes that can be learned with."""
        self.env_id = env_id
        self._env = env
        self._seen, self._space = box_spaces(env)
        self._low, self._high = (np.asarray(bound, np.float64) for bound in (self._space.low, self._space.high))
        self._middle, self._half = action_units(self._low, self._high)
        self._acts_in_integers = takes_integers(self._space)
        self._kinds = "biu" if np.dtype(self._seen.dtype).kind in "biu" else "biuf"
        self._closing = weakref.finalize(self, _close, env)
        self._closing.atexit = False
        self.observation_dim = int(np.prod(self._seen.shape))
        self.action_dim = int(np.prod(self._space.shape))
        self.can_be_placed = can_be_placed(env)
        self.steps_per_second = float(env.metadata.get("render_fps") or STEPS_PER_SECOND)
        if hasattr(env.unwrapped, "mujoco_renderer"):
            follow(env.unwrapped.mujoco_renderer)
        # A row is a seed, a mark of what was seen at first, and an action and a mark of what it led to for each step.
        # One that can be placed has room in between for where it was placed; its seed is -1 then.
        self._before_steps = 2 + self.observation_dim * self.can_be_placed
        self._row = np.zeros(self._before_steps + 64 * (self.action_dim + 1))
        self.observation = np.zeros(self.observation_dim)
        self.elapsed = 0
        self.env_return = 0.0
        self.terminated, self.truncated = False, True
        self._is_sound = False
        """Whether it stands where the history ends; not so after an exception in the middle of a step."""

    def reset(self, seed: int) -> None:
        """Start a new episode with a seed of at most 2**53."""
        seen = self._reset(seed)
        self._begin(seen, seed)

    def place(self, observation: NDArray[np.float64]) -> None:
        """Start a new episode where (S,) is observed. Raises UnusableEnvironmentError if that cannot be done."""
        if not self.can_be_placed:
            raise UnusableEnvironmentError(unplaceable(self.env_id))
        self._reset(0)  # Wrappers count an episode's steps from its reset.
        task: Any = self._env.unwrapped
        try:
            seen = task.place(observation.reshape(self._seen.shape))
        except Exception as error:
            raise RuntimeError(f"{self._at(0)}: place raised {type(error).__name__}: {error}") from error
        self._begin(self._checked(seen, 0), -1)
        self._row[2 : self._before_steps] = observation

    def step(self, action: NDArray[np.float32]) -> float:
        """Apply an action (A,), in units of the action space and clipped to it, and return the reward."""
        number, self._is_sound = self.elapsed + 1, False
        try:
            outcome = self._env.step(self._applied(action))
        except (Exception, SystemExit) as error:
            hint = _OLD_INTERFACE if "values to unpack" in str(error) else ""
            raise RuntimeError(f"{self._at(number)}: raised {type(error).__name__}: {error}{hint}") from error
        if not isinstance(outcome, tuple) or len(outcome) != 5:
            raise UnusableEnvironmentError(f"{self._at(number)}: step returned {_kind(outcome)}{_OLD_INTERFACE}")
        seen, reward, terminated, truncated, _ = outcome
        self.observation = self._checked(seen, number)
        paid = np.asarray(reward)
        if paid.size != 1 or paid.dtype.kind not in "biuf":
            raise UnusableEnvironmentError(f"{self._at(number)}: the reward is {reward!r}, which is no number")
        gained = float(paid.item())
        begin = self._before_steps + self.elapsed * (self.action_dim + 1)
        if begin == len(self._row):
            self._row = np.concatenate((self._row, np.zeros(begin - self._before_steps)))
        self.terminated, self.truncated = bool(terminated), bool(truncated)
        self._row[begin : begin + self.action_dim] = action
        self._row[begin + self.action_dim] = _mark(self.observation, gained, self.terminated, self.truncated)
        self.elapsed, self._is_sound = number, True
        self.env_return += gained
        return gained

    def history(self) -> NDArray[np.float64]:
        """Return the episode so far, as long as it is; see `replay`."""
        return self._row[: self._before_steps + self.elapsed * (self.action_dim + 1)].copy()

    def stands_at(self, history: NDArray[np.float64], elapsed: int) -> bool:
        """Return whether a history of some steps is that of the present episode; it may be longer."""
        own = self.history()
        return self._is_sound and elapsed == self.elapsed and history[: len(own)].tobytes() == own.tobytes()

    def replay(self, history: NDArray[np.float64], elapsed: int) -> None:
        """Play an episode again. Raises UnusableEnvironmentError, with the step, if it differs from what was seen."""
        if history[0] < 0:
            self.place(history[2 : self._before_steps])
        else:
            self.reset(int(history[0]))
        steps = history[self._before_steps :].reshape(-1, self.action_dim + 1)[:elapsed]
        self._refuse_other(history[1], self._row[1], elapsed)
        for step in steps:
            self.step(step[:-1].astype(np.float32))
            end = self._before_steps + self.elapsed * (self.action_dim + 1)
            self._refuse_other(step[-1], self._row[end - 1], elapsed)

    def render(self) -> NDArray[np.uint8]:
        """Return what it draws (height, width, 3).

        Raises UnusableEnvironmentError if that is no picture, or if something to draw with is not installed.
        """
        try:
            return checked(self._env.render())
        except (TypeError, ImportError, gymnasium.error.DependencyNotInstalled) as error:
            raise UnusableEnvironmentError(f"environment {self.env_id!r} cannot be filmed: {error}") from error

    def close(self) -> None:
        """Let go of what it holds; one that fails to do so is let go of anyway. It is also done when nobody is left."""
        self._closing()

    def _refuse_other(self, mark: float, again: float, length: int) -> None:
        if mark != again:
            raise UnusableEnvironmentError(
                f"environment {self.env_id!r} is not deterministic: an episode of {length} steps, played again from "
                f"the same start with the same actions, differed at step {self.elapsed}; it must draw from "
                "self.np_random alone, and reset must leave nothing of the episode before"
            )

    def _reset(self, seed: int) -> NDArray[np.float64]:
        self._is_sound = False
        try:
            outcome = self._env.reset(seed=seed)
        except (Exception, SystemExit) as error:
            hint = _OLD_INTERFACE if isinstance(error, TypeError) and "keyword argument" in str(error) else ""
            raise RuntimeError(f"{self._at(0)}: reset raised {type(error).__name__}: {error}{hint}") from error
        if not isinstance(outcome, tuple) or len(outcome) != 2 or not isinstance(outcome[1], dict):
            raise UnusableEnvironmentError(f"{self._at(0)}: reset returned {_kind(outcome)}{_OLD_INTERFACE}")
        return self._checked(outcome[0], 0)

    def _begin(self, seen: NDArray[np.float64], seed: int) -> None:
        self.observation = seen
        self._row[0], self._row[1] = seed, _mark(seen, 0.0, False, False)
        self.elapsed, self.env_return, self._is_sound = 0, 0.0, True
        self.terminated = self.truncated = False

    def _applied(self, action: NDArray[np.float32]) -> NDArray[Any]:
        """Return what the environment is given for an action in units (A,)."""
        wanted = np.clip(self._middle + self._half * action.reshape(self._space.shape), self._low, self._high)
        return np.asarray(np.rint(wanted) if self._acts_in_integers else wanted).astype(self._space.dtype)

    def _checked(self, observation: Any, number: int) -> NDArray[np.float64]:
        """Return what is observed after a step, flattened, if it is what the space declares."""
        try:
            seen = np.asarray(observation)
        except ValueError:
            seen = np.asarray(None)  # Lists of unequal length, which no space declares.
        space = self._seen
        if seen.dtype.kind not in self._kinds:
            found = f"{seen.dtype} numbers" if seen.dtype.kind == "f" else _kind(observation)
            raise UnusableEnvironmentError(
                f"{self._at(number)}: it observes {found}, but its observation space declares {space.dtype}"
            )
        if seen.shape != space.shape:
            raise UnusableEnvironmentError(
                f"{self._at(number)}: it observes an array of shape {seen.shape}, but its observation space declares "
                f"{space.shape}"
            )
        flat = seen.astype(np.float64).ravel()
        if not (np.abs(flat) <= _LARGEST).all():
            raise FloatingPointError(f"{self._at(number)}: gave an observation that is not finite: {seen}")
        return flat

    def _at(self, number: int) -> str:
        return f"environment {self.env_id!r}, " + (f"step {number} of an episode" if number else "start of an episode")


def _mark(seen: NDArray[np.float64], reward: float, terminated: bool, truncated: bool) -> float:
    """Return a number that tells what a step gave from anything else that it could have given."""
    return float(zlib.crc32(seen.tobytes() + struct.pack("<d??", reward, terminated, truncated)))


def _kind(value: Any) -> str:
    return f"{len(value)} values" if isinstance(value, tuple) else f"a {type(value).__name__}"
