"""Pictures of MuJoCo's simulators, with a camera that the robot does not leave."""

import ctypes.util
import os
import sys
from collections.abc import Mapping
from copy import copy
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""All that MuJoCo's next step depends on. `mjSTATE_FULLPHYSICS` is not: it leaves out the solver's warm start."""
_WITH_A_PLACE = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE)


def choose_backend() -> None:
    """Let MuJoCo draw off-screen on a Linux machine without a display, unless ``MUJOCO_GL`` says how."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # Gymnasium tries GLFW first, which only fails once it has to draw.
        os.environ.setdefault("MUJOCO_GL", "egl" if ctypes.util.find_library("EGL") else "osmesa")


class Painter:
    """Draws simulators of one model, off-screen.

    It has a copy of model and data of its own, so that no bit of a simulation follows from a picture.
    """

    def __init__(self, model: mujoco.MjModel, camera: Mapping[str, Any], width: int = 480, height: int = 480) -> None:
        """``camera`` holds attributes of MuJoCo's camera; it follows the robot, see `following`."""
        choose_backend()
        self.model = copy(model)
        _endless(self.model)
        self.viewer: Any = _viewer_class()(self.model, mujoco.MjData(self.model), width, height)
        for costly in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self.viewer.scn.flags[costly] = 0  # Without a graphics card they take two thirds of the time.
        for name, value in following(self.model, camera).items():
            setattr(self.viewer.cam, name, value)

    def paint(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) of the present state."""
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, data, state, STATE)
        mujoco.mj_setState(self.model, self.viewer.data, state, STATE)
        mujoco.mj_forward(self.model, self.viewer.data)
        return np.asarray(self.viewer.render("rgb_array"))

    def close(self) -> None:
        """Free the canvas."""
        self.viewer.close()


@lru_cache(maxsize=1)
def _viewer_class() -> Any:
    from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

    class Viewer(OffScreenViewer):
        """Gymnasium's, without a complaint where there was nothing to draw with and so nothing to free."""

        def free(self) -> None:
            if hasattr(self, "opengl_context"):
                super().free()

    return Viewer


def _endless(model: mujoco.MjModel) -> None:
    """Draw planes without an edge, as they are for what walks on them."""
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        size, material = model.geom_size[plane], model.geom_matid[plane]
        if material >= 0 and not model.mat_texuniform[material] and size[:2].all():
            # An endless plane has its texture repeated by length.
            model.mat_texrepeat[material] /= 2 * size[:2]
            model.mat_texuniform[material] = 1
        size[:2] = 0


def follow(renderer: Any) -> None:
    """Let an unnamed camera of Gymnasium's ``MujocoRenderer`` follow the robot; before its first picture.

    Such a camera is free: it stays where it is, whatever body it is said to track.
    """
    if renderer.camera_id == -1:
        renderer.default_cam_config = following(renderer.model, renderer.default_cam_config or {})
        renderer.camera_id = None  # any number makes the camera a free or a fixed one again


def following(model: mujoco.MjModel, camera: Mapping[str, Any]) -> dict[str, Any]:
    """Return a camera's attributes with those that make it follow: ``trackbodyid``, or else what can walk away."""
    body = camera.get("trackbodyid", walker_of(model))
    # Body 0 is the world. What stands on it does not leave the picture.
    kind = mujoco.mjtCamera.mjCAMERA_TRACKING if body > 0 else mujoco.mjtCamera.mjCAMERA_FREE
    return {**camera, "trackbodyid": max(body, -1), "type": kind}


def walker_of(model: mujoco.MjModel) -> int:
    """Return the heaviest thing in the world, as a body; -1 if it has no joint by which it can go elsewhere."""
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if not roots:
        return -1
    heaviest = max(roots, key=lambda body: model.body_subtreemass[body])
    joints = model.jnt_type[model.jnt_bodyid == heaviest]
    return heaviest if np.isin(joints, _WITH_A_PLACE).any() else -1


def checked(picture: Any) -> NDArray[np.uint8]:
    """Return what an environment has drawn. Raises TypeError unless it is a picture (height, width, 3) of bytes."""
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise TypeError(f"render() gave {type(picture).__name__}; expected an array (height, width, 3) of bytes")
    return picture
