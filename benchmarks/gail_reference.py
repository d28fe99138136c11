"""How much experience GAIL needs: ten demonstrations of gravity 9.8, an imitator under gravity 12.0, five seeds.

For every seed: environment steps and seconds until the deterministic policy first reaches a return of 2,900, and the
return at the end of the budget. Run ``python benchmarks/gail_reference.py --json FILE``; ``--setting official`` takes
the constants of the method's released code instead of the defaults, ``ppo`` the other policy optimizer,
``wide`` and ``cheap`` what would be faster per step.
"""

import argparse
import json
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np  # noqa: E402
from oodil.pipeline.experts import collect_demonstrations, load_expert  # noqa: E402

from benchmarks.throughput import machine  # noqa: E402
from oodil.pipeline.algorithms.gail import AdversarialReward  # noqa: E402
from oodil.pipeline.algorithms.learner import Learner  # noqa: E402
from oodil.pipeline.artifacts import Checkpoints  # noqa: E402
from oodil.pipeline.collecting import InlineRollouts  # noqa: E402
from oodil.pipeline.config import EnvironmentConfig, GailConfig  # noqa: E402
from oodil.pipeline.evaluation import evaluate  # noqa: E402
from oodil.pipeline.seeding import derive_key  # noqa: E402
from oodil.pipeline.training import Probe, train  # noqa: E402
from oodil.pipeline.versions import library_versions  # noqa: E402

ENV_ID = "oodil/Hopper-v0"
EXPERT = Path(__file__).parents[1] / "configs" / "experts" / "hopper-gravity-9.8"
IMITATOR, DEMONSTRATOR = {"gravity": 12.0}, {"gravity": 9.8}
TARGET_RETURN = 2900.0
EVALUATION_INTERVAL = 50_000
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "official": {
        "normalize_observations": False,
        "policy_optimizer": {"fisher_every": 1},
        "value": {"learning_rate": 3e-4, "epochs": 1, "minibatch_size": 86},
        "anneal": False,
        "lag": 0,
    },
    "ppo": {"policy_optimizer": {"kind": "ppo"}},
    "wide": {"simulators_per_group": 16, "steps_per_rollout": 40},
    "cheap": {
        "simulators_per_group": 16,
        "steps_per_rollout": 40,
        "policy_optimizer": {"fisher_every": 8},
        "value": {"epochs": 2},
    },
}


@dataclass
class Quiet:
    """A job's context that reports to nobody and never stops."""

    rollouts: InlineRollouts = field(default_factory=InlineRollouts)
    checkpoint_interval_s: float = float("inf")

    def progress(self, done: int, total: int, **metrics: float) -> None: ...

    def warn(self, message: str) -> None: ...

    def should_stop(self) -> bool:
        return False


def run_seed(seed: int, config: GailConfig) -> dict[str, Any]:
    policy, _ = load_expert(EXPERT)
    source = EnvironmentConfig(id=ENV_ID, dynamics=DEMONSTRATOR)
    demonstrations, _ = collect_demonstrations(
        policy,
        source,
        "9.8",
        10,
        seed,
        deterministic=False,
        full_length_only=True,
        minimum_return=None,
        context=Quiet(),
    )
    reward = AdversarialReward(demonstrations, np.ones(len(demonstrations)), config.discriminator, seed)
    learner = Learner(demonstrations.observation_dim, 3, config, reward, seed)
    seconds: list[float] = []
    evaluating = 0.0
    started = time.perf_counter()

    def measure() -> np.ndarray:
        nonlocal evaluating
        begun = time.perf_counter()
        seconds.append(begun - started - evaluating)
        seen = evaluate(learner.behavior_policy(), ENV_ID, IMITATOR, 8, derive_key(seed, "benchmark"))
        evaluating += time.perf_counter() - begun
        return seen.returns.mean()

    probe = Probe("return", max(1, config.total_steps // EVALUATION_INTERVAL), measure)
    imitator = EnvironmentConfig(id=ENV_ID, dynamics=IMITATOR)
    history = train(learner, imitator, config, [probe], Quiet(), Checkpoints(Path("unused"), {}))
    returns, steps = history.values("return"), history.steps("return")
    reached = np.flatnonzero(returns >= TARGET_RETURN)
    first = int(reached[0]) if reached.size else None
    return {
        "seed": seed,
        "demonstrations_return": float(demonstrations.returns.mean()),
        "steps_to_target": int(steps[first]) if first is not None else None,
        "seconds_to_target": seconds[first] if first is not None else None,
        "final_return": float(returns[-1]),
        "seconds": seconds[-1],
        "curve": {"env_steps": steps.tolist(), "return": returns.tolist()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--setting", choices=sorted(SETTINGS), default="default")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1_500_000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    config = GailConfig.model_validate({"total_steps": arguments.steps} | SETTINGS[arguments.setting])
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.processes, mp_context=context) as pool:
        results = list(pool.map(run_seed, range(arguments.seeds), [config] * arguments.seeds))
    for result in results:
        print({name: value for name, value in result.items() if name != "curve"})
    reached = [result["steps_to_target"] or float("inf") for result in results]
    print(
        f"{arguments.setting}: median steps to {TARGET_RETURN:,.0f}: {median(reached):,.0f}; mean final return "
        f"{np.mean([result['final_return'] for result in results]):,.0f}"
    )
    if arguments.json:
        whole = {
            "machine": machine(),
            "versions": library_versions(),
            "setting": arguments.setting,
            "processes": arguments.processes,
            "config": config.model_dump(mode="json"),
            "seeds": results,
        }
        arguments.json.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
