"""Gymnasium's v5 locomotion tasks with their dynamics as keyword arguments.

The observation is ``[qpos, qvel]`` with root x, as the paper's experiments use it. Dynamics are set on the compiled
model, so no XML is copied. Each class also states what `LocomotionBatch` needs to step many of them: its health rule
for a whole batch, and how it draws the initial velocity. The batch agrees to the last bit with one Gymnasium
environment per simulator.
"""

from collections.abc import Mapping
from typing import Any, Protocol

import mujoco
import numpy as np
from gymnasium.envs.mujoco import half_cheetah_v5, hopper_v5, walker2d_v5
from gymnasium.utils import EzPickle
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from oodil.pipeline.environments.batch import MujocoBatch, StepOutcome
from oodil.pipeline.environments.pictures import Painter, follow

Floats = NDArray[np.float64]


class Task(Protocol):
    """What a locomotion task says of itself; the names with an underscore are Gymnasium's own."""

    model: mujoco.MjModel
    frame_skip: int
    init_qpos: Floats
    velocity_limit: float
    """Velocities are clipped to it in the observation."""
    camera: Mapping[str, Any]
    """Attributes of the camera that draws pictures."""
    _reset_noise_scale: float
    _forward_reward_weight: float
    _ctrl_cost_weight: float
    _healthy_reward: float
    _terminate_when_unhealthy: bool

    @property
    def dt(self) -> float:
        """Seconds per control step."""

    def healthy_bounds(self) -> tuple[Floats, Floats]:
        """Return two (nq + nv,) vectors: a healthy state ``[qpos, qvel]`` lies strictly between them."""

    def reset_velocity(self, rng: np.random.Generator) -> Floats:
        """Draw the initial velocity (nv,) exactly as Gymnasium's reset does."""


def _uniform_velocity(task: "HopperEnv | Walker2dEnv", rng: np.random.Generator) -> Floats:
    scale = task._reset_noise_scale
    return task.init_qvel + rng.uniform(low=-scale, high=scale, size=task.model.nv)


def _no_bounds(task: Task) -> tuple[Floats, Floats]:
    size = task.model.nq + task.model.nv
    return np.full(size, -np.inf), np.full(size, np.inf)


def _height_and_angle_bounds(task: "HopperEnv | Walker2dEnv") -> tuple[Floats, Floats]:
    low, high = _no_bounds(task)
    (low[1], high[1]), (low[2], high[2]) = task._healthy_z_range, task._healthy_angle_range
    return low, high


class HopperEnv(hopper_v5.HopperEnv):
    """Hopper-v5 with root x in the observation and a chosen ``gravity`` in m/s^2 (positive, downwards)."""

    velocity_limit = 10.0
    camera: Mapping[str, Any] = hopper_v5.DEFAULT_CAMERA_CONFIG

    def __init__(self, gravity: float = 9.81, **kwargs: Any) -> None:
        if not 0 < gravity < np.inf:
            raise ValueError(f"gravity is {gravity}; it must be positive and finite (m/s^2, downwards)")
        super().__init__(exclude_current_positions_from_observation=False, **kwargs)
        EzPickle.__init__(self, gravity=gravity, **kwargs)  # in the place of what the parent has noted
        follow(self.mujoco_renderer)
        self.model.opt.gravity[2] = -gravity

    def healthy_bounds(self) -> tuple[Floats, Floats]:
        """Return the bounds of a healthy state (12,), by the rule of Hopper-v5."""
        low, high = _height_and_angle_bounds(self)
        # One range for all but root x and height; the angle has another one besides.
        low[2:] = np.maximum(low[2:], self._healthy_state_range[0])
        high[2:] = np.minimum(high[2:], self._healthy_state_range[1])
        return low, high

    def reset_velocity(self, rng: np.random.Generator) -> Floats:
        """Draw the initial velocity (nv,) exactly as Gymnasium's reset does."""
        return _uniform_velocity(self, rng)

    def batched(self, num_simulators: int, max_episode_steps: int) -> "LocomotionBatch":
        """Return many robots with these dynamics."""
        return LocomotionBatch(self, num_simulators, max_episode_steps)


class Walker2dEnv(walker2d_v5.Walker2dEnv):
    """Walker2d-v5 with root x in the observation and one sliding ``friction`` for both feet.

    Of the two geoms in contact the feet decide. By MuJoCo's own rule the larger friction wins, and feet that are more
    slippery than the floor, at 0.7, would change nothing.
    """

    velocity_limit = 10.0
    camera: Mapping[str, Any] = walker2d_v5.DEFAULT_CAMERA_CONFIG

    def __init__(self, friction: float = 1.9, **kwargs: Any) -> None:
        if not 0 < friction < np.inf:
            raise ValueError(f"friction is {friction}; it must be positive and finite")
        super().__init__(exclude_current_positions_from_observation=False, **kwargs)
        EzPickle.__init__(self, friction=friction, **kwargs)  # in the place of what the parent has noted
        follow(self.mujoco_renderer)
        for foot in ("foot_geom", "foot_left_geom"):
            self.model.geom(foot).friction[0] = friction
            self.model.geom(foot).priority[0] = 1

    def healthy_bounds(self) -> tuple[Floats, Floats]:
        """Return the bounds of a healthy state (18,), by the rule of Walker2d-v5."""
        return _height_and_angle_bounds(self)

    def reset_velocity(self, rng: np.random.Generator) -> Floats:
        """Draw the initial velocity (nv,) exactly as Gymnasium's reset does."""
        return _uniform_velocity(self, rng)

    def batched(self, num_simulators: int, max_episode_steps: int) -> "LocomotionBatch":
        """Return many robots with these dynamics."""
        return LocomotionBatch(self, num_simulators, max_episode_steps)


class HalfCheetahEnv(half_cheetah_v5.HalfCheetahEnv):
    """HalfCheetah-v5 with root x in the observation and the motors of the front and back leg scaled.

    ``front`` and ``back`` multiply the gears of the three motors of each leg; 1 is the unmodified robot.
    """

    velocity_limit = np.inf
    camera: Mapping[str, Any] = half_cheetah_v5.DEFAULT_CAMERA_CONFIG
    _healthy_reward = 0.0
    _terminate_when_unhealthy = False

    def __init__(self, front: float = 1.0, back: float = 1.0, **kwargs: Any) -> None:
        if not (0 <= front < np.inf and 0 <= back < np.inf):
            raise ValueError(f"front and back are {front} and {back}; a motor's scale must be finite and not negative")
        super().__init__(exclude_current_positions_from_observation=False, **kwargs)
        EzPickle.__init__(self, front=front, back=back, **kwargs)  # in the place of what the parent has noted
        follow(self.mujoco_renderer)
        for actuator in range(self.model.nu):
            name = mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)
            self.model.actuator_gear[actuator, 0] *= front if name.startswith("f") else back

    def healthy_bounds(self) -> tuple[Floats, Floats]:
        """HalfCheetah is never unhealthy, and pays nothing for it."""
        return _no_bounds(self)

    def reset_velocity(self, rng: np.random.Generator) -> Floats:
        """Draw the initial velocity (nv,) exactly as Gymnasium's reset does."""
        return self.init_qvel + self._reset_noise_scale * rng.standard_normal(self.model.nv)

    def batched(self, num_simulators: int, max_episode_steps: int) -> "LocomotionBatch":
        """Return many robots with these dynamics."""
        return LocomotionBatch(self, num_simulators, max_episode_steps)


class LocomotionBatch(MujocoBatch):
    """G robots of one task."""

    def __init__(self, task: Task, num_simulators: int, max_episode_steps: int) -> None:
        super().__init__(task.model, num_simulators, max_episode_steps)
        # A robot is one kinematic tree, so to look for islands of constraints, every time, finds nothing.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        self.task = task
        self.steps_per_second = 1 / task.dt
        # Views into MuJoCo's memory, fetched once: every attribute access on MjData costs as much as a copy.
        self._controls = [data.ctrl for data in self._data]
        self._positions = [data.qpos for data in self._data]
        self._velocities = [data.qvel for data in self._data]
        nq, nv = self.model.nq, self.model.nv
        self.observation_dim = nq + nv
        self._states = np.zeros((num_simulators, nq + nv))
        self._qpos, self._qvel = self._states[:, :nq], self._states[:, nq:]
        self._healthy_above, self._healthy_below = task.healthy_bounds()

    def observations(self) -> Floats:
        """Return (G, S) observations of the present states."""
        states, limit = self._states.copy(), self.task.velocity_limit
        if limit < np.inf:
            velocities = states[:, self.model.nq :]
            np.minimum(np.maximum(velocities, -limit, out=velocities), limit, out=velocities)
        return states

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) whether no velocity was clipped."""
        velocities = np.abs(observations[:, self.model.nq :])
        return np.asarray((velocities < self.task.velocity_limit).all(axis=1))

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions for one control step in every simulator."""
        x_before = self._qpos[:, 0].copy()
        model, frame_skip, step = self.model, self.task.frame_skip, mujoco.mj_step
        qpos, qvel = self._qpos, self._qvel
        for i, data in enumerate(self._data):
            self._controls[i][:] = actions[i]
            step(model, data, frame_skip)
            qpos[i] = self._positions[i]
            qvel[i] = self._velocities[i]
        return self._outcome(x_before, actions)

    def _outcome(self, x_before: Floats, actions: NDArray[np.floating]) -> StepOutcome:
        # The order of the operations follows Gymnasium's, so that the bits do too.
        task = self.task
        inside = (self._healthy_above < self._states) & (self._states < self._healthy_below)
        healthy = np.asarray(inside.all(axis=1))
        rewards = task._forward_reward_weight * ((self._qpos[:, 0] - x_before) / task.dt)
        rewards = rewards + healthy * task._healthy_reward
        rewards = rewards - task._ctrl_cost_weight * np.square(actions).sum(axis=1)
        terminated = ~healthy & task._terminate_when_unhealthy
        self._elapsed += 1
        self._returns += rewards
        return StepOutcome(rewards, terminated, self._elapsed >= self.max_episode_steps)

    def _start(self, data: mujoco.MjData, seed: int) -> None:
        rng, _ = np_random(seed)
        scale = self.task._reset_noise_scale
        data.qpos[:] = self.task.init_qpos + rng.uniform(low=-scale, high=scale, size=self.model.nq)
        data.qvel[:] = self.task.reset_velocity(rng)
        mujoco.mj_forward(self.model, data)

    def _put(self, data: mujoco.MjData, observation: Floats) -> None:
        # A velocity that the observation has clipped is placed at the limit.
        data.qpos[:], data.qvel[:] = np.split(observation, [self.model.nq])

    def _read(self, simulator: int) -> None:
        self._qpos[simulator] = self._positions[simulator]
        self._qvel[simulator] = self._velocities[simulator]

    def _new_painter(self) -> Painter:
        return Painter(self.model, self.task.camera)
