"""In how many frames of a film the robot is seen, in every environment that is shipped.

One episode each, of a shipped expert or of the hand-written demonstrator, with the frames that `oodil evaluate --video`
draws. Seen means that at least 0.1 % of the picture is robot, counted by MuJoCo's segmentation; of Driving, by the
car's color. ``still`` is the same with a camera that stays where it is, as an unnamed one of Gymnasium does.

Run ``python benchmarks/films.py --json FILE``, or with ids of environments for some of them.
"""

from contextlib import closing
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import arguments_of, circumstances, one_thread, save

from oodil.pipeline.environments.batch import MujocoBatch
from oodil.pipeline.filming import FRAMES_PER_SECOND, open_stage, play
from oodil.pipeline.stages.demonstrations import hand_written
from oodil.pipeline.stages.experts import load_expert

EXPERTS = {
    "oodil/Hopper-v0": ("hopper-gravity-9.8", {"gravity": 9.8}),
    "oodil/Walker2d-v0": ("walker2d-friction-1.1", {"friction": 1.1}),
    "oodil/HalfCheetah-v0": ("half-cheetah-front-0.9", {"front": 0.9}),
}
HAND_WRITTEN = "oodil/Driving-v0", "oodil/Panda-v0", "oodil/Panda20Hz-v0"
SEEN = 0.001
"""Least share of a picture. A car has 0.07 % of Driving's plane, not all of it in its color."""
CAR, SEEN_CAR = (50, 200, 0), 0.0002
NOT_A_ROBOT = "box", "table"
FOLDER = Path(__file__).parents[1] / "configs" / "experts"


def robot_share(simulators: Any) -> float:
    """Return the share of the picture that the robot has: of MuJoCo's, what moves and is no box."""
    if not isinstance(simulators, MujocoBatch):
        return float((simulators.render(0) == CAR).all(axis=2).mean())
    scene, model = simulators.painter.viewer.scn, simulators.model
    scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
    seen = simulators.render(0).astype(np.int64) @ (1, 256, 65536)
    robot = []
    for geom in scene.geoms[: scene.ngeom]:
        body = model.geom_bodyid[geom.objid] if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM else 0
        if body and not model.body(int(body)).name.startswith(NOT_A_ROBOT):
            robot.append(geom.segid + 1)
    return float(np.isin(seen, robot).mean())


def measure(env_id: str) -> dict[str, Any]:
    name, dynamics = EXPERTS.get(env_id, ("", {}))
    row: dict[str, Any] = {"environment": env_id, "policy": name or "hand-written"}
    for camera in ("following", "still"):
        with closing(open_stage(env_id, dynamics)) as simulators:
            controller = load_expert(FOLDER / name)[0] if name else hand_written(simulators, env_id)
            every = max(1, round(simulators.steps_per_second / FRAMES_PER_SECOND))
            shares = []
            for step in play(simulators, controller, (0,)):
                if step % every:
                    continue
                shares.append(robot_share(simulators))
                if camera == "still" and isinstance(simulators, MujocoBatch):
                    simulators.painter.viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FREE
        least = SEEN if env_id != "oodil/Driving-v0" else SEEN_CAR
        row |= {"frames": len(shares), f"seen_{camera}": int((np.array(shares) >= least).sum())}
        row[f"least_share_{camera}"] = round(min(shares), 5)
    return row


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("environments", nargs="*", default=[*EXPERTS, *HAND_WRITTEN], help="ids")
    arguments = parser.parse_args()
    one_thread()
    rows = []
    for env_id in arguments.environments:
        rows.append(measure(env_id))
        print(rows[-1], flush=True)
    save(arguments.json, {"rows": rows} | circumstances())


if __name__ == "__main__":
    main()
