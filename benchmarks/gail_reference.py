"""How much experience GAIL needs from one reproducible source, in every environment, with one setting for all.

For every seed: the true return of mean and of sampled actions along the training, environment steps until mean actions
first reach the task's target, and the share of episodes of the policy that a run would keep (`Candidates`), and of the
last one, that reach it. Constants are chosen with ``--dynamics
choosing``, imitators that no table uses, and reported with ``--dynamics reported``. ``--set KEY=VALUE`` changes a field
of the training, such as ``discriminator.gradient_penalty=0`` or ``policy_optimizer.kind=ppo``. What ``--json FILE``
has already is not trained again; remove it when the code has changed.

Run ``python benchmarks/gail_reference.py hopper walker2d --seeds 10-14 --dynamics reported --json FILE``.
"""

import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import UNUSED, Quiet, arguments_of, circumstances, collected, one_thread, save, seeds_of
from numpy.typing import NDArray

from oodil.pipeline.algorithms.gail import imitator
from oodil.pipeline.artifacts import encode_arrays
from oodil.pipeline.candidates import Candidates
from oodil.pipeline.config import EnvironmentConfig, GailConfig, ImitationConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.evaluation import evaluate
from oodil.pipeline.loading import apply_override
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stages.experts import load_expert
from oodil.pipeline.training import Probe, train

EXPERTS = Path(__file__).parents[1] / "configs" / "experts"
CURVE_POINTS = 28
CURVE_EPISODES, FINAL_EPISODES = 8, 100
NUM_CANDIDATES = ImitationConfig.model_fields["num_candidates"].default


@dataclass(frozen=True)
class Task:
    """One source of demonstrations and an imitator that can reproduce it."""

    env_id: str
    expert: str
    demonstrator: dict[str, float]
    reported: dict[str, float]
    """The imitator's dynamics that tables use."""
    choosing: dict[str, float]
    """The imitator's dynamics that constants are chosen with."""
    count: int
    target: float
    """True return that counts as solved."""
    total_steps: int
    minimum_return: float | None = None
    """Smallest return of a demonstration; without it only full-length episodes count."""


TASKS = {
    "hopper": Task(
        "oodil/Hopper-v0", "hopper-gravity-9.8", {"gravity": 9.8},
        {"gravity": 12.0}, {"gravity": 11.0}, 10, 2900, 700_000,
    ),
    "walker2d": Task(
        "oodil/Walker2d-v0", "walker2d-friction-9.9", {"friction": 9.9},
        {"friction": 19.9}, {"friction": 15.0}, 50, 2000, 1_000_000,
    ),
    "half_cheetah": Task(
        "oodil/HalfCheetah-v0", "half-cheetah-back-0.9", {"front": 1.0, "back": 0.9},
        {}, {"front": 0.95, "back": 0.95}, 100, 3000, 1_500_000,
    ),
    "driving": Task(
        "oodil/Driving-v0", "hand-written", {"obstacle_1": 0.5, "obstacle_2": 0.25, "speed": 1.0},
        {"obstacle_1": 0.4, "obstacle_2": 0.25, "speed": 1.0}, {"obstacle_1": 0.3, "obstacle_2": 0.2, "speed": 1.0},
        50, -500, 1_000_000, -500,
    ),
    "panda": Task(
        "oodil/Panda20Hz-v0", "hand-written", {"joint_1": 0},
        {"joint_1": 0, "joint_3": 0}, {"joint_1": 0, "joint_5": 0}, 140, 500, 500_000, 500,
    ),
    "panda_elbow": Task(
        "oodil/Panda20Hz-v0", "hand-written", {"joint_4": 0},
        {"joint_1": 0, "joint_3": 0, "joint_4": 0}, {"joint_1": 0, "joint_4": 0}, 90, 500, 500_000, 500,
    ),
}  # fmt: skip


def demonstrations_of(task: Task, seed: int) -> Demonstrations:
    """Collect the demonstrations of a task."""
    expert = None if task.expert == "hand-written" else load_expert(EXPERTS / task.expert)[0]
    environment = EnvironmentConfig(id=task.env_id, dynamics={**task.demonstrator})
    return collected(expert, environment, 0, task.count, seed, task.minimum_return)


def run_seed(name: str, dynamics: str, seed: int, config: GailConfig, keep: Path | None) -> dict[str, Any]:
    """Train one imitator."""
    one_thread()
    task = TASKS[name]
    target: dict[str, float] = getattr(task, dynamics)
    demonstrations = demonstrations_of(task, seed)
    spec, weights = environment_spec(task.env_id, target), np.ones(len(demonstrations))
    learner = imitator(
        spec.observation_dim, spec.action_dim, spec.max_episode_steps, demonstrations, weights, config, seed
    )
    key = derive_key(seed, "benchmark")
    measuring = 0.0
    started = time.perf_counter()

    def measure() -> NDArray[np.float64]:
        nonlocal measuring
        begun = time.perf_counter()
        policy = learner.behavior_policy()
        mean = evaluate(policy, task.env_id, target, CURVE_EPISODES, key)
        sampled = evaluate(policy, task.env_id, target, CURVE_EPISODES, key, stochastic=True)
        measuring += time.perf_counter() - begun
        return np.array([mean.mean_return, sampled.mean_return, float(np.exp(policy.log_std).mean())])

    environment = EnvironmentConfig(id=task.env_id, dynamics={**target})
    candidates = Candidates(learner, environment, NUM_CANDIDATES)
    probes = [Probe("return", CURVE_POINTS, measure), candidates.probe]
    history = train(learner, environment, config, probes, Quiet(), UNUSED)
    seconds = time.perf_counter() - started - measuring
    steps, curve = history.steps("return"), history.values("return")
    reached = np.flatnonzero(curve[:, 0] >= task.target)
    last = evaluate(learner.behavior_policy(), task.env_id, target, FINAL_EPISODES, key)
    kept_after = candidates.keep_closest(history)
    policy = learner.behavior_policy()
    final = evaluate(policy, task.env_id, target, FINAL_EPISODES, key)
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
        (keep / f"{name}-{dynamics}-{seed}.safetensors").write_bytes(encode_arrays(policy.arrays()))
    return {
        "task": name,
        "seed": seed,
        "demonstrator": task.demonstrator,
        "imitator": target,
        "target": task.target,
        "demonstrations_return": float(demonstrations.returns.mean()),
        "steps_to_target": int(steps[reached[0]]) if reached.size else None,
        "kept_after": kept_after,
        "last_return": last.mean_return,
        "final_return": final.mean_return,
        "final_share": float((final.returns >= task.target).mean()),
        "sampled_return": float(curve[-1, 1]),
        "seconds": round(seconds, 1),
        "curve": {"env_steps": steps.tolist(), "mean": curve[:, 0].round(1).tolist(),
                  "sampled": curve[:, 1].round(1).tolist(), "std": curve[:, 2].round(3).tolist()},
    }  # fmt: skip


def finished(path: Path | None, asked: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the results that a file has from earlier calls; one of other settings or libraries is refused."""
    if path is None or not path.exists():
        return []
    found: dict[str, Any] = json.loads(path.read_text())
    for key in ("dynamics", "set", "versions"):
        if found[key] != asked[key]:
            raise SystemExit(f"{path}: was made with {key} {found[key]}, not {asked[key]}; choose another file")
    seeds: list[dict[str, Any]] = found["seeds"]
    return seeds


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; all without one")
    parser.add_argument("--dynamics", choices=["choosing", "reported"], default="choosing")
    parser.add_argument("--seeds", type=seeds_of, default=range(5), metavar="A-B")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="fields of the training")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="write the trained policies to this folder")
    arguments = parser.parse_args()
    found = circumstances() | {"dynamics": arguments.dynamics, "set": arguments.set}
    results = finished(arguments.json, found)
    known = {(result["task"], result["seed"]) for result in results}
    jobs = []
    for name in arguments.tasks or TASKS:
        values: dict[str, Any] = {"total_steps": TASKS[name].total_steps}
        for each in arguments.set:
            apply_override(values, each)
        config = GailConfig.model_validate(values)
        left = [seed for seed in arguments.seeds if (name, seed) not in known]
        jobs += [(name, arguments.dynamics, seed, config, arguments.keep) for seed in left]
    with ProcessPoolExecutor(arguments.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        for future in [pool.submit(run_seed, *job) for job in jobs]:
            results.append(future.result() | {"time": found["machine"]["time"]})
            print({name: value for name, value in results[-1].items() if name != "curve"}, flush=True)
            save(arguments.json, found | {"seeds": results})
    for name in arguments.tasks or TASKS:
        seen = [result for result in results if result["task"] == name]
        reached = [result["steps_to_target"] or float("inf") for result in seen]
        print(
            f"{name}: median steps to {TASKS[name].target:,.0f}: {median(reached):,.0f}; final return mean "
            f"{np.mean([result['final_return'] for result in seen]):,.0f}, worst "
            f"{min(result['final_return'] for result in seen):,.0f}; starts solved, worst seed "
            f"{min(result['final_share'] for result in seen):.0%}"
        )


if __name__ == "__main__":
    main()
