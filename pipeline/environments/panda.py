"""Panda: an arm, some of whose joints are locked, pushes a box along a table (the paper's simulated robot).

Lengths in m, times in s, angles in rad; x ahead of the arm, z up. Letters: G simulators, J working joints.
"""

from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from oodil.pipeline.environments.batch import MujocoBatch, StepOutcome
from oodil.pipeline.environments.panda_arm import ALL_JOINTS, BOX_START, TIME_STEP, Arm
from oodil.pipeline.environments.pictures import Painter

Floats = NDArray[np.float64]

GOAL_X, GOAL_Z, GOAL_RADIUS = 0.81, 0.05, 0.05
SUCCESS_REWARD, FAILURE_REWARD = 1000.0, -1000.0
CAMERA = {"lookat": np.array((0.4, 0.0, 0.25)), "distance": 1.8, "azimuth": 120, "elevation": -20}


def judge(observations: Floats) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return rewards, successes and failures (G,) for (G, 6) observations."""
    hand_x, box = observations[:, 0], observations[:, 3:]
    reached = np.hypot(box[:, 0] - GOAL_X, box[:, 2] - GOAL_Z) < GOAL_RADIUS
    lost = (hand_x - box[:, 0] > 0.5) | (box[:, 2] < -0.1) | (np.abs(box) > 1).any(axis=1)
    lost &= ~reached
    return box[:, 0] - BOX_START[0] + SUCCESS_REWARD * reached + FAILURE_REWARD * lost, reached, lost


class PandaEnv(gymnasium.Env[Floats, NDArray[np.float32]]):
    """One arm; of ``joint_1`` to ``joint_6`` each works (1) or is locked (0); starts vary by ``spread`` rad.

    A control step is ``frame_skip`` simulation steps of 1/240 s under the same action.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 240}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(
        self,
        joint_1: float = 1,
        joint_2: float = 1,
        joint_3: float = 1,
        joint_4: float = 1,
        joint_5: float = 1,
        joint_6: float = 1,
        spread: float = 0.2,
        frame_skip: int = 1,
        render_mode: str | None = None,
    ) -> None:
        states = dict(zip(ALL_JOINTS, (joint_1, joint_2, joint_3, joint_4, joint_5, joint_6), strict=True))
        for number, state in states.items():
            if state not in (0, 1):
                raise ValueError(f"joint_{number} is {state}; a joint works (1) or is locked (0)")
        if not any(states.values()):
            raise ValueError("every joint is locked; at least one of joint_1 to joint_6 must be 1")
        if not 0 <= spread <= np.pi:
            raise ValueError(f"spread is {spread}; it must be between 0 and pi (rad)")
        if frame_skip < 1 or frame_skip != int(frame_skip):
            raise ValueError(f"frame_skip is {frame_skip}; it must be a whole number of simulation steps, at least 1")
        self.arm = Arm(tuple(number for number, state in states.items() if state), spread, int(frame_skip))
        self.metadata = self.metadata | {"render_fps": round(1 / TIME_STEP / frame_skip)}
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(self.arm.working),), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (6,), np.float64)
        self._data = mujoco.MjData(self.arm.model)
        self._painter: Painter | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Put the box on the table and the hand before it."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.arm.model, self._data)
        self.arm.start(self._data, self.np_random)
        return self.arm.observe(self._data), {}

    def step(self, action: NDArray[np.floating]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Move for one control step."""
        self.arm.move(self._data, np.asarray(action))
        observation = self.arm.observe(self._data)
        (reward,), (reached,), (lost,) = judge(observation[None])
        return observation, float(reward), bool(reached or lost), False, {"is_success": bool(reached)}

    def render(self) -> NDArray[np.uint8]:
        """Return the scene from the side (height, width, 3)."""
        if self._painter is None:
            self._painter = _new_painter(self.arm.model)
        return self._painter.paint(self._data)

    def close(self) -> None:
        """Free what rendering took."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None

    def batched(self, num_simulators: int, max_episode_steps: int) -> "PandaBatch":
        """Return many such arms."""
        return PandaBatch(self.arm, num_simulators, max_episode_steps)


class PandaBatch(MujocoBatch):
    """G arms with the same joints."""

    observation_dim = 6

    def __init__(self, arm: Arm, num_simulators: int, max_episode_steps: int) -> None:
        super().__init__(arm.model, num_simulators, max_episode_steps)
        self.arm = arm
        self.steps_per_second = 1 / (TIME_STEP * arm.frame_skip)
        self._observations = np.zeros((num_simulators, 6))

    def observations(self) -> Floats:
        """Return (G, 6) observations of the present states."""
        return self._observations.copy()

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, J) actions for one control step in every simulator."""
        for i, data in enumerate(self._data):
            self.arm.move(data, actions[i])
            self._observations[i] = self.arm.observe(data)
        rewards, reached, lost = judge(self._observations)
        self._elapsed += 1
        self._returns += rewards
        return StepOutcome(rewards, reached | lost, self._elapsed >= self.max_episode_steps)

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) that none does: angles and velocities are not observed."""
        return np.zeros(len(observations), np.bool_)

    def demonstrator(self) -> "Pusher":
        """Return the hand-written demonstrator of these arms."""
        return Pusher(self)

    def kinematics(self, simulator: int) -> tuple[Floats, Floats, Floats]:
        """Return the Jacobian (3, J) of a simulator's hand, its angles (J,) and the wanted ones (J,)."""
        data = self._data[simulator]
        return self.arm.jacobian(data), data.qpos[self.arm.angles].copy(), data.ctrl.copy()

    def _start(self, data: mujoco.MjData, seed: int) -> None:
        self.arm.start(data, np_random(seed)[0])

    def _put(self, data: mujoco.MjData, observation: Floats) -> None:
        self.arm.place(data, *np.split(observation, 2))

    def _read(self, simulator: int) -> None:
        data = self._data[simulator]
        mujoco.mj_kinematics(self.model, data)
        self._observations[simulator] = self.arm.observe(data)

    def _new_painter(self) -> Painter:
        return _new_painter(self.model)


class Pusher:
    """The hand-written demonstrator: bring the hand behind the box, to the height of its push, and then into it.

    It knows the joints that its arm has, so arms with other joints move the hand in other ways. With a locked elbow the
    hand does not get down behind the box, and pushes just below its upper edge.
    """

    INTO = 0.1
    GAIN, MAX_SPEED = 3.0, 0.4
    DAMPING = 1e-3
    CARE = np.array([1.0, 1.0, 3.0])
    """Weights of an error in x, y and z: where an arm cannot have all three, it keeps the height."""

    def __init__(self, batch: PandaBatch) -> None:
        self._batch = batch
        self._control_step = TIME_STEP * batch.arm.frame_skip
        elbow_works = 4 in batch.arm.working
        self._behind = 0.3 if elbow_works else 0.2
        self._push = np.array([0.0, 0.0, 0.0 if elbow_works else 0.085])
        self._aligned = np.array([0.05, 0.05 if elbow_works else 0.02])

    def mean(self, observations: Floats) -> NDArray[np.float32]:
        """Return (G, J) actions for (G, 6) observations of the batch as it stands."""
        return np.array([self._act(i, *np.split(row, 2)) for i, row in enumerate(observations)], np.float32)

    def _act(self, simulator: int, hand: Floats, box: Floats) -> Floats:
        pushed = box + self._push
        is_aligned = (np.abs(pushed - hand)[1:] < self._aligned).all()
        goal = pushed - (self.INTO if is_aligned else self._behind, 0.0, 0.0)
        velocity = self.GAIN * (goal - hand)
        velocity *= min(1.0, self.MAX_SPEED / max(float(np.linalg.norm(velocity)), 1e-9))
        jacobian, angles, wanted = self._batch.kinematics(simulator)
        jacobian = self.CARE[:, None] * jacobian
        # Damped least squares: https://en.wikipedia.org/wiki/Inverse_kinematics
        solved = np.linalg.solve(jacobian @ jacobian.T + self.DAMPING * np.eye(3), self.CARE * velocity)
        # The servos turn a joint by its distance to the wanted angle, per second.
        return np.clip((angles + jacobian.T @ solved - wanted) / self._control_step, -1, 1)


def _new_painter(model: mujoco.MjModel) -> Painter:
    painter = Painter(model, CAMERA, width=640)
    # robosuite keeps what collides in group 0, what is looked at in group 1, and marks in sites.
    painter.viewer.vopt.geomgroup[0], painter.viewer.vopt.sitegroup[:] = 0, 0
    return painter
