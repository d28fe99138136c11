"""What Panda's arms can do, by the simulator and without learning.

follow: whether an imitator's arm can take the way that the hand of a demonstrator takes, at its pace and with the box
in it. Followed means that the box ends at most 0.03 m before where the demonstration left it.

two joints: how far an arm with joints 2 and 5 alone pushes the box, over random angles at which joints 4 and 6 are
locked, random starts and random programmes of four constant actions.

Run ``python benchmarks/panda_arms.py --json FILE``.
"""

from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from common import arguments_of, circumstances, one_thread, save
from numpy.typing import NDArray

from oodil.pipeline.environments import make_batch, panda_arm
from oodil.pipeline.environments.panda_arm import ALL_JOINTS, BOX_START, TIME_STEP, Arm
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.seeding import numpy_rng
from oodil.pipeline.stages.demonstrations import hand_written

ENV_ID = "oodil/Panda-v0"
FOLLOWED_BY = {(1, 3): [(1, 3), (1,), (), (6,), (4,)], (1, 3, 4): [(1, 3), (4,)]}
"""Locked joints of imitators, and of the demonstrators that each is to follow."""
LOOK_AHEAD = 24


def follow(arm: Arm, states: NDArray[np.floating]) -> tuple[float, float]:
    """Return the mean distance of the hand from a demonstration's, and by how much the box falls short of its end."""
    hands = states[:, :3].astype(np.float64)
    data = mujoco.MjData(arm.model)
    arm.place(data, hands[0], states[0, 3:].astype(np.float64))
    errors = []
    for t in range(len(hands) - 1):
        ahead = hands[min(t + LOOK_AHEAD, len(hands) - 1)]
        turning = arm.toward(data, (ahead - arm.hand(data)) / (LOOK_AHEAD * TIME_STEP))
        arm.move(data, (data.qpos[arm.angles] + turning - data.ctrl) / TIME_STEP)
        errors.append(np.linalg.norm(hands[t + 1] - arm.hand(data)))
    return float(np.mean(errors)), float(states[-1, 3] - arm.observe(data)[3])


def follow_all(episodes: int) -> list[dict[str, Any]]:
    rows = []
    for imitator, demonstrators in FOLLOWED_BY.items():
        arm = Arm(tuple(number for number in ALL_JOINTS if number not in imitator), 0.2, 1)
        for locked in demonstrators:
            batch = make_batch(ENV_ID, {f"joint_{number}": 0.0 for number in locked}, episodes)
            seen = run_episodes(batch, hand_written(batch, ENV_ID), numpy_rng((0,)), stochastic=False)
            kept = [episode.states for episode in seen if episode.env_return > 500]
            errors, short = np.array([follow(arm, states) for states in kept]).T
            row = {
                "imitator_locked": imitator,
                "demonstrator_locked": locked,
                "demonstrations": len(kept),
                "followed": int((short <= 0.03).sum()),
                "median_hand_error_m": round(float(np.median(errors)), 3),
                "median_box_short_m": round(float(np.median(short)), 3),
            }
            print(row, flush=True)
            rows.append(row)
    return rows


def two_joints(arms: int, programmes: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    furthest, tried = BOX_START[0], 0
    for _ in range(arms):
        locked_at = {4: rng.uniform(-2.8, -1.8), 6: rng.uniform(0.2, 3.6)}
        panda_arm._compile.cache_clear()
        with patch.dict(panda_arm.LOCKED_ELBOW, locked_at):
            arm = Arm((2, 5), 0.0, 1)
        for _ in range(programmes):
            data = mujoco.MjData(arm.model)
            arm.put_box(data)
            for _ in range(100):
                data.qpos[arm.angles] = rng.uniform(arm.low, arm.high)
                mujoco.mj_forward(arm.model, data)
                if arm.is_before_box(data):
                    break
            else:
                continue
            data.ctrl[:] = data.qpos[arm.angles]
            tried += 1
            for action in rng.uniform(-1, 1, (4, 2)):
                for _ in range(250):
                    arm.move(data, action)
                    furthest = max(furthest, float(arm.observe(data)[3]))
    return {"programmes": tried, "furthest_box_m": round(furthest, 3)}


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--arms", type=int, default=60)
    arguments = parser.parse_args()
    found = circumstances()
    found |= {"follow": follow_all(arguments.episodes), "two_joints": two_joints(arguments.arms, 10)}
    print(found["two_joints"])
    save(arguments.json, found)


if __name__ == "__main__":
    main()
