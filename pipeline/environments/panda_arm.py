"""Panda's arm, some of whose joints are locked, with its table and box, as one model of MuJoCo.

Arm, gripper, table and box are robosuite's models, stepped by MuJoCo directly; robosuite's own control loop takes a
hundred times as long. A locked joint is none at all: its link is fixed to the one before, at the angle of the reset.
So are the seventh joint and the fingers, always.

Lengths in m, times in s, angles in rad; x ahead of the arm, z up. Letters: J working joints.
"""

import logging
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

TIME_STEP = 1 / 240
ALL_JOINTS = (1, 2, 3, 4, 5, 6)
START_ANGLES = {1: 0.0, 2: -np.pi / 6, 3: 0.0, 4: -3.0, 5: 0.0, 6: 5 * np.pi / 6, 7: np.pi / 4}
LOCKED_ELBOW = {2: 0.09, 4: -2.37, 6: 1.55}
"""How an arm starts whose fourth joint is locked. Folded as the others start, it could not reach the goal; straighter
than this, it could not get behind the box."""
FINGER_POSITION = 0.03
BOX_START, BOX_SIZE, BOX_MASS = (0.5, 0.0, 0.08), (0.3, 0.2, 0.2), 10.0
BOX_FRICTION = 0.25
START_BEFORE_X = 0.4
PLACED_FROM, PLACED_WITHIN, PLACED_STEPS = 6, 1e-6, 300
"""Starts from which the angles for an observed hand are sought, the error (m) that ends a search, and its steps."""
SERVO = 1000.0
"""N m s / rad. The wanted velocity is the distance to the wanted angle, per second, so this is the stiffness, too."""
_SITE, _BOX_JOINT, _ARM = "gripper0_grip_site", "box_joint0", ("robot0_", "gripper0_")


def start_angles(working: tuple[int, ...]) -> dict[int, float]:
    """Return the angles of all joints at the middle of the starts; those that do not work are locked there."""
    return START_ANGLES if 4 in working else START_ANGLES | LOCKED_ELBOW


class Arm:
    """A compiled arm with its table and box, and the rules of the task."""

    def __init__(self, working: tuple[int, ...], spread: float, frame_skip: int) -> None:
        self.model = _compile(working)
        self.working = working
        self.spread = spread
        self.frame_skip = frame_skip
        joints = [self.model.joint(_joint_name(n)) for n in working]
        self.angles = np.array([joint.qposadr[0] for joint in joints])
        """Where the working joints' angles are in ``qpos``."""
        self._freedoms = np.array([joint.dofadr[0] for joint in joints])
        self.low, self.high = np.array([joint.range for joint in joints]).T
        self._start = np.array([start_angles(working)[n] for n in working])
        self._site = self.model.site(_SITE).id
        self._box = self.model.joint(_BOX_JOINT).qposadr[0]
        bodies = [self.model.body(geom.bodyid[0]).name for geom in map(self.model.geom, range(self.model.ngeom))]
        self._is_arm = np.array([name.startswith(_ARM) for name in bodies])

    def start(self, data: mujoco.MjData, rng: np.random.Generator) -> None:
        """Draw angles until the hand is before the box and the arm touches nothing."""
        self.put_box(data)
        while True:
            drawn = self._start + rng.uniform(-self.spread, self.spread, len(self.working))
            data.qpos[self.angles] = np.clip(drawn, self.low, self.high)
            mujoco.mj_forward(self.model, data)
            if self.is_before_box(data):
                break
        data.ctrl[:] = data.qpos[self.angles]

    def place(self, data: mujoco.MjData, hand: Floats, box: Floats) -> None:
        """Put hand (3,) and box (3,) there, at rest and the box upright: neither turn nor velocity is observed.

        Of the angles found from several starts, those count that bring the hand nearest and the arm least into things.
        """
        found: list[tuple[float, Floats]] = []
        for seed in range(PLACED_FROM):
            self.start(data, np.random.default_rng(seed))
            self.put_box(data, box)
            for _ in range(PLACED_STEPS):
                mujoco.mj_kinematics(self.model, data)
                error = hand - self.hand(data)
                if np.linalg.norm(error) < PLACED_WITHIN:
                    break
                turned = data.qpos[self.angles] + 0.3 * self.toward(data, error)
                data.qpos[self.angles] = np.clip(turned, self.low, self.high)
            mujoco.mj_forward(self.model, data)
            touched = self._is_arm[data.contact.geom].any(axis=1)
            depth = np.max(-data.contact.dist[touched], initial=0.0)
            found.append((float(np.linalg.norm(hand - self.hand(data)) + depth), data.qpos.copy()))
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = min(found, key=lambda each: each[0])[1]
        data.ctrl[:] = data.qpos[self.angles]
        mujoco.mj_forward(self.model, data)

    def toward(self, data: mujoco.MjData, velocity: Floats) -> Floats:
        """Return (J,) turning that moves the hand with ``velocity`` (3,), by damped least squares."""
        jacobian = self.jacobian(data)
        return np.asarray(jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(3), velocity))

    def put_box(self, data: mujoco.MjData, position: ArrayLike = BOX_START) -> None:
        """Put the box somewhere, upright."""
        data.qpos[self._box : self._box + 3] = position
        data.qpos[self._box + 3 : self._box + 7] = (1, 0, 0, 0)

    def is_before_box(self, data: mujoco.MjData) -> bool:
        """Return whether an episode may start like this: the hand before the box, and the arm touching nothing."""
        return bool(self.hand(data)[0] < START_BEFORE_X and not self._is_arm[data.contact.geom].any())

    def move(self, data: mujoco.MjData, action: NDArray[np.floating]) -> None:
        """Move the wanted angles by ``action`` (J,) in [-1, 1] rad/s for one control step."""
        turn = np.clip(action, -1, 1) * TIME_STEP
        for _ in range(self.frame_skip):
            data.ctrl[:] = np.minimum(np.maximum(data.ctrl + turn, self.low), self.high)
            mujoco.mj_step(self.model, data)
        mujoco.mj_kinematics(self.model, data)

    def hand(self, data: mujoco.MjData) -> Floats:
        """Return the position (3,) between the fingers."""
        return np.asarray(data.site_xpos[self._site])

    def jacobian(self, data: mujoco.MjData) -> Floats:
        """Return (3, J): how fast the hand moves when a joint turns."""
        whole = np.empty((3, self.model.nv))
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_jacSite(self.model, data, whole, None, self._site)
        return whole[:, self._freedoms]

    def observe(self, data: mujoco.MjData) -> Floats:
        """Return (6,): where the hand and the box are. Velocities and angles are not observed."""
        return np.concatenate((self.hand(data), data.qpos[self._box : self._box + 3]))


def _joint_name(number: int) -> str:
    return f"robot0_joint{number}"


@lru_cache(maxsize=8)
def _compile(working: tuple[int, ...]) -> mujoco.MjModel:
    """Compile robosuite's arm, gripper, table and box with velocity servos at the working joints."""
    spec = mujoco.MjSpec.from_string(_assembled())
    spec.option.timestep = TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    limits = {actuator.target: actuator.ctrlrange.copy() for actuator in spec.actuators}
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for body in spec.bodies:
        if body.name.startswith(_ARM):
            # Gravity is compensated, as an arm's own controller does.
            body.gravcomp = 1.0
            for geom in body.geoms:
                if geom.contype or geom.conaffinity:
                    # It meets box and table, not itself: a link that is fixed to the base would touch its neighbor.
                    geom.contype, geom.conaffinity = 2, 1
            for joint in list(body.joints):
                if joint.name not in map(_joint_name, working):
                    _lock(spec, body, joint, start_angles(working))
    box = spec.geom("box_g0")
    # With a higher priority than any other geom, the box alone decides on the friction of its contacts.
    box.priority, box.friction[0] = 1, BOX_FRICTION
    for name in ("box_g0", "table_collision", "floor"):
        spec.geom(name).contype, spec.geom(name).conaffinity = 1, 3
    spec.geom("floor").pos[2] = -0.65
    for number in working:
        name = _joint_name(number)
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gainprm=[SERVO] + [0.0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0.0, -SERVO, -SERVO] + [0.0] * 7,
            forcelimited=True,
            forcerange=limits[name],
        )
    return spec.compile()


def _lock(spec: mujoco.MjSpec, body: Any, joint: Any, angles: dict[int, float]) -> None:
    """Fix a body to its parent, where the joint would hold it at the reset."""
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        side = 1 if joint.range[1] > 0 else -1
        move = np.empty(3)
        mujoco.mju_rotVecQuat(move, side * FINGER_POSITION * np.asarray(joint.axis), np.asarray(body.quat))
        body.pos = np.asarray(body.pos) + move
    else:
        turn, turned = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, np.asarray(joint.axis), angles[int(joint.name[-1])])
        mujoco.mju_mulQuat(turned, np.asarray(body.quat), turn)
        body.quat = turned
    spec.delete(joint)


@lru_cache(maxsize=1)
def _assembled() -> str:
    """Return the XML of robosuite's models put together. Raises ImportError when robosuite is not installed."""
    # It warns of everything that it could have besides.
    logging.disable(logging.WARNING)
    try:
        from robosuite.models.arenas import TableArena
        from robosuite.models.grippers import PandaGripper
        from robosuite.models.objects import BoxObject
        from robosuite.models.robots import Panda
        from robosuite.models.tasks import ManipulationTask

        arena = TableArena((1.5, 1.0, 0.05), table_offset=(0.5, 0, BOX_START[2] - BOX_SIZE[2] / 2), has_legs=False)
        robot = Panda()
        robot.add_gripper(PandaGripper())
        density = BOX_MASS / float(np.prod(BOX_SIZE))
        box = BoxObject("box", size=[side / 2 for side in BOX_SIZE], density=density, rgba=(0.85, 0.45, 0.2, 1))
        xml: str = ManipulationTask(mujoco_arena=arena, mujoco_robots=[robot], mujoco_objects=[box]).get_xml()
        return xml
    except ModuleNotFoundError as error:
        both = "pip install 'oodil[robot]' && pip install --no-deps robosuite"  # docs/decisions.md
        raise ModuleNotFoundError(f"needs {error.name}; {both}", name=error.name) from error
    finally:
        logging.disable(logging.NOTSET)
