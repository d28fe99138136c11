"""Batches of simulators: what all have in common, and MuJoCo's at the speed of raw ``mj_step``.

Letters: G simulators, S observation, A action. A MuJoCo batch agrees to the last bit with one Gymnasium environment per
simulator, and can be saved and restored in the middle of an episode: `mjSTATE_INTEGRATION` holds all that the next step
depends on (`mjSTATE_FULLPHYSICS` does not: it leaves out the solver's warm start).
"""

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from pipeline.environments.mujoco import BatchedTask

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(frozen=True)
class Snapshot:
    """Everything that the future of G simulators depends on."""

    states: NDArray[np.float64]
    """(G, N); what it means is the batch's own affair. MuJoCo's integration states, or a seed and actions."""
    elapsed_steps: NDArray[np.int64]
    """(G,) steps since the last reset."""
    episode_returns: NDArray[np.float64]
    """(G,) sum of the environment's own reward since the last reset; for evaluation only."""


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


class MujocoBatch:
    """G simulators of one locomotion task; the caller decides when an ended one is reset."""

    def __init__(self, env: BatchedTask, num_simulators: int, max_episode_steps: int) -> None:
        self.env = env
        self.num_simulators = num_simulators
        self.max_episode_steps = max_episode_steps
        self.model = env.model
        self._data = [mujoco.MjData(self.model) for _ in range(num_simulators)]
        # Views into MuJoCo's memory, fetched once: every attribute access on MjData costs as much as a copy.
        self._controls = [data.ctrl for data in self._data]
        self._positions = [data.qpos for data in self._data]
        self._velocities = [data.qvel for data in self._data]
        nq, nv = self.model.nq, self.model.nv
        self._states = np.zeros((num_simulators, nq + nv))
        self._qpos, self._qvel = self._states[:, :nq], self._states[:, nq:]
        self._healthy_above, self._healthy_below = env.healthy_bounds()
        self._elapsed = np.zeros(num_simulators, np.int64)
        self._returns = np.zeros(num_simulators)
        self.observation_dim = nq + nv
        self.action_dim = self.model.nu

    def observations(self) -> NDArray[np.float64]:
        """Return (G, S) observations of the present states."""
        states, limit = self._states.copy(), self.env.velocity_limit
        if limit < np.inf:
            velocities = states[:, self.model.nq :]
            np.minimum(np.maximum(velocities, -limit, out=velocities), limit, out=velocities)
        return states

    def reset(self, simulator: int, seed: int) -> None:
        """Start a new episode in one simulator, as ``gymnasium.make(...).reset(seed=seed)`` would."""
        rng, _ = np_random(seed)
        scale = self.env._reset_noise_scale
        data = self._data[simulator]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = self.env.init_qpos + rng.uniform(low=-scale, high=scale, size=self.model.nq)
        data.qvel[:] = self.env.reset_velocity(rng)
        mujoco.mj_forward(self.model, data)
        self._read(simulator)
        self._elapsed[simulator] = 0
        self._returns[simulator] = 0.0

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions for one control step in every simulator."""
        x_before = self._qpos[:, 0].copy()
        model, frame_skip, step = self.model, self.env.frame_skip, mujoco.mj_step
        qpos, qvel = self._qpos, self._qvel
        for i, data in enumerate(self._data):
            self._controls[i][:] = actions[i]
            step(model, data, frame_skip)
            qpos[i] = self._positions[i]
            qvel[i] = self._velocities[i]
        return self._outcome(x_before, actions)

    def _outcome(self, x_before: NDArray[np.float64], actions: NDArray[np.floating]) -> StepOutcome:
        # The order of the operations follows Gymnasium's, so that the bits do too.
        env = self.env
        inside = (self._healthy_above < self._states) & (self._states < self._healthy_below)
        healthy = np.asarray(inside.all(axis=1))
        rewards = env._forward_reward_weight * ((self._qpos[:, 0] - x_before) / env.dt)
        rewards = rewards + healthy * env._healthy_reward
        rewards = rewards - env._ctrl_cost_weight * np.square(actions).sum(axis=1)
        terminated = ~healthy & env._terminate_when_unhealthy
        self._elapsed += 1
        self._returns += rewards
        return StepOutcome(rewards, terminated, self._elapsed >= self.max_episode_steps)

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

    def _read(self, simulator: int) -> None:
        self._qpos[simulator] = self._positions[simulator]
        self._qvel[simulator] = self._velocities[simulator]
