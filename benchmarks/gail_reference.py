"""How much experience GAIL needs: ten demonstrations of gravity 9.8, an imitator under gravity 12.0, five seeds.

For every seed: environment steps and seconds until the deterministic policy first reaches a return of 2,900, and the
return at the end of the budget. Run ``python benchmarks/gail_reference.py --json FILE``; ``--setting official`` takes
the constants of the method's released code instead of the defaults, ``ppo`` the other policy optimizer,
``wide`` and ``cheap`` what would be faster per step.
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import UNUSED, Quiet, arguments_of, circumstances, one_thread, save
from numpy.typing import NDArray

from oodil.pipeline.algorithms.gail import imitator
from oodil.pipeline.config import EnvironmentConfig, GailConfig
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stages.demonstrations import collect_demonstrations
from oodil.pipeline.stages.experts import load_expert
from oodil.pipeline.training import Probe, train

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


def run_seed(seed: int, config: GailConfig) -> dict[str, Any]:
    policy, _ = load_expert(EXPERT)
    source = EnvironmentConfig(id=ENV_ID, dynamics=DEMONSTRATOR)
    demonstrations, _ = collect_demonstrations(
        policy,
        source,
        0,
        10,
        seed,
        deterministic=False,
        full_length_only=True,
        minimum_return=None,
        context=Quiet(),
    )
    spec, weights = environment_spec(ENV_ID, IMITATOR), np.ones(len(demonstrations))
    learner = imitator(spec.observation_dim, spec.action_dim, demonstrations, weights, config, seed)
    seconds: list[float] = []
    evaluating = 0.0
    started = time.perf_counter()

    def measure() -> NDArray[np.float64]:
        nonlocal evaluating
        begun = time.perf_counter()
        seconds.append(begun - started - evaluating)
        seen = evaluate(learner.behavior_policy(), ENV_ID, IMITATOR, 8, derive_key(seed, "benchmark"))
        evaluating += time.perf_counter() - begun
        return np.array(seen.mean_return)

    probe = Probe("return", max(1, config.total_steps // EVALUATION_INTERVAL), measure)
    environment = EnvironmentConfig(id=ENV_ID, dynamics=IMITATOR)
    history = train(learner, environment, config, [probe], Quiet(), UNUSED)
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
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--setting", choices=sorted(SETTINGS), default="default")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1_500_000)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    config = GailConfig.model_validate({"total_steps": arguments.steps} | SETTINGS[arguments.setting])
    found = circumstances()
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
    found |= {"setting": arguments.setting, "processes": arguments.processes}
    save(arguments.json, found | {"config": config.model_dump(mode="json"), "seeds": results})


if __name__ == "__main__":
    main()
