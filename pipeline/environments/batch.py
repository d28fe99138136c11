"""Batches of simulators: what all have in common, and what those have that MuJoCo steps.

Letters: G simulators, S observation, A action.
"""

import ctypes
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Snapshot
from oodil.pipeline.environments.pictures import STATE, Painter


@dataclass(frozen=True)
class StepOutcome:
    """What one step of G simulators gives; ``env_rewards`` is never used for imitation."""

    env_rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Simulators(Protocol):
    """G simulators of one task, stepped together; the caller decides when an ended one is reset."""

    num_simulators: int
    max_episode_steps: int
    observation_dim: int
    action_dim: int

    def observations(self) -> NDArray[np.float64]:
        """Return (G, S) observations of the present states."""

    def reset(self, simulator: int, seed: int) -> None:
        """Start a new episode in one simulator."""

    def place(self, simulator: int, observation: NDArray[np.floating]) -> None:
        """Start a new episode in one simulator where (S,) is observed, as far as that tells its state.

        Raises UnusableEnvironmentError for an environment that cannot do it.
        """

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) whether each of (N, S) observations tells the whole state, so that `place` is exact."""

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions for one control step."""

    def elapsed_steps(self) -> NDArray[np.int64]:
        """Return (G,) steps since the last reset of each simulator."""

    def episode_returns(self) -> NDArray[np.float64]:
        """Return (G,) sums of the environment's own reward since the last reset; for evaluation only."""

    def snapshot(self) -> Snapshot:
        """Save all simulators; `restore` continues from here to the same bits."""

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of a batch of the same size and task."""


class VisibleSimulators(Simulators, Protocol):
    """Simulators that can be looked at: all that `make_batch` makes, with Gymnasium's render_mode "rgb_array"."""

    steps_per_second: float
    """Of simulated time."""

    def render(self, simulator: int) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) of one simulator."""

    def close(self) -> None:
        """Free what pictures took."""


def stop_the_clock() -> None:
    """Keep MuJoCo from timing itself: reading the clock for ``MjData.timer`` is a sixth of a step of Hopper.

    The clock is the whole process's, so one that somebody has set stays.
    """
    if mujoco.get_mjcb_time() is None:
        mujoco.set_mjcb_time(ctypes.pythonapi.PyFloat_GetMin)  # native code that returns always the same number


class MujocoBatch(ABC):
    """G simulators of one compiled model, stepped at the speed of raw ``mj_step``; a `Simulators`."""

    observation_dim: int
    steps_per_second: float

    def __init__(self, model: mujoco.MjModel, num_simulators: int, max_episode_steps: int) -> None:
        self.model = model
        self.num_simulators = num_simulators
        self.max_episode_steps = max_episode_steps
        self.action_dim = model.nu
        self._data = [mujoco.MjData(model) for _ in range(num_simulators)]
        self._elapsed = np.zeros(num_simulators, np.int64)
        self._returns = np.zeros(num_simulators)
        self._painter: Painter | None = None

    @abstractmethod
    def observations(self) -> NDArray[np.float64]:
        """Return (G, S) observations of the present states."""

    @abstractmethod
    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) whether each of (N, S) observations tells the whole state, so that `place` is exact."""

    @abstractmethod
    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions for one control step in every simulator."""

    @abstractmethod
    def _start(self, data: mujoco.MjData, seed: int) -> None:
        """Put one simulator where ``gymnasium.make(...).reset(seed=seed)`` would."""

    @abstractmethod
    def _put(self, data: mujoco.MjData, observation: NDArray[np.float64]) -> None:
        """Put one simulator, just reset, where (S,) is observed."""

    @abstractmethod
    def _read(self, simulator: int) -> None:
        """Take over what is observed of a simulator that was put somewhere else."""

    @abstractmethod
    def _new_painter(self) -> Painter:
        """Return what draws pictures of the simulators."""

    def reset(self, simulator: int, seed: int) -> None:
        """Start a new episode in one simulator, as ``gymnasium.make(...).reset(seed=seed)`` would."""
        mujoco.mj_resetData(self.model, self._data[simulator])
        self._start(self._data[simulator], seed)
        self._begin(simulator)

    def place(self, simulator: int, observation: NDArray[np.floating]) -> None:
        """Start a new episode in one simulator where (S,) is observed."""
        mujoco.mj_resetData(self.model, self._data[simulator])
        self._put(self._data[simulator], observation.astype(np.float64))
        self._begin(simulator)

    def _begin(self, simulator: int) -> None:
        self._read(simulator)
        self._elapsed[simulator] = 0
        self._returns[simulator] = 0.0

    def elapsed_steps(self) -> NDArray[np.int64]:
        """Return (G,) steps since the last reset of each simulator."""
        return self._elapsed.copy()

    def episode_returns(self) -> NDArray[np.float64]:
        """Return (G,) sums of the environment's own reward since the last reset; for evaluation only."""
        return self._returns.copy()

    def snapshot(self) -> Snapshot:
        """Save all simulators; `restore` continues from here to the same bits."""
        states = np.empty((self.num_simulators, mujoco.mj_stateSize(self.model, STATE)))
        for row, data in zip(states, self._data, strict=True):
            mujoco.mj_getState(self.model, data, row, STATE)
        return Snapshot(states, self._elapsed.copy(), self._returns.copy())

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of a batch of the same size and model."""
        expected = (self.num_simulators, mujoco.mj_stateSize(self.model, STATE))
        if snapshot.states.shape != expected:
            raise ValueError(f"snapshot holds states of shape {snapshot.states.shape}; this batch needs {expected}")
        for i, data in enumerate(self._data):
            mujoco.mj_setState(self.model, data, snapshot.states[i], STATE)
            self._read(i)
        self._elapsed[:] = snapshot.elapsed_steps
        self._returns[:] = snapshot.episode_returns

    def render(self, simulator: int) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) of one simulator."""
        return self.painter.paint(self._data[simulator])

    @property
    def painter(self) -> Painter:
        """What draws pictures of the simulators."""
        if self._painter is None:
            self._painter = self._new_painter()
        return self._painter

    def close(self) -> None:
        """Free what pictures took."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None
