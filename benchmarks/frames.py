"""Four frames of a run's policy for the README, a second apart: ``frames.py RUN_DIR --output docs/frames.png``.

Needs a machine that can render; without a display, MUJOCO_GL=osmesa or egl.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

import oodil

FRAMES, APART, SIZE = 4, 125, 240
"""Their number, the steps between them, and their pixels."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--output", type=Path, default=Path("docs/frames.png"))
    parser.add_argument("--policy", default="imitation")
    arguments = parser.parse_args()
    run = oodil.open_run(arguments.run_dir)
    environment, policy = run.config.environment, run.policy(arguments.policy)
    looks = {"render_mode": "rgb_array", "camera_name": "track", "width": SIZE, "height": SIZE}
    made_with: dict[str, Any] = environment.dynamics | looks
    env = gymnasium.make(environment.id, **made_with)
    observation, _ = env.reset(seed=0)
    frames: list[np.ndarray] = []
    while len(frames) < FRAMES:
        for _ in range(APART):
            observation, _, terminated, _, _ = env.step(policy.act(observation))
            assert not terminated, f"the episode ended after {len(frames)} frames"
        frames.append(np.asarray(env.render()))
    env.close()
    strip = Image.fromarray(np.concatenate(frames, axis=1))
    strip.quantize(64).save(arguments.output, optimize=True)


if __name__ == "__main__":
    main()
