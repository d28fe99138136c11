"""How fast each environment is: its batched form beside the Gymnasium form, on one core.

Both sides play random actions with resets, in turns; processor time is counted, so that another program on the same
core counts for neither. Run ``python benchmarks/environments.py --json FILE``.
"""

import statistics
import time
from typing import Any

import gymnasium
import numpy as np
from common import arguments_of, circumstances, one_thread, save
from throughput import clock_as_shipped

from oodil.pipeline.environments import make_batch

SIMULATORS = 32
STEPS = 100
"""Of each simulator in a round; as many steps in all of the single environment."""
ENVIRONMENTS = ("Hopper", "Walker2d", "HalfCheetah", "Driving", "Panda", "Panda20Hz")


def speed(env_id: str, rounds: int) -> dict[str, Any]:
    """Return steps per second of both forms and their ratio, medians of all rounds."""
    env = gymnasium.make(env_id)
    batch = make_batch(env_id, {}, SIMULATORS)
    rng = np.random.default_rng(0)
    single, batched = [], []
    for index in range(rounds):
        actions = rng.uniform(-1, 1, (STEPS, SIMULATORS, batch.action_dim)).astype(np.float32)
        for g in range(SIMULATORS):
            batch.reset(g, seed=index * SIMULATORS + g)
        started = time.process_time()
        for action in actions:
            outcome = batch.step(action)
            batch.observations()
            for g in np.flatnonzero(outcome.terminated | outcome.truncated).tolist():
                batch.reset(g, seed=g)
        batched.append(actions.shape[0] * SIMULATORS / (time.process_time() - started))
        env.reset(seed=index)
        with clock_as_shipped():
            started = time.process_time()
            for action in actions.reshape(-1, batch.action_dim):
                _, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    env.reset()
            single.append(actions.shape[0] * SIMULATORS / (time.process_time() - started))
    return {
        "batched_steps_per_s": statistics.median(batched),
        "gymnasium_steps_per_s": statistics.median(single),
        "ratio": statistics.median(b / s for b, s in zip(batched, single, strict=True)),
        "rounds": rounds,
    }


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    result = circumstances() | {"environments": {}}
    for name in ENVIRONMENTS:
        figures = result["environments"][name] = speed(f"oodil/{name}-v0", arguments.rounds)
        print(
            f"{name:12} {figures['batched_steps_per_s']:9,.0f} /s batched, "
            f"{figures['gymnasium_steps_per_s']:9,.0f} /s Gymnasium: {figures['ratio']:.1f} times",
            flush=True,
        )
    save(arguments.json, result)


if __name__ == "__main__":
    main()
