"""How fast each environment is: its batched form beside the Gymnasium form, on one core.

Both sides play random actions with resets, in turns; processor time is counted, so that another program on the same
core counts for neither.
"""

# ruff: noqa: E402  (threads are limited before NumPy is imported, and the program may not be installed)
import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import gymnasium
import numpy as np

from benchmarks.throughput import clock_as_shipped, machine
from oodil.pipeline.environments import make_batch
from oodil.pipeline.versions import library_versions

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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result: dict[str, Any] = {"machine": machine(), "versions": library_versions(), "environments": {}}
    for name in ENVIRONMENTS:
        figures = result["environments"][name] = speed(f"oodil/{name}-v0", arguments.rounds)
        print(
            f"{name:12} {figures['batched_steps_per_s']:9,.0f} /s batched, "
            f"{figures['gymnasium_steps_per_s']:9,.0f} /s Gymnasium: {figures['ratio']:.1f} times",
            flush=True,
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
